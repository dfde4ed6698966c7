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
from itertools import groupby
from pathlib import Path
from typing import TYPE_CHECKING, Any, NoReturn

import pytest
from hypothesis import settings
from one_run import begun_once, folder_of, turn
from postgres_server import PostgresServer, own_server

if TYPE_CHECKING:
    from docker_site import DockerSite, Images
    from kubernetes_site import KubernetesSite

# How long an example takes says nothing on a machine that others use too. `make fuzz` is where to look for more.
# The same examples each time: a test that fails for somebody fails for everybody. SKYTETHER_RANDOM=1 draws others.
settings.register_profile(
    "skytether", deadline=None, max_examples=30, derandomize=os.environ.get("SKYTETHER_RANDOM", "") == ""
)
settings.load_profile("skytether")

pytest.register_assert_rewrite("skytether.testing.runtime_contract")

# A run under nohup ignores it, and so would every program that a test starts.
signal.signal(signal.SIGHUP, signal.SIG_DFL)


TOGETHER = (
    "api/test_bounded.py",
    "bridge/test_mtu.py",
    "bridge/test_nat.py",
    "cli/commands/bridge/test_bridge.py",
    "cli/commands/robot/test_commission.py",
    "cli/test_names.py",
    "cli/test_lazy.py",
    "cli/commands/test_doctor.py",
    "cli/commands/test_group.py",
    "cli/commands/robot/test_never_wait.py",
    "cli/commands/test_relay.py",
    "cli/commands/test_nouns.py",
    "cli/commands/site/test_machine.py",
    "cli/commands/robot/test_gate_process.py",
    "contracts/",
    "e2e/test_compose.py",
    "e2e/test_demo.py::test_demo_prints_one_json_object",
    "e2e/test_navigation_guide.py",
    "e2e/test_replay.py",
    "e2e/test_rolling_nodes.py",
    "jepsen/",
    "lab/test_bench_api.py",
    "lab/test_bench_bridge.py",
    "lab/test_bench_bridge_ros2.py",
    "lab/test_bench_failover.py",
    "lab/test_bench_face.py",
    "lab/test_bench_fleet.py",
    "lab/test_bench_legs.py",
    "lab/test_bench_mapping.py",
    "lab/test_bench_migrate.py",
    "lab/test_bench_resize.py",
    "lab/test_bench_ros.py",
    "lab/test_bench_safety.py",
    "lab/test_bench_scale.py",
    "lab/test_bench_join.py",
    "lab/test_bench_start.py",
    "lab/test_embedded.py",
    "lab/test_follow_in_front.py",
    "lab/test_nine_goals.py",
    "lab/test_person.py",
    "lab/test_walk.py",
    "lab/world/",
    "orchestrator/test_backup.py",
    "orchestrator/runtimes/test_confinement.py",
    "orchestrator/test_crowd.py",
    "orchestrator/test_disk_full.py",
    "orchestrator/runtimes/docker/test_runtime.py",
    "orchestrator/domain/test_clock_jump.py",
    "orchestrator/http/test_api.py",
    "orchestrator/runtimes/docker/test_docker_resize.py",
    "orchestrator/runtimes/docker/test_fence.py",
    "orchestrator/runtimes/docker/test_namespaces.py",
    "orchestrator/runtimes/docker/test_docker_orchestrated.py",
    "orchestrator/nodes/test_nodes_attacks.py",
    "orchestrator/nodes/test_nodes_docker.py",
    "orchestrator/nodes/test_nodes_replicas.py",
    "orchestrator/test_faults.py",
    "orchestrator/test_faults_engine.py",
    "orchestrator/runtimes/test_file_log.py",
    "orchestrator/test_follow_image.py",
    "orchestrator/groups/test_group_end.py",
    "orchestrator/groups/test_group_joins.py",
    "orchestrator/groups/test_groups_docker.py",
    "orchestrator/test_image_push.py",
    "orchestrator/test_images.py",
    "orchestrator/runtimes/kubernetes/test_pace.py",
    "orchestrator/runtimes/kubernetes/test_kubernetes_storm.py",
    "orchestrator/runtimes/test_left_behind.py",
    "orchestrator/store/test_migrations.py",
    "orchestrator/scheduling/test_successors.py",
    "orchestrator/test_navigation_image.py",
    "orchestrator/http/test_openapi.py",
    "orchestrator/scheduling/test_plan.py",
    "orchestrator/runtimes/test_process.py",
    "orchestrator/runtimes/test_process_fence.py",
    "orchestrator/scheduling/test_reconcile.py",
    "orchestrator/test_rolling.py",
    "orchestrator/test_replicas.py",
    "orchestrator/groups/test_scaler.py",
    "orchestrator/http/test_server.py",
    "orchestrator/telemetry/test_heartbeat.py",
    "orchestrator/telemetry/test_service_events.py",
    "orchestrator/store/test_store.py",
    "orchestrator/telemetry/test_tls_and_logs.py",
    "robot/graphs/test_registry.py",
    "robot/safety/geometry/test_footprint.py",
    "robot/safety/gate/test_gate_loop.py",
    "robot/safety/rules/test_rules.py",
    "robot/safety/sensing/test_sensing.py",
    "robot/safety/geometry/test_stopping.py",
    "robot/control/test_failure_detector.py",
    "robot/control/test_arbiter.py",
    "robot/graphs/ros2/",
    "robot/agent/test_agent_survives.py",
    "robot/agent/test_status.py",
    "robot/control/test_supervisor.py",
    "robot/offload/test_task_manager.py",
    "ros/ros1/",
    "ros/ros2/test_console.py",
    "ros/ros2/test_display.py",
    "ros/ros2/test_gate.py",
    "ros/ros2/native/",
    "ros/ros2/test_navigation_action.py",
    "ros/ros2/test_node.py",
    "ros/ros2/test_own_gate.py",
    "ros/ros2/test_parameters.py",
    "ros/ros2/test_port.py",
    "ros/ros2/test_robot_run.py",
    "service/test_actions_live.py",
    "service/test_calls.py",
    "services/",
    "terraform/",
    "wire/",
)
"""Where slow tests bear company: their time is made up, or they wait for what they expect, however long it takes."""

