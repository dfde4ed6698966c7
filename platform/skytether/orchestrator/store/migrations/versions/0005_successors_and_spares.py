"""Instances that replace others, and warm ones that are nobody's yet."""

import sqlalchemy as sa
from alembic import op

revision = "0005"
down_revision = "0004"
branch_labels = None
depends_on = None


def upgrade() -> None:
    op.add_column("instances", sa.Column("replaces", sa.String(length=32), nullable=True))
    op.add_column("instances", sa.Column("pinned", sa.String(length=63), nullable=True))
    op.add_column("instances", sa.Column("spare", sa.Boolean(), nullable=False, server_default=sa.false()))
    op.create_index(op.f("ix_instances_replaces"), "instances", ["replaces"])
