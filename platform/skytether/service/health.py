"""The health check of a service's container: its loop is alive.

Run as a file, so it imports the standard library only, and of that little: it runs every few seconds beside the
service. The service touches its ready file every `BEAT_S` while no step of it hangs (see ``skytether.service.beat``).
"""

import json
import os
import sys
import time

BEAT_S = 1.0
"""Seconds between two touches."""
SILENT_S = 10.0
"""A loop that has shown no life for so long hangs."""
_GRANT_VARIABLE = "SKYTETHER_GRANT"
_DEFAULT_GRANT_PATH = "/run/skytether/grant.json"


def check(grant_path: str, now: float) -> str:
    """What is wrong with the service of this grant; empty: nothing.

    Args:
        grant_path: File with the grant.
        now: Seconds since the epoch.
    """
    try:
        with open(grant_path, "rb") as file:
            ready_file = json.load(file)["ready_file"]
        silent = now - os.stat(ready_file).st_mtime
    except (OSError, ValueError, KeyError, TypeError) as error:
        # The grant holds a key: what its text is, is told nobody.
        return f"the service is not ready: {type(error).__name__}"
    return f"the service's loop has hung for {silent:.0f} s" if silent > SILENT_S else ""


def main() -> int:
    """Exit status 0: alive; 1: not, with one sentence."""
    trouble = check(os.environ.get(_GRANT_VARIABLE, _DEFAULT_GRANT_PATH), time.time())
    print(trouble or "alive")  # noqa: T201 (the engine keeps what a health check prints)
    return 1 if trouble else 0


if __name__ == "__main__":
    sys.exit(main())
