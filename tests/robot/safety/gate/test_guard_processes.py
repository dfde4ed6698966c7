"""Guard and gate as real processes, killed, frozen and signalled: what the wheels were told, held against the limits.

Every velocity carries the time at which the kernel saw it sent: no change between any two within half a second may be
larger than the limits allow in that time (`skytether.lab.safety.checker`), whatever happens.
"""

import itertools
import json
import os
import resource
import signal
import socket
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from contextlib import suppress
from pathlib import Path

import pytest

from skytether.guard.record import decode
from skytether.guard.velocity import STANDSTILL
from skytether.lab.safety.record import now
from skytether.lab.safety.robot import LIMITS, PlayedRobot
from skytether.lab.safety.stage import Stage
from skytether.messages import Bool
from skytether.robot.safety.client import GateError

pytestmark = pytest.mark.slow

SIGNALS = {"killed": signal.SIGKILL, "frozen": signal.SIGSTOP}


@pytest.fixture
def robot(tmp_path: Path) -> Iterator[PlayedRobot]:
    with PlayedRobot(tmp_path) as robot:
        robot.go()
        yield robot


def check(stage: Stage) -> None:
    """Nothing that was promised was broken since the stage was made."""
    finding = stage.finding()
    log = stage.robot.log.read_text(errors="replace")[-4000:] if finding.violations else ""
    assert not finding.violations, "\n".join([*(f"{v.kind} ({v.times}): {v.text}" for v in finding.violations), log])


def freeze(robot: PlayedRobot, role: str, seconds: float) -> None:
    pid = robot.signal(role, signal.SIGSTOP)
    time.sleep(seconds)
    os.kill(pid, signal.SIGCONT)


def stands(robot: PlayedRobot) -> None:
    robot.wait(lambda: robot.record.last.velocity == STANDSTILL, "the robot stands")


@pytest.mark.parametrize("role", ["gate", "guard"])
@pytest.mark.parametrize("seconds", [0.07, 0.15, 1.0])
def test_who_stood_still_goes_on_from_what_the_wheels_were_told(robot, role, seconds):
    stage = Stage(robot)
    for _ in range(3):
        freeze(robot, role, seconds)
        stage.drives_on(f"the {role} was frozen for {seconds} s")
    check(stage)


@pytest.mark.parametrize("role", ["gate", "guard"])
@pytest.mark.parametrize("after", [0.0, 0.7])  # by then the gate's socket is full of words that it is up
def test_a_button_pressed_while_somebody_stood_still_finds_the_robot_standing(robot, role, after):
    stage = Stage(robot)
    pid = robot.signal(role, signal.SIGSTOP)
    time.sleep(after)
    robot.pressed = True
    with stage.stands(0.0 if after else stage.promised.partner, f"the {role} is frozen, and the button is pressed"):
        time.sleep(1.0)
        os.kill(pid, signal.SIGCONT)
        time.sleep(1.0)
    robot.wait(lambda: "button" in robot.ask("status")["stopped"], "the button is latched")
    check(stage)


def test_a_driver_that_starts_again_begins_from_standstill(robot):
    stage = Stage(robot)
    for seconds in (0.0, 0.05, 0.5):
        robot.hardware.vanish()
        time.sleep(seconds)
        began = now()
        robot.hardware.appear()
        robot.wait(lambda since=began: robot.record.last.at > since, "the driver is told something")
        stage.drives_on("the driver is there again")
        first = [told for told in robot.record.since(began) if told.at >= began]
        assert abs(first[0].velocity.linear) <= 1.0 * 0.04  # 1 m/s^2, two periods


@pytest.mark.parametrize("seconds", [0.25, 0.35, 1.0])
def test_a_driver_that_does_not_read_for_a_while_finds_no_jump_in_what_waits(robot, seconds):
    """Ten datagrams find room; that there is none for the next was taken for a standstill, of wheels that turned."""
    stage = Stage(robot)
    robot.hardware.hang(seconds)
    time.sleep(seconds)
    stage.drives_on("the driver reads again")
    check(stage)


def test_a_killed_guard_leaves_no_jump_to_zero(robot):
    stage = Stage(robot)
    with stage.stands(stage.promised.partner, "the guard is killed"):
        robot.signal("guard", signal.SIGKILL)
        time.sleep(1.0)
    check(stage)
    speeds = [told.velocity.linear for told in robot.record.since(now() - 1.2)]
    assert len([speed for speed in speeds if 0 < speed < 0.45]) >= 5  # a ramp of a quarter of a second
    robot.wait(lambda: not robot.alive("gate"), "the gate ends without its guard")


