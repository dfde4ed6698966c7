"""The Docker runtime on a real engine: what the contract does not ask of every runtime."""

from __future__ import annotations

import json
import os
import platform
import socket
import ssl
import subprocess
from collections.abc import Iterator
from contextlib import closing, contextmanager
from pathlib import Path
from typing import Any

import psutil
import pytest
from docker_runs import KEY, PYTHON, docker, inside, launch, until, until_phase
from docker_site import DockerSite
from engine_ways import EngineProxy, Registry, ssh_server

from skytether.api.manifest import ServiceSpec
from skytether.lab.bench.transports.certificate import write_certificate
from skytether.orchestrator.runtimes.base import Observation, Phase, RuntimeFailure
from skytether.orchestrator.runtimes.docker import DockerRuntime
from skytether.orchestrator.runtimes.docker.volumes import remove_left

pytestmark = [pytest.mark.docker, pytest.mark.slow]


def until_gone(runtime: DockerRuntime) -> str:
    """Why it does not answer, once it does not."""

    def failure() -> str:
        try:
            runtime.observe()
        except RuntimeFailure as error:
            return str(error)
        return ""

    return until(failure)


@pytest.fixture
def runtime(docker_site: DockerSite, tmp_path: Path) -> Iterator[DockerRuntime]:
    with closing(docker_site.open(tmp_path)) as runtime:
        yield runtime


@pytest.fixture
def host_ports() -> Iterator[dict[str, int]]:
    """Ports of this machine, as an orchestrator or anything else may have them open: TCP and UDP."""
    with socket.create_server(("0.0.0.0", 0)) as tcp, socket.socket(type=socket.SOCK_DGRAM) as udp:
        udp.bind(("0.0.0.0", 0))
        udp.settimeout(1)
        yield {"tcp": tcp.getsockname()[1], "udp": udp.getsockname()[1], "fd": udp.fileno()}


_TRY = """
import json, socket
from concurrent.futures import ThreadPoolExecutor
def reaches(address):
    try:
        socket.create_connection(address, timeout=1.5).close()
    except OSError:
        return False
    return True
with ThreadPoolExecutor(64) as pool:
    print(json.dumps(list(pool.map(reaches, TRIED))))
"""


_SEND = """
import contextlib, socket
for address in TRIED:
    with contextlib.suppress(PermissionError):
        socket.socket(type=socket.SOCK_DGRAM).sendto(b"x", address)
print("true")
"""


def addresses() -> list[str]:
    """All of this machine's, bridges of the engine among them."""
    rows = json.loads(subprocess.run(["ip", "-j", "-4", "address"], check=True, capture_output=True).stdout)
    return [a["local"] for row in rows for a in row["addr_info"] if not a["local"].startswith("127.")]


def reaches(host: str, port: int) -> bool:
    try:
        socket.create_connection((host, port), timeout=1).close()
    except OSError:
        return False
    return True


def test_a_container_reaches_nobody(
    docker_site: DockerSite, runtime: DockerRuntime, host_ports: dict[str, int]
) -> None:
    for instance in ("i1", "i2"):
        runtime.start(launch(docker_site, instance))
    until_phase(runtime, Phase.RUNNING, "i1")
    until_phase(runtime, Phase.RUNNING, "i2")
    one, other = docker_site.containers()
    network = json.loads(docker("network", "inspect", docker_site.network))[0]
    gateway = network["IPAM"]["Config"][0]["Gateway"]
    neighbour = network["Containers"][other]["IPv4Address"].partition("/")[0]
    serve = "import socket, time; s = socket.create_server(('', 8080)); time.sleep(60)"
    docker("exec", "-d", other, PYTHON, "-c", serve)
    until(lambda: reaches(neighbour, 8080))  # from this machine, as whoever may
    tried = [(host, host_ports["tcp"]) for host in (gateway, *addresses())]
    tried += [(neighbour, 8080), ("169.254.169.254", 80), ("192.0.2.1", 80)]
    # The same question from a container on the engine's own network shows that it is a good one.
    asked = _TRY.replace("TRIED", repr(tried[:1]))
    free = docker("run", "--rm", "--entrypoint", PYTHON, docker_site.images.toy, "-c", asked)
    assert json.loads(free) == [True]
    assert inside(one, _TRY.replace("TRIED", repr(tried))) == [False] * len(tried)
    assert inside(one, _SEND.replace("TRIED", repr([(host, host_ports["udp"]) for host, _ in tried])))
    with socket.fromfd(host_ports["fd"], socket.AF_INET, socket.SOCK_DGRAM) as udp:
        udp.settimeout(1)
        with pytest.raises(TimeoutError):
            udp.recv(10)


