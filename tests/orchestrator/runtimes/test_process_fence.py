"""Two orchestrators at one process site, as programs: one is frozen or killed in the middle of an act."""

from __future__ import annotations

import base64
import contextlib
import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest

from skytether.api.grant import GRANT_VARIABLE, Grant
from skytether.api.manifest import ServiceSpec
from skytether.orchestrator.runtimes import runs
from skytether.orchestrator.runtimes.base import Launch, OvertakenError, Phase, RuntimeFailure, SiteSilentError
from skytether.orchestrator.runtimes.fence import Fence
from skytether.orchestrator.runtimes.process import ProcessOptions, ProcessRuntime
from skytether.orchestrator.runtimes.procfs import ProcessId, ProcessStat

PATIENCE = 20.0


def launch(instance: str = "i1", attempt: int = 1) -> Launch:
    key = base64.b64encode(bytes(32)).decode()
    grant = Grant(
        instance=instance, service="toy", robot="walker", session_id="00112233445566aa", session_key=key, topics=()
    )
    return Launch(attempt, ServiceSpec(entrypoint="skytether.testing.toy_service"), grant)


LATE = """
import os, signal, sys
from pathlib import Path
sys.path.insert(0, sys.argv[1])
from test_process_fence import launch
from skytether.orchestrator.runtimes.base import OvertakenError
from skytether.orchestrator.runtimes.process import ProcessOptions, ProcessRuntime

runtime = ProcessRuntime("lab", Path(sys.argv[2]), ProcessOptions())
runtime.lead(1)
spawn = runtime._spawn

def freezing(*given):
    if sys.argv[3] == "before":
        os.kill(os.getpid(), signal.SIGSTOP)
    child = spawn(*given)
    if sys.argv[3] == "after":
        os.kill(os.getpid(), signal.SIGSTOP)
    return child

runtime._spawn = freezing
runtime.start(launch())
for act in (lambda: runtime.start(launch("i2")), lambda: runtime.stop("i1", force=True), lambda: runtime.remove("i1")):
    try:
        act()
    except OvertakenError:
        print("refused", flush=True)
runtime.close()
"""


def until(what: Callable[[], object]) -> None:
    deadline = time.monotonic() + PATIENCE
    while not what():
        assert time.monotonic() < deadline, "it did not come to pass"
        time.sleep(0.005)


def frozen(pid: int) -> bool:
    return Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0] == "T"


def processes(folder: Path) -> list[int]:
    """Those that lead a session and were given the grant of the instance, by what the kernel says."""
    wanted = f"{GRANT_VARIABLE}={folder}/instances/i1/own/grant.json".encode()
    found = []
    for one in Path("/proc").glob("[0-9]*"):
        with contextlib.suppress(OSError):
            stat = ProcessStat.read(int(one.name))
            if stat and not stat.zombie and stat.session == stat.pid and wanted in (one / "environ").read_bytes():
                found.append(stat.pid)
    return found


@pytest.fixture
def leader(tmp_path: Path) -> Iterator[ProcessRuntime]:
    runtime = ProcessRuntime("lab", tmp_path, ProcessOptions())
    yield runtime
    for instance in list(runtime.observe()):
        runtime.remove(instance)
    runtime.close()


@pytest.mark.slow
@pytest.mark.parametrize("then", [signal.SIGCONT, signal.SIGKILL])
@pytest.mark.parametrize("moment", ["before", "after"])
def test_a_leader_that_is_frozen_in_the_middle_of_a_start(
    tmp_path: Path, leader: ProcessRuntime, moment: str, then: signal.Signals
) -> None:
    command = [sys.executable, "-c", LATE, str(Path(__file__).parent), str(tmp_path), moment]
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as late:
        until(lambda: late.poll() is not None or frozen(late.pid))
        leader.lead(2)
        leader.start(launch("i3"))
        until(lambda: leader.observe()["i3"].phase is Phase.RUNNING)  # only that one instance is held up
        assert leader.observe_some(["i1"])["i1"].phase is Phase.STARTING
        for act in (
            lambda: leader.start(launch()),
            lambda: leader.stop("i1", force=True),
            lambda: leader.remove("i1"),
        ):
            with pytest.raises(SiteSilentError, match="another orchestrator has been at this instance"):
                act()
        assert len(processes(tmp_path)) == (moment == "after")
        os.kill(late.pid, then)
        said, _ = late.communicate(timeout=PATIENCE)
    assert said == ("refused\n" * 3 if then is signal.SIGCONT else "")
    leader.start(launch())
    until(lambda: leader.observe()["i1"].phase is Phase.RUNNING)
    assert len(processes(tmp_path)) == 1
    assert leader.observe().keys() == {"i1", "i3"}
    leader.remove("i1")
    assert processes(tmp_path) == []