LONGEST = (
    "e2e/test_navigation_guide.py",
    "orchestrator/test_faults_engine.py",
    "ros/ros2/native/test_walk.py",
    "e2e/test_compose.py",
    "jepsen/test_short.py",
    "ros/ros2/native/test_robot_run.py",
    "orchestrator/test_navigation_image.py",
    "e2e/test_rolling_nodes.py",
    "lab/test_nine_goals.py",
    "orchestrator/runtimes/docker/test_fence.py",
    "orchestrator/runtimes/docker/test_runtime.py",
    "lab/test_bench_safety.py",
    "contracts/test_runtime_contract.py",
    "contracts/test_two_leaders.py",
    "ros/ros1/test_service_container.py",
    "lab/test_bench_bridge.py",
    "orchestrator/runtimes/docker/test_docker_resize.py",
    "ros/ros2/native/test_service_container.py",
    "lab/test_bench_mapping.py",
    "orchestrator/groups/test_scaler.py",
    "orchestrator/test_follow_image.py",
    "ros/ros2/native/test_node.py",
    "cli/commands/robot/test_commission.py",
    "robot/safety/gate/test_guard_processes.py",
    "robot/safety/gate/test_processes.py",
)
"""The files of a minute and more: they begin first, so that at the end nobody waits for one of them."""

ALONE = (
    "orchestrator/http/test_server.py::test_a_killed_orchestrator_comes_back",
    "orchestrator/http/test_server.py::test_a_killed_service_is_seen_within_a_second",
    "orchestrator/http/test_server.py::test_at_shutdown_what_was_asked",
    "orchestrator/http/test_server.py::test_killed_in_the_middle_of_starting",
    "orchestrator/http/test_server.py::test_watchers_do_not_hold_up_the_end",
)
"""Among those the ones that look at the clock."""

CLUSTER_LONGEST = (
    "test_a_release_drives_robots",
    "test_eviction_a_kill_in_mid_start",
    "test_two_orchestrators_over_postgresql",
    "test_an_api_server_that_stands_still",
    "test_a_standby_is_given_out",
)
"""Of those with a cluster the ones that take half a minute and more: several processes share them, and begin with them,
or the end of the row would be a wait for one."""

