"""The licences of all that requirements.lock names, as a page of the documentation; what is installed says them.

make licences
"""

from __future__ import annotations

import re
import sys
from importlib.metadata import PackageMetadata, PackageNotFoundError, metadata
from pathlib import Path

LOCK = Path(__file__).parents[1] / "requirements.lock"
NOT_INSTALLED = {"atheris": "Apache-2.0", "colorama": "BSD-3-Clause", "pywin32": "PSF-2.0"}
"""What says nothing itself, or is for other systems only."""
CLOSER_LOOK = re.compile(r"GPL|General Public|MPL|Mozilla|EPL|Eclipse|Proprietary|any-OSI")
"""Licences that ask for more than a notice."""
NOTES = {
    "apsw": "used by rosbags; its user chooses any licence that the OSI approved",
    "certifi": "a list of authorities; unchanged",
    "docutils": "for `make site`; only its modes for Emacs are under the GPL",
    "eclipse-zenoh": "its user chooses Apache-2.0",
    "psycopg": "extra `postgres`; LGPL: used unchanged as a library, replaceable",
    "psycopg-binary": "extra `postgres`; LGPL: used unchanged as a library, replaceable",
    "tqdm": "extra `follow-in-front`, asked for by LiteRT, which only its tools use; unchanged",
}
_HEAD = """\
# Licences

Of all packages of `requirements.lock`, those for tests and tools included; made by `make licences` from
what the packages say of themselves. Skytether is under Apache-2.0.
"""


def pins() -> list[tuple[str, str]]:
    """Name and version of each, as the lock file has them; some have two, for different Pythons."""
    return re.findall(r"^([a-z0-9][a-z0-9._-]*)==(\S+)", LOCK.read_text(), re.MULTILINE)


def licence(name: str) -> str:
    """What the installed package says; the newest way of saying it first."""
    if name in NOT_INSTALLED:
        return NOT_INSTALLED[name]
    try:
        said: PackageMetadata = metadata(name)
    except PackageNotFoundError:
        return "not installed here"
    classifiers = [line.split(" :: ")[-1] for line in said.get_all("Classifier") or () if line.startswith("License ::")]
    text = said["License-Expression"] if "License-Expression" in said else "; ".join(classifiers)
    return text or said.json.get("license", "").partition("\n")[0] or "says none"


def page() -> str:
    """All of them; first those at which to look."""
    rows = [(name, version, licence(name)) for name, version in pins()]
    closer = [row for row in rows if CLOSER_LOOK.search(row[2])]
    lines = [
        _HEAD,
        "## That ask for more than a notice",
        "| package | version | licence | |",
        "| --- | --- | --- | --- |",
    ]
    lines += [
        f"| {name} | {version} | {said} | {NOTES.get(name, 'a tool, or for tests')} |" for name, version, said in closer
    ]
    lines += ["", "## The others", "| package | version | licence |", "| --- | --- | --- |"]
    lines += [f"| {name} | {version} | {said} |" for name, version, said in rows if (name, version, said) not in closer]
    return "\n".join(lines) + "\n"


if __name__ == "__main__":
    sys.stdout.write(page())
