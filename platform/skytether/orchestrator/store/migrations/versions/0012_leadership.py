"""Who leads, and in which epoch."""

import sqlalchemy as sa
from alembic import op

revision = "0012"
down_revision = "0011"
branch_labels = None
depends_on = None


def upgrade() -> None:
    made = op.create_table(
        "leadership",
        sa.Column("one", sa.Boolean(), nullable=False),
        sa.Column("epoch", sa.BigInteger(), nullable=False),
        sa.Column("holder", sa.String(length=16), nullable=False),
        sa.Column("until", sa.Float(), nullable=False),
        sa.PrimaryKeyConstraint("one", name=op.f("pk_leadership")),
        comment="One row: who leads, until when by the database's clock, and whose leader may still change something",
    )
    op.bulk_insert(made, [{"one": True, "epoch": 0, "holder": "", "until": 0.0}])
    # Orchestrators of the schema before lead by a lock of the server, look once a second whether there is a newer
    # schema, and know nothing of this row: nobody leads by it before they have seen it. In a new database are none.
    if op.get_bind().dialect.name == "postgresql":
        op.execute(
            "UPDATE leadership SET until = extract(epoch FROM clock_timestamp()) + 2 WHERE EXISTS (SELECT 1 FROM sites)"
        )
