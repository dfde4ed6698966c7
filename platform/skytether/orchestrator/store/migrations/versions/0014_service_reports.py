"""Events that services report."""

import sqlalchemy as sa
from alembic import op

revision = "0014"
down_revision = "0013"
branch_labels = None
depends_on = None


def upgrade() -> None:
    said = sa.Column("said", sa.Integer(), nullable=False, server_default="0", comment="See Record.said")
    code = sa.Column(
        "code", sa.String(63), nullable=False, server_default="", comment="Of what the service said; empty: our own"
    )
    op.add_column("instances", said)
    op.add_column("events", code)
