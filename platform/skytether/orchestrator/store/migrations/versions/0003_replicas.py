"""What several orchestrators over one database share: robots' reports, and facts on which they must agree."""

import sqlalchemy as sa
from alembic import op

revision = "0003"
down_revision = "0002"
branch_labels = None
depends_on = None


def upgrade() -> None:
    op.create_table(
        "reports",
        sa.Column("instance", sa.String(length=32), nullable=False),
        sa.Column("at", sa.Float(), nullable=False),
        sa.Column("report", sa.JSON(), nullable=False),
        sa.ForeignKeyConstraint(["instance"], ["instances.id"], name=op.f("fk_reports_instance"), ondelete="CASCADE"),
        sa.PrimaryKeyConstraint("instance", name=op.f("pk_reports")),
        comment="The last of each instance's robot: any orchestrator may get it, and the one that leads exports it",
    )
    op.create_table(
        "facts",
        sa.Column("name", sa.String(length=63), nullable=False),
        sa.Column("value", sa.String(length=255), nullable=False),
        sa.PrimaryKeyConstraint("name", name=op.f("pk_facts")),
        comment="What all orchestrators over this database must agree on",
    )