_ASK = """
import json, socket, struct, time
def ask(ip, server):
    labels = [*reversed(ip.split(".")), "in-addr", "arpa"]
    name = b"".join(bytes([len(label)]) + label.encode() for label in labels)
    asked = struct.pack(">6H", 7, 0x100, 1, 0, 0, 0) + name + b"\\0" + struct.pack(">2H", 12, 1)
    with socket.socket(type=socket.SOCK_DGRAM) as sock:
        sock.settimeout(1)
        try:
            sock.sendto(asked, server)
            return sock.recv(1000)[-60:].decode("latin-1")
        except OSError:
            return ""
rows = [row.split()[1].split(":") for row in open("/proc/net/udp").read().splitlines()[1:]]
ports = [53] + [int(port, 16) for address, port in rows if address == "0B00007F"]
told = [answer for port in ports for ip in ASKED if (answer := ask(ip, ("127.0.0.11", port)))]
before = time.monotonic()
try:
    socket.getaddrinfo("nowhere.example", 1)
except OSError:
    took = time.monotonic() - before
with socket.socket(type=socket.SOCK_DGRAM) as sock:
    for n in range(5000):
        sock.sendto(b"x", (f"127.1.{n // 250}.{1 + n % 250}", 5000))
tracked = int(open("/proc/sys/net/netfilter/nf_conntrack_count").read())
print(json.dumps({"ports": len(ports), "told": told, "took": took, "tracked": tracked}))
"""


def test_a_container_learns_no_names_of_others_and_fills_no_table_of_the_kernel(
    docker_site: DockerSite, runtime: DockerRuntime
) -> None:
    """The engine's own name server told who else is there, and what a service sent to itself was remembered outside."""
    for instance in ("i1", "i2"):
        runtime.start(launch(docker_site, instance))
        until_phase(runtime, Phase.RUNNING, instance)
    network = json.loads(docker("network", "inspect", docker_site.network))[0]
    asked = [there["IPv4Address"].partition("/")[0] for there in network["Containers"].values()]
    assert len(asked) >= 2
    for container in docker_site.containers():
        found = inside(container, f"ASKED = {asked!r}\n{_ASK}")
        assert found["ports"] == 2, "where the name server is can be seen"
        assert found["told"] == []
        assert found["took"] < 5, "and is not waited for"
        assert found["tracked"] < 100


def test_what_a_site_opens_is_open_and_no_more_and_no_reload_of_the_machines_firewall_ends_it(
    docker_site: DockerSite, host_ports: dict[str, int], tmp_path: Path
) -> None:
    (address, *_) = addresses()
    egress = [f"{address}:{host_ports['tcp']}", f"{address}:{host_ports['udp']}/udp", "localhost:1"]
    with closing(docker_site.open(tmp_path, egress=[f"{address}:*", "localhost:1/tcp"])) as runtime:
        runtime.start(launch(docker_site, needs={"egress": egress}))
        until_phase(runtime, Phase.RUNNING)
        (container,) = docker_site.containers()
        with socket.create_server(("0.0.0.0", 0)) as closed:
            tried = [(address, host_ports["tcp"]), (address, closed.getsockname()[1])]
            assert inside(container, _TRY.replace("TRIED", repr(tried))) == [True, False]
        assert inside(container, _SEND.replace("TRIED", repr([(address, host_ports["udp"])])))
        with socket.fromfd(host_ports["fd"], socket.AF_INET, socket.SOCK_DGRAM) as udp:
            udp.settimeout(5)
            assert udp.recv(10) == b"x"
        assert "localhost" in docker("exec", container, "cat", "/etc/hosts")
        # Nothing of it is in the machine's own firewall, which may be read anew at any time.
        assert "table inet skytether {" not in docker_site.nft("host", "list ruleset")
        assert "policy drop" in docker_site.nft(f"container:{container}", "list table inet skytether")
        runtime.remove("i1")


