"""What is asked of an engine, as data: no engine needed."""

from __future__ import annotations

import base64
import io
import json
import os
import socket
import tarfile
from contextlib import closing, nullcontext
from dataclasses import replace
from itertools import product
from pathlib import Path
from typing import Any

import pytest
import yaml
from docker.errors import ImageNotFound
from image_builder import build_script
from nothing_lost import litter
from pydantic import ValidationError

from skytether.api.grant import Grant
from skytether.api.manifest import ServiceSpec
from skytether.api.pull_progress import PullProgress
from skytether.node.seccomp_rules import holds as holds_all
from skytether.node.seccomp_rules import keeps_in
from skytether.orchestrator.runtimes.base import Launch, OvertakenError, Phase, RuntimeFailure
from skytether.orchestrator.runtimes.containers import last_line
from skytether.orchestrator.runtimes.docker import DockerRuntime
from skytether.orchestrator.runtimes.docker import runtime as docker_runtime
from skytether.orchestrator.runtimes.docker.engine import Engine, EngineGoneError, Tunnel, root_cause
from skytether.orchestrator.runtimes.docker.fence import Fence
from skytether.orchestrator.runtimes.docker.images import PullMeter, check_credentials, ensure_image
from skytether.orchestrator.runtimes.docker.launch import Job
from skytether.orchestrator.runtimes.docker.limits import ContainerLimits, limits_of, pull_limits
from skytether.orchestrator.runtimes.docker.meter import Usage, usage_of
from skytether.orchestrator.runtimes.docker.network import bridge_of
from skytether.orchestrator.runtimes.docker.objects import (
    Declared,
    Namespace,
    advised,
    archives,
    container,
    data_volume,
    declared,
    free_gpus,
    free_port,
    guard,
    holder,
    refusal,
)
from skytether.orchestrator.runtimes.docker.options import DockerOptions
from skytether.orchestrator.runtimes.docker.seen import ContainerState, observation, parse, parse_helper

KEY = base64.b64encode(bytes(range(32))).decode()
ROOT = Path(__file__).parents[4]


def options(**given: Any) -> DockerOptions:
    return DockerOptions.model_validate(given)


def spec(**given: Any) -> ServiceSpec:
    return ServiceSpec.model_validate({"image": "toy", **given})


def launch(**given: Any) -> Launch:
    grant = Grant(
        instance="i1", service="toy", robot="walker", session_id="00112233445566aa", session_key=KEY, topics=()
    )
    return Launch(3, spec(**given), grant)


def body(given: dict[str, Any] | None = None, **more: Any) -> dict[str, Any]:
    asked = {"image": Declared("sha256:1"), "port": None, "gpus": (), "info": {"NCPU": 4}, "hosts": {}} | more
    return container(launch(**(given or {})), options(), "me", **asked)


def test_an_image_has_its_health_checked_no_more_than_once_a_second() -> None:
    """Every millisecond kept half a processor of the engine's machine busy, which no limit of the container bounds."""
    often = {"Config": {"Healthcheck": {"Test": ["CMD", "true"], "Interval": 1_000_000, "StartInterval": 1}}}
    asked = body(image=declared("sha256:1", often))["Healthcheck"]
    assert asked == {"Interval": 1_000_000_000, "StartInterval": 1_000_000_000}, "what is checked stays the image's"
    negative = {"Config": {"Healthcheck": {"Test": ["CMD", "true"], "Interval": -1}}}
    assert body(image=declared("sha256:1", negative))["Healthcheck"] == {"Interval": 1_000_000_000}, "without a pause"
    for ours in ({"Interval": 5_000_000_000}, {"Interval": 1_000_000_000}, {"Interval": 0}, {}, None):
        assert "Healthcheck" not in body(image=declared("sha256:1", {"Config": {"Healthcheck": ours}}))


@pytest.mark.parametrize("test", [["CMD"], ["CMD", ""], ["CMD-SHELL"], ["true"]])
def test_an_image_whose_health_check_has_no_command_is_not_started(test: list[str]) -> None:
    """An engine (20.10) ended by the first, and all containers of its machine with it."""
    with pytest.raises(RuntimeFailure, match="its image declares the health check"):
        declared("sha256:1", {"Config": {"Healthcheck": {"Test": test}}})


def test_an_image_that_declares_thousands_of_volumes_is_not_started() -> None:
    """An engine took longer for three thousand than any call may, and so was taken to be gone."""
    paths = {f"/v/{n}": {} for n in range(33)}
    with pytest.raises(RuntimeFailure, match="its image declares 33 volumes, and may declare 32"):
        declared("sha256:1", {"Config": {"Volumes": paths}})
    del paths["/v/0"]
    with pytest.raises(RuntimeFailure, match="so that /run/skytether is in /run; none may be in another"):
        declared("sha256:1", {"Config": {"Volumes": {"/run/": {}}}})
    with pytest.raises(RuntimeFailure, match="so that /w/a/b is in /w; none may be in another"):
        declared("sha256:1", {"Config": {"Volumes": {"/w": {}, "//w/../w/a/b": {}}}})
    mounts = body(image=declared("sha256:1", {"Config": {"Volumes": paths}}))["HostConfig"]["Mounts"]
    assert len(mounts) == 34


def test_a_container_may_do_nothing_that_it_need_not() -> None:
    made = body()
    host = made["HostConfig"]
    assert made["User"] == "65532:65532"
    assert host["ReadonlyRootfs"] is True
    assert host["CapDrop"] == ["ALL"]
    unprivileged, profile = host["SecurityOpt"]
    assert unprivileged == "no-new-privileges"
    assert json.loads(profile.removeprefix("seccomp="))["defaultAction"] == "SCMP_ACT_ERRNO"
    assert host["NetworkMode"] == "skytether"
    assert not host.keys() & {"Privileged", "CapAdd", "Binds", "PidMode", "IpcMode", "UsernsMode"}


