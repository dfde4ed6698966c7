"""Whether an engine would run code of an image as it packs that one's files, as root of the machine.

Docker packs them in a process of its own whose root is the image's (``docker-tar``), and looks up the names of their
owners there. For that, glibc loads a library for each service that ``nsswitch.conf`` names, out of the image. To have
them loaded before, that process looks up the user ``docker`` first (CVE-2019-14271): which loads those that are asked
until one knows that user, and none that are for groups alone.
"""

from __future__ import annotations

import pwd
import re
from pathlib import Path

_BUILT_IN = {"files"}
"""Part of glibc itself."""
_ASKED_FIRST = "docker"


def loads_late(switch: Path = Path("/etc/nsswitch.conf"), users: Path = Path("/etc/passwd")) -> str | None:
    """Why an engine would load such a library out of an image, in a sentence with what to do; None: it would not."""
    text = switch.read_text(errors="replace") if switch.exists() else ""
    by_users, by_groups = _services(text, "passwd"), _services(text, "group")
    loaded, whose = list(by_users), ""
    if _is_known(users):
        loaded, whose = (
            by_users[: by_users.index("files") + 1] if "files" in by_users else [],
            " (it has a user docker)",
        )
    late = sorted({*by_users, *by_groups} - {*loaded} - _BUILT_IN)
    if not late:
        return None
    todo = "rename that user" if whose else f"have {switch} name the same services for group as for passwd"
    return f"the engine of this machine{whose} would load libnss_{late[0]} out of an image: {todo}"


def _services(text: str, what: str) -> list[str]:
    found = re.search(rf"(?m)^\s*{what}:(.*)$", text)
    return re.sub(r"\[[^\]]*\]|#.*", " ", found[1]).split() if found else ["files"]


def _is_known(users: Path) -> bool:
    """Whether some service knows the user who is asked for first; of these the first one that does not is not told."""
    if any(line.startswith(f"{_ASKED_FIRST}:") for line in users.read_text(errors="replace").splitlines()):
        return True
    try:
        pwd.getpwnam(_ASKED_FIRST)
    except KeyError:
        return False
    return True