@pytest.mark.parametrize(
    ("first", "how", "second", "then"),
    [
        (first, how, second, then)
        for first, second in itertools.permutations(["guard", "gate"])
        for how, then in itertools.product(SIGNALS, repeat=2)
    ],
)
def test_in_every_order_of_deaths_the_wheels_are_told_to_stop(robot, first, how, second, then):
    stage = Stage(robot)
    partner = robot.pid(second)
    robot.signal(first, SIGNALS[how])
    stands(robot)
    with stage.stands(0.0, f"the {first} {how}, then the {second} {then}"):
        with suppress(ProcessLookupError):  # a gate without its guard ends by itself
            os.kill(partner, SIGNALS[then])
        time.sleep(0.5)
    for left in robot.processes():  # who was frozen goes on from standstill
        left.resume()
    time.sleep(0.5)
    check(stage)


def test_a_gate_that_goes_on_beside_another_guard_tells_the_wheels_nothing(robot):
    gate = robot.signal("gate", signal.SIGSTOP)
    robot.signal("guard", signal.SIGKILL)
    robot.guard.wait(30)
    robot.go()
    stage = Stage(robot)
    os.kill(gate, signal.SIGCONT)
    robot.wait(lambda: gate not in [left.pid for left in robot.processes()], "it ends")
    time.sleep(0.5)
    check(stage)


def test_a_guard_that_is_started_anew_waits_until_the_gate_of_the_one_before_has_braked(tmp_path):
    with PlayedRobot(tmp_path, {"limits": {**LIMITS, "linear_acceleration": 0.25, "linear_braking": 0.25}}) as robot:
        robot.go()
        stage = Stage(robot)
        robot.signal("guard", signal.SIGKILL)
        robot.guard.wait(30)
        robot.start_guard()
        stands(robot)
        robot.go()
        check(stage)


@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGHUP, signal.SIGINT])
def test_a_guard_that_is_told_to_end_brakes_first(robot, number):
    stage = Stage(robot)
    with stage.stands(stage.promised.stop, f"the guard got {number.name}"):
        robot.signal("guard", number)
        assert robot.guard.wait(30) == 0
    assert robot.record.last.velocity == STANDSTILL
    check(stage)
    assert not robot.alive("gate")


def test_under_nohup_a_terminal_that_is_closed_stops_no_robot(tmp_path):
    with PlayedRobot(tmp_path, before=lambda: signal.signal(signal.SIGHUP, signal.SIG_IGN)) as robot:
        robot.go()
        robot.signal("guard", signal.SIGHUP)
        time.sleep(1.0)
        assert robot.alive("guard")
        robot.wait(robot.drives, "the robot drives on")


@pytest.mark.parametrize("order", [("guard", "gate"), ("gate", "guard")])
def test_a_service_manager_that_signals_all_at_once_ends_no_one_before_the_wheels_stand(robot, order):
    stage = Stage(robot)
    with stage.stands(stage.promised.stop, "SIGTERM for everybody"):
        for role in order:
            robot.signal(role, signal.SIGTERM)
        assert robot.guard.wait(30) == 0
    assert robot.record.last.velocity == STANDSTILL
    check(stage)


def test_a_gate_that_cannot_be_ended_does_not_hold_up_the_guard(robot):
    # A process in the kernel's hands does not die of a kill; one that is frozen by a debugger is as near as tests get.
    robot.signal("gate", signal.SIGSTOP)
    began = time.monotonic()
    robot.signal("guard", signal.SIGTERM)
    assert robot.guard.wait(30) == 0
    assert time.monotonic() - began < 5
    assert robot.record.last.velocity == STANDSTILL


@pytest.mark.parametrize("victim", ["gate", "guard"])
def test_an_acknowledged_stop_is_kept_whatever_dies_next(robot, victim):
    for i, reason in enumerate(["released", "not \udcff UTF-8", "x" * 5000, "two\nlines\n", "stopped", ""]):
        robot.stop(reason)
        pid = robot.signal(victim, signal.SIGKILL)
        if victim == "guard":
            robot.start_guard()
        robot.wait(lambda gone=pid: other_gate(robot, gone), "the next gate answers")
        stopped = robot.ask("status")["stopped"]
        assert stopped, f"attempt {i}: the stop for {reason[:20]!r} is lost"
        time.sleep(0.3)
        assert robot.record.last.velocity == STANDSTILL
        robot.go()


