"""What placement reckoned is kept; sites have a speed, a cost and allowed images."""

import sqlalchemy as sa
from alembic import op

revision = "0002"
down_revision = "0001"
branch_labels = None
depends_on = None


def upgrade() -> None:
    with op.batch_alter_table("instances") as table:
        table.add_column(sa.Column("scores", sa.JSON(), nullable=False, server_default="[]"))
    with op.batch_alter_table("sites") as table:
        table.add_column(sa.Column("speed", sa.Float(), nullable=False, server_default="1"))
        table.add_column(sa.Column("cost", sa.Float(), nullable=False, server_default="0"))
        table.add_column(sa.Column("images", sa.JSON(), nullable=False, server_default='["*"]'))
