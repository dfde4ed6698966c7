"""A real engine removes files of volumes when nobody runs any more who may have a folder of them."""

from __future__ import annotations

import json
import os
import secrets
import signal
import subprocess
import tempfile
import time
from concurrent.futures import Executor, Future, ThreadPoolExecutor
from contextlib import ExitStack, suppress
from datetime import datetime
from http import HTTPStatus
from pathlib import Path

import pytest
from gated_engine import ENGINE, Gated, gate_at, gated

from skytether.node import shims
from skytether.node.machine import Answer, ask

__all__ = ["gated"]
pytestmark = [pytest.mark.docker, pytest.mark.slow]


def test_files_are_removed_when_nobody_runs_who_may_have_a_folder_of_them(gated: Gated) -> None:
    # It looks back first: what others run at this engine meets nothing that is made here.
    assert gated.ask(f"DELETE /volumes/{secrets.token_hex(32)}").status == HTTPStatus.NOT_FOUND
    gated.network()
    shared = f"{gated.name}-shared"
    assert gated.ask("POST /volumes/create", {"Name": shared, "Labels": gated.labels}).status == HTTPStatus.CREATED
    one, own = gated.make(shared)
    other, others = gated.make(shared)
    alone, apart = gated.make()
    assert gated.ask(f"DELETE /containers/{alone}?v=1&force=1").status == HTTPStatus.NO_CONTENT
    assert not gated.has(apart)
    assert gated.ask(f"DELETE /containers/{one}?v=1&force=1").status == HTTPStatus.NO_CONTENT
    assert ask(ENGINE, f"/containers/{one}/json").status == HTTPStatus.NOT_FOUND
    assert gated.has(own)
    refused = gated.ask(f"DELETE /volumes/{own}")
    assert (refused.status, b"volume is in use" in refused.content) == (HTTPStatus.CONFLICT, True)
    assert gated.has(own)
    assert gated.ask(f"POST /containers/{other}/kill?signal=KILL").status == HTTPStatus.NO_CONTENT
    assert gated.ask(f"POST /containers/{other}/wait").status == HTTPStatus.OK
    assert gated.ask(f"DELETE /volumes/{own}").status == HTTPStatus.NO_CONTENT
    assert not gated.has(own)
    assert gated.ask(f"DELETE /containers/{other}?v=1").status == HTTPStatus.NO_CONTENT
    assert not gated.has(others)


def test_whose_network_another_one_joins_goes_on_after_that(gated: Gated) -> None:
    """It is paused meanwhile."""
    gated.network()
    holds, _ = gated.make()
    joins, _ = gated.make(network=f"container:{holds}")
    states = [json.loads(gated.ask(f"GET /containers/{one}/json").content)["State"] for one in (holds, joins)]
    assert [state["Status"] for state in states] == ["running", "running"]
    assert gated.ask(f"POST /containers/{holds}/kill?signal=KILL").status == HTTPStatus.NO_CONTENT
    assert gated.ask(f"DELETE /containers/{joins}?force=1").status == HTTPStatus.NO_CONTENT


