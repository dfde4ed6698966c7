"""Groups of robots, and what they share."""

import sqlalchemy as sa
from alembic import op

revision = "0015"
down_revision = "0014"
branch_labels = None
depends_on = None


def upgrade() -> None:
    group = sa.Column(
        "share_group", sa.String(63), nullable=True, comment="With whom it shares what it sees; NULL: with nobody"
    )
    op.add_column("robots", group)
    op.create_table(
        "shared",
        sa.Column("robot", sa.String(length=63), nullable=False),
        sa.Column("service", sa.String(length=63), nullable=False),
        sa.Column("share_group", sa.String(length=63), nullable=False, comment="To which it was told"),
        sa.Column("at", sa.Float(), nullable=False),
        sa.Column("text", sa.Text(), nullable=False),
        sa.ForeignKeyConstraint(["robot"], ["robots.name"], name=op.f("fk_shared_robot_robots"), ondelete="CASCADE"),
        sa.PrimaryKeyConstraint("robot", "service", name=op.f("pk_shared")),
        comment="What each robot's services told the others of its group last",
    )
