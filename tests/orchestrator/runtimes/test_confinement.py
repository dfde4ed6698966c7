"""What an instance of a process site can reach: not the orchestrator's secrets, not the others."""

from __future__ import annotations

import ast
import base64
import contextlib
import json
import os
import secrets
import socket
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import psutil
import pytest

from skytether.api.grant import Grant
from skytether.api.manifest import Limits, ServiceSpec
from skytether.orchestrator.runtimes import confine, confinement, process, users
from skytether.orchestrator.runtimes.base import Launch, Observation, Phase, RuntimeFailure
from skytether.orchestrator.runtimes.confinement import Machine, covers, opened, this_machine
from skytether.orchestrator.runtimes.notes import noted_port
from skytether.orchestrator.runtimes.process import ProcessOptions, ProcessRuntime

INTRUDER = """
import ctypes, json, os, socket, sys
grant = json.load(open(os.environ["SKYTETHER_GRANT"]))
state, parent = grant["params"]["say"], int(grant["params"]["parent"])
tries = {
    "operator.token": lambda: open(f"{state}/operator.token").read(),
    "state listed": lambda: find(state, "operator.token"),
    "instances listed": lambda: find(f"{state}/instances", "other"),
    "own note": lambda: open(f"{state}/instances/i1/run.json").read(),
    "other's grant": lambda: open(f"{state}/instances/other/own/grant.json").read(),
    "other's data": lambda: open(f"{state}/data/robot/toy/other/kept").read(),
    "shadow": lambda: open("/etc/shadow").read(),
    "environment": lambda: open(f"/proc/{parent}/environ").read(),
    "arguments": lambda: open(f"/proc/{parent}/cmdline").read(),
    "memory": lambda: open(f"/proc/{parent}/mem", "rb"),
    "its root": lambda: os.listdir(f"/proc/{parent}/root/{state}"),
    "signal": lambda: os.kill(parent, 0),
    "socket": lambda: socket.socket(socket.AF_UNIX).connect(f"{state}/engine.sock"),
    "code": lambda: open(sys.argv[0] + ".new", "w"),
    "programs": lambda: open("/usr/local/bin/skytether-intruder", "w"),
    "devices": lambda: os.mknod(f"{state}/data/walker/toy/i1/disk", 0o060600, os.makedev(254, 0)),
    "root": lambda: os.setuid(0) if os.getuid() else os.chown(state, 1, 1),
    "empty": lambda: os.truncate(f"{state}/operator.token", 0),
    "empty by opening": lambda: os.open(f"{state}/operator.token", os.O_ACCMODE | os.O_TRUNC),
    "empty code": lambda: os.open(sys.argv[0], os.O_RDONLY | os.O_TRUNC),
    "modes": lambda: os.chmod(state, 0o777),
    "modes by another call": lambda: call("syscall", 452, -100, state.encode(), 0o777, 0),
    "attributes": lambda: os.setxattr(f"{state}/operator.token", "user.a", b"1"),
    "mounts": lambda: call("unshare", 0x00020000),
    "users": lambda: call("unshare", 0x10000000),
    "own data": lambda: open(f"{grant['data_dir']}/recording", "w"),
    "own folder": lambda: open(grant["ready_file"] + ".draft", "w"),
    "temporary": lambda: __import__("tempfile").TemporaryFile(),
    "child": lambda: __import__("subprocess").run(["/bin/true"], check=True),
}
def find(folder, name):
    if name not in os.listdir(folder):
        raise OSError("there is another folder over it")
def call(name, *arguments):
    if getattr(ctypes.CDLL(None), name)(*arguments):
        raise OSError(name)
for name, attempt in tries.items():
    try:
        attempt()
        print("did", name)
    except OSError as error:
        print("refused", name, error)
"""
ALLOWED = ["own data", "own folder", "temporary", "child"]


def launch(attempt: int = 1, entrypoint: str = "skytether.testing.toy_service", **params: Any) -> Launch:
    key = base64.b64encode(bytes(32)).decode()
    topics: dict[str, Any] = {"session_id": "00112233445566aa", "session_key": key, "topics": ()}
    grant = Grant(instance="i1", service="toy", robot="walker", params=params, **topics)
    return Launch(attempt, ServiceSpec(entrypoint=entrypoint), grant)


def until(runtime: ProcessRuntime, phase: Phase) -> Observation:
    deadline = time.monotonic() + 60
    while (seen := runtime.observe()["i1"]).phase is not phase:
        assert time.monotonic() < deadline, seen
        time.sleep(0.01)
    return seen


