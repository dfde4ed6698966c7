"""Example service: drives straight on and stops before the wall. Walked through in ``docs/writing-a-service.md``."""