def test_no_two_pairs_of_robot_and_service_share_a_volume() -> None:
    names = [f"{a}{b}{c}" for a in ("a", "b") for b in ("", "-", "-b-", "--") for c in ("", "a")]
    volumes = set()
    for robot, service in product(names, names):
        grant = Grant(
            instance="i1", service=service, robot=robot, session_id="00112233445566aa", session_key=KEY, topics=()
        )
        volumes.add(data_volume("me", Launch(1, spec(), grant)))
    assert len(volumes) == len(set(names)) ** 2
    assert data_volume("me", launch()) == "skytether-me-data-walker-toy"


class Registry:
    """An engine that has no image, and on which somebody else's comes for whatever name is pulled."""

    def __init__(self, *here: str) -> None:
        self.here = set(here)
        self.pulled: list[str] = []

    def asked(self) -> Any:
        return nullcontext()

    def api(self, timeout_s: float | None = None) -> Any:
        return self

    def inspect_image(self, image: str) -> dict[str, str]:
        if image not in self.here:
            raise ImageNotFound("none")
        return {"Id": f"id of {image}"}

    def pull(self, image: str, **_: Any) -> list[dict[str, str]]:
        self.pulled.append(image)
        self.here.add(image)
        return []


DIGEST = f"@sha256:{'0' * 64}"


@pytest.mark.parametrize("pull", ["missing", "always"])
@pytest.mark.parametrize("pinned", [False, True])
@pytest.mark.parametrize("guard", ["skytether/guard:1", "registry.example/guard:1", "guard"])
def test_the_guards_image_is_never_pulled_by_a_name(guard: str, pull: str, pinned: bool) -> None:
    engine: Any = Registry()
    asked = options(guard_image=guard, pull=pull, pinned=pinned)
    with pytest.raises(RuntimeFailure, match="is not pulled by this name"):
        ensure_image(engine, asked, guard, print, by_digest=True)
    assert engine.pulled == []
    engine.here.add(guard)
    assert ensure_image(engine, asked, guard, print, by_digest=True) == f"id of {guard}"
    assert engine.pulled == []
    assert ensure_image(engine, asked, guard + DIGEST, print, by_digest=True)


@pytest.mark.parametrize("image", ["skytether/virtual-trail:1", "docker.io/skytether/recorder", "skytether/x"])
def test_our_own_names_are_never_pulled_and_others_are(image: str) -> None:
    engine: Any = Registry()
    with pytest.raises(RuntimeFailure, match="make images"):
        ensure_image(engine, options(pull="always"), image, print)
    assert engine.pulled == []
    for owned in (image + DIGEST, "registry.example/skytether/x:1", "example/toy:1"):
        assert ensure_image(engine, options(), owned, print)
        assert engine.pulled.pop() == owned


def test_limits_come_from_the_manifest() -> None:
    host = body({"needs": {"cpu": 0.25, "memory_mb": 200}})["HostConfig"]
    assert (host["NanoCpus"], host["CpuShares"]) == (1_000_000_000, 2560)
    assert (host["Memory"], host["MemorySwap"], host["PidsLimit"]) == (200 << 20, 200 << 20, 256)
    given = {"needs": {"cpu": 2, "memory_mb": 200}, "limits": {"cpu": 2.5, "memory_mb": 300, "pids": 20}}
    host = body(given)["HostConfig"]
    assert (host["NanoCpus"], host["Memory"], host["PidsLimit"]) == (2_500_000_000, 300 << 20, 20)
    assert body({"needs": {"cpu": 2}})["HostConfig"]["NanoCpus"] == 2_000_000_000
    # An engine refuses a limit above what its machine has, and the kernel one that is next to nothing.
    assert body({"limits": {"cpu": 8}}, info={"NCPU": 2})["HostConfig"]["NanoCpus"] == 2_000_000_000
    assert body({"needs": {"cpu": 0.001}, "limits": {"cpu": 0.001}})["HostConfig"]["NanoCpus"] == 10_000_000


@pytest.mark.parametrize("limits", [{"cpu": 0.5}, {"memory_mb": 100}])
def test_a_limit_below_the_need_is_refused(limits: dict[str, float]) -> None:
    with pytest.raises(ValidationError, match="less than needs"):
        spec(needs={"cpu": 1, "memory_mb": 128}, limits=limits)


def test_devices_and_gpus_are_handed_over() -> None:
    host = body({"needs": {"gpu": 2, "devices": ["/dev/video0"]}}, gpus=(1, 3))["HostConfig"]
    assert host["Devices"] == [
        {"PathOnHost": "/dev/video0", "PathInContainer": "/dev/video0", "CgroupPermissions": "rw"}
    ]
    assert host["DeviceRequests"] == [{"Driver": "nvidia", "DeviceIDs": ["1", "3"], "Capabilities": [["gpu"]]}]
    assert body()["HostConfig"]["DeviceRequests"] == []
    asked = options(devices=["/dev/video0"], groups=[44])
    for needs, groups in (({"devices": ["/dev/video0"]}, ["44"]), ({}, [])):
        made = container(launch(needs=needs), asked, "me", Declared("x"), None, (), {"NCPU": 4}, {})
        assert made["HostConfig"]["GroupAdd"] == groups


def test_an_engines_refusal_comes_with_what_to_do() -> None:
    said = 'could not select device driver "nvidia" with capabilities: [[gpu]]'
    assert advised(said) == f"{said}; the engine has no NVIDIA container toolkit: install it, or set 'gpu' to 0"
    assert advised("no space left on device") == "no space left on device"


@pytest.mark.parametrize(("code", "status"), [(0, 0), (3, 3), (127, 127), (137, -9), (139, -11), (255, 255)])
def test_a_signal_is_told_from_a_status_of_the_programs_own(code: int, status: int) -> None:
    assert observation(ContainerState("c", "i1", 1, "exited", exit_code=code), options()).exit_status == status


