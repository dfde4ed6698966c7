"""The database's history, for Alembic; run at each start of the orchestrator.

An orchestrator of the version before may run still, and notices a second later: what it writes meanwhile must fit, so
a column that is added has a server default; what it reads and does not find it answers with 503.
"""
