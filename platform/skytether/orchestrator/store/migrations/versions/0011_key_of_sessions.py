"""With which secret key each session began."""

import sqlalchemy as sa
from alembic import op

revision = "0011"
down_revision = "0010"
branch_labels = None
depends_on = None


def upgrade() -> None:
    op.add_column("instances", sa.Column("key_id", sa.String(length=32), nullable=False, server_default=""))