@pytest.fixture
def state(tmp_path: Path) -> Iterator[Path]:
    """A state folder with secrets, an instance of somebody else, and an engine's socket."""
    folder = tmp_path / "state"
    folder.mkdir(mode=0o700)
    for path in ("operator.token", "instances/other/own/grant.json", "data/robot/toy/other/kept"):
        (folder / path).parent.mkdir(parents=True, exist_ok=True)
        (folder / path).write_text("secret")
    (tmp_path / "code").mkdir()
    (tmp_path / "code/intruder.py").write_text(INTRUDER)
    with socket.socket(socket.AF_UNIX) as engine, contextlib.chdir(folder):  # for a path that is short enough
        engine.bind("engine.sock")
        engine.listen()
        yield folder


@pytest.mark.slow
@pytest.mark.parametrize(("own_user", "newest"), [(True, 99), (False, 99), (False, 2)])
def test_an_instance_reaches_its_own_folders_and_nothing_of_the_orchestrator(
    state: Path, own_user: bool, newest: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    machine = this_machine()
    if not machine.landlock or not machine.seccomp:
        pytest.skip("the kernel has no Landlock or no seccomp")
    if own_user and not machine.user:
        pytest.skip(f"no users of their own: {machine.why or 'not root'}")
    machine = replace(machine, user=own_user, landlock=min(machine.landlock, newest))
    monkeypatch.setattr(process, "this_machine", lambda: machine)
    shared = [] if own_user else ["arguments", *(["signal"] if machine.landlock < 6 else [])]
    allowed = [*shared, *ALLOWED]
    runtime = ProcessRuntime("lab", state, ProcessOptions(python_path=(str(state.parent / "code"),)))
    assert runtime.isolation()[-2:] == (f"Landlock {machine.landlock}", "seccomp")
    runtime.start(launch(entrypoint="intruder", say=str(state), parent=os.getpid()))
    seen = until(runtime, Phase.EXITED)
    log = runtime.logs("i1", 100)
    runtime.remove("i1")
    assert seen.exit_status == 0, log
    assert [line.removeprefix("did ") for line in log.splitlines() if line.startswith("did ")] == allowed
    assert log.count("refused ") == INTRUDER.count("lambda") - len(allowed), log
    assert (state / "operator.token").read_text() == "secret"


@pytest.mark.slow
def test_two_instances_are_two_users_and_one_keeps_its_own(tmp_path: Path) -> None:
    if not this_machine().user:
        pytest.skip("no users of their own")
    runtime = ProcessRuntime("lab", tmp_path, ProcessOptions())
    runtime.start(launch())
    until(runtime, Phase.RUNNING)
    owner = (tmp_path / "data/walker/toy/i1").stat().st_uid
    assert users.USERS[0] <= owner <= users.USERS[1]
    assert (tmp_path / "instances/i1").stat().st_uid == 0  # what it cannot write, it cannot make a trap of
    runtime.start(launch(attempt=2))
    until(runtime, Phase.RUNNING)
    assert (tmp_path / "data/walker/toy/i1").stat().st_uid == owner
    runtime.remove("i1")


@pytest.mark.slow
def test_an_orchestrator_with_a_close_umask_starts_them_too(tmp_path: Path) -> None:
    if not this_machine().user:
        pytest.skip("no users of their own")
    runtime = ProcessRuntime("lab", tmp_path, ProcessOptions())
    before = os.umask(0o077)
    try:
        runtime.start(launch())
    finally:
        os.umask(before)
    deadline = time.monotonic() + 60
    while (seen := runtime.observe()["i1"]).phase is Phase.STARTING:
        assert time.monotonic() < deadline
        time.sleep(0.01)
    assert seen.phase is Phase.RUNNING, runtime.logs("i1", 9)
    assert (tmp_path / "instances/i1/own/ready.json").stat().st_mode & 0o777 == 0o600  # what it writes is its own, too
    runtime.remove("i1")


RUNNER = """
import json, os, time
grant = json.load(open(os.environ["SKYTETHER_GRANT"]))
beat = os.open(grant["data_dir"] + "/beat", os.O_CREAT | os.O_WRONLY)
end = time.monotonic() + 30  # whatever becomes of the test
while time.monotonic() < end:
    if os.fork():
        os._exit(0)
    os.setsid()
    os.pwrite(beat, b"%20d" % time.monotonic_ns(), 0)
"""


@pytest.mark.slow
def test_who_leaves_its_session_and_forks_all_the_time_ends(tmp_path: Path) -> None:
    if not this_machine().user:
        pytest.skip("no users of their own")
    (tmp_path / "code").mkdir()
    (tmp_path / "code/runner.py").write_text(RUNNER)
    runtime = ProcessRuntime("lab", tmp_path / "state", ProcessOptions(python_path=(str(tmp_path / "code"),)))
    runtime.start(launch(entrypoint="runner"))
    beat = tmp_path / "state/data/walker/toy/i1/beat"
    deadline = time.monotonic() + 60
    while not (beat.exists() and beat.read_bytes()):
        assert time.monotonic() < deadline, runtime.logs("i1", 9)
        time.sleep(0.01)
    runtime.remove("i1")
    last = beat.read_bytes()
    time.sleep(0.2)
    assert beat.read_bytes() == last


LOOKER = """
import json, os
path = json.load(open(os.environ["SKYTETHER_GRANT"]))["params"]["say"] + "/notes"
try:
    print("ran; read", open(path).read())
except OSError:
    print("ran; refused", path)
"""
RUN_ONE = """
import sys, time
from pathlib import Path
from skytether.api.grant import Grant
from skytether.api.manifest import ServiceSpec
from skytether.orchestrator.runtimes.base import Launch, Phase
from skytether.orchestrator.runtimes.process import ProcessOptions, ProcessRuntime
state, started = sys.argv[1:]
runtime = ProcessRuntime("lab", Path(state), ProcessOptions(python_path=(started + "/code",)))
session = {"session_id": "00112233445566aa", "session_key": "A" * 43 + "=", "topics": ()}
grant = Grant(instance="i1", service="toy", robot="walker", params={"say": started}, **session)
runtime.start(Launch(1, ServiceSpec(entrypoint="looker"), grant))
while runtime.observe()["i1"].phase is not Phase.EXITED:
    time.sleep(0.01)
print(runtime.logs("i1", 9), end="")
runtime.remove("i1")
"""
CROWD = """
import os, time
try:
    while os.fork():
        pass
    time.sleep(60)
except BlockingIOError:
    print("no more")
"""


@pytest.mark.slow
def test_no_instance_has_more_processes_than_its_manifest_says(tmp_path: Path) -> None:
    if not this_machine().user:
        pytest.skip("no users of their own")
    (tmp_path / "code").mkdir()
    (tmp_path / "code/crowd.py").write_text(CROWD)
    runtime = ProcessRuntime("lab", tmp_path / "state", ProcessOptions(python_path=(str(tmp_path / "code"),)))
    asked = launch(entrypoint="crowd")
    runtime.start(replace(asked, spec=ServiceSpec(entrypoint="crowd", limits=Limits(pids=20))))
    seen = until(runtime, Phase.EXITED)
    assert runtime.logs("i1", 9) == "no more\n"
    assert seen.exit_status == 0
    user = (tmp_path / "state/data/walker/toy/i1").stat().st_uid
    left = [one for one in psutil.process_iter(["uids"]) if one.info["uids"].real == user]
    runtime.remove("i1")
    assert 0 < len(left) <= 20


@pytest.mark.slow
def test_what_it_wrote_before_it_had_a_user_is_its_own_and_nothing_else_is(tmp_path: Path) -> None:
    if not this_machine().user:
        pytest.skip("no users of their own")
    data, secret = tmp_path / "data/walker/toy/i1", tmp_path / "secret"
    (data / "maps/old").mkdir(parents=True)
    (data / "maps/old/hall").touch(0o600)
    secret.touch(0o600)
    (data / "maps/link").symlink_to(secret)
    (data / "folder").symlink_to(tmp_path)
    (data / "same").hardlink_to(secret)
    runtime = ProcessRuntime("lab", tmp_path, ProcessOptions())
    runtime.start(launch())
    until(runtime, Phase.RUNNING)
    (user,) = {path.stat().st_uid for path in (data, data / "maps", data / "maps/old", data / "maps/old/hall")}
    assert users.noted_user(user)
    assert {path.stat().st_uid for path in (secret, tmp_path)} == {0}
    runtime.remove("i1")


@pytest.mark.slow
def test_what_holds_is_found_under_a_clock_that_is_faked_too(faketime: str) -> None:
    program = (
        "from skytether.orchestrator.runtimes.confinement import _imported, readable, this_machine\n"
        "tried = set()\n"
        "for _ in range(10):\n"
        "    this_machine.cache_clear()\n"
        "    _imported.cache_clear()\n"
        "    tried.add((this_machine(), tuple(readable(()))))\n"
        "print(*tried, sep='\\n')"
    )
    faked = {**os.environ, "LD_PRELOAD": faketime, "FAKETIME": "+1h", "FAKETIME_DONT_FAKE_MONOTONIC": "1"}
    command = [sys.executable, "-c", program]
    told = [subprocess.check_output(command, text=True, env=env).splitlines() for env in (dict(os.environ), faked)]
    assert told[0] == told[1]
    assert len(told[0]) == 1


def test_nobody_else_is_ended() -> None:
    for user in (-1, 0, 1000, users.USERS[1] + 1):
        with pytest.raises(ValueError, match="no instance's own user"):
            users.end_all_of(user)
        assert users.noted_user(user) is None


def test_a_folder_that_holds_the_state_is_not_for_services(tmp_path: Path) -> None:
    with pytest.raises(RuntimeFailure, match=rf"services may reach {tmp_path}, which holds {tmp_path}/sites/lab"):
        ProcessRuntime("lab", tmp_path / "sites/lab", ProcessOptions(readable=(tmp_path,)))
    with pytest.raises(RuntimeFailure, match="services may reach"):
        ProcessRuntime("lab", tmp_path / "sites/lab", ProcessOptions(writable=(tmp_path,)))


def test_a_launch_file_opens_neither_folders_nor_secrets(tmp_path: Path) -> None:
    state, kept = tmp_path / "sites/lab", tmp_path / "nav.launch"
    runtime = ProcessRuntime("lab", state, ProcessOptions(readable=(tmp_path / "maps",)))
    for name in ("nav.launch", "key", "maps/private", "sites/lab/data/other"):
        (tmp_path / name).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / name).touch()
        (tmp_path / name).chmod(0o600 if name in ("key", "maps/private") else 0o644)
    (tmp_path / "link").symlink_to(tmp_path / "key")

    def start(path: str) -> Launch:
        asked = launch(entrypoint="this")
        return replace(asked, spec=ServiceSpec(graph="ros1", entrypoint="this", launch=path))

    for wrong, why in (
        ("/", "is no file that every user may read"),
        (f"{tmp_path}", "is no file"),
        (f"{tmp_path}/key", "is no file"),
        (f"{tmp_path}/link", "is no file"),
        (f"{state}/data/other", "is in the orchestrator's state"),
        (f"{tmp_path}/none", "No such file"),
        ("/a\0b", "cannot be read"),
    ):
        with pytest.raises(RuntimeFailure, match=why):
            runtime.start(start(wrong))
    for right in (str(kept), f"{tmp_path}/maps/private", "package/nav.launch"):
        runtime.start(start(right))
        until(runtime, Phase.EXITED)
        runtime.remove("i1")