def test_nothing_runs_in_the_network_whose_filter_could_not_be_set(docker_site: DockerSite, tmp_path: Path) -> None:
    with closing(docker_site.open(tmp_path, guard_image=docker_site.images.toy)) as runtime:  # it has no nft
        runtime.start(launch(docker_site))
        assert "nft" in until_phase(runtime, Phase.EXITED).detail
        assert docker_site.containers() == []


def test_a_container_may_do_little(docker_site: DockerSite, runtime: DockerRuntime) -> None:
    runtime.start(launch(docker_site, needs={"memory_mb": 100}, limits={"cpu": 0.5, "pids": 40}))
    until_phase(runtime, Phase.RUNNING)
    (container,) = docker_site.containers()
    status = inside(
        container,
        "import json; print(json.dumps(dict(l.split(':', 1) for l in open('/proc/self/status').read().splitlines())))",
    )
    said = {key: value.split() for key, value in status.items()}
    assert set(said["Uid"]) == set(said["Gid"]) == {"65532"}
    assert {said[key][0] for key in ("CapInh", "CapPrm", "CapEff", "CapBnd", "CapAmb")} == {"0" * 16}
    assert said["NoNewPrivs"] == ["1"]
    assert said["Seccomp"] == ["2"]
    tried = inside(
        container,
        """
import json, os
def writes(folder):
    try:
        open(os.path.join(folder, "x"), "w").close()
    except OSError as error:
        return error.strerror
    return ""
print(json.dumps([writes(f) for f in ("/", "/app", "/run/skytether", "/tmp", "/var/lib/skytether/i1")]))
""",
    )
    assert tried == ["Read-only file system", "Read-only file system", "Permission denied", "", ""]
    host = json.loads(docker("inspect", container))[0]["HostConfig"]
    assert (host["Memory"], host["NanoCpus"], host["PidsLimit"]) == (100 << 20, 500_000_000, 40)
    assert 10 < inside(container, _THREADS) < 40


_THREADS = """
import threading, time
n = 0
try:
    while n < 60:
        threading.Thread(target=time.sleep, args=(3,), daemon=True).start()
        n += 1
except RuntimeError:
    pass
print(n)
"""


def test_the_key_is_seen_by_the_service_alone(docker_site: DockerSite, runtime: DockerRuntime) -> None:
    runtime.start(launch(docker_site, params={"environment": True}))
    until_phase(runtime, Phase.RUNNING)
    (container,) = docker_site.containers()
    grant = "/run/skytether/instance/grant.json"
    assert inside(container, f"print(open('{grant}').read())")["session_key"] == KEY
    mode = inside(container, f"import json, os; s = os.stat('{grant}'); print(json.dumps([s.st_uid, oct(s.st_mode)]))")
    assert mode == [65_532, "0o100400"]
    assert docker("exec", "-u", "1000:1000", container, "cat", grant, check=False) == ""
    told = [docker("inspect", container), docker("exec", container, "env"), docker("logs", container)]
    told.append(docker("top", container, "-eo", "pid,args"))
    assert not [text for text in told if KEY in text]
    volume = next(m for m in json.loads(told[0])[0]["Mounts"] if m["Destination"] == "/run/skytether")
    runtime.remove("i1")
    assert volume["Name"] not in docker("volume", "ls", "-q").split()


