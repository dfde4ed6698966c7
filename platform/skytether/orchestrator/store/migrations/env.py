"""What Alembic runs: over a connection that the orchestrator hands in, or one made from ``sqlalchemy.url``."""

from alembic import context
from sqlalchemy import Connection, create_engine

from skytether.orchestrator.store.models import metadata


def migrate(connection: Connection) -> None:
    context.configure(connection=connection, target_metadata=metadata, render_as_batch=True)
    with context.begin_transaction():
        context.run_migrations()


handed_in = context.config.attributes.get("connection")
if handed_in is not None:
    migrate(handed_in)
else:
    with create_engine(context.config.get_main_option("sqlalchemy.url") or "").begin() as own:
        migrate(own)