def other_gate(robot: PlayedRobot, gone: int) -> bool:
    try:
        status = robot.ask("status")
        return status["pid"] != gone and status["guard_pid"] == robot.guard.pid and bool(status["hand"])
    except GateError:
        return False


def test_a_stop_while_the_gate_is_frozen_holds_for_the_next_one(robot):
    pid = robot.signal("gate", signal.SIGSTOP)
    stage = Stage(robot)
    with stage.stands(stage.promised.partner, "a stop while the gate is frozen"):
        robot.stop("somebody fell")
        robot.wait(lambda: other_gate(robot, pid), "a frozen gate is started anew")
    assert "somebody fell" in robot.ask("status")["stopped"]
    check(stage)


def test_a_stop_while_the_guard_is_frozen_holds_for_the_next_one(robot):
    robot.signal("guard", signal.SIGSTOP)
    robot.stop("somebody fell")
    robot.signal("guard", signal.SIGKILL)
    robot.start_guard()
    robot.wait(lambda: other_gate(robot, 0), "the next gate answers")
    assert "somebody fell" in robot.ask("status")["stopped"]


@pytest.mark.parametrize("again", ["stop.sock", "button"])
def test_a_reset_that_waits_in_a_frozen_gate_does_not_end_a_stop_that_came_after_it(robot, again):
    robot.stop("somebody fell")
    robot.wait(lambda: robot.ask("status")["guard"]["stopped"] == "somebody fell", "gate and guard know it")
    gate = robot.signal("gate", signal.SIGSTOP)
    with socket.socket(socket.AF_UNIX, socket.SOCK_SEQPACKET) as reset:
        reset.connect(str(robot.folder / "control.sock"))
        reset.send(b'{"do": "reset"}')
        if again == "button":
            robot.hardware.send("estop", Bool(True))
        else:
            with socket.socket(socket.AF_UNIX, socket.SOCK_SEQPACKET) as link:
                link.connect(str(robot.folder / again))
                link.send(b'{"do": "stop", "reason": "and another one"}')
                assert json.loads(link.recv(65536))["kept"]
        time.sleep(0.1)
        os.kill(gate, signal.SIGCONT)
        reset.settimeout(30)
        assert "refused" in json.loads(reset.recv(65536))
    assert robot.ask("status")["stopped"] == "somebody fell"


@pytest.mark.parametrize("what", ["lock", "folder"])
def test_a_guard_whose_folder_is_gone_brakes_and_ends(robot, what):
    """Nobody could stop it any more, and another one could be started for the same wheels."""
    stage = Stage(robot)
    if what == "lock":
        (robot.folder / "lock").unlink()
    else:
        robot.folder.rename(robot.folder.with_name("old"))
    assert robot.guard.wait(30) == 1
    assert robot.record.last.velocity == STANDSTILL
    robot.wait(lambda: not robot.alive("gate"), "its gate ends")
    check(stage)


def test_a_guard_that_gets_no_descriptor_more_goes_on_without_a_gate(robot):
    guard = robot.pid("guard")
    before = resource.prlimit(guard, resource.RLIMIT_NOFILE)
    lowest = max(int(name) for name in os.listdir(f"/proc/{guard}/fd")) + 1
    resource.prlimit(guard, resource.RLIMIT_NOFILE, (min(lowest, 3), before[1]))  # not one, whatever is closed
    stage = Stage(robot)
    with stage.stands(stage.promised.partner, "the gate was killed while the guard could open nothing"):
        robot.signal("gate", signal.SIGKILL)
        time.sleep(2.5)
    assert robot.guard.poll() is None
    resource.prlimit(guard, resource.RLIMIT_NOFILE, before)
    robot.go()
    check(stage)


def test_idle_clients_do_not_hold_up_a_stop(robot):
    idle = []
    for name in ("control.sock", "stop.sock") * 20:
        link = socket.socket(socket.AF_UNIX, socket.SOCK_SEQPACKET)
        link.settimeout(30)
        link.connect(str(robot.folder / name))
        idle.append(link)
        time.sleep(0.03)
    stage = Stage(robot)
    with stage.stands(stage.promised.stop + 0.5, "a stop with forty idle clients"):
        robot.stop("somebody fell")
        time.sleep(1.0)
    check(stage)
    for link in idle:
        link.close()