_CALLS = """
import ctypes, errno, json
libc = ctypes.CDLL(None, use_errno=True)
def refused(number, *arguments):
    ctypes.set_errno(0)
    return libc.syscall(number, *arguments) == -1 and ctypes.get_errno() == errno.EPERM
calls = {"ptrace": (101, 0), "process_vm_readv": (310, 1, 0, 0, 0, 0, 0), "unshare of users": (272, 0x10000000),
         "keyctl": (250, 0, 0, 0), "io_uring_setup": (425, 1, 0), "shmget": (29, 0, 4096, 0o1600), "mount": (165,),
         "personality": (135, 0xFFFFFFFF), "packets": (41, 17, 3, 0)}
print(json.dumps([name for name, call in calls.items() if not refused(*call)]))
"""


@pytest.mark.skipif(platform.machine() != "x86_64", reason="the numbers of the calls are those of x86_64")
def test_calls_of_the_kernel_that_no_service_needs_are_refused(docker_site: DockerSite, runtime: DockerRuntime) -> None:
    runtime.start(launch(docker_site))
    until_phase(runtime, Phase.RUNNING)
    (container,) = docker_site.containers()
    assert inside(container, _CALLS) == []
    assert {"user 65532", "no capabilities", "seccomp"} <= set(runtime.isolation())
    toy = ("--entrypoint", PYTHON, docker_site.images.toy, "-c", _CALLS)
    open_there = json.loads(docker("run", "--rm", "--security-opt", "seccomp=unconfined", "--user", "65532", *toy))
    assert {"unshare of users", "shmget", "personality"} <= set(open_there), "the questions are good ones"


def test_what_it_writes_stays(docker_site: DockerSite, runtime: DockerRuntime) -> None:
    runtime.start(launch(docker_site))
    until_phase(runtime, Phase.RUNNING)
    (container,) = docker_site.containers()
    inside(container, "open('/var/lib/skytether/i1/recording', 'w').write('kept'); print(1)")
    runtime.remove("i1")
    assert docker_site.containers() == []
    (volume,) = docker_site.volumes()
    toy = docker_site.images.toy
    assert docker("run", "--rm", "-v", f"{volume}:/d", "--entrypoint", "cat", toy, "/d/i1/recording") == "kept"


def test_a_volume_of_which_another_container_may_have_a_folder_stays_until_that_one_has_ended(
    docker_site: DockerSite, runtime: DockerRuntime
) -> None:
    """An engine that was built with an older Go follows a folder that becomes a link while it removes that."""
    for instance in ("i1", "i2"):  # of one service and one robot: they have a volume of data in common
        runtime.start(launch(docker_site, instance))
        until_phase(runtime, Phase.RUNNING, instance)
    assert len(docker_site.volumes_with("skytether.io/instance")) == 2
    runtime.remove("i1")
    assert len(docker_site.containers()) == 1
    remove_left(runtime.engine, docker_site.owner)
    assert len(docker_site.volumes_with("skytether.io/instance=i1")) == 1
    runtime.remove("i2")
    assert docker_site.volumes_with("skytether.io/instance=i2") == [], "its own went with it"
    remove_left(runtime.engine, docker_site.owner)
    assert docker_site.volumes_with("skytether.io/instance") == []
    assert len(docker_site.volumes()) == 1, "that of data"


def test_what_writes_too_much_is_ended_and_not_started_again_until_there_is_room(
    docker_site: DockerSite, tmp_path: Path
) -> None:
    with closing(docker_site.open(tmp_path, data_mb=1)) as runtime:
        runtime.start(launch(docker_site))
        until_phase(runtime, Phase.RUNNING)
        (container,) = docker_site.containers()
        inside(container, "open('/var/lib/skytether/i1/much', 'wb').write(bytes(3 << 20)); print(1)")
        runtime.scales.weigh()
        assert "has more than 1 MiB in the volume" in runtime.observe()["i1"].exceeds
        with pytest.raises(RuntimeFailure, match="has more than 1 MiB"):
            runtime.start(launch(docker_site, "i2"))
        inside(container, "import os; os.remove('/var/lib/skytether/i1/much'); print(1)")
        runtime.scales.weigh()
        assert runtime.observe()["i1"].exceeds == ""
        inside(container, "open('/run/skytether/instance/much', 'wb').write(bytes(65 << 20)); print(1)")
        runtime.scales.weigh()
        assert runtime.observe()["i1"].exceeds == "has more than 64 MiB in a volume that is not for data"
        runtime.remove("i1")


