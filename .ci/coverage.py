"""What share of each room's statements the quick tests run: ``make coverage`` prints it.

What slow tests run, in processes of their own mostly, is not counted.
"""

from __future__ import annotations

import json
import sys
from collections import defaultdict
from pathlib import PurePath

ROOTS = 3
"""Parts of a path that name a room: ``platform/skytether/wire``."""


def table(document: dict[str, dict[str, dict[str, dict[str, int]]]]) -> str:
    """A line for each room, the least covered first, and one for all."""
    rooms: dict[str, list[int]] = defaultdict(lambda: [0, 0])
    for path, file in document["files"].items():
        for room in ("/".join(PurePath(path).parent.parts[:ROOTS]), "all"):
            rooms[room][0] += file["summary"]["num_statements"]
            rooms[room][1] += file["summary"]["covered_lines"]
    shares = {room: (covered / statements, statements) for room, (statements, covered) in rooms.items() if statements}
    rows = sorted(shares.items(), key=lambda row: (row[0] == "all", row[1]))
    return "".join(f"{share:6.1%} of {statements:6,} statements  {room}\n" for room, (share, statements) in rows)


if __name__ == "__main__":
    sys.stdout.write(table(json.load(sys.stdin)))
