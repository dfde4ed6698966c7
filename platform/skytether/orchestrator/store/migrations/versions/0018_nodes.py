"""Machines that join by themselves, and sites whose instances are moved elsewhere."""

import sqlalchemy as sa
from alembic import op

revision = "0018"
down_revision = "0017"
branch_labels = None
depends_on = None


def upgrade() -> None:
    evacuating: sa.Column[bool] = sa.Column(
        "evacuating",
        sa.Boolean(),
        nullable=False,
        server_default=sa.false(),
        comment="What runs there is moved elsewhere",
    )
    op.add_column("sites", evacuating)
    op.create_table(
        "nodes",
        sa.Column("site", sa.String(length=63), nullable=False),
        sa.Column("serial", sa.String(length=40), nullable=False, comment="Of the certificate that it showed last"),
        sa.Column("ends_at", sa.Float(), nullable=False),
        sa.Column(
            "next_serial",
            sa.String(length=40),
            nullable=True,
            comment="Of the one that it was given and has not shown yet",
        ),
        sa.Column(
            "follow",
            sa.Boolean(),
            nullable=False,
            comment="Whether the address of the site is the machine's present one",
        ),
        sa.Column("joined_at", sa.Float(), nullable=False),
        sa.Column("seen_at", sa.Float(), nullable=False),
        sa.Column("seen_as", sa.String(length=64), nullable=False, comment="Address that its connections come from"),
        sa.Column("machine", sa.JSON(), nullable=False),
        sa.ForeignKeyConstraint(["site"], ["sites.name"], name=op.f("fk_nodes_site_sites"), ondelete="CASCADE"),
        sa.PrimaryKeyConstraint("site", name=op.f("pk_nodes")),
        comment="Machines that joined, and which certificates of theirs are good: no others are",
    )
    op.create_table(
        "invitations",
        sa.Column("id", sa.String(length=16), nullable=False),
        sa.Column("prefix", sa.String(length=16), nullable=False),
        sa.Column("sha256", sa.String(length=64), nullable=False),
        sa.Column("site", sa.JSON(), nullable=False, comment="As it is to be"),
        sa.Column("name", sa.String(length=63), nullable=False),
        sa.Column("by", sa.String(length=80), nullable=False),
        sa.Column("created_at", sa.Float(), nullable=False),
        sa.Column("expires_at", sa.Float(), nullable=False),
        sa.Column("used_at", sa.Float(), nullable=True, comment="NULL: it is good"),
        sa.Column("used_from", sa.String(length=64), nullable=True),
        sa.Column(
            "used_key",
            sa.String(length=64),
            nullable=True,
            comment="SHA-256 of the public key that got a certificate",
        ),
        sa.PrimaryKeyConstraint("id", name=op.f("pk_invitations")),
        comment="Tokens with which a machine may join, once",
    )
    op.create_index(op.f("ix_invitations_prefix"), "invitations", ["prefix"])
