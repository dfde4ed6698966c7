"""The database's history, for Alembic; run at each start of the orchestrator."""
