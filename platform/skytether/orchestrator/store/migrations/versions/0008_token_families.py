"""Tokens have one successor, an end that they cannot put off, and names of their own."""

import sqlalchemy as sa
from alembic import op

revision = "0008"
down_revision = "0007"
branch_labels = None
depends_on = None

_LENGTH = 63
"""Of a name."""


def upgrade() -> None:
    op.add_column("tokens", sa.Column("family", sa.String(length=16), nullable=False, server_default=""))
    op.add_column("tokens", sa.Column("ends_at", sa.Float(), nullable=True, comment="NULL: never"))
    successor = sa.Column("successor", sa.String(length=16), nullable=True, comment="NULL: it was not renewed")
    op.add_column("tokens", successor)
    comment = "Robot and name, of one token at a time; NULL: it was renewed"
    op.add_column("tokens", sa.Column("handle", sa.String(length=127), nullable=True, comment=comment))
    # Which were made from which is not known: each is a family of its own.
    op.execute("UPDATE tokens SET family = id, ends_at = expires_at")
    taken = set()
    connection = op.get_bind()
    rows = connection.execute(sa.text("SELECT id, name, robot FROM tokens ORDER BY created_at DESC, id")).all()
    for id_, name, robot in rows:
        kept = name if (robot, name) not in taken else f"{name[: _LENGTH - 1 - len(id_)]}-{id_}"
        taken.add((robot, kept))
        change = sa.text("UPDATE tokens SET name = :name, handle = :handle WHERE id = :id")
        connection.execute(change, {"name": kept, "handle": f"{robot or ''}/{kept}", "id": id_})
    op.create_index(op.f("ix_tokens_family"), "tokens", ["family"])
    op.create_index(op.f("ix_tokens_handle"), "tokens", ["handle"], unique=True)
