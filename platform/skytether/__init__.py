"""Skytether: a robot's heavy computing elsewhere, tied to the robot by a bridge that holds.

Nothing lives here but the version; see ``docs/architecture.md`` for what each package is for.
"""

__version__ = "0.1.0"
