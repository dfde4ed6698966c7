"""Orders to robots to stop."""

import sqlalchemy as sa
from alembic import op

revision = "0009"
down_revision = "0008"
branch_labels = None
depends_on = None


def upgrade() -> None:
    op.create_table(
        "stops",
        sa.Column("robot", sa.String(length=63), nullable=False),
        sa.Column("id", sa.String(length=32), nullable=False),
        sa.Column("at", sa.Float(), nullable=False),
        sa.Column("reason", sa.String(length=200), nullable=False),
        sa.Column("by", sa.String(length=80), nullable=False),
        sa.Column("acknowledged_at", sa.Float(), nullable=True),
        sa.ForeignKeyConstraint(["robot"], ["robots.name"], name=op.f("fk_stops_robot_robots"), ondelete="CASCADE"),
        sa.PrimaryKeyConstraint("robot", name=op.f("pk_stops")),
        comment="The last order to each robot to stop",
    )
