"""What runtimes of containers have in common: pure, data in and data out."""

from __future__ import annotations

import secrets
from pathlib import Path
from typing import Any

from skytether.api.manifest import ServiceSpec

USER = 65_532
"""Who every service is, and who owns its files; nobody on the machine."""
INNER_PORT = 7600
"""UDP port inside the container; robots are told the one by which it is reached."""
_UNOWNED = "skytether/"
"""What the names of our own images begin with, as `make images` builds them."""
_PUBLIC = ("docker.io", "index.docker.io")
"""Whom engines ask for names without a registry."""
_SIGNALLED, _SIGNALS = 128, 64
"""An exit status above the first means the signal that is left, as far as there are any: 255 is a program's own -1."""


def with_owner(options: dict[str, Any]) -> dict[str, Any]:
    """The options of a new site, with the name under which its containers are found again."""
    return {"owner": secrets.token_hex(6), **options}


def kept_owner(folder: Path) -> str:
    """For a site whose options name none: made up at first use."""
    path = folder / "owner"
    if not path.exists():
        path.write_text(secrets.token_hex(6))
    return path.read_text().strip()


def data_name(owner: str, robot: str, service: str) -> str:
    """Of what keeps what one service writes for one robot, over all its instances.

    Names have hyphens: between two of them a dot says where the one ends, which is part of neither. Where there is no
    other hyphen there is nothing to mistake, and it has the name that it always had.
    """
    return f"skytether-{owner}-data-{robot}{'.' if '-' in robot + service else '-'}{service}"


def image_refusal(spec: ServiceSpec, *, pinned: bool) -> str | None:
    """Why a service's image is not run; None: it is."""
    if not spec.image:
        return "the service has no image, only an entrypoint: it needs a process site"
    if pinned and "@sha256:" not in spec.image:
        return f"image '{spec.image}' is named without its digest, and the site takes pinned images only"
    return None


def is_pulled(image: str) -> bool:
    """Whether a registry may be asked for a name: not for those of our own images, which nobody owns in any registry.

    Whoever registered the name there first would run code on all engines. A digest says what comes, whoever sends it.
    """
    if "@sha256:" in image:
        return True
    host, _, rest = image.partition("/")
    return not (rest if host in _PUBLIC else image).startswith(_UNOWNED)


def most_cores(spec: ServiceSpec) -> float:
    """That a container may have."""
    return spec.limits.cpu or max(1.0, spec.needs.cpu)


def most_memory_mb(spec: ServiceSpec) -> int:
    """That a container may have [MiB]; beyond it the service is killed."""
    return spec.limits.memory_mb or spec.needs.memory_mb


def exit_status(code: int) -> int:
    """As the contract has it; negative: the signal that ended it."""
    return _SIGNALLED - code if _SIGNALLED < code <= _SIGNALLED + _SIGNALS else code


def out_of_memory(limit_mb: int) -> str:
    """How a run ended that took too much [MiB]."""
    return f"ran out of memory: its limit is {limit_mb} MiB (limits.memory_mb of its manifest)"


def last_line(text: str) -> str:
    """The last line that can be read, at most 300 characters of it."""
    for line in reversed(text.split("\n")):
        readable = "".join(c for c in line if c.isprintable()).strip()
        if readable:
            return readable[:300]
    return ""
