"""What tests of every package share: the means that not every machine has."""

from __future__ import annotations

import contextlib
import ctypes.util
import gc
import json
import os
import secrets
import shutil
import signal
import subprocess
import time
from collections.abc import Generator, Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Any, NoReturn

import pytest
import slow_tests
from hypothesis import HealthCheck, settings
from one_run import begun_once, folder_of, turn
from postgres_server import PostgresServer, own_server

if TYPE_CHECKING:
    from docker_site import DockerSite, Images
    from kubernetes_site import KubernetesSite

# How long an example takes says nothing on a machine that others use too. `make fuzz` is where to look for more.
# The same examples each time: a test that fails for somebody fails for everybody. SKYTETHER_RANDOM=1 draws others.
settings.register_profile(
    "skytether",
    deadline=None,
    max_examples=30,
    derandomize=os.environ.get("SKYTETHER_RANDOM", "") == "",
    suppress_health_check=[HealthCheck.too_slow],  # as with the deadline: it goes by the clock
)
settings.load_profile("skytether")

pytest.register_assert_rewrite("skytether.testing.runtime_contract")

# A run under nohup ignores it, and so would every program that a test starts.
signal.signal(signal.SIGHUP, signal.SIG_DFL)


QUICK_S = 0.5
"""Of processor time; a quick test that takes more belongs among the slow ones, or is made cheaper."""
LEFT_OPEN = 50
"""Descriptors that a test may leave; beyond 1,024 open ones `select` fails, in whatever test comes then."""
_BEGAN = pytest.StashKey[float]()
_OPEN = pytest.StashKey[int]()


@pytest.hookimpl(tryfirst=True)
def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    slow_tests.arrange(items)


def pytest_configure() -> None:
    """Started in the background of a script, a program has its interrupt signal ignored, and so have its children."""
    if signal.getsignal(signal.SIGINT) is signal.SIG_IGN:
        signal.signal(signal.SIGINT, signal.default_int_handler)


def pytest_collection() -> None:
    """Nothing of what is collected goes before the end: to look for it again and again takes 2 s."""
    gc.disable()


@pytest.hookimpl(trylast=True)
def pytest_collection_finish() -> None:
    """Nor does the collector look through all of that in each test in which it comes along: it would take 1 s."""
    gc.freeze()
    gc.enable()


@pytest.hookimpl(tryfirst=True)
def pytest_runtest_setup(item: pytest.Item) -> None:
    item.stash[_BEGAN] = time.process_time()
    item.stash[_OPEN] = len(os.listdir("/proc/self/fd"))


@pytest.hookimpl(trylast=True)
def pytest_runtest_teardown(item: pytest.Item) -> None:
    left = len(os.listdir("/proc/self/fd")) - item.stash[_OPEN]
    if left > LEFT_OPEN:
        pytest.fail(f"it leaves {left} descriptors open, {LEFT_OPEN} at most", pytrace=False)


@pytest.hookimpl(wrapper=True)
def pytest_runtest_makereport(item: pytest.Item) -> Generator[None, pytest.TestReport, pytest.TestReport]:
    """Note what a quick test cost, with its fixtures; whoever else uses the machine adds little to that."""
    report = yield
    if report.when == "teardown" and item.get_closest_marker("slow") is None and _BEGAN in item.stash:
        report.user_properties.append(("processor_s", time.process_time() - item.stash[_BEGAN]))
    return report


def pytest_terminal_summary(terminalreporter: pytest.TerminalReporter) -> None:
    """The costliest quick tests, and why a test was run again: pytest keeps that to itself where it then passed."""
    ended = (report for report in terminalreporter.stats.get("", ()) if report.when == "teardown")
    costs = [(dict(report.user_properties).get("processor_s", 0.0), report.nodeid) for report in ended]
    costly = sorted((cost for cost in costs if cost[0] > QUICK_S), reverse=True)
    if costly:
        terminalreporter.section(f"quick tests of more than {QUICK_S} s of processor time: {len(costly)}")
    for seconds, name in costly[:10]:
        terminalreporter.write_line(f"{seconds:.2f}s {name}")
    for report in terminalreporter.stats.get("rerun", ()):
        why = getattr(getattr(report.longrepr, "reprcrash", None), "message", report.longrepr)
        terminalreporter.write_line(f"run again: {report.nodeid}, for {' '.join(str(why).split())[:3000]}")