@pytest.mark.parametrize("held", [True, False])
def test_who_joins_the_network_of_one_that_ends_meanwhile_is_in_no_other(
    gated: Gated, held: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    """As the kernel ends who holds the network, paused as it is, for want of memory, and gives its number to another.

    What makes the network is stopped meanwhile: an attacker has an engine wait for a large volume that it removes.

    Args:
        gated: The engine.
        held: Whether that number can be kept; if not, who joined is ended at once.
        monkeypatch: Has it not be kept.
    """
    if not held:
        monkeypatch.setattr("skytether.node.joins.shims.stop", lambda *_: None)
    gated.network()
    holds, _ = gated.make()
    joins, _ = gated.make(network=f"container:{holds}", starts=False)
    number = int(json.loads(ask(ENGINE, f"/containers/{holds}/json").content)["State"]["Pid"])
    stat = Path(f"/proc/{number}/stat")
    with ThreadPoolExecutor() as pool, ExitStack() as after:
        said, runtime = _stopped_in(gated, joins, pool, after)
        os.kill(number, signal.SIGKILL)
        for freezer in Path("/sys/fs/cgroup").glob(f"freezer/**/*{holds}*/freezer.state"):
            freezer.write_text("THAWED")
        while " Z " not in stat.read_text() if held else stat.exists():
            time.sleep(0.01)
        for _ in range(20 if held else 10_000):
            Path("/proc/sys/kernel/ns_last_pid").write_text(str(number - 1))
            other = subprocess.Popen(["sleep", "60"])
            after.callback(other.wait)
            after.callback(other.kill)
            if other.pid == number:
                break
        assert (other.pid == number) is not held
        os.kill(runtime, signal.SIGCONT)
        answer = said.result(30)
    assert (answer.status, b"ended meanwhile" in answer.content) == (HTTPStatus.CONFLICT, True), answer.content
    assert not stat.exists(), "its end is heard, late"
    state = json.loads(ask(ENGINE, f"/containers/{joins}/json").content)["State"]
    assert state["Running"] is False
    never_ran = state["StartedAt"].startswith("0001-")
    assert never_ran or not held
    if not never_ran:  # with rights enough this is rare: it is ended as soon as it has a process
        began, ended = (datetime.fromisoformat(state[key][:26] + "+00:00") for key in ("StartedAt", "FinishedAt"))
        print(f"it was in the network of the machine for {(ended - began).total_seconds():.3f} s")  # noqa: T201


def test_what_an_earlier_program_stopped_goes_on(gated: Gated) -> None:
    """It was killed while a container joined another's network: nobody could end that one any more."""
    gated.network()
    holds, _ = gated.make()
    gated.make(network=f"container:{holds}")
    number = int(json.loads(ask(ENGINE, f"/containers/{holds}/json").content)["State"]["Pid"])
    assert ask(ENGINE, f"/containers/{holds}/pause", method="POST").status == HTTPStatus.NO_CONTENT
    assert shims.stop(holds, number)
    with tempfile.TemporaryDirectory(prefix="sky-") as folder, gate_at(str(Path(folder) / "gate.sock")):
        again = Gated(str(Path(folder) / "gate.sock"), gated.name)
        assert again.ask(f"POST /containers/{holds}/kill?signal=KILL").status == HTTPStatus.NO_CONTENT
        assert again.ask(f"POST /containers/{holds}/wait").status == HTTPStatus.OK


def test_somebody_else_can_end_a_container_whose_network_is_joined(
    gated: Gated, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The engine waits for the stopped shim then, and what that is stopped for waits for the engine."""
    gated.network()
    holds, _ = gated.make()
    joins, _ = gated.make(network=f"container:{holds}", starts=False)
    stop, ends = shims.stop, list[Future[Answer]]()
    monkeypatch.setattr("skytether.node.join_watch._LONG_S", 1.0)
    with ThreadPoolExecutor() as pool:

        def stop_and_end(container: str, first: object) -> bool | None:
            held = stop(container, first)
            kill = f"/containers/{container}/kill?signal=KILL"
            ends.append(pool.submit(ask, ENGINE, kill, method="POST", patience=60))
            time.sleep(0.5)
            return held

        monkeypatch.setattr("skytether.node.joins.shims.stop", stop_and_end)
        said = pool.submit(gated.ask, f"POST /containers/{joins}/start").result(60)
        assert ends[0].result(60).status == HTTPStatus.NO_CONTENT
    assert said.status >= HTTPStatus.BAD_REQUEST
    for one in (holds, joins):
        assert json.loads(ask(ENGINE, f"/containers/{one}/json").content)["State"]["Running"] is False


def test_somebody_else_ends_it_only_when_who_joins_is_in_its_network_or_nowhere(
    gated: Gated, monkeypatch: pytest.MonkeyPatch
) -> None:
    """That start takes long, and needs nothing more of the engine: before, another process got the number meanwhile.

    Nobody is kept waiting for good. Then who joins is ended as soon as it has a process.
    """
    monkeypatch.setattr("skytether.node.join_watch._LONG_S", 1.0)
    monkeypatch.setattr("skytether.node.join_watch.PATIENCE_S", 0.2)
    gated.network()
    holds, _ = gated.make()
    joins, _ = gated.make(network=f"container:{holds}", starts=False)
    number = int(json.loads(ask(ENGINE, f"/containers/{holds}/json").content)["State"]["Pid"])
    with ThreadPoolExecutor() as pool, ExitStack() as after:
        said, runtime = _stopped_in(gated, joins, pool, after)
        ends = pool.submit(ask, ENGINE, f"/containers/{holds}/kill?signal=KILL", method="POST", patience=60)
        time.sleep(3.0)  # longer than it waits for before it lets that one end, were there no start under way
        assert Path(f"/proc/{number}").exists()
        assert not ends.done()
        assert ends.result(30).status == HTTPStatus.NO_CONTENT
        while Path(f"/proc/{number}").exists():
            time.sleep(0.01)
        os.kill(runtime, signal.SIGCONT)
        assert b"ended meanwhile" in said.result(30).content
    state = json.loads(ask(ENGINE, f"/containers/{joins}/json").content)["State"]
    assert state["Running"] is False


def _stopped_in(gated: Gated, container: str, pool: Executor, after: ExitStack) -> tuple[Future[Answer], int]:
    """A start that stands still in what makes the container; that one's number, and that it goes on in the end."""
    said = pool.submit(gated.ask, f"POST /containers/{container}/start")
    while not (runtime := _runtime_of(container)):
        assert not said.done()
    os.kill(runtime, signal.SIGSTOP)
    after.callback(lambda: Path(f"/proc/{runtime}").exists() and os.kill(runtime, signal.SIGCONT))
    return said, runtime


def _runtime_of(container: str) -> int | None:
    """The process that makes a container just now."""
    for path in Path("/proc").glob("[0-9]*/cmdline"):
        with suppress(OSError):
            words = path.read_bytes().split(b"\0")
            if b"create" in words and container.encode() in words and b"runc" in words[0]:
                return int(path.parent.name)
    return None


def test_who_starts_after_a_restart_of_the_node_by_what_was_asked_before_it_has_kin(gated: Gated) -> None:
    """That start waited at the engine, which said meanwhile that nothing runs; files of the machine were removed."""
    gated.network()
    shared = f"{gated.name}-shared"
    assert gated.ask("POST /volumes/create", {"Name": shared, "Labels": gated.labels}).status == HTTPStatus.CREATED
    late, own = gated.make(shared, starts=False)
    with tempfile.TemporaryDirectory(prefix="sky-") as folder, gate_at(str(Path(folder) / "gate.sock")):
        again = Gated(str(Path(folder) / "gate.sock"), gated.name)
        assert again.ask(f"DELETE /volumes/{secrets.token_hex(32)}").status == HTTPStatus.NOT_FOUND  # it looks back
        assert ask(ENGINE, f"/v1.41/containers/{late}/start", method="POST").status == HTTPStatus.NO_CONTENT
        holds, _ = again.make(shared)
        assert again.ask(f"DELETE /containers/{late}?v=1&force=1").status == HTTPStatus.NO_CONTENT
        assert again.ask(f"DELETE /volumes/{own}").status == HTTPStatus.CONFLICT
        assert again.has(own)
        assert again.ask(f"DELETE /containers/{holds}?force=1").status == HTTPStatus.NO_CONTENT
        assert again.ask(f"DELETE /volumes/{own}").status == HTTPStatus.NO_CONTENT