def test_what_hides_from_being_weighed_is_ended(docker_site: DockerSite, tmp_path: Path) -> None:
    """An engine that comes to a folder too deep for a path says nothing of the volume, however much is beside it."""
    with closing(docker_site.open(tmp_path, data_mb=1)) as runtime:
        runtime.start(launch(docker_site))
        until_phase(runtime, Phase.RUNNING)
        (container,) = docker_site.containers()
        inside(container, _HIDE)
        for _ in range(2):
            runtime.scales.weigh()
        assert "the engine cannot tell how much is in there" in runtime.observe()["i1"].exceeds
        with pytest.raises(RuntimeFailure, match="the engine cannot tell"):
            runtime.start(launch(docker_site, "i2"))
        runtime.remove("i1")


_HIDE = """
import os
os.chdir("/var/lib/skytether/i1")
open("much", "wb").write(bytes(3 << 20))
for _ in range(30):
    os.mkdir("d" * 200)
    os.chdir("d" * 200)
print(1)
"""


def test_ends_are_told_apart(docker_site: DockerSite, runtime: DockerRuntime) -> None:
    runtime.start(launch(docker_site, "hog", params={"hog_mb": 200}, needs={"memory_mb": 40}))
    runtime.start(launch(docker_site, "killed"))
    runtime.start(launch(docker_site, "missing", image="skytether/no-such-thing:1"))
    runtime.start(launch(docker_site, "bad", params={"exit_status": 3, "say": "boom"}))
    until_phase(runtime, Phase.RUNNING, "killed")
    docker("kill", *[c for c in docker_site.containers() if "killed" in docker("inspect", "-f", "{{.Name}}", c)])
    assert until_phase(runtime, Phase.EXITED, "killed").exit_status == -9
    hog = until_phase(runtime, Phase.EXITED, "hog")
    assert hog.detail.startswith("ran out of memory: its limit is 40 MiB")
    missing = until_phase(runtime, Phase.EXITED, "missing")
    assert missing.detail.startswith("could not be started: image 'skytether/no-such-thing:1' is not on the engine")
    bad = until_phase(runtime, Phase.EXITED, "bad")
    assert (bad.exit_status, bad.detail, bad.last_line) == (3, "", "boom")


@pytest.fixture
def device(docker_site: DockerSite) -> Iterator[tuple[str, int]]:
    """A device file of this machine that a group may open and others may not, and the group's number."""
    path, group = f"/dev/{docker_site.owner}", 44_444
    root = ["run", "--rm", "-u", "0", "-v", "/dev:/dev", "--entrypoint", "sh"]
    make = f"mknod -m 660 {path} c 1 3 && chown 0:{group} {path}"
    docker(*root, docker_site.images.toy, "-c", make)
    yield path, group
    docker(*root, docker_site.images.toy, "-c", f"rm {path}")