def require(name: str, reason: str) -> NoReturn:
    """Skip the test because the means ``name`` is not here; fail where it was promised to be.

    ``SKYTETHER_REQUIRE=data,docker`` promises: a machine that is set up for these must not skip them silently.
    """
    promised = os.environ.get("SKYTETHER_REQUIRE", "").replace(",", " ").split()
    if name in promised:
        pytest.fail(f"'{name}' is listed in SKYTETHER_REQUIRE, but {reason}", pytrace=False)
    pytest.skip(reason)


@pytest.fixture
def full_pipe() -> Iterator[int]:
    """The end to write to of a pipe that is full, and that nobody reads."""
    reader, writer = os.pipe()
    os.set_blocking(writer, False)
    with contextlib.suppress(BlockingIOError):
        while True:
            os.write(writer, bytes(4096))
    os.set_blocking(writer, True)
    yield writer
    os.close(reader)
    os.close(writer)


@pytest.fixture(scope="session")
def data_dir() -> Path:
    """The directory of real recordings, for tests marked ``data``."""
    folder = os.environ.get("SKYTETHER_DATA", "")
    if not folder:
        require("data", "SKYTETHER_DATA does not name the directory of the recordings")
    if not Path(folder).is_dir():
        require("data", f"SKYTETHER_DATA names {folder}, which is no directory")
    return Path(folder)


@pytest.fixture(scope="session")
def terraform_program() -> str:
    """Terraform, or OpenTofu, which does the same."""
    found = shutil.which("terraform") or shutil.which("tofu")
    if found is None:
        require("terraform", "neither terraform nor tofu is here")
    return found


@pytest.fixture(scope="session")
def netns() -> None:
    """Network namespaces and TUN devices, for tests that need a network of their own (root on Linux)."""
    from skytether.lab.netns import why_unavailable

    trouble = why_unavailable()
    if trouble is not None:
        require("netns", trouble)


@pytest.fixture(scope="session")
def nftables(netns: None) -> None:
    """The programs of a router that translates addresses, for network namespaces."""
    for program in ("nft", "conntrack"):
        if shutil.which(program) is None:
            require("nftables", f"the program '{program}' is missing: install nftables and conntrack")


@pytest.fixture(scope="session")
def ros1() -> None:
    """A ROS 1 installation: master, rospy and the tools, under the system's Python."""
    for program in ("rosmaster", "roslaunch", "rosbag"):
        if shutil.which(program) is None:
            require("ros1", f"the program '{program}' is missing: install ros-core and python3-rospy")


@pytest.fixture(scope="session")
def ros2() -> str:
    """A Python that has ROS 2 (rclpy): the one that ``SKYTETHER_ROS2_PYTHON`` names, or that of `make ros2`."""
    python = os.environ.get("SKYTETHER_ROS2_PYTHON") or str(Path(__file__).parents[1] / ".venv-ros2/bin/python")
    if not Path(python).exists():
        require("ros2", f"there is no {python}: run `make ros2`, or name ROS 2's Python with SKYTETHER_ROS2_PYTHON")
    tried = subprocess.run([python, "-c", "import rclpy"], capture_output=True, text=True)
    if tried.returncode:
        require("ros2", f"{python} cannot import rclpy: {tried.stderr.strip().splitlines()[-1]}; run `make ros2`")
    return python


@pytest.fixture(scope="session")
def systemd() -> None:
    """The program that reads and scores units."""
    if shutil.which("systemd-analyze") is None:
        require("systemd", "the program 'systemd-analyze' is missing: install systemd")


