"""Networks that are closed off before anybody asks, on a real engine."""

from __future__ import annotations

import json
import socket
from collections.abc import Iterator
from contextlib import closing
from pathlib import Path
from typing import Any

import pytest
from docker import APIClient
from docker_runs import docker, inside, launch, until, until_phase
from docker_site import DockerSite

from skytether.orchestrator.runtimes.base import Phase
from skytether.orchestrator.runtimes.docker import DockerRuntime
from skytether.orchestrator.runtimes.docker.network import close_off, guard_image
from skytether.orchestrator.runtimes.docker.options import DockerOptions

pytestmark = [pytest.mark.docker, pytest.mark.slow]


@pytest.fixture
def runtime(docker_site: DockerSite, tmp_path: Path) -> Iterator[DockerRuntime]:
    """With one that is ready."""
    with closing(docker_site.open(tmp_path)) as runtime:
        tended(runtime, 1)
        yield runtime


def tended(runtime: DockerRuntime, ready: int) -> None:
    """As the reconciler does, until so many are ready and nothing else is done."""

    def done() -> bool:
        runtime.tidy()
        pool = runtime.namespaces
        return len(pool.ready) == ready and not pool.busy

    until(done)


def inspected(container: str) -> Any:
    return json.loads(docker("inspect", container))[0]


def holder_of(site: DockerSite, container: str) -> str:
    """The container whose network this one is in."""
    kind, _, holder = inspected(container)["HostConfig"]["NetworkMode"].partition(":")
    assert (kind, holder in site.helpers()) == ("container", True)
    return holder


def test_a_start_gets_a_network_that_is_closed_off_and_nobody_gets_a_used_one(
    docker_site: DockerSite, runtime: DockerRuntime
) -> None:
    (holder,) = docker_site.helpers()
    assert "policy drop" in docker_site.nft(f"container:{holder}", "list table inet skytether")
    status = dict(
        line.split(":", 1) for line in docker("exec", holder, "cat", "/proc/1/status").splitlines() if ":" in line
    )
    assert set(status["Uid"].split()) == {"65532"}
    assert {status[key].strip() for key in ("CapInh", "CapPrm", "CapEff", "CapBnd", "CapAmb")} == {"0" * 16}
    assert (status["NoNewPrivs"].strip(), status["Seccomp"].strip()) == ("1", "2")
    runtime.start(launch(docker_site))
    seen = until_phase(runtime, Phase.RUNNING)
    (container,) = docker_site.containers()
    assert holder_of(docker_site, container) == holder
    network = json.loads(docker("network", "inspect", docker_site.network))[0]
    gateway = network["IPAM"]["Config"][0]["Gateway"]
    tries = f"""
import json, socket
def tried(address):
    try:
        socket.socket(type=socket.SOCK_DGRAM).sendto(b"x", address)
    except OSError as error:
        return error.strerror
print(json.dumps([tried(a) for a in {[(gateway, 9), ("192.0.2.1", 53)]!r}]))
"""
    assert inside(container, tries) == ["Operation not permitted"] * 2
    used = until(lambda: (now := runtime.observe()["i1"]).received_bytes is not None and now)
    with socket.socket(type=socket.SOCK_DGRAM) as robot:

        def received() -> bool:
            robot.sendto(b"x" * 1000, (seen.host, seen.port))
            return bool(runtime.observe()["i1"].received_bytes > used.received_bytes + 5000)

        until(received)
    tended(runtime, 1)
    assert len(docker_site.helpers()) == 2
    runtime.stop("i1", force=True)
    until_phase(runtime, Phase.EXITED)
    tended(runtime, 1)
    assert holder not in docker_site.helpers()
    runtime.close()
    assert docker_site.helpers() == []


def test_a_restart_keeps_its_port_and_is_closed_off_anew(docker_site: DockerSite, runtime: DockerRuntime) -> None:
    runtime.start(launch(docker_site))
    before = until_phase(runtime, Phase.RUNNING)
    runtime.stop("i1", force=True)
    until_phase(runtime, Phase.EXITED)
    runtime.start(launch(docker_site, attempt=2))
    after = until(lambda: (now := runtime.observe()["i1"]).phase is Phase.RUNNING and now)
    assert (after.attempt, after.port) == (2, before.port)
    (last,) = docker("ps", "-q", "--no-trunc", "--filter", f"name=skytether-{docker_site.owner}-i1-2").split()
    assert "policy drop" in docker_site.nft(f"container:{last}", "list table inet skytether")


