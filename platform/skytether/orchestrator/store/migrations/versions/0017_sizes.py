"""What instances have of their sites, where that is not what their manifests say any more."""

import sqlalchemy as sa
from alembic import op

revision = "0017"
down_revision = "0016"
branch_labels = None
depends_on = None


def upgrade() -> None:
    size = sa.Column("size", sa.JSON(none_as_null=True), comment="What it has; NULL: what its manifest says")
    resize = sa.Column("resize", sa.JSON(none_as_null=True), comment="What it is to have instead; NULL: nothing else")
    op.add_column("instances", size)
    op.add_column("instances", resize)