@pytest.fixture(scope="session")
def faketime() -> str:
    """A library that gives a program, by LD_PRELOAD, a wall clock which a test can set."""
    found = sorted(Path("/usr/lib").glob("*/faketime/libfaketimeMT.so.1"))
    if not found:
        require("faketime", "there is no libfaketimeMT.so.1: install libfaketime")
    return str(found[0])


@pytest.fixture(scope="session")
def gl() -> None:
    """What draws without a display, for the simulated camera."""
    if all(ctypes.util.find_library(name) is None for name in ("OSMesa", "EGL")):
        require("gl", "there is no OpenGL that draws without a display: install libosmesa6")


@pytest.fixture(scope="session")
def docker_engine() -> str:
    """A Docker engine that answers, and the image that everything is built on; its version."""
    if shutil.which("docker") is None:
        require("docker", "the program 'docker' is missing: install docker.io")
    asked = subprocess.run(["docker", "version", "--format", "{{.Server.Version}}"], capture_output=True, text=True)
    if asked.returncode:
        require("docker", f"no Docker engine answers: {asked.stderr.strip()}")
    if subprocess.run(["docker", "image", "inspect", "debian:bookworm-slim"], capture_output=True).returncode:
        require("docker", "the engine has no image debian:bookworm-slim")
    return asked.stdout.strip()


@pytest.fixture(scope="session")
def postgres_programs() -> None:
    """What a PostgreSQL server of a test's own is made with."""
    if not list(Path("/usr/lib/postgresql").glob("*/bin/initdb")):
        require("postgres", "there is no PostgreSQL server: install postgresql")


@pytest.fixture(scope="session")
def postgres_server(postgres_programs: None) -> Iterator[PostgresServer]:
    """A PostgreSQL server, for tests marked ``postgres``; see ``postgres`` for an empty database."""
    with own_server() as server:
        yield server


@pytest.fixture
def postgres(postgres_server: PostgresServer) -> Iterator[str]:
    """The address of an empty database."""
    import psycopg

    name = f"test_{secrets.token_hex(6)}"
    with psycopg.connect(postgres_server.url, autocommit=True) as connection:
        connection.execute(f"CREATE DATABASE {name}")
    yield f"{postgres_server.url.rpartition('/')[0]}/{name}"
    with psycopg.connect(postgres_server.url, autocommit=True) as connection:
        connection.execute(f"DROP DATABASE {name} WITH (FORCE)")


@pytest.fixture(scope="session")
def sshd() -> str:
    """The program of an SSH server, for engines that are reached through one."""
    program = shutil.which("sshd", path=f"{os.environ['PATH']}:/usr/sbin")
    if program is None:
        require("docker", "the program 'sshd' is missing: install openssh-server")
    return program


@pytest.fixture(scope="session")
def registry_program() -> str:
    """The program of a registry of images."""
    program = shutil.which("docker-registry")
    if program is None:
        require("registry", "the program 'docker-registry' is missing: install docker-registry")
    return program


@pytest.fixture(scope="session")
def compose_programs() -> None:
    """What starts ``compose.yaml``, and what stands in for the images that no registry here has."""
    for program, package in (("docker-compose", "docker-compose"), ("prometheus", "prometheus")):
        if shutil.which(program) is None:
            require("compose", f"the program '{program}' is missing: install {package}")
    if not list(Path("/usr/lib/postgresql").glob("*/bin/initdb")):
        require("compose", "there is no PostgreSQL server: install postgresql")


@pytest.fixture(scope="session")
def docker_images(docker_engine: str, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Images]:
    """The base image, the network's guard, one service and the toy, built from this very code.

    ``SKYTETHER_TEST_IMAGES`` names what they begin with, if several runs are to share them: nobody removes them then.
    """
    from docker_site import Images

    shared = os.environ.get("SKYTETHER_TEST_IMAGES", "")
    prefix = shared or f"skytether-test-{secrets.token_hex(4)}/"
    folder = folder_of(tmp_path_factory)

    def images(prefix: str, rows: list[dict[str, Any]]) -> Images:
        return Images(prefix, rows, folder, kept=bool(shared))

    def begin() -> str:
        made = images(prefix, [])
        made.build_all()
        return json.dumps([prefix, made.rows])

    with begun_once(folder, "images", begin, lambda: images(*json.loads(told)).remove_all()) as told:
        yield images(*json.loads(told))


