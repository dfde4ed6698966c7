"""The words of the orchestrator: records and their legal changes, errors, secrets, checks of what people wrote.

No database, no socket, no thread of its own, no setting of an operator; time is an argument, or a clock that was passed
in. What several threads ask has a lock.
"""
