"""What containers report, read from a made-up engine; a real one is in the runtimes' contract."""

from __future__ import annotations

import base64
import bz2
import io
import json
import lzma
import tarfile
from contextlib import nullcontext
from types import SimpleNamespace
from typing import Any

import pytest

from skytether.api.service_report import MOST_BYTES, ServiceReport
from skytether.orchestrator.runtimes.base import RuntimeFailure
from skytether.orchestrator.runtimes.docker.reports import ReportReader, unpacked

ONE = {"reports": [{"number": 1, "code": "lost", "message": "here"}]}


def archive(content: bytes, kind: bytes = tarfile.REGTYPE) -> bytes:
    buffer = io.BytesIO()
    with tarfile.open(fileobj=buffer, mode="w") as tar:
        entry = tarfile.TarInfo("reports.json")
        entry.type, entry.size = kind, len(content)
        tar.addfile(entry, io.BytesIO(content))
    return buffer.getvalue()


class MadeUpEngine:
    """Has one file for each container."""

    base_url, _version, timeout = "http://engine", "1.41", 1.0
    api_version = "1.41"

    def __init__(self) -> None:
        self.files: dict[str, bytes] = {}
        self.mode = 0o600
        self.shifting: set[str] = set()
        """Containers whose files are others whenever they are fetched."""
        self.gets = 0

    def asked(self) -> Any:
        return nullcontext()

    def api(self) -> MadeUpEngine:
        return self

    def head(self, url: str, **_: Any) -> Any:
        content = self.files.get(url.split("/")[-2])
        if content is None:
            return SimpleNamespace(status_code=404, headers={})
        stat = {"name": "reports.json", "size": len(content), "mode": self.mode, "mtime": str(hash(content))}
        header = base64.b64encode(json.dumps(stat).encode()).decode()
        return SimpleNamespace(status_code=200, headers={"X-Docker-Container-Path-Stat": header})

    def fetch(self, url: str, most: int, **_: Any) -> Any:
        self.gets += 1
        if url.split("/")[-2] in self.shifting:
            raise RuntimeFailure(f"more than {most} bytes")
        return SimpleNamespace(status_code=200, content=archive(self.files[url.split("/")[-2]]))


@pytest.fixture
def engine() -> MadeUpEngine:
    return MadeUpEngine()


def reader(engine: Any) -> ReportReader:
    return ReportReader(engine, lambda: ["c1", "c2"])


def test_a_file_is_read_when_it_changed_only(engine: MadeUpEngine) -> None:
    engine.files["c1"] = json.dumps(ONE).encode()
    read = reader(engine)
    read.refresh()
    read.refresh()
    assert (read.of("c1"), read.of("c2"), engine.gets) == ((ServiceReport(1, "lost", "here"),), (), 1)
    engine.files["c1"] = json.dumps(ONE).replace("here", "there").encode()
    read.refresh()
    assert [report.message for report in read.of("c1")] == ["there"]
    del engine.files["c1"]
    read.refresh()
    assert read.of("c1") == ()


def test_a_file_that_changes_while_it_is_fetched_keeps_no_other_from_being_read(engine: MadeUpEngine) -> None:
    engine.files["c1"] = engine.files["c2"] = json.dumps(ONE).encode()
    read = reader(engine)
    read.refresh()
    engine.files = {"c1": b"{}", "c2": json.dumps(ONE).replace("here", "there").encode()}
    engine.shifting = {"c1"}
    read.refresh()
    assert [report.message for report in read.of("c2")] == ["there"]
    assert [report.message for report in read.of("c1")] == ["here"], "what was read of it before stays"


@pytest.mark.parametrize("mode", [1 << 31 | 0o700, 1 << 27 | 0o777, 1 << 25 | 0o600])
def test_what_is_no_plain_file_is_not_fetched(engine: MadeUpEngine, mode: int) -> None:
    engine.files["c1"], engine.mode = json.dumps(ONE).encode(), mode
    read = reader(engine)
    read.refresh()
    assert (read.of("c1"), engine.gets) == ((), 0)


def test_what_is_too_large_is_not_fetched(engine: MadeUpEngine) -> None:
    engine.files["c1"] = b" " * MOST_BYTES + json.dumps(ONE).encode()
    read = reader(engine)
    read.refresh()
    assert (read.of("c1"), engine.gets) == ((), 0)


@pytest.mark.parametrize(
    "content",
    [
        b"",
        b"no archive",
        archive(b"{"),
        archive(b"[" * 100_000),
        archive(b"", tarfile.DIRTYPE),
        archive(b"", tarfile.SYMTYPE),
        archive(b" " * (MOST_BYTES + 1)),
        bz2.compress(archive(json.dumps(ONE).encode())),  # 70 KiB could unpack to gigabytes of heads
        lzma.compress(archive(json.dumps(ONE).encode())),
    ],
)
def test_a_strange_archive_has_no_document(content: bytes) -> None:
    assert unpacked(content) is None
