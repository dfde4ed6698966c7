"""Which orchestrators are there, and where they are reached."""

import sqlalchemy as sa
from alembic import op

revision = "0020"
down_revision = "0019"
branch_labels = None
depends_on = None


def upgrade() -> None:
    op.create_table(
        "orchestrators",
        sa.Column("address", sa.String(300), primary_key=True),
        sa.Column("seen_at", sa.Float, nullable=False),
    )