RERUN = {
    "bridge/test_clock.py": "measures one-way delays to a millisecond, on cores that others use too",
    "lab/test_bench_failover.py": "judges a cut to within three periods of the commands",
    "lab/test_bench_safety.py": "judges each velocity that the wheels are told by the moment it was told",
    "lab/test_handover.py": "judges the time without commands at a hand-over",
    "lab/test_tun.py": "judges the emulated delays of packets by the clock",
    "orchestrator/test_hostile.py": "judges how quick others' renewals are beside an attacker who takes a core",
    "orchestrator/http/test_server.py": "judges how soon a killed program is back",
    "robot/safety/gate/test_cloud_processes.py": "as test_guard_processes.py",
    "robot/safety/gate/test_cut_network.py": "as test_guard_processes.py",
    "robot/safety/gate/test_guard_processes.py": "judges each velocity of the wheels by the moment it was told",
    "robot/safety/gate/test_processes.py": "as test_guard_processes.py",
    "robot/safety/gate/test_sensing_processes.py": "as test_guard_processes.py",
    "robot/agent/test_agent_live.py": "judges how soon a silent service is noticed",
    "service/test_process.py": "judges the periods of a service's loop",
}
"""The only tests that may be run again when they fail, and why: they judge moments to some 10 ms, and the machine may
be taken for longer by somebody else. What fails anywhere else is a finding: the product is wrong, or the test."""

QUICK_S = 0.5
"""Of processor time; a quick test that takes more belongs among the slow ones, or is made cheaper."""
LEFT_OPEN = 50
"""Descriptors that a test may leave; beyond 1,024 open ones `select` fails, in whatever test comes then."""
_BEGAN = pytest.StashKey[float]()
_OPEN = pytest.StashKey[int]()


@pytest.hookimpl(tryfirst=True)
def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Mark what `make test` runs beside others, and what it may run again; the longest files come first."""
    here = Path(__file__).parent
    for path, ours in groupby(items, key=lambda item: item.path):
        if not path.is_relative_to(here):
            continue
        file = path.relative_to(here).as_posix()
        for item in ours:
            name = f"{file}::{item.name}"
            if name.startswith(TOGETHER) and not name.startswith(ALONE):
                item.add_marker(pytest.mark.together)
            if item.get_closest_marker("flaky"):
                raise pytest.UsageError(f"{name}: what may be run again stands in RERUN in tests/conftest.py, with why")
            if item.get_closest_marker("slow") and name.startswith(tuple(RERUN)):
                item.add_marker(pytest.mark.flaky(reruns=2, reruns_delay=3))
    rank = {here / file: number for number, file in enumerate(LONGEST)}
    items.sort(key=lambda item: rank.get(item.path, len(rank)))
    _order(items)


def _order(items: list[pytest.Item]) -> None:
    """Of what needs a cluster first what takes longest, each with another, for a process is given two at a time; what
    wants to be alone last."""
    ours = [item for item in items if item.get_closest_marker("kubernetes")]
    ours.sort(key=lambda item: item.get_closest_marker("whole_cluster") is not None)
    longest = [item for name in CLUSTER_LONGEST for item in ours if item.name.startswith(name)]
    others = [item for item in ours if item not in longest]
    pairs = [item for pair in zip(longest, others, strict=False) for item in pair]
    rest = [item for item in (*longest, *others) if item not in pairs]
    items[:] = [item for item in items if not item.get_closest_marker("kubernetes")] + pairs + rest


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
        terminalreporter.write_line(f"run again: {report.nodeid}, for {' '.join(str(why).split())[:500]}")


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
def _docker_network(docker_images: Images) -> Iterator[DockerSite]:
    from docker_site import DockerSite

    site = DockerSite(docker_images)
    yield site
    site.close()


@pytest.fixture
def docker_site(_docker_network: DockerSite) -> Iterator[DockerSite]:
    """A site on the real engine; its containers and volumes are removed after each test."""
    yield _docker_network
    _docker_network.clean()


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
