from __future__ import annotations

import base64
import contextlib
import json
import os
import shutil
import signal
import socket
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest

from skytether.api.grant import Grant
from skytether.api.manifest import ServiceSpec
from skytether.orchestrator.domain.errors import InvalidError
from skytether.orchestrator.domain.validation import parse
from skytether.orchestrator.runtimes.base import Launch, Observation, Phase, RuntimeFailure
from skytether.orchestrator.runtimes.notes import noted_port
from skytether.orchestrator.runtimes.process import ProcessOptions, ProcessRuntime
from skytether.orchestrator.runtimes.procfs import (
    BOOT_ID,
    ProcessId,
    ProcessStat,
    find_by_environment,
    session_members,
    stat_of,
)

KEY = base64.b64encode(bytes(range(32))).decode()
NESTED = b"[" * 60_000
"""No JSON that a reader should follow."""


def launch(attempt: int = 1, entrypoint: str = "skytether.testing.toy_service", **params: Any) -> Launch:
    grant = Grant(
        instance="i1",
        service="toy",
        robot="walker",
        params=params,
        session_id="00112233445566aa",
        session_key=KEY,
        topics=(),
    )
    return Launch(attempt, ServiceSpec(entrypoint=entrypoint), grant)


Open = Callable[..., ProcessRuntime]


@pytest.fixture
def open_runtime(tmp_path: Path) -> Iterator[Open]:
    opened: list[ProcessRuntime] = []

    def make(**options: Any) -> ProcessRuntime:
        opened.append(ProcessRuntime("lab", tmp_path, ProcessOptions(**options)))
        return opened[-1]

    yield make
    for runtime in opened:
        for instance in list(runtime.observe()):
            runtime.remove(instance)
        runtime.close()


def until(runtime: ProcessRuntime, phase: Phase, patience: float = 10.0) -> Observation:
    deadline = time.monotonic() + patience
    while (seen := runtime.observe()["i1"]).phase is not phase:
        assert time.monotonic() < deadline, seen
        time.sleep(0.002)
    return seen


def pid_of(folder: Path) -> int:
    return int(json.loads((folder / "instances/i1/run.json").read_text())["process"][0])


def said(runtime: ProcessRuntime, word: str) -> str:
    """The rest of the log's line that begins with a word."""
    return next(
        line.removeprefix(word).strip() for line in runtime.logs("i1", 100).splitlines() if line.startswith(word)
    )


def alive(pid: int) -> bool:
    stat = ProcessStat.read(pid)
    return stat is not None and not stat.zombie


def test_options_that_no_robot_could_use_are_refused() -> None:
    with pytest.raises(InvalidError, match="advertise_host is needed"):
        parse(ProcessOptions, {"bind_host": "0.0.0.0"})
    with pytest.raises(InvalidError, match=r"options\.bind_hots: unknown key, did you mean 'bind_host'\?"):
        parse(ProcessOptions, {"bind_hots": "x"}, prefix=("options",))
    for wrong, text in (
        ({"bind_host": "localhost"}, "bind_host: must be an address such as 192.0.2.7, not 'localhost'"),
        ({"bind_host": "192.0.2.7", "advertise_host": "::"}, "advertise_host is needed"),
        ({"advertise_host": ""}, "advertise_host"),
        ({"folder": "relative/two"}, "folder: must be an absolute path such as .*, not 'relative/two'"),
    ):
        with pytest.raises(InvalidError, match=text):
            parse(ProcessOptions, wrong)


def test_this_process_in_proc() -> None:
    stat = ProcessStat.read(os.getpid())
    assert stat is not None
    assert stat.session == os.getsid(0)
    assert not stat.zombie
    assert stat.memory_bytes > 1 << 20
    assert stat_of(ProcessId(stat.pid, stat.start_time)) is not None
    assert stat_of(ProcessId(stat.pid, stat.start_time + 1)) is None
    assert session_members(ProcessId(stat.pid, stat.start_time + 1)) == []
    assert ProcessStat.read(2**22 + 1) is None
    assert find_by_environment("SKYTETHER_GRANT", "/nowhere") is None


def test_without_an_entry_point_it_is_refused(open_runtime: Open) -> None:
    assert "needs a container site" in (open_runtime().refuses(ServiceSpec(image="x")) or "")


