"""A robot whose orchestrator, token and network come and go: the real orchestrator and service, real sockets."""

import time

import pytest

from skytether.api.client import Client
from skytether.api.rest import RobotCreate
from skytether.emulator.udp_link import LinkEmulator
from skytether.lab.demo import WalkerHardware
from skytether.lab.embedded import EmbeddedOrchestrator
from skytether.lab.trail import Trail
from skytether.lab.walk import World
from skytether.robot.agent.agent import Agent
from skytether.robot.agent.config import AgentConfig
from skytether.robot.control.command import Source
from skytether.robot.offload.site_prober import TaskConfig

pytestmark = pytest.mark.slow


def wait_for(condition, what):
    deadline = time.monotonic() + 30
    while not condition():
        assert time.monotonic() < deadline, f"waited for {what} in vain"
        time.sleep(0.01)


def test_a_robot_stays_usable_whatever_comes_and_goes(tmp_path):
    (tmp_path / "state").mkdir()
    base = WalkerHardware(World(Trail(), seed=1))
    base.walking.set()
    with EmbeddedOrchestrator(tmp_path / "state") as orchestrator, LinkEmulator(("127.0.0.1", 9)) as link:
        tokens = [register(orchestrator)]
        orchestrator.kill()

        def route(host, port):
            link.set_target(host, port)
            return link.address

        config = AgentConfig(
            robot="walker",
            url=orchestrator.url,
            token=tokens[0],
            fresh_token=lambda: tokens[-1],
            service="virtual-trail",
            fallback="admittance",
            bind=("127.0.0.1", 0),
            task=TaskConfig(probe_s=0.2),
            route=route,
        )
        with Agent(config, base) as agent:
            # Offline start: its own controller drives, and the trouble is told.
            wait_for(lambda: base.world.velocity.linear > 0.1, "the robot's own controller")
            assert agent.source is Source.FALLBACK
            wait_for(lambda: "no orchestrator answers" in agent.status().trouble, "the trouble to be told")
            # It comes: the service drives, on the site that was measured meanwhile.
            orchestrator.start()
            wait_for(lambda: agent.source is Source.CLOUD, "the service")
            wait_for(lambda: agent.status().decision.site == "local", "a decision")
            assert agent.status().trouble == ""
            # It is restarted, and the robot gets another address: who drives stays, or comes back soon.
            first = agent.status().instance.id
            orchestrator.kill()
            link.rebind()
            orchestrator.start()
            wait_for(lambda: renewed(orchestrator, first), "a renewed lease")
            wait_for(lambda: agent.source is Source.CLOUD, "the service after the network changed")
            # The token ends, with all that the robot held: it drives itself, and comes back with the new one.
            with operator(orchestrator) as client:
                client.delete_robot("walker")
            wait_for(lambda: agent.source is Source.FALLBACK, "its own controller after the token ended")
            wait_for(lambda: agent.status().trouble, "the trouble with the token")
            tokens.append(register(orchestrator))
            wait_for(lambda: agent.source is Source.CLOUD, "the service with the new token")
            assert agent.status().instance.id != first
            assert agent.status().driver.errors == {}
    assert base.samples


def operator(orchestrator):
    return Client(orchestrator.url, orchestrator.operator_token)


def register(orchestrator):
    with operator(orchestrator) as client:
        return client.create_robot(RobotCreate(name="walker")).token


def renewed(orchestrator, instance):
    """The instance that was there before goes on, its lease counted from after the start."""
    with operator(orchestrator) as client:
        found = client.get_instance(instance)
    return found.state == "running" and found.restarts == 0
