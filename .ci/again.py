"""After parts of the tests that failed: run what failed once more, one at a time, and say of each what came of it.

`make test` runs tests beside others on few cores. What fails there and passes alone is a finding, the product's or the
test's, and is named at the end of the run, but one of a thousand does not hold up everybody's work.

Usage: again.py [STATUS ...]: with which the parts ended, of those that failed. Run in the folder that pytest ran in.
"""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path

MOST = 5
"""More than that did not fail by accident."""
FAILED = 1
"""Pytest's status where tests failed; with any other one it did not run them all."""
LAST_FAILED = Path(".pytest_cache/v/cache/lastfailed")


def main(statuses: list[int]) -> int:
    """The status to end with."""
    if not statuses:
        return 0
    failed = sorted(json.loads(LAST_FAILED.read_text())) if LAST_FAILED.is_file() else []
    if any(status != FAILED for status in statuses) or not 0 < len(failed) <= MOST:
        _say(f"Tests failed: {len(failed)}. At most {MOST} are run again, and only if all parts ran to their end.")
        return 1
    _say(f"What failed is run once more, one at a time: {len(failed)} ...")
    if subprocess.run([sys.executable, "-m", "pytest", *failed]).returncode:
        _say("It failed alone, too.")
        return 1
    _say("They passed. Each is a finding all the same, for the product is wrong, or the test:")
    for name in failed:
        _say(f"  failed beside others, passed alone: {name}")
    return 0


def _say(line: str) -> None:
    sys.stdout.write(f"{line}\n")
    sys.stdout.flush()


if __name__ == "__main__":
    sys.exit(main([int(status) for status in sys.argv[1:]]))