def test_the_key_is_in_the_archive_and_nowhere_else() -> None:
    assert KEY not in json.dumps(body())
    (folder, archive), (data, archive_of_data) = archives(launch())
    assert (folder, data) == ("/run/skytether", "/var/lib/skytether")
    assert KEY.encode() not in archive_of_data
    with tarfile.open(fileobj=io.BytesIO(archive_of_data)) as tar:
        assert [(entry.name, entry.mode, entry.uid) for entry in tar] == [("i1", 0o700, 65_532)]
    with tarfile.open(fileobj=io.BytesIO(archive)) as tar:
        entries = {entry.name: entry for entry in tar}
        file = tar.extractfile("instance/grant.json")
        assert file is not None
        grant = Grant.model_validate_json(file.read())
    assert grant.session_key == KEY
    assert (grant.bind_host, grant.bind_port) == ("0.0.0.0", 7600)
    assert {entry.uid for entry in entries.values()} == {65_532}
    assert entries["instance/grant.json"].mode == 0o400
    assert entries["instance"].mode == 0o700
    assert grant.data_dir == "/var/lib/skytether/i1"


def test_published_and_advertised_addresses_are_two_things() -> None:
    asked = options(bind_host="0.0.0.0", advertise_host="192.0.2.7")
    bindings = container(launch(), asked, "me", Declared("x"), 7700, (), {"NCPU": 4}, {})["HostConfig"]["PortBindings"]
    assert bindings == {"7600/udp": [{"HostIp": "0.0.0.0", "HostPort": "7700"}]}
    seen = observation(ContainerState("c", "i1", 1, "running", host_port=7700, ready=True), asked)
    assert (seen.phase, seen.host, seen.port) == (Phase.RUNNING, "192.0.2.7", 7700)


@pytest.mark.parametrize(
    ("given", "bound", "advertised"),
    [
        ({}, "127.0.0.1", "127.0.0.1"),
        ({"bind_host": "192.0.2.1"}, "192.0.2.1", "192.0.2.1"),
        ({"engine": "ssh://me@edge:2222"}, "0.0.0.0", "edge"),
        ({"engine": "ssh://edge", "advertise_host": "192.0.2.7"}, "0.0.0.0", "192.0.2.7"),
    ],
)
def test_where_robots_find_instances(given: dict[str, str], bound: str, advertised: str) -> None:
    assert (options(**given).bound, options(**given).advertised) == (bound, advertised)


@pytest.mark.parametrize(
    ("given", "said"),
    [
        ({"engine": "http://edge"}, "engine must be"),
        ({"engine": "unix://"}, "engine must be"),
        ({"engine": "ssh://"}, "engine must be"),
        ({"engine": "ssh://edge:port"}, "engine: "),
        ({"engine": "ssh://-oProxyCommand"}, "do not begin with '-'"),
        ({"engine": "ssh://-l@edge"}, "do not begin with '-'"),
        ({"engine": "ssh://edge;touch"}, "user and host have letters, digits"),
        ({"engine": "ssh://`id`@edge"}, "user and host have letters, digits"),
        ({"engine": "ssh://edge%h"}, "user and host have letters, digits"),
        ({"engine": "ssh://me:secret@edge"}, "no password"),
        ({"engine": "tcp://edge"}, "engine must be"),
        ({"engine": "tcp://edge:2375"}, "without it anyone is let in"),
        ({"tls": {"ca": "a", "cert": "b", "key": "c"}}, "tls"),
        ({"bind_host": "0.0.0.0"}, "advertise_host is needed"),
        ({"bind_host": "::", "network": "own"}, "advertise_host is needed"),
        ({"bind_host": "192.0.2.7", "advertise_host": "0.0.0.0"}, "advertise_host is needed"),
        ({"bind_host": "localhost"}, "must be an address such as 192.0.2.7, not 'localhost'"),
        ({"network": "host"}, "no published ports"),
        ({"network": "container:orchestrator"}, "should match pattern"),
        ({"environment": {"A=B": "c"}}, "should match pattern"),
        ({"devices": ["video0"]}, "should match pattern"),
        ({"groups": [0]}, "greater than or equal to 1"),
        ({"ports": [7700, 7600]}, "the first is above the last"),
        ({"ports": [0, 7600]}, "greater than or equal to 1"),
        ({"engin": "unix:///x"}, "Extra inputs"),
        ({"pull": "sometimes"}, "'missing', 'always' or 'never'"),
    ],
)
def test_wrong_options_are_refused(given: dict[str, Any], said: str) -> None:
    with pytest.raises(ValidationError, match=said):
        options(**given)


def test_what_a_site_can_never_run() -> None:
    assert "no image" in str(refusal(ServiceSpec(entrypoint="x"), options()))
    assert "digest" in str(refusal(spec(image="x:1"), options(pinned=True)))
    assert refusal(spec(image=f"x@sha256:{'0' * 64}"), options(pinned=True)) is None
    needing = spec(needs={"devices": ["/dev/a", "/dev/b"]})
    assert "/dev/b" in str(refusal(needing, options(devices=["/dev/a"])))
    assert refusal(needing, options(devices=["/dev/a", "/dev/b"])) is None


def test_gpus_are_given_out_once() -> None:
    assert free_gpus(0, 0, []) == ()
    assert free_gpus(2, 4, [0, 2]) == (1, 3)
    assert free_gpus(2, 2, [1]) is None


def test_the_port_of_the_run_before_then_the_first_free_one() -> None:
    assert free_port(None, None, []) is None
    assert free_port(None, 40_000, []) == 40_000
    assert free_port(None, 40_000, [40_000]) is None
    assert free_port((7600, 7602), None, [7600]) == 7601
    assert free_port((7600, 7602), 7602, [7600]) == 7602
    assert free_port((7600, 7602), 9999, []) == 7600
    with pytest.raises(StopIteration):
        free_port((7600, 7601), None, [7600, 7601])