def test_devices_of_the_machine(docker_site: DockerSite, tmp_path: Path, device: tuple[str, int]) -> None:
    path, group = device
    there: dict[str, Any] = {"devices": [path, "/dev/unplugged"], "groups": [group], "gpu": 1}
    with closing(docker_site.open(tmp_path, **there)) as runtime:
        runtime.start(launch(docker_site, "with", needs={"devices": [path]}))
        runtime.start(launch(docker_site, "missing", needs={"devices": ["/dev/unplugged"]}))
        runtime.start(launch(docker_site, "gpu", needs={"gpu": 1}))
        missing = until_phase(runtime, Phase.EXITED, "missing")
        assert missing.detail.startswith("could not be started: error gathering device information")
        assert missing.detail.endswith("plug it in, or take it out of the site's option 'devices'")
        gpu = until_phase(runtime, Phase.EXITED, "gpu")  # no machine that runs tests has one
        assert "the engine has no NVIDIA container toolkit" in gpu.detail
        until_phase(runtime, Phase.RUNNING, "with")
        (container,) = docker_site.containers()
        assert inside(container, f"open('{path}', 'wb').write(b'x'); print(1)") == 1


def test_a_log_is_followed_until_its_run_ends(docker_site: DockerSite, runtime: DockerRuntime) -> None:
    assert runtime.follow("i1", 10) is None
    runtime.start(launch(docker_site, params={"say": "hello", "flood": 3}))
    until_phase(runtime, Phase.RUNNING)
    stream = runtime.follow("i1", 2)
    assert stream is not None
    text = ""
    while "line 2" not in text:
        text += stream.read() or ""
    assert text == "line 1\nline 2\n"
    runtime.stop("i1", force=True)
    while (piece := stream.read()) is not None:
        text += piece
    stream.close()
    assert text == "line 1\nline 2\n"
    until_phase(runtime, Phase.EXITED)
    assert runtime.follow("i1", 2) is None


def test_what_it_uses_is_told_while_it_runs(docker_site: DockerSite, runtime: DockerRuntime) -> None:
    runtime.start(launch(docker_site, params={"hog_mb": 20}))
    until_phase(runtime, Phase.RUNNING)

    def measured() -> Observation | None:
        """Since it has what it is to hog: the first figures may be from before."""
        now = runtime.observe()["i1"]
        return now if (now.memory_bytes or 0) > 20 << 20 else None

    seen = until(measured)
    assert seen.cpu_s > 0.001
    with socket.socket(type=socket.SOCK_DGRAM) as robot:

        def received() -> bool:
            robot.sendto(b"x" * 1000, (seen.host, seen.port))
            return runtime.observe()["i1"].received_bytes > seen.received_bytes + 5000

        until(received)
    runtime.stop("i1", force=True)
    assert until_phase(runtime, Phase.EXITED).cpu_s is None


def test_a_port_that_is_taken(docker_site: DockerSite, tmp_path: Path) -> None:
    with socket.socket(type=socket.SOCK_DGRAM) as taken:
        taken.bind(("127.0.0.1", 0))
        port = taken.getsockname()[1]
        with closing(docker_site.open(tmp_path, ports=[port, port])) as runtime:
            runtime.start(launch(docker_site))
            seen = until_phase(runtime, Phase.EXITED)
            assert (
                seen.detail == f"could not be started: every UDP port from {port} to {port} is taken (option 'ports')"
            )
            assert docker_site.containers() == []


@contextmanager
def checked(site: DockerSite, folder: Path, check: str, timeout: str) -> Iterator[str]:
    """An image of the toy with another health check, which is asked often."""
    image = site.images.name("checked")
    often = f"--interval=200ms --timeout={timeout} --start-period=1ms --retries=2"
    (folder / "Dockerfile").write_text(f"FROM {site.images.toy}\nHEALTHCHECK {often} CMD {check}\n")
    environment = {**os.environ, "DOCKER_BUILDKIT": "0"}
    subprocess.run(
        ["docker", "build", "-q", "-t", image, str(folder)], check=True, env=environment, capture_output=True
    )
    try:
        yield image
    finally:
        docker("image", "rm", "-f", image)


def test_an_ill_container_says_so(docker_site: DockerSite, runtime: DockerRuntime, tmp_path: Path) -> None:
    with checked(docker_site, tmp_path, '["/bin/sh", "-c", "echo its arm is stuck; exit 1"]', "20s") as image:
        runtime.start(launch(docker_site, image=image))
        until(lambda: (seen := runtime.observe()["i1"]).phase is Phase.RUNNING and seen.detail == "its arm is stuck")
        runtime.remove("i1")


