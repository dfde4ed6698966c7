"""Who wants to hide what they did: by a flood, by writing in the file, by taking lines away."""

from __future__ import annotations

import asyncio
import json
import logging
import os
import socket
import stat
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from typer.testing import CliRunner

from skytether.cli.app import app
from skytether.orchestrator.config.settings import Logs, Settings
from skytether.orchestrator.domain.errors import InvalidError
from skytether.orchestrator.domain.validation import parse
from skytether.orchestrator.telemetry import logs
from skytether.orchestrator.telemetry.audit import AuditError, ChainFile, Journal, Sink, verify
from skytether.orchestrator.telemetry.logs import Audit, JsonFormatter, set_up


def written(path: Path, numbers: range, **more: Any) -> None:
    file = ChainFile(path, **more)
    file.setFormatter(JsonFormatter())
    for n in numbers:
        record = logging.LogRecord("skytether.audit", logging.INFO, "", 0, "did %d", (n,), None)
        record.fields = {"who": "operator", "path": f"/\ud800{n}"}
        file.handle(record)
    file.close()


def test_lines_vouch_for_one_another_over_restarts_and_full_files(tmp_path: Path) -> None:
    path = tmp_path / "audit"
    for start in (0, 10, 20):
        written(path, range(start, start + 10), full=2000)
    assert len(list(tmp_path.glob("audit.0*"))) > 1
    checked = verify(path)
    assert (checked.lines, checked.first) == (30, 1)
    assert {stat.S_IMODE(file.stat().st_mode) for file in tmp_path.iterdir()} == {0o600}
    (tmp_path / "audit.000001").unlink()  # moved to an archive
    assert verify(path).first > 1


@pytest.mark.parametrize(
    "attack", ["changed", "away", "put in", "swapped", "twice", "spaced", "deep", "no json", "file away"]
)
def test_what_was_done_to_the_file_is_found(tmp_path: Path, attack: str) -> None:
    path = tmp_path / "audit"
    written(path, range(40), full=3000)
    lines = path.read_text().splitlines()
    assert len(lines) > 3
    if attack == "changed":
        lines[1] = lines[1].replace("operator", "somebody")
    elif attack == "away":
        del lines[1]
    elif attack == "put in":
        lines.insert(1, lines[1])
    elif attack == "swapped":
        lines[1:3] = reversed(lines[1:3])
    elif attack == "twice":  # JSON takes the last
        lines[1] = '{"who": "somebody", ' + lines[1][1:]
    elif attack == "spaced":
        lines[1] = lines[1].replace(": ", ":  ")
    elif attack == "deep":
        lines[1] = '{"a": ' * 50_000
    elif attack == "no json":
        lines[1] = "{}"
    else:
        (tmp_path / "audit.000002").unlink()
    path.write_text("\n".join(lines) + "\n")
    with pytest.raises(AuditError, match=r"line \d+: (not as|something)"):
        verify(path)
    result = CliRunner().invoke(app, ["orchestrator", "audit", "verify", str(path)])
    assert result.exit_code == 1


def test_an_end_that_was_cut_off_shows_by_a_hash_noted_elsewhere(tmp_path: Path) -> None:
    path = tmp_path / "audit"
    written(path, range(5))
    noted = verify(path).last_hash
    runner = CliRunner()
    shown = runner.invoke(app, ["orchestrator", "audit", "verify", str(path), "--last", noted])
    assert shown.exit_code == 0
    assert noted in shown.output
    path.write_text("".join(line + "\n" for line in path.read_text().splitlines()[:3]))
    verify(path)
    with pytest.raises(AuditError, match="cut off"):
        verify(path, noted)