def described(**state: Any) -> dict[str, Any]:
    """An engine's description of a container, as far as it is read."""
    return {
        "Id": "c1",
        "Config": {"Labels": {"skytether.io/instance": "i1", "skytether.io/attempt": "3", "skytether.io/gpus": "0,2"}},
        "HostConfig": {"Memory": 64 << 20},
        "NetworkSettings": {"Ports": {"7600/udp": [{"HostIp": "127.0.0.1", "HostPort": "40123"}]}},
        "State": {"Status": "running", "ExitCode": 0, "OOMKilled": False, **state},
    }


def test_a_container_is_known_by_its_labels() -> None:
    seen = parse(described())
    assert seen == ContainerState(
        "c1", "i1", 3, "running", limits=ContainerLimits(64 << 20), host_port=40_123, gpus=frozenset({0, 2})
    )
    foreign = described()
    foreign["Config"]["Labels"] = None
    assert parse(foreign) is None


@pytest.mark.parametrize("port", ["0", "65536", "-1", "9" * 30])
def test_no_robot_is_sent_to_what_is_no_port(port: str) -> None:
    lies = described()
    lies["NetworkSettings"]["Ports"]["7600/udp"][0]["HostPort"] = port
    seen = parse(lies)
    assert seen is not None
    assert seen.host_port is None
    lies["NetworkSettings"], lies["Config"]["Labels"]["skytether.io/port"] = {}, port
    seen = parse(lies)
    assert seen is not None
    assert seen.host_port is None


def test_who_joins_a_network_says_nothing_of_it_and_is_found_where_that_is_published() -> None:
    made = body(namespace=Namespace("h1", "holder", 40_124))
    assert made["HostConfig"]["NetworkMode"] == "container:h1"
    assert "ExposedPorts" not in made, "the engine refuses it"
    assert not made["HostConfig"].keys() & {"PortBindings", "Dns", "ExtraHosts"}
    joined = described()
    joined["Config"]["Labels"] = made["Labels"]
    joined["NetworkSettings"] = {"Ports": {}}
    seen = parse(joined)
    assert seen is not None
    assert (seen.namespace, seen.host_port) == ("h1", 40_124)
    seen = replace(seen, ready=True)
    assert observation(seen, options()).detail == ""
    assert observation(seen, options(), cut_off=True).detail == "the container that held its network has ended"


def test_who_holds_a_network_has_no_right_and_a_guard_one_in_one_network() -> None:
    holds, guards = holder(options(), "me", "sha256:1"), guard(options(), "me", "sha256:1", "c1", "list ruleset")
    assert holds["User"] == "65532:65532"
    assert guards["HostConfig"]["CapAdd"] == ["NET_ADMIN"]
    assert guards["HostConfig"]["NetworkMode"] == "container:c1"
    assert holds["HostConfig"]["SecurityOpt"] == options().security
    assert guards["HostConfig"]["SecurityOpt"] == options().guard_security
    for host in (holds["HostConfig"], guards["HostConfig"]):
        assert (host["CapDrop"], host["ReadonlyRootfs"], host["IpcMode"]) == (["ALL"], True, "none")
        assert host["SecurityOpt"][0] == "no-new-privileges"
        assert not host.keys() & {"Privileged", "Binds", "Mounts", "PidMode"}
    assert "CapAdd" not in holds["HostConfig"]
    for made, target in ((holds, ""), (guards, "c1")):
        found = parse_helper({**described(), "Name": "/x", "Config": {"Labels": made["Labels"]}})
        assert found is not None
        assert (found.name, found.runs, found.target) == ("x", True, target)
        assert parse({**described(), "Config": {"Labels": made["Labels"]}}) is None
    assert parse_helper({**described(), "Name": "/x"}) is None


@pytest.mark.parametrize(
    ("state", "status", "detail"),
    [
        ({"ExitCode": 1}, 1, ""),
        ({"ExitCode": 137}, -9, ""),
        ({"ExitCode": 143}, -15, ""),
        ({"ExitCode": 137, "OOMKilled": True}, -9, "ran out of memory: its limit is 64 MiB"),
        ({"ExitCode": 0, "OOMKilled": True}, 0, ""),  # a child's death that the service lived with
    ],
)
def test_ends_are_told_apart(state: dict[str, Any], status: int, detail: str) -> None:
    seen = parse(described(Status="exited", **state))
    assert seen is not None
    ended = observation(seen, options())
    assert (ended.phase, ended.exit_status) == (Phase.EXITED, status)
    assert ended.detail.startswith(detail)
    assert bool(ended.detail) == bool(detail)


def test_a_failed_health_check_is_told_in_its_own_words() -> None:
    log = [{"ExitCode": 0, "Output": "fine\n"}, {"ExitCode": 1, "Output": "the service's loop has hung for 12 s\n"}]
    seen = parse(described(Health={"Status": "unhealthy", "Log": log}))
    assert seen is not None
    assert seen.ill == "the service's loop has hung for 12 s"
    silent = parse(described(Health={"Status": "unhealthy", "Log": [{"ExitCode": 1, "Output": " \n"}]}))
    assert silent is not None
    assert silent.ill == "its health check fails"
    late = parse(described(Health={"Status": "unhealthy", "Log": [*log, {"ExitCode": -1, "Output": "exceeded (3s)"}]}))
    assert late is not None
    assert late.ill == "", "nobody who runs is started again because the machine is busy"
    for before in ([], log[:1]):  # an engine says so of one that was paused
        paused = parse(described(Health={"Status": "unhealthy", "Log": before}))
        assert paused is not None
        assert paused.ill == ""
    for status in ("starting", "healthy"):
        well = parse(described(Health={"Status": status, "Log": log}))
        assert well is not None
        assert well.ill == ""


