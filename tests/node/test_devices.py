"""Through which images an engine would read what is on a machine's disk."""

from __future__ import annotations

import io
import tarfile
from itertools import count

import pytest

from skytether.node.devices import device_in


def archive(*entries: tuple[str, bytes, tuple[int, int] | bytes], form: int = tarfile.PAX_FORMAT) -> bytes:
    """Name, type, and numbers of a device or what is in a file."""
    buffer = io.BytesIO()
    with tarfile.open(fileobj=buffer, mode="w", format=form) as made:
        for name, kind, what in entries:
            entry = tarfile.TarInfo(name)
            entry.type = kind
            if isinstance(what, tuple):
                entry.devmajor, entry.devminor = what
            else:
                entry.size = len(what)
            made.addfile(entry, io.BytesIO(what) if isinstance(what, bytes) else None)
    return buffer.getvalue()


FILE, FOLDER, CHARACTERS, BLOCKS = tarfile.REGTYPE, tarfile.DIRTYPE, tarfile.CHRTYPE, tarfile.BLKTYPE
HARMLESS = (
    ("dev", FOLDER, b""),
    ("dev/null", CHARACTERS, (1, 3)),
    ("dev/ptmx", CHARACTERS, (5, 2)),
    ("pipe", tarfile.FIFOTYPE, b""),
    ("a" * 300, FILE, b"a" * 3_000_000),
    ("\xe4", tarfile.SYMTYPE, b""),
)


def found(content: bytes) -> str | None:
    return device_in(io.BytesIO(content))


def test_what_tools_leave_in_images_is_let_through() -> None:
    assert found(archive(*HARMLESS)) is None
    assert found(archive()) is None


@pytest.mark.parametrize(
    ("kind", "numbers"),
    [(BLOCKS, (8, 0)), (BLOCKS, (1, 3)), (CHARACTERS, (1, 1)), (CHARACTERS, (5, 1)), (CHARACTERS, (10, 200))],
    ids=["disk", "memory disk", "memory", "console", "tun"],
)
def test_a_file_of_a_device_is_found_wherever_it_is(kind: bytes, numbers: tuple[int, int]) -> None:
    assert found(archive(*HARMLESS, ("usr/b\n\x1b", kind, numbers), ("z", FILE, b"a"))) == "usr/b\\n\\x1b is a device"
    deep = archive(("a/" * 500 + "disk", kind, numbers))
    assert str(found(deep)).endswith("is a device")


def test_what_is_no_head_is_taken_for_none() -> None:
    """A file may hold what looks like one."""
    inner = archive(("disk", BLOCKS, (8, 0)))
    assert found(archive(("a", FILE, inner))) is None
    assert found(archive(("a", FILE, inner), ("b", BLOCKS, (8, 0)))) == "b is a device"


def test_where_an_engine_may_have_left_something_out_there_is_no_telling() -> None:
    assert str(found(archive(("a/" * 1900, FOLDER, b"")))).endswith("is at a path that is too long")
    assert str(found(archive(("a/" * 1900, FOLDER, b""), form=tarfile.GNU_FORMAT))).endswith("too long")


def test_a_length_that_is_told_elsewhere_is_not_believed() -> None:
    entry = tarfile.TarInfo("a")
    entry.pax_headers = {"size": "9000000000"}
    buffer = entry.tobuf(tarfile.PAX_FORMAT)
    assert str(found(buffer + bytes(1024))).endswith("is too large")


@pytest.mark.parametrize(
    ("content", "why"),
    [
        (archive(*HARMLESS)[:1_000_000], "half of an archive"),
        (archive(("a", FOLDER, b""))[:512], "half of an archive"),
        (b"", "half of an archive"),
        (b"a" * 512, "no archive"),
        (archive(("a", FOLDER, b"")) + b'{"message": "no"}', "something else after an archive"),
        (archive(("a", FOLDER, b"")) + archive(("disk", BLOCKS, (8, 0))), "something else after an archive"),
    ],
)
def test_what_is_not_whole_is_no_answer(content: bytes, why: str) -> None:
    with pytest.raises(ValueError, match=why):
        found(content)


def test_a_look_has_an_end() -> None:
    ticks = count(step=500)
    with pytest.raises(ValueError, match="more in it than can be looked at"):
        device_in(io.BytesIO(archive(*HARMLESS)), lambda: float(next(ticks)))