def test_capacity_is_the_machines_unless_told_otherwise(open_runtime: Open) -> None:
    assert open_runtime().capacity().cpu == os.cpu_count()
    limited = open_runtime(cpu=1.5, memory_mb=64).capacity()
    assert (limited.cpu, limited.memory_mb) == (1.5, 64)


@pytest.mark.slow
def test_secrets_are_readable_by_the_owner_only_and_neither_in_arguments_nor_environment(
    open_runtime: Open, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("OPERATOR_SECRET", "s3cret")
    runtime = open_runtime(environment={"EXTRA": "1"})
    runtime.start(launch(environment=True))
    until(runtime, Phase.RUNNING)
    folder = tmp_path / "instances/i1"
    assert folder.stat().st_mode & 0o777 == 0o700
    for name in ("own/grant.json", "log", "run.json"):
        assert (folder / name).stat().st_mode & 0o777 == 0o600, name
    proc = Path("/proc") / str(pid_of(tmp_path))
    assert KEY.encode() not in (proc / "environ").read_bytes() + (proc / "cmdline").read_bytes()
    names = said(runtime, "environment").split()
    assert {"EXTRA", "SKYTETHER_GRANT"} <= set(names)
    assert "OPERATOR_SECRET" not in names


@pytest.mark.slow
def test_the_grant_holds_what_only_the_runtime_knows(open_runtime: Open, tmp_path: Path) -> None:
    runtime = open_runtime()
    runtime.start(launch(say="hello"))
    until(runtime, Phase.RUNNING)
    grant = Grant.model_validate_json((tmp_path / "instances/i1/own/grant.json").read_bytes())
    assert grant.params == {"say": "hello"}
    assert grant.session_key == KEY
    assert grant.bind_host == "127.0.0.1"
    assert Path(grant.data_dir) == tmp_path / "data/walker/toy/i1"
    assert Path(grant.data_dir).is_dir()


@pytest.mark.slow
def test_the_advertised_address_is_told_not_the_bound_one(open_runtime: Open) -> None:
    runtime = open_runtime(bind_host="0.0.0.0", advertise_host="robot-lab.example")
    runtime.start(launch())
    assert until(runtime, Phase.RUNNING).host == "robot-lab.example"


@pytest.mark.slow
def test_data_outlives_the_instance_and_empty_folders_do_not(open_runtime: Open, tmp_path: Path) -> None:
    runtime = open_runtime()
    runtime.start(launch())
    runtime.remove("i1")
    assert not (tmp_path / "data/walker").exists()
    runtime.start(launch())
    kept = tmp_path / "data/walker/toy/i1/recording.mcap"
    kept.write_bytes(b"precious")
    runtime.remove("i1")
    assert kept.read_bytes() == b"precious"


@pytest.mark.slow
def test_a_killed_process_is_seen_at_the_next_look_whoever_its_parent_is(open_runtime: Open, tmp_path: Path) -> None:
    first = open_runtime()
    first.start(launch())
    until(first, Phase.RUNNING)
    second = open_runtime()  # as after a restart: it must not depend on being the parent
    os.kill(pid_of(tmp_path), signal.SIGKILL)
    assert until(second, Phase.EXITED, patience=1.0).exit_status is None
    assert until(first, Phase.EXITED, patience=1.0).exit_status == -signal.SIGKILL


@pytest.mark.slow
def test_what_a_service_started_ends_with_it(open_runtime: Open) -> None:
    runtime = open_runtime()
    runtime.start(launch(child=True))
    until(runtime, Phase.RUNNING)
    child = int(said(runtime, "child"))
    runtime.stop("i1", force=False)
    until(runtime, Phase.EXITED)
    assert alive(child)  # it ignores the polite request
    runtime.stop("i1", force=True)
    _gone(child)


@pytest.mark.slow
def test_what_a_crashed_service_started_ends_before_its_next_run(open_runtime: Open, tmp_path: Path) -> None:
    runtime = open_runtime()
    runtime.start(launch(child=True))
    until(runtime, Phase.RUNNING)
    child = int(said(runtime, "child"))
    os.kill(pid_of(tmp_path), signal.SIGKILL)
    until(runtime, Phase.EXITED)
    runtime.start(launch(attempt=2))
    _gone(child)


def _gone(pid: int) -> None:
    deadline = time.monotonic() + 5
    while alive(pid):
        assert time.monotonic() < deadline
        time.sleep(0.002)


@pytest.mark.slow
def test_a_strangers_process_with_the_same_pid_is_not_taken_for_ours(open_runtime: Open, tmp_path: Path) -> None:
    first = open_runtime()
    first.start(launch())
    until(first, Phase.RUNNING)
    note = tmp_path / "instances/i1/run.json"
    real = note.read_text()
    document = json.loads(real)
    document["process"][1] -= 1  # as if ours had been started a tick earlier, and its pid had come again
    document["user"] = None  # without a user of its own, by which what is left of a run is known
    note.write_text(json.dumps(document))
    second = open_runtime()
    assert second.observe()["i1"].phase is Phase.EXITED
    second.stop("i1", force=True)
    second.remove("i1")
    assert alive(document["process"][0])  # it is not touched
    _put_back(tmp_path, real)
    assert first.observe()["i1"].phase is not Phase.EXITED


def _put_back(folder: Path, note: str) -> None:
    (folder / "instances/i1").mkdir()
    (folder / "instances/i1/run.json").write_text(note)


@pytest.mark.slow
def test_nothing_from_before_a_reboot_is_taken_for_alive(open_runtime: Open, tmp_path: Path) -> None:
    first = open_runtime()
    first.start(launch())
    until(first, Phase.RUNNING)
    note = tmp_path / "instances/i1/run.json"
    document = json.loads(note.read_text())
    assert document["boot"] == BOOT_ID
    note.write_text(json.dumps({**document, "boot": "another"}))
    assert open_runtime().observe()["i1"].phase is Phase.EXITED
    note.write_text(json.dumps(document))  # or it would be nobody's


@pytest.mark.slow
def test_a_run_whose_pid_was_never_noted_is_found_by_its_grant(open_runtime: Open, tmp_path: Path) -> None:
    first = open_runtime()
    first.start(launch())
    until(first, Phase.RUNNING)
    pid = pid_of(tmp_path)
    note = tmp_path / "instances/i1/run.json"
    document = json.loads(note.read_text())
    del document["process"]  # the orchestrator was killed between launch and note
    note.write_text(json.dumps(document))
    second = open_runtime()
    assert second.observe()["i1"].phase is Phase.RUNNING
    second.stop("i1", force=False)
    until(second, Phase.EXITED)
    assert not alive(pid)


def _broken(note: Path, content: str | None) -> None:
    if content is None:
        note.unlink(missing_ok=True)
    else:
        note.write_text(content)


@pytest.mark.slow
@pytest.mark.parametrize(
    "content",
    [None, "", '{"attempt": 1, "bo', "[]", '{"attempt": "x", "process": ["a", "b"]}', '{"process": [1, 2, 3]}'],
)
def test_a_run_whose_note_was_broken_is_ended_before_the_next_begins(
    open_runtime: Open, tmp_path: Path, content: str | None
) -> None:
    runtime = open_runtime()
    runtime.start(launch())
    until(runtime, Phase.RUNNING)
    pid = pid_of(tmp_path)
    for second in (runtime, open_runtime()):  # the leader that began it, and the next one
        _broken(tmp_path / "instances/i1/run.json", content)
        assert second.observe_some(["i1"])["i1"].phase is Phase.RUNNING
    second.start(launch(attempt=2))
    assert not alive(pid)
    assert until(second, Phase.RUNNING).attempt == 2
    second.remove("i1")
    assert not (tmp_path / "instances/i1").exists()


@pytest.mark.slow
def test_a_run_whose_folder_was_deleted_is_ended_before_the_next_begins(open_runtime: Open, tmp_path: Path) -> None:
    runtime = open_runtime()
    runtime.start(launch())
    until(runtime, Phase.RUNNING)
    pid = pid_of(tmp_path)
    shutil.rmtree(tmp_path / "instances/i1")
    assert runtime.observe()["i1"].phase is not Phase.EXITED
    runtime.start(launch(attempt=2))
    assert not alive(pid)
    until(runtime, Phase.RUNNING)
    pid = pid_of(tmp_path)
    shutil.rmtree(tmp_path / "instances/i1")
    runtime.remove("i1")
    assert not alive(pid)
    assert runtime.observe() == {}


@pytest.mark.slow
def test_a_port_that_another_has_taken_meanwhile_is_not_asked_for(open_runtime: Open) -> None:
    runtime = open_runtime()
    runtime.start(launch())
    port = until(runtime, Phase.RUNNING).port
    runtime.stop("i1", force=True)
    until(runtime, Phase.EXITED)
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as other:
        other.bind(("127.0.0.1", port))
        runtime.start(launch(attempt=2))
        assert until(runtime, Phase.RUNNING).port != port


@pytest.mark.slow
def test_the_port_is_kept_over_a_run_that_never_got_ready(open_runtime: Open) -> None:
    runtime = open_runtime()
    runtime.start(launch())
    port = until(runtime, Phase.RUNNING).port
    runtime.stop("i1", force=True)
    runtime.start(launch(attempt=2, exit_status=1))
    until(runtime, Phase.EXITED)
    runtime.start(launch(attempt=3))
    assert until(runtime, Phase.RUNNING).port == port


@pytest.mark.slow
def test_the_log_of_what_another_orchestrator_began_can_be_read_and_followed(open_runtime: Open) -> None:
    other, runtime = open_runtime(), open_runtime()
    assert other.follow("i1", 10) is None
    runtime.start(launch(flood=2))
    until(runtime, Phase.RUNNING)
    assert "line 1\n" in other.logs("i1", 100)
    followed = other.follow("i1", 100)
    assert followed is not None
    with contextlib.closing(followed) as stream:
        assert "line 1\n" in (stream.read() or "")
        runtime.stop("i1", force=True)
        until(runtime, Phase.EXITED)
        runtime.remove("i1")
        while stream.read() is not None:
            pass


@pytest.mark.slow
def test_a_log_is_kept_within_bounds_and_its_newest_lines_stay(open_runtime: Open, tmp_path: Path) -> None:
    runtime = open_runtime(log_bytes=4096)
    runtime.start(launch(flood=2000))
    until(runtime, Phase.RUNNING)
    log = tmp_path / "instances/i1/log"
    assert log.stat().st_size > 4096
    runtime.tidy()
    assert log.stat().st_size <= 2048
    lines = runtime.logs("i1", 1000).splitlines()
    assert lines[-1] == "line 1999"
    assert lines == [f"line {n}" for n in range(2000 - len(lines), 2000)]


@pytest.mark.slow
def test_a_module_that_is_not_there_ends_at_once_and_says_so(open_runtime: Open) -> None:
    runtime = open_runtime()
    runtime.start(launch(entrypoint="no_such_module_anywhere"))
    seen = until(runtime, Phase.EXITED)
    assert seen.exit_status == 1
    assert "No module named no_such_module_anywhere" in seen.last_line


@pytest.mark.slow
def test_services_that_are_not_installed_are_found_on_the_python_path(open_runtime: Open, tmp_path: Path) -> None:
    (tmp_path / "mine").mkdir()
    (tmp_path / "mine/my_service.py").write_text("print('\\x1b[31mmine\\x07')")
    runtime = open_runtime(python_path=[str(tmp_path / "mine")])
    runtime.start(launch(entrypoint="my_service"))
    seen = until(runtime, Phase.EXITED)
    assert seen.exit_status == 0
    assert seen.last_line == "[31mmine"  # what could play tricks on a terminal is taken out


def test_a_folder_that_cannot_be_written_is_a_failure_in_words(open_runtime: Open, tmp_path: Path) -> None:
    runtime = open_runtime()
    (tmp_path / "instances/i1").write_text("in the way")
    with pytest.raises(RuntimeFailure, match="cannot start toy on this machine"):
        runtime.start(launch())
    with contextlib.suppress(FileNotFoundError):
        (tmp_path / "instances/i1").unlink()
    assert runtime.observe() == {}


@pytest.mark.parametrize(
    "content",
    [
        b"rubbish",
        b"[1]",
        b"\xff\xfe",
        NESTED,
        b'{"port": "x"}',
        b'{"port": true}',
        b'{"port": 0}',
        b'{"port": -5}',
        b'{"port": 65536}',
        b'{"port": 1e300}',
        b'{"port": {"a": 1}}',
        b'{"port": 1' + b" " * (1 << 20) + b"}",
    ],
)
def test_rubbish_notes_no_port(tmp_path: Path, content: bytes) -> None:
    (tmp_path / "ready.json").write_bytes(content)
    assert noted_port(tmp_path / "ready.json") is None


def test_a_ready_file_with_rubbish_in_it_is_no_ready_file(tmp_path: Path, open_runtime: Open) -> None:
    runtime = open_runtime()
    runtime.start(launch(entrypoint="this"))
    (tmp_path / "instances/i1/own/ready.json").write_bytes(NESTED)
    assert runtime.observe()["i1"].port is None
    assert until(runtime, Phase.EXITED).port is None
    runtime.start(launch(attempt=2, entrypoint="this"))  # it is read once more, for the port to keep


def test_a_folder_for_a_ready_file_takes_no_file_descriptor(tmp_path: Path, open_runtime: Open) -> None:
    runtime = open_runtime()
    runtime.start(launch(entrypoint="this"))
    (tmp_path / "instances/i1/own/ready.json").mkdir()
    before = len(os.listdir("/proc/self/fd"))
    for _ in range(10):
        assert runtime.observe()["i1"].port is None
    until(runtime, Phase.EXITED)
    runtime.start(launch(attempt=2, entrypoint="this"))
    assert len(os.listdir("/proc/self/fd")) <= before


def test_of_a_log_no_more_is_told_than_is_kept(tmp_path: Path, open_runtime: Open) -> None:
    runtime = open_runtime(log_bytes=1024)
    runtime.start(launch(entrypoint="this"))
    until(runtime, Phase.EXITED)
    (tmp_path / "instances/i1/log").write_bytes(b"x" * 100_000 + b"\nlast\n")
    assert runtime.logs("i1", 1) == "last\n"
    assert len(runtime.logs("i1", 5)) == 1024


@pytest.mark.slow
def test_the_processor_time_of_children_that_have_ended_counts() -> None:
    before = ProcessStat.read(os.getpid())
    burn = "import time\nwhile time.process_time() < 0.5: pass"
    subprocess.run([sys.executable, "-c", burn], check=True)
    after = ProcessStat.read(os.getpid())
    assert before is not None
    assert after is not None
    assert after.cpu_s - before.cpu_s >= 0.4


@pytest.mark.slow
def test_what_a_robots_services_write_is_bounded_and_nothing_starts_beyond(open_runtime: Open, tmp_path: Path) -> None:
    runtime = open_runtime(data_mb=1)
    runtime.start(launch())
    until(runtime, Phase.RUNNING)
    runtime.tidy()
    assert runtime.observe()["i1"].exceeds == ""
    kept = tmp_path / "data/walker/recorder/earlier"
    kept.mkdir(parents=True)
    (kept / "old.mcap").write_bytes(bytes(2 << 20))
    deadline = time.monotonic() + 10
    while not runtime.observe()["i1"].exceeds:
        runtime.tidy()
        assert time.monotonic() < deadline
        time.sleep(0.05)
    assert "has more than 1 MiB in" in runtime.observe()["i1"].exceeds
    runtime.stop("i1", force=True)
    until(runtime, Phase.EXITED)
    with pytest.raises(RuntimeFailure, match=r"robot 'walker' has more than 1 MiB in .*delete what is not needed"):
        runtime.start(launch(attempt=2))
    (kept / "old.mcap").unlink()
    runtime.start(launch(attempt=2))
    until(runtime, Phase.RUNNING)


@pytest.mark.slow
def test_no_folder_that_a_service_made_keeps_it_from_being_weighed_started_and_removed(
    open_runtime: Open, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    runtime = open_runtime()
    runtime.start(launch())
    until(runtime, Phase.RUNNING)
    own = tmp_path / "instances/i1/own"
    at = os.open(own, os.O_PATH)
    for _ in range(1_500):  # beyond what has a path, and beyond Python's recursion
        os.mkdir("deep", dir_fd=at)
        above, at = at, os.open("deep", os.O_PATH, dir_fd=at)
        os.close(above)
    os.close(at)
    runtime.tidy()
    assert "too deep ones in its own folder" in runtime.observe()["i1"].exceeds
    runtime.start(launch(attempt=2))
    until(runtime, Phase.RUNNING)
    assert not (own / "deep").exists()
    monkeypatch.setattr("skytether.orchestrator.runtimes.disk.MOST_FILES", 2)
    monkeypatch.setattr("skytether.orchestrator.runtimes.process.WEIGH_S", 0.0)
    (own / "one").touch()
    runtime.tidy()
    assert "files or too deep ones in its own folder" in runtime.observe()["i1"].exceeds
    runtime.remove("i1")
    assert not own.parent.exists()