def test_what_holds_secrets_is_seen() -> None:
    assert opened(Path("/srv/state"), ["/usr", "/srv"]) == "/srv"
    assert opened(Path("/srv/state"), ["/usr"]) is None


@pytest.mark.slow
def test_services_read_nothing_of_where_the_orchestrator_was_started_but_what_is_theirs_in_it(tmp_path: Path) -> None:
    """Started by ``python -m`` in a folder that is closed to other users, with code of a site in it."""
    started = tmp_path / "started"
    (started / "code").mkdir(parents=True)
    (started / "code/looker.py").write_text(LOOKER)
    (started / "notes").write_text("secret")
    (started / "run.py").write_text(RUN_ONE)
    started.chmod(0o700)
    environment = {**os.environ, "PYTHONPATH": str(started)}
    done = subprocess.run(
        [sys.executable, "-m", "run", str(tmp_path / "state"), str(started)],
        cwd=started,
        env=environment,
        capture_output=True,
        text=True,
        timeout=60,
    )
    assert done.stdout == f"ran; refused {started}/notes\n", done


def test_the_outermost_folder_that_others_may_not_pass_is_covered(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(confinement, "COVERED", ("/run",))
    with tempfile.TemporaryDirectory(dir="/var/tmp") as root:  # above pytest's own is one that others may not pass
        for path, mode in (("", 0o755), ("a", 0o755), ("a/b", 0o700), ("a/b/c", 0o700), ("d", 0o755)):
            os.makedirs(f"{root}/{path}", exist_ok=True)
            os.chmod(f"{root}/{path}", mode)
        assert covers([f"{root}/a/b/c/e", f"{root}/a/b/c", f"{root}/d", "/run/x"]) == ["/run", f"{root}/a/b"]


def test_a_user_is_one_instances_of_all_sites_and_nobody_elses(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(users, "_taken", {})
    monkeypatch.setattr(users, "USERS", (61_184, 61_186))
    monkeypatch.setattr(users, "users_of_processes", lambda: {0, 61_185})
    first = users.allocate_user("lab/i1", None)
    second = users.allocate_user("edge/i1", None)
    assert {first, second} == {61_184, 61_186}
    assert users.allocate_user("lab/i1", None) == first
    with pytest.raises(RuntimeFailure, match="all users from 61184 to 61186 are taken"):
        users.allocate_user("lab/i2", 61_185)
    assert users.keep_user("lab/i3", second) is None
    users.free_user("edge/i1")
    assert users.allocate_user("lab/i2", second) == second
    monkeypatch.setattr(users, "_taken", {})
    assert users.keep_user("lab/i3", 61_185) == 61_185  # its own run
    monkeypatch.setattr(users, "USERS", (0, 0))
    monkeypatch.setattr(users, "users_of_processes", set)
    with pytest.raises(RuntimeFailure):  # root has a name
        users.allocate_user("lab/i4", None)


@pytest.mark.slow
def test_the_end_of_one_sites_instance_is_none_of_anothers(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    if not this_machine().user:
        pytest.skip("no users of their own")
    low = users.USERS[0] + secrets.randbelow(1000)
    monkeypatch.setattr(users, "USERS", (low, low + 1))  # so few that two sites would take the same one
    lab, edge = (ProcessRuntime(name, tmp_path / name, ProcessOptions()) for name in ("lab", "edge"))
    for runtime in (lab, edge):
        runtime.start(launch())
        until(runtime, Phase.RUNNING)
    again = ProcessRuntime("lab", tmp_path / "lab", ProcessOptions())  # as after a restart
    again.remove("i1")
    assert edge.observe_some(["i1"])["i1"].phase is Phase.RUNNING
    edge.remove("i1")
    lab.remove("i1")


def test_what_a_machine_lacks_is_said() -> None:
    assert Machine(0, seccomp=True, user=False, why="not permitted").lacks() == (
        "instances can read all of the orchestrator's secrets: the kernel has no Landlock, and there are no users of "
        "their own (not permitted)"
    )
    assert Machine(7, seccomp=True, user=False).lacks() == ""
    assert Machine(2, seccomp=True, user=False).lacks() == ""
    assert Machine(7, seccomp=False, user=True).lacks() == ""
    assert (
        "can change the modes of the orchestrator's files, and reach sockets"
        in Machine(7, seccomp=False, user=False).lacks()
    )
    assert "can empty the orchestrator's files, change" in Machine(2, seccomp=False, user=False).lacks()
    assert Machine(2, seccomp=False, user=True).holds() == ("own user", "own mounts", "Landlock 2")
    assert Machine(0, seccomp=False, user=True, hidden=True).holds() == ("own user", "own mounts", "own processes")


@pytest.mark.skipif(os.geteuid() != 0, reason="needs root, to make mounts")
def test_a_kernel_that_does_not_hide_processes_is_not_said_to() -> None:
    """Before Linux 5.8 the option is taken, and does nothing."""
    code = "import os, runpy, sys\nconfine = runpy.run_path(sys.argv[1])\nmount = confine['_mount']\n"
    code += (
        "if sys.argv[2] == 'old':\n    confine['own_mounts'].__globals__['_mount'] = lambda *given: mount(*given[:4])\n"
    )
    code += "print(confine['probe']())"

    def probed(kernel: str) -> Any:
        command = [sys.executable, "-I", "-S", "-c", code, confine.__file__, kernel]
        return ast.literal_eval(subprocess.run(command, capture_output=True, text=True, check=True).stdout)

    new = probed("new")
    if not new["hidden"]:
        pytest.skip("this machine hides no processes")
    assert new["user"]
    old = probed("old")
    assert (old["user"], old["hidden"]) == (True, False)


def test_a_link_or_a_pipe_for_a_ready_file_is_none_and_holds_nobody_up(tmp_path: Path) -> None:
    (tmp_path / "real").write_text('{"port": 4000}')
    (tmp_path / "link").symlink_to(tmp_path / "real")
    os.mkfifo(tmp_path / "pipe")
    assert noted_port(tmp_path / "real") == 4000
    assert noted_port(tmp_path / "link") is None
    assert noted_port(tmp_path / "pipe") is None


def test_a_program_that_the_service_does_not_see_is_named(tmp_path: Path) -> None:
    asked: dict[str, Any] = {
        "read": [],
        "write": [],
        "user": None,
        "landlock": 0,
        "seccomp": False,
        "command": [str(tmp_path / "x")],
    }
    done = subprocess.run([sys.executable, confine.__file__, json.dumps(asked)], capture_output=True, text=True)
    assert done.returncode == 1
    said = f"the service cannot be confined: [Errno 2] {tmp_path}/x: No such file or directory; the service does not"
    assert done.stderr.startswith(said)