def test_who_is_asked_too_slowly_is_not_ill(docker_site: DockerSite, runtime: DockerRuntime, tmp_path: Path) -> None:
    """As on a machine that is so busy that no check of a health ends in time."""
    with checked(docker_site, tmp_path, '["sleep", "600"]', "500ms") as image:
        runtime.start(launch(docker_site, image=image))
        until_phase(runtime, Phase.RUNNING)
        (container,) = docker_site.containers()
        until(lambda: docker("inspect", "-f", "{{.State.Health.Status}}", container) == "unhealthy")
        runtime.follower.inspect(container)
        assert runtime.observe()["i1"].detail == ""
        runtime.remove("i1")


def test_a_network_that_was_pruned_is_made_again_and_goes_with_its_site(
    docker_site: DockerSite, runtime: DockerRuntime
) -> None:
    runtime.start(launch(docker_site))
    until_phase(runtime, Phase.RUNNING)
    runtime.dismantle()  # in use: it stays
    runtime.remove("i1")
    docker("network", "rm", docker_site.network)  # as `docker system prune` does
    runtime.start(launch(docker_site, attempt=2))
    until_phase(runtime, Phase.RUNNING)
    runtime.remove("i1")
    runtime.dismantle()
    runtime.dismantle()
    assert docker_site.network not in docker("network", "ls", "--format", "{{.Name}}").split()


def test_what_is_not_ours_is_left_alone(docker_site: DockerSite, runtime: DockerRuntime) -> None:
    labels = ["--label", "skytether.io/instance=i1", "--label", "skytether.io/attempt=1"]
    toy, sleep = docker_site.images.toy, ["--entrypoint", "sleep"]
    plain = docker("run", "-d", *sleep, toy, "100")
    elsewhere = docker("run", "-d", *labels, "--label", "skytether.io/owner=somebody-else", *sleep, toy, "100")
    try:
        assert runtime.observe() == {}
        runtime.start(launch(docker_site))
        until_phase(runtime, Phase.RUNNING)
        runtime.stop("i1", force=True)
        runtime.remove("i1")
        states = [docker("inspect", "-f", "{{.State.Status}}", c) for c in (plain, elsewhere)]
        assert states == ["running", "running"]
    finally:
        docker("rm", "-f", plain, elsewhere)


def test_an_engine_that_goes_away_and_comes_back(docker_site: DockerSite, tmp_path: Path) -> None:
    proxy = EngineProxy(tmp_path / "engine.sock")
    with closing(docker_site.open(tmp_path, engine=proxy.engine)) as runtime:
        assert "does not answer: No such file or directory" in until_gone(runtime)
        proxy.start()
        until(lambda: runtime_answers(runtime))
        runtime.start(launch(docker_site))
        before = until_phase(runtime, Phase.RUNNING)
        proxy.cut()
        assert "does not answer" in until_gone(runtime)
        with pytest.raises(RuntimeFailure):
            runtime.capacity()
        with pytest.raises(RuntimeFailure):
            runtime.logs("i1", 10)
        (container,) = docker_site.containers()
        docker("kill", container)  # while nobody looks
        proxy.start()
        until(lambda: runtime_answers(runtime))
        after = until_phase(runtime, Phase.EXITED)
        assert (after.attempt, after.exit_status) == (before.attempt, -9)
    proxy.cut()


def stopped(runtime: DockerRuntime) -> bool:
    """Ask as the reconciler does: again, when the site did not answer."""
    try:
        runtime.stop("i1", force=True)
    except RuntimeFailure:
        return False
    return True


def is_seen(runtime: DockerRuntime, phase: Phase) -> bool:
    """Whether the engine answers, and says so."""
    try:
        return runtime.observe()["i1"].phase is phase
    except RuntimeFailure:
        return False


def runtime_answers(runtime: DockerRuntime) -> bool:
    try:
        runtime.observe()
    except RuntimeFailure:
        return False
    return True