def test_what_opens_something_gets_a_network_of_its_own(docker_site: DockerSite, tmp_path: Path) -> None:
    with closing(docker_site.open(tmp_path, egress=["192.0.2.1"])) as runtime:
        tended(runtime, 1)
        runtime.start(launch(docker_site, needs={"egress": ["192.0.2.1:80"]}))
        until_phase(runtime, Phase.RUNNING)
        (container,) = docker_site.containers()
        assert inspected(container)["HostConfig"]["NetworkMode"] == docker_site.network
        assert "192.0.2.1" in docker_site.nft(f"container:{container}", "list table inet skytether")


def test_one_that_somebody_removed_is_missed_by_no_start(
    docker_site: DockerSite, runtime: DockerRuntime, monkeypatch: pytest.MonkeyPatch
) -> None:
    (ready,) = runtime.namespaces.ready
    there = runtime.follower.helpers()
    assert there[ready.id].runs
    monkeypatch.setattr(runtime.follower, "helpers", lambda: there)  # nobody has told of it yet
    docker("rm", "-f", ready.id)
    runtime.start(launch(docker_site))
    until_phase(runtime, Phase.RUNNING)
    (container,) = docker_site.containers()
    assert inspected(container)["HostConfig"]["NetworkMode"] == docker_site.network


SOCKETS = """
for ([1, 1, 0], [2, 2, 0], [10, 2, 0], [16, 3, 0], [16, 3, 12]) {
    print socket(my $made, $$_[0], $$_[1], $$_[2]) ? 1 : 0;
}
print socketpair(my $one, my $other, 1, 2, 0) ? 1 : 0;
"""


def test_a_guard_makes_sockets_for_filters_alone(docker_site: DockerSite, tmp_path: Path) -> None:
    """By one of AF_UNIX it would be given one of another network, and its right with it."""
    holding, profile = DockerOptions().guard_security
    (tmp_path / "guard.json").write_text(profile.removeprefix("seccomp="))
    held = f"--security-opt={holding}", f"--security-opt=seccomp={tmp_path / 'guard.json'}"
    right = "--network=none", "--cap-drop=ALL", "--cap-add=NET_ADMIN"
    image = docker_site.images.name("guard")
    assert docker("run", "--rm", *right, *held, "--entrypoint=perl", image, "-e", SOCKETS) == "000010"


def test_who_loses_its_network_is_not_well(docker_site: DockerSite, runtime: DockerRuntime) -> None:
    runtime.start(launch(docker_site))
    until_phase(runtime, Phase.RUNNING)
    (container,) = docker_site.containers()
    docker("kill", holder_of(docker_site, container))
    until(lambda: runtime.observe()["i1"].detail == "the container that held its network has ended")


def test_what_a_killed_orchestrator_left_is_removed_and_what_runs_keeps_its_network(
    docker_site: DockerSite, runtime: DockerRuntime, tmp_path: Path
) -> None:
    runtime.start(launch(docker_site))
    before = until_phase(runtime, Phase.RUNNING)
    (container,) = docker_site.containers()
    tended(runtime, 1)
    holder = holder_of(docker_site, container)
    (ready,) = set(docker_site.helpers()) - {holder}
    # As if it had been killed while it made one: its guard is left, and what that closes off.
    image = guard_image(runtime.engine, runtime.options)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(APIClient, "wait", _killed)
        patch.setattr(APIClient, "remove_container", lambda *_, **__: None)
        with pytest.raises(_KilledError):
            close_off(runtime.engine, runtime.options, docker_site.owner, image, ready, {})
    assert len(docker_site.helpers()) == 3
    with closing(docker_site.open(tmp_path)) as second:
        tended(second, 1)
        until(lambda: len(docker_site.helpers()) == 2)
        assert holder in docker_site.helpers()
        assert ready not in docker_site.helpers()
        assert second.observe()["i1"].phase is Phase.RUNNING
        assert second.observe()["i1"].port == before.port
        second.remove("i1")
        second.dismantle()
        assert docker_site.helpers() == []


class _KilledError(BaseException):
    pass


def _killed(*_: Any, **__: Any) -> None:
    raise _KilledError