def test_half_a_line_is_taken_off_and_the_chain_goes_on(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    path = tmp_path / "audit"
    written(path, range(3))
    with path.open("a") as file:
        file.write('{"n": 4, "bef')
    written(path, range(3, 6))
    assert verify(path).lines == 6
    assert "cut off" in caplog.text


def test_what_an_older_version_wrote_is_put_aside(tmp_path: Path) -> None:
    path = tmp_path / "audit"
    path.write_text('{"who": "operator"}\n')
    path.chmod(0o644)
    written(path, range(2))
    assert verify(path).lines == 2
    assert (tmp_path / "audit.before-chain").read_text() == '{"who": "operator"}\n'


def test_two_do_not_write_one_file_and_a_link_is_not_followed(tmp_path: Path) -> None:
    first = ChainFile(tmp_path / "audit")
    with pytest.raises(OSError, match="another orchestrator"):
        ChainFile(tmp_path / "audit")
    first.close()
    (tmp_path / "link").symlink_to(tmp_path / "audit")
    with pytest.raises(OSError, match="symbolic link"):
        ChainFile(tmp_path / "link")


def test_on_a_full_disk_the_line_is_in_the_log_and_the_chain_has_no_gap(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    path, write = tmp_path / "audit", os.write
    written(path, range(2))
    monkeypatch.setattr("os.write", lambda file, data: write(file, data[:20]))
    written(path, range(2, 4))
    monkeypatch.undo()
    assert "takes no line (no space left): did 3" in caplog.text
    written(path, range(4, 6))
    assert verify(path).lines == 4


def test_what_is_no_file_stays_as_it_is(tmp_path: Path) -> None:
    os.mkfifo(tmp_path / "pipe", 0o644)
    with pytest.raises(OSError, match="no plain file"):
        ChainFile(tmp_path / "pipe")
    assert stat.S_IMODE((tmp_path / "pipe").stat().st_mode) & 0o044


@pytest.fixture
def loggers() -> Iterator[None]:
    yield
    for handler in list(logs.audit.handlers):
        logs.audit.removeHandler(handler)
        handler.close()
    logs.audit.propagate = True


def ask(audit: Audit, path: str, who: str | None, status: int, method: str | None = None) -> None:
    scope: dict[str, Any] = {
        "type": "http",
        "method": method or ("GET" if status == 401 else "DELETE"),
        "path": path,
        "client": ("192.0.2.1", 1),
    }
    scope["state"] = {"who": who} if who else {}

    async def nothing(*_: Any) -> Any:
        return None

    asyncio.run(audit(scope, nothing, nothing))


def answering(status: int) -> Any:
    async def answer(scope: Any, receive: Any, send: Any) -> None:
        await send({"type": "http.response.start", "status": status, "headers": []})

    return answer


def test_a_flood_of_strangers_takes_nothing_out_of_the_audit(
    tmp_path: Path, loggers: None, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    path = tmp_path / "audit"
    monkeypatch.setattr(logging, "basicConfig", lambda **_: None)
    set_up(Logs(audit_file=path))
    now = [0.0]
    ask(Audit(answering(204)), "/api/v1/sites/edge", "operator", 204)
    flood = Audit(answering(401), lambda: now[0])
    with caplog.at_level(logging.INFO, "skytether.strangers"):
        for n in range(1300):
            ask(flood, f"/{n}/" + "a" * 60_000, None, 401)
        now[0] = 60.0
        ask(flood, "/once-more", None, 401)
    told = [record for record in caplog.records if record.name == "skytether.strangers"]
    assert len(told) == 101
    assert max(len(record.getMessage()) for record in told) < 400
    assert vars(told[-1])["fields"]["left_out"] == 1200
    (line,) = [json.loads(text) for text in path.read_text().splitlines()]
    assert (line["who"], line["path"]) == ("operator", "/api/v1/sites/edge")
    assert stat.S_IMODE(path.stat().st_mode) == 0o600


@pytest.mark.parametrize("status", [403, 404, 409, 413, 422, 503])
def test_a_robot_that_is_refused_all_the_time_fills_no_disk(
    tmp_path: Path, loggers: None, monkeypatch: pytest.MonkeyPatch, status: int
) -> None:
    """What is not there, say: thirty long lines a second of it would be 1.5 GB a day, of which none is deleted."""
    path = tmp_path / "audit"
    monkeypatch.setattr(logging, "basicConfig", lambda **_: None)
    set_up(Logs(audit_file=path))
    hostile = Audit(answering(status), lambda: 0.0)
    for n in range(500):
        ask(hostile, f"/api/v1/robots/r{n}", "robot:hostile", status)
    ask(hostile, "/api/v1/robots/other", "robot:other", status)
    lines = [json.loads(text) for text in path.read_text().splitlines()]
    assert [line["who"] for line in lines] == ["robot:hostile"] * 60 + ["robot:other"]


def test_what_every_robot_does_all_the_time_is_no_line(
    tmp_path: Path, loggers: None, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A hundred robots of a group that share once a second would write 3.7 GB a day."""
    path = tmp_path / "audit"
    monkeypatch.setattr(logging, "basicConfig", lambda **_: None)
    set_up(Logs(audit_file=path))
    for does in ("renew", "share", "session"):
        ask(Audit(answering(200)), f"/api/v1/instances/i1/{does}", "robot:walker", 200, "POST")
    (line,) = [json.loads(text) for text in path.read_text().splitlines()]
    assert line["path"] == "/api/v1/instances/i1/session"


def test_the_same_lines_go_to_syslog_and_journald(tmp_path: Path) -> None:
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as listens:
        listens.bind(str(tmp_path / "s"))
        for sink, mark in ((Sink(str(tmp_path / "s")), b"<85>skytether-audit: {"), (Journal(str(tmp_path / "s")), b"")):
            sink.setFormatter(JsonFormatter())
            record = logging.LogRecord("skytether.audit", logging.INFO, "", 0, "x\ny", (), None)
            record.fields = {"who": "robot:r\n1", "status": 204}
            sink.handle(record)
            said = listens.recv(4096)
            assert said.startswith(mark)
            sink.close()
        assert b"\nSKYTETHER_STATUS=204\n" in said
        assert b"SKYTETHER_WHO" not in said  # a line break would begin a field of the caller's making
        message = said.splitlines()[-1]
        assert json.loads(message.removeprefix(b"MESSAGE="))["who"] == "robot:r\n1"


@pytest.mark.skipif(os.geteuid() != 0, reason="needs root, to give a socket away")
def test_the_audit_goes_to_no_other_users_socket(tmp_path: Path) -> None:
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as listens:
        listens.bind(str(tmp_path / "s"))
        os.chown(tmp_path / "s", 54_321, 54_321)
        with pytest.raises(PermissionError, match="may not have the audit: it is the user 54321"):
            Sink(str(tmp_path / "s"))


def test_a_log_of_the_system_that_takes_nothing_holds_nobody_up(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as listens:
        listens.bind(str(tmp_path / "s"))
        sink = Sink(str(tmp_path / "s"))
        sink.setFormatter(JsonFormatter())
        for _ in range(2000):
            sink.handle(logging.LogRecord("skytether.audit", logging.INFO, "", 0, "x", (), None))
    assert "not taken" in caplog.text
    assert len(caplog.records) < 20
    sink.close()


@pytest.mark.parametrize("wrong", ["/dev/log", "udp:host.example:514", "udp:192.0.2.1", "tcp:192.0.2.1:514", "unix:x"])
def test_where_syslog_is_must_be_said_so(wrong: str) -> None:
    with pytest.raises(InvalidError, match="audit_syslog"):
        parse(Settings, {"logs": {"audit_syslog": wrong}}, "")