def test_what_a_container_uses() -> None:
    message = {
        "cpu_stats": {"cpu_usage": {"total_usage": 1_500_000_000}},
        "memory_stats": {"usage": 5000, "stats": {"inactive_file": 1000}},
        "networks": {"eth0": {"rx_bytes": 1, "tx_bytes": 2}, "eth1": {"rx_bytes": 10, "tx_bytes": 20}},
    }
    assert usage_of(message) == Usage(1.5, 4000, 11, 22)
    assert usage_of({**message, "networks": None}) == Usage(1.5, 4000, 0, 0)
    assert usage_of({"memory_stats": {}}) is None  # it has ended
    assert usage_of({**message, "memory_stats": {"usage": 1, "stats": {"total_inactive_file": 7}}}) == Usage(
        1.5, 0, 11, 22
    )


@pytest.mark.parametrize("lie", [10**400, -1, 1.5, float("nan"), "7", None])
def test_what_no_container_can_use_is_not_counted(lie: Any) -> None:
    """It would be summed up with what is true, and shown with it."""
    used = {"cpu_stats": {"cpu_usage": {"total_usage": 1}}, "memory_stats": {"usage": 5}}
    for message in (
        {**used, "cpu_stats": {"cpu_usage": {"total_usage": lie}}},
        {**used, "networks": {"eth0": {"rx_bytes": lie, "tx_bytes": 0}}},
        {**used, "networks": {"eth0": {"rx_bytes": 0, "tx_bytes": lie}}},
    ):
        with pytest.raises((ValueError, TypeError)):
            usage_of(message)


def test_the_last_line_that_can_be_read() -> None:
    assert last_line("a\nboom\x1b\x07\n \n\x00\n") == "boom"
    assert last_line("x" * 400) == "x" * 300
    assert last_line("") == ""


def test_a_pull_tells_how_far_it_is() -> None:
    meter = PullMeter("x:1")
    said = [
        meter.after(message)
        for message in (
            {"status": "Pulling from x", "id": "1"},
            {"status": "Downloading", "id": "a", "progressDetail": {"current": 5_000_000, "total": 10_000_000}},
            {"status": "Downloading", "id": "b", "progressDetail": {"current": 1_000_000, "total": 30_000_000}},
            {"status": "Download complete", "id": "a"},
            {"status": "Extracting", "id": "a", "progressDetail": {"current": 2_000_000, "total": 10_000_000}},
            {"status": "Download complete", "id": "b"},
            {"status": "Pull complete", "id": "a"},
            {"status": "Extracting", "id": "b", "progressDetail": {"current": 99_000_000}},
        )
    ]
    assert list(map(str, said)) == [
        "pulling x:1",
        "pulling x:1: 5 of 10 MB",
        "pulling x:1: 6 of 40 MB",
        "pulling x:1: 11 of 40 MB",
        "pulling x:1: 11 of 40 MB",
        "unpacking x:1: 2 of 40 MB",
        "unpacking x:1: 10 of 40 MB",
        "unpacking x:1: 40 of 40 MB",
    ]
    assert said[1] == PullProgress(image="x:1", done_bytes=5_000_000, total_bytes=10_000_000)
    assert said[-1] == PullProgress(image="x:1", unpacking=True, done_bytes=40_000_000, total_bytes=40_000_000)


def test_credentials_must_be_private(tmp_path: Path) -> None:
    file = tmp_path / "config.json"
    with pytest.raises(RuntimeFailure, match="No such file"):
        check_credentials(str(file))
    file.write_text("{")
    with pytest.raises(RuntimeFailure, match="no JSON"):
        check_credentials(str(file))
    file.write_text('{"auths": []}')
    file.chmod(0o600)
    with pytest.raises(RuntimeFailure, match="no 'auths'"):
        check_credentials(str(file))
    file.write_text('{"auths": {}}')
    check_credentials(str(file))
    file.chmod(0o644)
    with pytest.raises(RuntimeFailure, match="chmod 600"):
        check_credentials(str(file))


def test_the_profile_of_calls_is_an_allow_list_and_another_may_be_named(tmp_path: Path) -> None:
    (profile,) = (json.loads(row[8:]) for row in options().security if row.startswith("seccomp="))
    allowed = {name for row in profile["syscalls"] if row["action"] == "SCMP_ACT_ALLOW" for name in row["names"]}
    forbidden = {"ptrace", "process_vm_readv", "mount", "unshare", "setns", "bpf", "keyctl", "io_uring_setup", "chroot"}
    assert not allowed & (forbidden | {"clone3", "userfaultfd", "perf_event_open", "open_by_handle_at", "personality"})
    assert {row["args"][0]["value"] for row in profile["syscalls"] if row["names"] == ["socket"]} == {1, 2, 10, 16}
    assert options(seccomp="default").security == options(seccomp="default").guard_security == ["no-new-privileges"]
    (tmp_path / "own.json").write_text('{"defaultAction": "SCMP_ACT_ALLOW"}')
    own = options(seccomp=str(tmp_path / "own.json")).security
    assert own == ["no-new-privileges", 'seccomp={"defaultAction": "SCMP_ACT_ALLOW"}']
    of_guards = options(seccomp=str(tmp_path / "own.json")).guard_security
    assert of_guards == options(seccomp="default", engine="node://edge", advertise_host="192.0.2.1").guard_security
    (profile,) = (row[8:] for row in of_guards if row.startswith("seccomp="))
    assert holds_all(profile)
    assert keeps_in(profile)
    assert not keeps_in(options().security[1].removeprefix("seccomp="))
    with pytest.raises(RuntimeFailure, match="seccomp /nowhere"):
        DockerRuntime("edge", tmp_path, options(seccomp="/nowhere"))


def test_a_key_for_an_engine_that_others_can_read_is_refused(tmp_path: Path) -> None:
    files = {name: tmp_path / f"{name}.pem" for name in ("ca", "cert", "key")}
    for path in files.values():
        path.write_text("anything")
    of_tls = options(engine="tcp://127.0.0.1:1", bind_host="127.0.0.1", tls={n: str(p) for n, p in files.items()})
    files["key"].chmod(0o644)
    with pytest.raises(RuntimeFailure, match=f"others can read the key.*chmod 600 {files['key']}"):
        DockerRuntime("edge", tmp_path, of_tls)
    files["key"].chmod(0o640)
    DockerRuntime("edge", tmp_path, of_tls).close()


