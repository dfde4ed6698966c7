"""Who got the key of a session: it is handed out once."""

import sqlalchemy as sa
from alembic import op

revision = "0007"
down_revision = "0006"
branch_labels = None
depends_on = None


def upgrade() -> None:
    comment = "SHA-256 of the claim that got the session's key; NULL: nobody did"
    op.add_column("instances", sa.Column("claim", sa.String(length=64), nullable=True, comment=comment))