def test_a_gate_that_ends_three_times_within_a_minute_is_not_trusted(robot):
    for _ in range(3):
        pid = robot.signal("gate", signal.SIGKILL)
        robot.wait(lambda gone=pid: other_gate(robot, gone), "the next gate answers")
    assert "three times" in robot.ask("status")["stopped"] or "3 times" in robot.ask("status")["stopped"]
    status = robot.ask("status")["guard"]
    assert status["gate_restarts"] == 3
    events = decode((robot.folder / "record").read_bytes())
    assert [event["what"] for event in events if event["who"] == "gate"].count("death") == 3


def test_a_machine_that_was_started_is_stopped(tmp_path):
    with PlayedRobot(tmp_path) as robot:
        robot.wait(lambda: other_gate(robot, 0), "the gate answers")
        assert "since the machine was started" in robot.ask("status")["stopped"]
        with pytest.raises(GateError, match=r"reset. comes first"):
            robot.ask("start")
        time.sleep(0.5)
        assert robot.record.last.velocity == STANDSTILL
        robot.go()
        robot.signal("guard", signal.SIGKILL)
        text = (robot.folder / "latch").read_bytes()
        boot = Path("/proc/sys/kernel/random/boot_id").read_text().strip()
        assert text.startswith(b"released\n" + boot.encode())
        (robot.folder / "latch").write_bytes(text.replace(boot.encode(), b"0" * len(boot)))  # as from another boot
        robot.start_guard()
        robot.wait(lambda: other_gate(robot, 0), "the gate answers")
        assert "since the machine was started" in robot.ask("status")["stopped"]


def test_a_log_that_nobody_reads_holds_up_nothing(tmp_path):
    reader, writer = os.pipe()
    os.set_blocking(writer, False)
    with suppress(BlockingIOError):
        while True:
            os.write(writer, bytes(4096))
    os.set_blocking(writer, True)
    with PlayedRobot(tmp_path, output=writer) as robot:
        robot.go()
        stage = Stage(robot)
        robot.signal("gate", signal.SIGKILL)
        stage.expect(lambda: robot.velocity == STANDSTILL, "the guard stops the wheels")
        robot.go()
        robot.stop("somebody fell")
        robot.signal("guard", signal.SIGTERM)
        assert robot.guard.wait(30) == 0
        check(stage)
    os.close(reader)
    os.close(writer)


def test_the_guard_is_the_standard_library(robot):
    maps = Path(f"/proc/{robot.pid('guard')}/maps").read_text()
    assert "numpy" not in maps
    assert "pydantic" not in maps
    command = Path(f"/proc/{robot.pid('guard')}/cmdline").read_bytes().split(b"\0")
    assert command[2:4] == [b"-m", b"skytether.guard"]


def test_what_is_permitted_is_taken_and_what_is_not_is_said(robot):
    guard = robot.pid("guard")
    status = robot.ask("status")
    not_permitted = " ".join(status["guard"]["not_permitted"])
    taken = os.sched_getscheduler(guard) == os.SCHED_FIFO
    assert taken != ("SCHED_FIFO" in not_permitted)
    locked = next(line for line in Path(f"/proc/{guard}/status").read_text().splitlines() if line.startswith("VmLck"))
    assert (int(locked.split()[1]) > 0) != ("mlockall" in not_permitted)
    for said in status["guard"]["not_permitted"]:
        assert said in robot.log.read_text()


def test_a_second_guard_says_what_to_do(robot, tmp_path):
    command = [sys.executable, "-m", "skytether.cli", "robot", "gate", str(tmp_path / "robot.yaml")]
    said = subprocess.run(command, capture_output=True, text=True, timeout=60)
    assert said.returncode == 1
    assert "another gate runs in" in said.stderr


def test_many_beats_and_rubbish_from_people_are_borne(robot):
    """Requests come as fast as they can while the robot drives."""
    ended = threading.Event()

    def flood():
        while not ended.is_set():
            try:
                with socket.socket(socket.AF_UNIX, socket.SOCK_SEQPACKET) as link:
                    link.settimeout(1)
                    link.connect(str(robot.folder / "stop.sock"))
                    link.send(b"\xff" * 3000)
                    json.loads(link.recv(4096))
            except (OSError, ValueError):
                continue

    stage = Stage(robot)
    threads = [threading.Thread(target=flood) for _ in range(3)]
    for thread in threads:
        thread.start()
    time.sleep(3)
    ended.set()
    for thread in threads:
        thread.join()
    stage.drives_on("after the flood")
    check(stage)
