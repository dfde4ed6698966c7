"""Real processes that are killed for real, and robots that vanish; after each nothing is lost, doubled or left."""

from __future__ import annotations

import os
import signal
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, Literal

import pytest
from fault_scene import Scene, ask, programs_in, put_toy
from nothing_lost import assert_nothing_lost, processes, told
from orchestrator_program import Program, until

from skytether.api.rest import Renew, SiteCreate, State

pytestmark = pytest.mark.slow

TOY = "skytether.testing.toy_service"


@pytest.fixture
def programs(tmp_path: Path) -> Iterator[Callable[..., Program]]:
    yield from programs_in(tmp_path)


def local(name: str, tier: Literal["edge", "cloud"] = "edge", **options: Any) -> SiteCreate:
    return SiteCreate(name=name, tier=tier, runtime="process", options=options)


def test_the_orchestrator_is_killed_with_an_instance_in_every_phase(programs: Any) -> None:
    program = programs()
    runs = processes(program.folder)
    with program.start() as client:
        client.create_site(local("edge", cpu=3))
        put_toy(client, entrypoint=TOY)
        scene = Scene.begin(client, program)
        before = client.get_instance(scene.running)
        at_work = runs()
        program.end(signal.SIGKILL)
    assert runs() == at_work
    scene.note_placing(program)
    with program.start() as client:
        now = assert_nothing_lost(told(client), scene.after(), runs)
        for instance in (scene.running, scene.starting):
            assert now[instance] == at_work[instance]
        assert client.get_instance(scene.running).session == before.session
        assert all(instance.restarts == 0 for instance in client.instances())
        client.delete_instance(scene.starting)
        assert_nothing_lost(told(client), {scene.starting: State.STOPPED, scene.pending: State.RUNNING}, runs)


def test_robots_vanish_in_every_phase(programs: Any) -> None:
    """What they held is free again, and the standby that one had taken is there anew."""
    program = programs()
    runs = processes(program.folder)
    with program.start() as client:
        for name in ("one", "other"):
            client.create_site(local(name, "cloud", cpu=4))
        put_toy(client, "warm", standby=1, tier="cloud", entrypoint=TOY)
        put_toy(client, "mover", tier="cloud", entrypoint=TOY)
        until(lambda: [i for i in client.instances() if i.state is State.RUNNING], program)
        warm, moving = ask(client, "r6", "warm"), ask(client, "r7", "mover")
        assert client.get_instance(warm).state is State.RUNNING
        until(lambda: client.get_instance(moving).state is State.RUNNING, program)
        client.create_site(local("edge", cpu=3))
        put_toy(client, entrypoint=TOY)
        scene = Scene.begin(client, program)
        successor = client.migrate_instance(moving).id
        vanished = [*vars(scene).values(), warm, moving, successor]
        for instance in set(vanished) - {scene.stopping}:  # that one may have ended by now
            client.renew_instance(instance, Renew(lease_s=1))
        left = assert_nothing_lost(told(client), dict.fromkeys(vanished, State.STOPPED), runs)
        standbys = [i.id for i in client.instances() if i.id not in vanished]
        assert len(standbys) == 1
        assert set(left) <= set(standbys)
        assert_nothing_lost(told(client), {standbys[0]: State.RUNNING}, runs)


def test_two_orchestrators_that_were_given_the_same_folder_by_mistake(programs: Any, tmp_path: Path) -> None:
    one, two = programs("one"), programs("two")
    shared = tmp_path / "shared"
    runs = processes(shared)
    try:
        with one.start() as first, two.start() as second:
            for client in (first, second):
                client.create_site(local("edge", folder=str(shared)))
                put_toy(client, entrypoint=TOY)
            mine, other = ask(first, "r1"), ask(second, "r1")
            for client, instance in ((first, mine), (second, other)):
                until(lambda c=client, i=instance: c.get_instance(i).state is State.RUNNING)
            both = runs()
            one.end(signal.SIGKILL)
            with one.start() as again:  # it looks at all that is there
                assert_nothing_lost(told(again), {mine: State.RUNNING}, lambda: {mine: runs()[mine]})
                again.delete_instance(mine)
                assert_nothing_lost(told(second), {other: State.RUNNING}, runs)
            assert runs() == {other: both[other]}
            assert second.get_instance(other).restarts == 0
    finally:
        for sessions in runs().values():
            for session in sessions:
                os.killpg(int(session.split()[1]), signal.SIGKILL)