def test_an_act_waits_for_another_on_the_same_instance_only_and_not_for_ever(tmp_path: Path) -> None:
    one, other = Fence(tmp_path), Fence(tmp_path, wait_s=0.02)
    assert not other.busy("i1")
    with one.acting("i1"):
        assert other.busy("i1")
        assert not other.busy("i2")
        with other.acting("i2"):
            pass
        with pytest.raises(SiteSilentError, match=r"for 0\.02 s: if it hangs, end it"), other.acting("i1"):
            pass
    with other.acting("i1"):
        pass


def test_for_one_that_hangs_nobody_waits_long_again(tmp_path: Path) -> None:
    slept: list[float] = []
    one, other = Fence(tmp_path), Fence(tmp_path, clock=lambda: sum(slept), sleep=slept.append)

    def waited() -> float:
        before = sum(slept)
        with pytest.raises(SiteSilentError), other.acting("i1"):
            pass
        return round(sum(slept) - before, 1)

    with one.acting("i1"):
        assert [waited(), waited(), waited()] == [2.0, 0.2, 0.2]
    with other.acting("i1"):
        pass
    with one.acting("i1"):
        assert waited() == 2.0


def test_an_epoch_is_kept_and_the_earlier_one_is_refused_at_its_next_act(tmp_path: Path) -> None:
    one, other = Fence(tmp_path), Fence(tmp_path)
    with one.acting("i1"):
        pass
    one.lead(7)
    with one.acting("i1"):
        other.lead(8)  # does not wait: this act is over before anything else is done to the instance
        one_is_at_it = other.busy("i1")
    assert one_is_at_it
    with pytest.raises(OvertakenError), one.acting("i1"):
        pass
    with pytest.raises(OvertakenError):
        Fence(tmp_path).lead(7)
    with pytest.raises(OvertakenError, match="epochs/8"):
        one.must_lead()


def test_who_is_frozen_while_it_begins_to_lead_keeps_nobody_from_leading(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    one, other = Fence(tmp_path, wait_s=0), Fence(tmp_path, wait_s=0)
    looked = one.must_lead

    def frozen_after_the_look() -> None:
        looked()
        other.lead(8)

    monkeypatch.setattr(one, "must_lead", frozen_after_the_look)
    with pytest.raises(OvertakenError):
        one.lead(7)
    monkeypatch.undo()
    with other.acting("i1"), pytest.raises(OvertakenError):
        one.must_lead()
    with pytest.raises(OvertakenError), one.acting("i2"):
        pass


def test_a_site_that_cannot_be_written_is_nobodys_fault(tmp_path: Path) -> None:
    gone = Fence(tmp_path / "gone")
    with pytest.raises(SiteSilentError, match="cannot write"):
        gone.lead(1)
    with pytest.raises(SiteSilentError, match="cannot open"), gone.acting("i1"):
        pass
    assert not gone.busy("i1")


def test_a_process_that_cannot_be_ended_is_told_and_holds_up_nobody(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    monkeypatch.setattr(runs, "END_S", 0.02)
    with subprocess.Popen(["sleep", "60"]) as child:
        stat = ProcessStat.read(child.pid)
        assert stat is not None
        run = runs.Run(1, ProcessId(child.pid, stat.start_time), str(tmp_path), child=child)
        monkeypatch.setattr(run, "kill", lambda: None)  # as of one that waits for a broken disk
        with pytest.raises(RuntimeFailure, match=f"process {child.pid}"):
            run.end()
        child.kill()
