"""Example service with an action. Walked through in ``docs/writing-a-service.md``."""