def test_what_holds_a_container_is_told_and_no_user_of_its_own(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    with closing(DockerRuntime("edge", tmp_path, options(engine=f"unix://{tmp_path}/none"))) as runtime:
        assert runtime.isolation() == (), "nothing is known of an engine that is away"
        told = {"SecurityOptions": ["name=seccomp,profile=default", "name=userns", "name=other"]}
        monkeypatch.setattr(runtime.follower, "info", lambda _: told)
        assert runtime.isolation() == ("user 65532", "no capabilities", "user namespace", "seccomp")


def test_the_bridge_is_of_one_network() -> None:
    assert len(bridge_of("n" * 200)) <= 15
    assert bridge_of("a") != bridge_of("b")


def test_names_are_known_within() -> None:
    made = body(hosts={"api.example": ("192.0.2.1", "192.0.2.2")})
    assert made["HostConfig"]["ExtraHosts"] == ["api.example:192.0.2.1", "api.example:192.0.2.2"]


def test_the_ssh_client_asks_nobody() -> None:
    given = options(engine="ssh://me@edge:2222/run/docker.sock", ssh={"identity": "/keys/id", "known_hosts": "/k"})
    command = Tunnel(given).command(Path("/tmp/x/engine.sock"), Path("/tmp/x/said"))
    assert command[command.index("-E") + 1] == "/tmp/x/said"
    assert command[-4:] == ["-L", "/tmp/x/engine.sock:/run/docker.sock", "me@edge", "cat"]
    assert "BatchMode=yes" in command
    assert {"StrictHostKeyChecking=yes", "VerifyHostKeyDNS=no", "NoHostAuthenticationForLocalhost=no"} <= set(command)
    assert {"UserKnownHostsFile=/k", "GlobalKnownHostsFile=/dev/null"} <= set(command)
    assert command[command.index("-p") + 1] == "2222"
    assert Tunnel(options(engine="ssh://edge")).command(Path("s"), Path("e"))[-3] == "s:/var/run/docker.sock"


@pytest.mark.skipif(os.geteuid() != 0, reason="needs root, to listen as another user")
def test_what_another_user_listens_at_is_no_engine(tmp_path: Path) -> None:
    path = tmp_path / "docker.sock"
    with socket.socket(socket.AF_UNIX) as listens:
        listens.bind(str(path))
        os.seteuid(54_321)
        listens.listen()
        os.seteuid(0)
        with pytest.raises(EngineGoneError, match="may not be the engine: it is the user 54321"):
            Engine(options(engine=f"unix://{path}")).api()


def test_an_error_is_told_by_its_root() -> None:
    outer = ValueError("Connection aborted", FileNotFoundError(2, "No such file or directory"))
    assert root_cause(outer) == "No such file or directory"
    assert root_cause(TimeoutError("x")) == "timed out"


LOCK = """\
numpy==2.4.6 ; python_full_version < '3.12' \\
    --hash=sha256:aa
    # via
    #   skytether (pyproject.toml)
    #   rosbags
numpy==2.5.5 ; python_full_version >= '3.12' \\
    --hash=sha256:bb
    # via rosbags
rosbags==0.11 \\
    --hash=sha256:cc
    # via skytether (pyproject.toml)
mypy==2.4 \\
    --hash=sha256:dd
    # via skytether (pyproject.toml)
"""


def test_what_is_in_an_image_is_listed_the_same_each_time() -> None:
    rows = ["pypi\tPyYAML\t6.0.3", "deb\tg++\t4:12.2.0-3~x\tamd64", "deb\tg++\t4:12.2.0-3~x\tamd64", ""]
    made = build_script().bill("skytether/x:1", "sha256:ab", "\n".join(rows))
    assert made == build_script().bill("skytether/x:1", "sha256:ab", "\n".join(reversed(rows)))
    assert made["metadata"]["component"] == {"type": "container", "name": "skytether/x:1", "version": "sha256:ab"}
    assert [row["purl"] for row in made["components"]] == [
        "pkg:deb/debian/g%2B%2B@4%3A12.2.0-3~x?arch=amd64",
        "pkg:pypi/pyyaml@6.0.3",
    ]


def test_the_list_of_an_image_is_a_file_beside_those_of_the_others(tmp_path: Path) -> None:
    ran: list[Any] = []

    class Client:
        """An engine that runs one program."""

        containers = property(lambda self: self)
        api = property(lambda self: self)

        def run(self, image: str, command: list[str], **how: Any) -> bytes:
            ran.append((image, command[0], how))
            return b"pypi\tPyYAML\t6.0.3\n"

        def inspect_image(self, image: str) -> dict[str, str]:
            return {"Id": f"sha256:{image}"}

    for image in ("registry.example:5000/skytether/recorder:1", "skytether/base:1"):
        build_script().write_bill(Client(), image, tmp_path / "sbom")
    names = ["registry.example_5000_skytether_recorder_1.cdx.json", "skytether_base_1.cdx.json"]
    assert sorted(path.name for path in (tmp_path / "sbom").iterdir()) == names
    made = json.loads((tmp_path / "sbom" / names[1]).read_text())
    assert made["metadata"]["component"]["version"] == "sha256:skytether/base:1"
    assert [row["name"] for row in made["components"]] == ["PyYAML"]
    how = {"entrypoint": "/bin/sh", "remove": True, "network_disabled": True}
    assert ran[0] == ("registry.example:5000/skytether/recorder:1", "-c", how)


def test_a_tag_says_what_an_image_is_made_from(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    build = build_script()
    for name, text in (("base", "ARG DEBIAN"), ("trail", "ARG BASE"), ("guard", "ARG DEBIAN")):
        (tmp_path / name).mkdir()
        (tmp_path / name / "Dockerfile").write_text(text)
    monkeypatch.setattr(build, "IMAGES", tmp_path)
    monkeypatch.setattr(build, "EXTRAS", {})
    monkeypatch.setattr(build, "WORK", tmp_path)
    (tmp_path / "wheels" / "project").mkdir(parents=True)

    def made() -> list[str]:
        return [build.source_tag(name, "sha256:ab", "x86_64") for name in ("base", "trail", "guard")]

    before = made()
    assert made() == before
    assert len(set(before)) == 3
    assert build.source_tag("trail", "sha256:cd", "x86_64") != before[1], (
        "what it is built on is built on another Debian"
    )
    (tmp_path / "wheels" / "project" / "skytether.whl").write_bytes(b"other code")
    base, trail, guard = made()
    assert base != before[0]
    assert trail != before[1]
    assert guard == before[2]


def test_an_image_gets_what_the_lock_file_pins_for_it() -> None:
    build = build_script()
    old = build.locked(LOCK, {"python_full_version": "3.11.2"})
    assert old["numpy"][0] == "numpy==2.4.6 \\\n    --hash=sha256:aa"
    assert "rosbags" in old["numpy"][1]
    assert build.closure({"rosbags"}, old) == {"rosbags", "numpy"}
    rows = build.requirements((), "x86_64")
    assert "numpy" in rows
    assert "fastapi" not in rows
    assert "mypy" not in rows
    assert "fastapi" in build.requirements(("orchestrator",), "x86_64")
    assert build.order(["recorder"]) == ["base", "recorder"]
    with pytest.raises(build.BuildError, match="there is no image 'x'"):
        build.order(["x"])


def test_every_service_with_an_image_has_its_dockerfile() -> None:
    for path in (ROOT / "services").glob("*/*/service.yaml"):
        image = yaml.safe_load(path.read_text())["spec"]["image"]
        name = image.removeprefix("skytether/").removesuffix(":1")
        assert (ROOT / "images" / name / "Dockerfile").is_file(), image


def test_a_network_that_cannot_be_closed_off_is_told_before_the_first_start(
    tmp_path: Path, caplog: pytest.LogCaptureFixture, monkeypatch: pytest.MonkeyPatch
) -> None:
    def cannot(*_: Any) -> None:
        raise RuntimeFailure("no guard")

    monkeypatch.setattr(docker_runtime, "ensure_network", cannot)
    with closing(DockerRuntime("edge", tmp_path, options(engine=f"unix://{tmp_path}/none"))) as runtime:
        monkeypatch.setattr(runtime.follower, "info", lambda _: {})
        runtime.prepare_early()
        runtime.prepare_early()
        assert runtime.blocked() == "no guard"
        monkeypatch.setattr(docker_runtime, "ensure_network", lambda *_: None)
        runtime.prepare_early()
        assert runtime.blocked() == ""
    assert caplog.text.count("site edge: nothing can be started: no guard") == 1, "said once"


def test_guards_that_earlier_releases_left_are_found_though_they_name_no_owner(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    class FakeApi:
        def prune_containers(self, filters: dict[str, Any]) -> None:
            pruned.append(filters)

    pruned: list[dict[str, Any]] = []
    monkeypatch.setattr(docker_runtime, "ensure_network", lambda *_: None)
    with closing(DockerRuntime("edge", tmp_path, options(engine=f"unix://{tmp_path}/none"))) as runtime:
        monkeypatch.setattr(runtime.follower, "info", lambda _: {})
        monkeypatch.setattr(runtime.engine, "api", FakeApi)
        runtime.prepare_early()
    assert pruned == [{"label": ["skytether.io/guard"], "until": "60s"}], "and none that is at work"


def test_one_guard_left_behind_is_litter_where_no_network_is_ready() -> None:
    """Of what the tests of faults look at."""

    class FakeSite:
        network, owner = "net", "me"

        def __init__(self, **labels: list[str]) -> None:
            self.by_label = {"skytether.io/helper=": labels["holders"], "skytether.io/helper": labels["helpers"]}
            self.by_label["skytether.io/namespace"] = labels["used"]

        def labelled(self, label: str, *_: str) -> list[str]:
            return self.by_label[label]

        def helpers(self) -> list[str]:
            return self.labelled("skytether.io/helper")

        def volumes(self) -> list[str]:
            return []

        def volumes_with(self, *_: str) -> list[str]:
            return []

        def docker(self, *_: str) -> str:
            return ""

    def left(**labels: list[str]) -> list[str]:
        site: Any = FakeSite(**labels)
        return litter(site)()

    assert left(holders=[], helpers=["guard"], used=[]) == ["guard"]
    assert left(holders=["a"], helpers=["a"], used=[]) == left(holders=["a", "b"], helpers=["a", "b"], used=["i"]) == []
    assert left(holders=["a", "b"], helpers=["a", "b"], used=[]) == ["a", "b"]


def test_what_a_start_has_given_up_is_no_run_and_is_begun_anew(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """An engine that is slow started it, and will end it: both without an answer in time."""
    nothing: Any = None
    begun = ContainerState("c1", "i1", 3, "running", host_port=40_123, ready=True)
    with closing(DockerRuntime("edge", tmp_path, options(engine=f"unix://{tmp_path}/none"))) as runtime:
        monkeypatch.setattr(runtime.follower, "seen", lambda _: [begun])
        monkeypatch.setattr(runtime.follower, "of", lambda _: [begun])
        job = runtime.jobs["i1"] = Job(
            launch(), nothing, nothing, "", nothing, nothing, nothing, Fence(nothing, ""), None
        )
        job.unanswered = True
        runtime.start(launch())
        assert runtime.jobs["i1"] is job, "it runs, whoever said so"
        assert runtime.observe()["i1"].phase is Phase.RUNNING
        job.given_up.add("c1")
        assert runtime.observe() == {}
        runtime.start(launch())
        again = runtime.jobs["i1"]
        assert again is not job
        assert "c1" in again.given_up


def test_what_a_start_has_given_up_is_removed_though_nobody_asks_for_it(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Its instance may have ended before it was begun anew."""
    nothing: Any = None
    there = [
        ContainerState("c1", "i1", 3, "running"),
        ContainerState("c2", "i2", 1, "running"),
        ContainerState("c3", "i3", 1, "exited"),
    ]
    removed: list[str] = []
    monkeypatch.setattr(
        "skytether.orchestrator.runtimes.docker.runtime.remove", lambda *given: removed.append(given[-1])
    )
    with closing(DockerRuntime("edge", tmp_path, options(engine=f"unix://{tmp_path}/none"))) as runtime:
        monkeypatch.setattr(runtime.follower, "seen", lambda _: there)
        job = runtime.jobs["i1"] = Job(
            launch(), nothing, nothing, "", nothing, nothing, nothing, Fence(nothing, ""), None
        )
        job.unanswered = True
        job.given_up.add("c1")
        monkeypatch.setattr(Job, "ended", property(lambda _: False))
        runtime.remove_unbegun()
        assert removed == [], "who is at it does it"
        monkeypatch.setattr(Job, "ended", property(lambda _: True))
        runtime.remove_unbegun()
        assert removed == ["c1"]


def test_who_sees_that_a_start_failed_sees_that_nothing_is_left_of_it() -> None:
    class Failing(Job):
        def _clear(self) -> bool:
            return False

        def _launch(self) -> None:
            raise RuntimeFailure("no space left")

        def __setattr__(self, name: str, value: Any) -> None:
            if name == "failure" and value:
                assert self.unstarted
            super().__setattr__(name, value)

    nothing: Any = None
    job = Failing(nothing, nothing, nothing, "", nothing, nothing, nothing, Fence(nothing, ""), None)
    job.start()
    job.join(30)
    assert job.ended
    assert "no space left" in job.failure


def test_a_start_that_fails_under_another_leader_says_nothing_of_the_service() -> None:
    """Who leads by now removed what had just been made."""

    class Failing(Job):
        def _clear(self) -> bool:
            return False

        def _launch(self) -> None:
            raise RuntimeFailure("the container is marked for removal")

    class Overtaken(Fence):
        def must_lead(self, epoch: int | None = None) -> None:
            raise OvertakenError("another orchestrator leads")

    nothing: Any = None
    job = Failing(nothing, nothing, nothing, "", nothing, nothing, nothing, Overtaken(nothing, ""), None)
    job.launch = launch()
    job.start()
    job.join(30)
    assert job.ended
    assert job.unanswered
    assert not job.failure


@pytest.mark.parametrize(
    ("told", "without", "blocked"),
    [
        (
            {"MemoryLimit": False, "CpuCfsQuota": True, "PidsLimit": False},
            False,
            "no limit of memory and processes, so",
        ),
        ({"MemoryLimit": False, "CpuCfsQuota": True, "PidsLimit": False}, True, ""),
        ({"MemoryLimit": True, "Rootless": True, "CgroupVersion": "1"}, False, "no limit of memory and processor time"),
        ({"MemoryLimit": True, "Rootless": True, "CgroupVersion": "2"}, False, ""),
    ],
)
def test_an_engine_that_holds_no_limits_starts_nothing_unless_told(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, told: dict[str, Any], without: bool, blocked: str
) -> None:
    monkeypatch.setattr(docker_runtime, "ensure_network", lambda *_: None)
    given = options(engine=f"unix://{tmp_path}/none", without_limits=without)
    with closing(DockerRuntime("edge", tmp_path, given)) as runtime:
        monkeypatch.setattr(runtime.follower, "info", lambda _: told)
        runtime.prepare_early()
        assert blocked in runtime.blocked()
        assert bool(runtime.blocked()) == bool(blocked)


@pytest.mark.parametrize(
    ("told", "parent"),
    [
        ({"CgroupDriver": "cgroupfs"}, "/"),
        ({"CgroupDriver": "cgroupfs", "SecurityOptions": ["name=seccomp,profile=default"]}, "/"),
        ({"CgroupDriver": "cgroupfs", "SecurityOptions": ["name=seccomp", "name=rootless"]}, None),
        ({"CgroupDriver": "cgroupfs", "Rootless": True, "SecurityOptions": None}, None),
        ({"CgroupDriver": "systemd"}, None),
        ({}, None),
    ],
)
def test_a_container_is_weighed_against_other_programs_itself(told: dict[str, Any], parent: str | None) -> None:
    assert body(info={"NCPU": 4, **told})["HostConfig"].get("CgroupParent") == parent


@pytest.mark.parametrize(
    ("told", "cores", "means"),
    [
        ({}, 8, ContainerLimits(128 << 20, 1_000_000_000, 1024)),
        ({"needs": {"cpu": 3, "memory_mb": 64}}, 2, ContainerLimits(64 << 20, 2_000_000_000, 30_720)),
        ({"needs": {"cpu": 64, "memory_mb": 64}}, 64, ContainerLimits(64 << 20, 64_000_000_000, 262_144)),
        (
            {"needs": {"cpu": 0.001}, "limits": {"cpu": 0.001, "memory_mb": 500}},
            2,
            ContainerLimits(500 << 20, 10_000_000, 10),
        ),
    ],
)
def test_limits_are_told_and_read_alike(told: dict[str, Any], cores: float, means: ContainerLimits) -> None:
    limits = limits_of(spec(**told), cores)
    assert limits == means
    document = limits.document()
    assert document["MemorySwap"] == document["Memory"], "no swap, also after a change"
    assert pull_limits(document) == limits
    assert pull_limits({"Memory": 5, "NanoCpus": None}) == ContainerLimits(5)