def test_an_engine_behind_tls(docker_site: DockerSite, tmp_path: Path) -> None:
    ca, cert, key = map(str, write_certificate("127.0.0.1", tmp_path))
    context = ssl.SSLContext(ssl.PROTOCOL_TLS_SERVER)
    context.load_cert_chain(cert, key)
    context.load_verify_locations(ca)
    context.verify_mode = ssl.CERT_REQUIRED
    proxy = EngineProxy(context=context)
    proxy.start()
    folder = tmp_path / "stranger"
    folder.mkdir()
    stranger = dict(zip(("ca", "cert", "key"), map(str, write_certificate("127.0.0.1", folder)), strict=True))
    try:
        ours = {"engine": proxy.engine, "tls": {"ca": ca, "cert": cert, "key": key}, "bind_host": "127.0.0.1"}
        with closing(docker_site.open(tmp_path, **ours)) as runtime:
            runtime.start(launch(docker_site))
            seen = until_phase(runtime, Phase.RUNNING)
            assert seen.host == "127.0.0.1"
            assert "toy service" in runtime.logs("i1", 10)
        for wrong in (stranger, {**stranger, "ca": ca}):  # we do not know it; it does not know us
            with closing(docker_site.open(tmp_path, **{**ours, "tls": wrong})) as runtime:
                assert "does not answer" in until_gone(runtime)
    finally:
        proxy.cut()


def test_an_engine_behind_ssh(sshd: str, docker_site: DockerSite, tmp_path: Path) -> None:
    with ssh_server(sshd) as options:
        with closing(docker_site.open(tmp_path, **options, bind_host="127.0.0.1")) as runtime:
            runtime.start(launch(docker_site))
            seen = until_phase(runtime, Phase.RUNNING)
            assert seen.host == "127.0.0.1"
            assert "toy service" in runtime.logs("i1", 10)
            (tunnel,) = (child for child in psutil.Process().children() if child.name() == "ssh")
            tunnel.kill()  # the network is gone for a moment
            tunnel.wait()
            until(lambda: is_seen(runtime, Phase.RUNNING))
            until(lambda: stopped(runtime))
            until(lambda: is_seen(runtime, Phase.EXITED))
        unknown = {**options, "ssh": {**options["ssh"], "known_hosts": str(tmp_path / "none")}}
        with closing(docker_site.open(tmp_path, **unknown)) as runtime:
            assert "Host key verification failed" in until_gone(runtime)


def test_a_private_registry_with_digests(docker_site: DockerSite, tmp_path: Path) -> None:
    registry = Registry()
    pinned = f"{registry.image}@{registry.digest}"
    told: set[str] = set()
    try:
        wrong = registry.credentials(tmp_path, "open")
        with closing(docker_site.open(tmp_path, pull="missing", registry_auth=wrong)) as runtime:
            runtime.start(launch(docker_site, image=pinned))
            seen = until_phase(runtime, Phase.EXITED)
            assert seen.detail.startswith(f"could not be started: image '{pinned}' is not on the engine and cannot")
        right = registry.credentials(tmp_path)
        with closing(docker_site.open(tmp_path, pull="missing", registry_auth=right, pinned=True)) as runtime:
            assert "digest" in str(runtime.refuses(ServiceSpec(image=f"{registry.image}:1")))
            runtime.start(launch(docker_site, image=pinned, attempt=2))

            def ended() -> bool:
                seen = runtime.observe()["i1"]
                told.add(str(seen.pull or ""))
                return seen.phase is Phase.EXITED

            until(ended)
            # It came as it is named; that there is nothing in it to run is another matter.
            assert registry.digest in docker("image", "inspect", "-f", "{{.RepoDigests}}", pinned)
            assert any(text.endswith(" of 3 MB") for text in told), told
            assert runtime.observe()["i1"].exit_status == 127
    finally:
        registry.close()
        docker("image", "rm", "-f", pinned, check=False)
