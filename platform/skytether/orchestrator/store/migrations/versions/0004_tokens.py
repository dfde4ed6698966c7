"""Tokens have a table of their own: several of a robot, those of operators with scopes, and each may expire."""

import sqlalchemy as sa
from alembic import op

revision = "0004"
down_revision = "0003"
branch_labels = None
depends_on = None


def upgrade() -> None:
    op.create_table(
        "tokens",
        sa.Column("id", sa.String(length=16), nullable=False),
        sa.Column("name", sa.String(length=63), nullable=False),
        sa.Column("robot", sa.String(length=63), nullable=True, comment="NULL: an operator's"),
        sa.Column("scopes", sa.JSON(), nullable=False),
        sa.Column("prefix", sa.String(length=16), nullable=False),
        sa.Column("sha256", sa.String(length=64), nullable=False),
        sa.Column("created_at", sa.Float(), nullable=False),
        sa.Column("expires_at", sa.Float(), nullable=True),
        sa.Column("last_used_at", sa.Float(), nullable=True),
        sa.ForeignKeyConstraint(["robot"], ["robots.name"], name=op.f("fk_tokens_robot"), ondelete="CASCADE"),
        sa.PrimaryKeyConstraint("id", name=op.f("pk_tokens")),
    )
    op.create_index(op.f("ix_tokens_prefix"), "tokens", ["prefix"])
    # The prefix begins with the mark of all tokens; what follows it is an id as good as any.
    op.execute(
        "INSERT INTO tokens (id, name, robot, scopes, prefix, sha256, created_at)"
        " SELECT substr(token_prefix, 5), name, name, '[]', token_prefix, token_sha256, created_at FROM robots"
    )
    op.drop_index(op.f("ix_robots_token_prefix"), "robots")
    # Column by column, in place: a copy of the table would cascade into the tokens.
    op.drop_column("robots", "token_prefix")
    op.drop_column("robots", "token_sha256")
