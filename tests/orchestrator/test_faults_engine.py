"""A real Docker engine that is killed, hangs, or is shared by mistake: it is the test's own."""

from __future__ import annotations

import os
import signal
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest
from docker_site import DockerSite, Images
from engine_ways import EngineProxy
from fault_scene import Scene, ask, programs_in, put_toy
from nothing_lost import assert_nothing_lost, containers, litter, processes, told
from orchestrator_program import Program, until
from own_engine import OwnEngine

from skytether.api.client import Client
from skytether.api.rest import SiteCreate, State

pytestmark = [pytest.mark.docker, pytest.mark.slow]

TOY = "skytether.testing.toy_service"


@pytest.fixture(scope="module")
def engine(docker_images: Images, netns: None) -> Iterator[OwnEngine]:
    engine = OwnEngine()
    try:
        engine.start()
        engine.load(docker_images.toy, docker_images.name("guard"))
        yield engine
    finally:
        engine.close()


@pytest.fixture
def site(engine: OwnEngine, docker_images: Images) -> Iterator[DockerSite]:
    # An orchestrator that a test before killed may have been closing the network off: the next one to do so removes
    # what it left, but a minute later at the earliest.
    guards = engine.docker("ps", "-aq", "--filter", "label=skytether.io/helper").split()
    if guards:
        engine.docker("rm", "-f", *guards)
    site = DockerSite(docker_images, engine.address)
    yield site
    site.close()


@pytest.fixture
def programs(tmp_path: Path, site: DockerSite) -> Iterator[Callable[..., Program]]:
    """They end before their site is cleared: one that runs makes anew what it misses there."""
    yield from programs_in(tmp_path)


def add_site(client: Client, site: DockerSite, name: str = "edge", **options: Any) -> None:
    client.create_site(SiteCreate(name=name, tier="edge", runtime="docker", options=site.options(**options)))


def running(client: Client, *instances: str) -> Callable[[], bool]:
    return lambda: all(client.get_instance(instance).state is State.RUNNING for instance in instances)


def unreachable(client: Client) -> Callable[[], bool]:
    return lambda: client.get_site("edge").state == "unreachable"


def test_the_orchestrator_is_killed_with_a_container_in_every_phase(
    programs: Any, site: DockerSite, tmp_path: Path
) -> None:
    proxy = EngineProxy(tmp_path / "engine.sock", target=site.engine)
    proxy.start()
    program = programs()
    with program.start() as client:
        add_site(client, site, cpu=4, engine=proxy.engine, timeout_s=60)
        put_toy(client, image=site.images.toy)
        begun = ask(client, "r0")
        until(running(client, begun), program)
        client.delete_instance(begun)
        until(lambda: client.get_instance(begun).state is State.STOPPED, program)
        proxy.swallow = b"/start HTTP"
        begun = ask(client, "r0")
        assert proxy.swallowed.wait(30)  # it was made, and is not begun
        proxy.swallow = None
        scene = Scene.begin(client, program)
        before = client.get_instance(scene.running)
        at_work = containers(site)()
        program.end(signal.SIGKILL)
    assert containers(site)() == at_work
    scene.note_placing(program)
    with program.start() as client:
        expected = {**scene.after(), begun: State.RUNNING}
        now = assert_nothing_lost(told(client), expected, containers(site), left=litter(site))
        for instance in (scene.running, scene.starting):
            assert now[instance] == at_work[instance]
        assert client.get_instance(scene.running).session == before.session
        assert all(instance.restarts == 0 for instance in client.instances())
        client.delete_instance(scene.starting)
        after = {scene.starting: State.STOPPED, scene.pending: State.RUNNING}
        assert_nothing_lost(told(client), after, containers(site), left=litter(site))
    proxy.cut()


