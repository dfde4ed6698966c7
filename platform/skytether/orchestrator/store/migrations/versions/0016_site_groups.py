"""Groups of sites and their machines."""

import sqlalchemy as sa
from alembic import op

revision = "0016"
down_revision = "0015"
branch_labels = None
depends_on = None


def upgrade() -> None:
    op.create_table(
        "site_groups",
        sa.Column("name", sa.String(length=63), nullable=False),
        sa.Column("asked", sa.JSON(), nullable=False),
        sa.Column("owner", sa.String(length=32), nullable=False, comment="Word by which its machines are found again"),
        sa.Column("draining", sa.Boolean(), server_default=sa.false(), nullable=False),
        sa.Column("failures", sa.Integer(), server_default="0", nullable=False),
        sa.Column("retry_at", sa.Float(), server_default="0", nullable=False),
        sa.Column("reason", sa.String(length=1024), server_default="", nullable=False),
        sa.Column("told", sa.JSON(), server_default="[]", nullable=False, comment="The last events, oldest first"),
        sa.PrimaryKeyConstraint("name", name=op.f("pk_site_groups")),
        comment="Groups of sites, whose machines are made and destroyed as they are needed",
    )
    op.create_table(
        "machines",
        sa.Column("name", sa.String(length=63), nullable=False),
        sa.Column("site_group", sa.String(length=63), nullable=False),
        sa.Column("stage", sa.String(length=16), nullable=False),
        sa.Column("since", sa.Float(), nullable=False, comment="Of the stage"),
        sa.Column("provided", sa.String(length=255), comment="The provider's id; NULL: it has not said yet"),
        sa.Column("reason", sa.String(length=1024), server_default="", nullable=False),
        sa.ForeignKeyConstraint(["site_group"], ["site_groups.name"], name=op.f("fk_machines_site_group_site_groups")),
        sa.PrimaryKeyConstraint("name", name=op.f("pk_machines")),
        comment="A row is there before its machine is made, and until that is destroyed",
    )
    op.create_index(op.f("ix_machines_site_group"), "machines", ["site_group"], unique=False)
