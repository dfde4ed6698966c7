"""How far the pull of an image is, beside the reason that tells it in words."""

import sqlalchemy as sa
from alembic import op

revision = "0019"
down_revision = "0018"
branch_labels = None
depends_on = None


def upgrade() -> None:
    for table in ("instances", "events"):
        comment = "How far that is; NULL: the reason tells of no pull"
        op.add_column(table, sa.Column("pull", sa.JSON(none_as_null=True), comment=comment))
