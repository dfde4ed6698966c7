"""What a service says of itself for people: a small file beside its ready file, which the runtime reads.

    {"reports": [{"number": 1, "code": "no_path", "message": "There is no way to the goal."}]}

Beside them ``{"step_s": 0.004}`` says that of 20 of its last steps 19 took no longer, where the orchestrator wants to
know. The newest come last, and have the highest numbers. No service is trusted: whatever is in its file, what is read
of it is bounded, and obeys no code.
"""

from __future__ import annotations

import json
import re
from collections.abc import Iterable
from dataclasses import asdict, dataclass
from typing import Any

from .printable import printable

FILE_NAME = "reports.json"
"""In the folder of the ready file."""
MOST_REPORTS = 8
"""That one file holds: the newest."""
MOST_BYTES = 64 << 10
"""Of a file that are read; with all its reports it has 20 KiB at most."""
MOST_CHARACTERS = 300
"""Of a message."""
_MOST_NUMBER = 2**31 - 1
"""That every database can hold."""
_LONGEST_S = 3600.0
_CODE = re.compile(r"[a-z][a-z0-9_]{0,62}", re.ASCII)


@dataclass(frozen=True, slots=True)
class ServiceReport:
    """One report."""

    number: int
    """Counts up from 1 in each run."""
    code: str
    """For programs."""
    message: str
    """A sentence for people."""


def is_code(text: str) -> bool:
    """Whether it may be a report's code: small letters, digits and underscores, a letter first, 63 at most."""
    return _CODE.fullmatch(text) is not None


def write_reports(reports: Iterable[ServiceReport], step_s: float | None = None) -> bytes:
    """The content of the file."""
    steps = {} if step_s is None else {"step_s": round(step_s, 6)}
    return json.dumps({"reports": [asdict(report) for report in reports], **steps}).encode()


def pull_step_s(document: object) -> float | None:
    """How long steps take, says a document that anybody may have written; None: it does not say."""
    told = document.get("step_s") if isinstance(document, dict) else None
    if isinstance(told, bool) or not isinstance(told, int | float):
        return None
    return float(told) if 0 <= told <= _LONGEST_S else None


def pull_reports(document: object) -> tuple[ServiceReport, ...]:
    """The reports of a document that anybody may have written, in the order of their numbers; none that is wrong."""
    rows = document.get("reports") if isinstance(document, dict) else None
    read = (_pull(row) for row in rows[-MOST_REPORTS:]) if isinstance(rows, list) else ()
    found = {report.number: report for report in read if report is not None}
    return tuple(found[number] for number in sorted(found))


def pull_trouble(document: object, untold: str) -> str:
    """What a service says is wrong with it, in a document that anybody may have written; empty: nothing.

    ``untold`` stands for what it does not say, as services of the time before did not.
    """
    told = document.get("trouble") if isinstance(document, dict) else None
    if not isinstance(told, str):
        return untold
    return printable(told[:MOST_CHARACTERS], lines=False)[:MOST_CHARACTERS]


def _pull(row: Any) -> ServiceReport | None:
    if not isinstance(row, dict):
        return None
    number, code, message = row.get("number"), row.get("code"), row.get("message")
    if type(number) is not int or not 0 < number <= _MOST_NUMBER:
        return None
    if not isinstance(code, str) or not is_code(code) or not isinstance(message, str):
        return None
    return ServiceReport(number, code, printable(message[:MOST_CHARACTERS], lines=False)[:MOST_CHARACTERS])
