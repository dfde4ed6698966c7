"""What robots say of their gates."""

import sqlalchemy as sa
from alembic import op

revision = "0010"
down_revision = "0009"
branch_labels = None
depends_on = None


def upgrade() -> None:
    op.create_table(
        "gates",
        sa.Column("robot", sa.String(length=63), nullable=False),
        sa.Column("at", sa.Float(), nullable=False),
        sa.Column("report", sa.JSON(), nullable=False),
        sa.ForeignKeyConstraint(["robot"], ["robots.name"], name=op.f("fk_gates_robot_robots"), ondelete="CASCADE"),
        sa.PrimaryKeyConstraint("robot", name=op.f("pk_gates")),
        comment="What each robot said last of the gate before its wheels",
    )