def test_the_engine_is_killed_and_begins_again(programs: Any, site: DockerSite, engine: OwnEngine) -> None:
    """First as one that lets containers live on, then as one that does not; and one container is killed alone."""
    program = programs()
    places = (containers(site), processes(program.folder))
    with program.start() as client:
        add_site(client, site, cpu=8)
        client.create_site(SiteCreate(name="local", tier="edge", runtime="process", options={"cpu": 8}))
        put_toy(client, image=site.images.toy)
        put_toy(client, "other", entrypoint=TOY)
        one, elsewhere = ask(client, "r1"), ask(client, "r2", "other")
        until(running(client, one, elsewhere), program)
        before, at_work = client.get_instance(one), containers(site)()

        engine.kill()
        two = ask(client, "r3")  # nobody may have noticed yet
        until(unreachable(client), program)
        three = ask(client, "r4")
        four = ask(client, "r5", "other")
        until(running(client, four), program)
        assert client.get_instance(one).state is State.RUNNING
        engine.start("--live-restore")
        expected = dict.fromkeys((one, two, three, four, elsewhere), State.RUNNING)
        now = assert_nothing_lost(told(client), expected, *places, left=litter(site))
        assert now[one] == at_work[one]
        assert all(instance.restarts == 0 for instance in client.instances())

        engine.kill()
        until(unreachable(client), program)
        engine.start()
        until(lambda: client.get_instance(one).restarts == 1, program)
        assert_nothing_lost(told(client), expected, *places, left=litter(site))
        assert [client.get_instance(i).restarts for i in (one, two, three, elsewhere)] == [1, 1, 1, 0]
        assert client.get_instance(one).session == before.session

        [container] = containers(site)()[one]
        os.kill(int(engine.docker("inspect", "--format", "{{.State.Pid}}", container)), signal.SIGKILL)
        until(lambda: client.get_instance(one).restarts == 2, program)
        assert_nothing_lost(told(client), expected, *places, left=litter(site))
        ended = dict.fromkeys(expected, State.STOPPED)
        for instance in ended:
            client.delete_instance(instance)
        assert_nothing_lost(told(client), ended, *places, left=litter(site))


def test_the_engine_hangs(programs: Any, site: DockerSite, engine: OwnEngine) -> None:
    """With a start under way; all else goes on."""
    program = programs()
    places = (containers(site), processes(program.folder))
    with program.start() as client:
        add_site(client, site, cpu=8, timeout_s=2)
        client.create_site(SiteCreate(name="local", tier="edge", runtime="process", options={"cpu": 8}))
        put_toy(client, image=site.images.toy)
        put_toy(client, "other", entrypoint=TOY)
        one = ask(client, "r1")
        until(running(client, one), program)
        at_work = containers(site)()
        engine.signal(signal.SIGSTOP)
        try:
            two = ask(client, "r2")  # nobody has noticed yet: it is asked to run there
            until(unreachable(client), program)
            three = ask(client, "r3")
            four = ask(client, "r4", "other")
            until(running(client, four), program)
            assert unreachable(client)()
            states = told(client)()
            assert (states[one], states[three]) == (State.RUNNING, State.PENDING)
            assert states[two] in (State.PENDING, State.STARTING)
        finally:
            engine.signal(signal.SIGCONT)
        expected = dict.fromkeys((one, two, three, four), State.RUNNING)
        now = assert_nothing_lost(told(client), expected, *places, left=litter(site))
        assert now[one] == at_work[one]
        assert all(instance.restarts == 0 for instance in client.instances())


def test_two_orchestrators_that_were_given_the_same_engine_by_mistake(
    programs: Any, site: DockerSite, engine: OwnEngine
) -> None:
    other = DockerSite(site.images, site.engine)
    other.network = site.network
    sleeping = ("--entrypoint", "sleep", site.images.name("guard"), "600")
    stranger = engine.docker("run", "-d", "--label", "skytether.io/instance=mine", *sleeping)
    one, two = programs("one"), programs("two")
    with one.start() as first, two.start() as second:
        for client, of in ((first, site), (second, other)):
            add_site(client, of)
            put_toy(client, image=site.images.toy)
        mine, its = ask(first, "r1"), ask(second, "r1")
        until(running(first, mine), one)
        until(running(second, its), two)
        at_work = containers(other)()
        one.end(signal.SIGKILL)
        with one.start() as again:  # it looks at all that is there
            assert_nothing_lost(told(again), {mine: State.RUNNING}, containers(site), left=litter(site))
            again.delete_instance(mine)
            assert_nothing_lost(told(again), {mine: State.STOPPED}, containers(site), left=litter(site))
        assert containers(other)() == at_work
        assert_nothing_lost(told(second), {its: State.RUNNING}, containers(other))
        assert second.get_instance(its).restarts == 0
        assert engine.docker("inspect", "--format", "{{.State.Status}}", stranger) == "running"
    other.clean()
    engine.docker("rm", "-f", stranger)
