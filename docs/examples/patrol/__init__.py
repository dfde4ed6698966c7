"""Example service with calls. Walked through in ``docs/writing-a-service.md``."""