@pytest.fixture(scope="session")
def orchestrator_image(docker_images: Images) -> Iterator[str]:
    """Its name; for tests that have it run on a cluster."""
    with docker_images.another("orchestrator") as name:
        yield name


@pytest.fixture(scope="session")
def _docker_network(docker_images: Images) -> Iterator[str]:
    from docker_site import DockerSite

    site = DockerSite(docker_images)
    yield site.network
    site.close()


@pytest.fixture
def docker_site(docker_images: Images, _docker_network: str) -> Iterator[DockerSite]:
    """A site on the real engine, of an owner that no other test has; containers and volumes are removed at the end."""
    from docker_site import DockerSite

    site = DockerSite(docker_images, network=_docker_network)
    yield site
    site.clean()


@pytest.fixture(scope="session")
def _cluster(docker_engine: str, tmp_path_factory: pytest.TempPathFactory) -> Iterator[str]:
    import node_sweeper

    program = os.environ.get("SKYTETHER_CLUSTER", "")
    if not program:
        require("kubernetes", "SKYTETHER_CLUSTER does not name the program that starts a cluster for tests")
    root = subprocess.run(["docker", "info", "-f", "{{.DockerRootDir}}"], check=True, capture_output=True, text=True)
    disk = shutil.disk_usage(root.stdout.strip())
    if disk.free < 0.18 * disk.total:  # at 85 % the node removes images that no pod uses now, those of our tests too
        require("kubernetes", f"{disk.free / disk.total:.0%} of the engine's disk is free; a cluster's node wants 18 %")
    # Its proxy lets packets of loopback leave the machine, from then on; other tests count on the kernel's refusal.
    refusal = Path("/proc/sys/net/ipv4/conf/all/route_localnet")

    def begin() -> str:
        before = refusal.read_text().strip()
        begun = subprocess.run([program, "up"], capture_output=True, text=True)
        if begun.returncode:  # it fetches packages
            begun = subprocess.run([program, "up"], capture_output=True, text=True)
        if begun.returncode:
            require("kubernetes", f"{program} up failed: {begun.stderr.strip()}")
        path = begun.stdout.split()[-1]
        return f"{before} {path} {node_sweeper.begin(path)}"

    def end() -> None:
        before, _, sweeper = told.split()
        with contextlib.suppress(ProcessLookupError):
            os.kill(int(sweeper), signal.SIGTERM)
        subprocess.run([program, "down"], capture_output=True)
        refusal.write_text(before)

    with begun_once(folder_of(tmp_path_factory), "cluster", begin, end) as told:
        yield told.split()[1]


@pytest.fixture
def kubeconfig(
    request: pytest.FixtureRequest, _cluster: str, tmp_path_factory: pytest.TempPathFactory
) -> Iterator[str]:
    """The administrator's, of a real cluster whose pods run in the Docker engine, so that it has the same images.

    ``SKYTETHER_CLUSTER`` names the program that starts it (``up``, which prints the path) and stops it (``down``): it
    takes a part of a processor, which other tests need. A test marked ``whole_cluster`` has it to itself.
    """
    alone = request.node.get_closest_marker("whole_cluster") is not None
    with turn(folder_of(tmp_path_factory), "cluster", alone=alone):
        yield _cluster


@pytest.fixture(scope="session")
def _kubernetes_namespace(_cluster: str, docker_images: Images) -> Iterator[KubernetesSite]:
    from kubernetes_site import KubernetesSite

    site = KubernetesSite(docker_images, _cluster)
    yield site
    site.close()


@pytest.fixture
def kubernetes_site(kubeconfig: str, _kubernetes_namespace: KubernetesSite) -> Iterator[KubernetesSite]:
    """A site on the real cluster; what it has made is removed after each test."""
    _kubernetes_namespace.begin()
    yield _kubernetes_namespace
    _kubernetes_namespace.clean()
