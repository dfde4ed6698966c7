"""Sites that are to be deleted with their last instance."""

import sqlalchemy as sa
from alembic import op

revision = "0013"
down_revision = "0012"
branch_labels = None
depends_on = None


def upgrade() -> None:
    op.add_column("sites", sa.Column("draining", sa.Boolean(), nullable=False, server_default=sa.false()))
