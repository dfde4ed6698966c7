"""The closed loop that a service may be tested in: what its link does to messages, in made-up time."""

from dataclasses import dataclass, field
from pathlib import Path

import pytest

from skytether.emulator.link_model import LinkConditions
from skytether.lab.trail import Pose
from skytether.lab.world.plan import Box, Plan
from skytether.messages import String, TFMessage, Twist, Vector3
from skytether.service import Input, Output, Service
from skytether.testing.drive import Drive

pytest.importorskip("mujoco")

HALL = Plan("hall", (Box("wall", 9.0, 0.0, 0.1, 4.0, wall=True),), (), (Pose(0.0, 0.0, 0.0),), (Pose(3.0, 0.0, 0.0),))


@dataclass(frozen=True)
class MapParams:
    """What a drive tells a service."""

    map: str = ""
    start: dict[str, float] = field(default_factory=dict)


class Straight(Service[MapParams]):
    """Drives on; notes how old and in which order the poses are that it gets."""

    rate_hz = 30.0
    tf = Input(TFMessage)
    cmd_vel = Output(Twist)
    status = Output(String)

    def start(self) -> None:
        self.ages: list[float] = []
        self.sent: list[float] = []

    def step(self, now: float) -> None:
        if tf := self.tf.take():
            self.ages.append(now - tf.sent_at)
            self.sent.append(tf.sent_at)
        self.cmd_vel.publish(Twist(Vector3(x=0.5)))
        self.status.publish(String('{"state": "driving", "code": "ok"}'))


def drive(folder: Path, link: LinkConditions | None = None) -> Drive:
    return Drive(Straight, folder, {}, HALL, link=link)


def test_a_link_delays_both_ways(tmp_path: Path) -> None:
    prompt, late = drive(tmp_path), drive(tmp_path, LinkConditions(delay=0.1))
    for made in (prompt, late):
        made.run(1.0)
    service = late.harness.service
    assert isinstance(service, Straight)
    assert all(age == pytest.approx(0.1, abs=1e-6) for age in service.ages)
    # The first command is on its way for 0.1 s: so much less of 0.5 m/s.
    assert prompt.robot.distance - late.robot.distance == pytest.approx(0.05, abs=0.006)
    assert late.statuses == [("driving", "ok")]
    assert late.until("driving", 1.0)
    assert len(late.times) == pytest.approx(30, abs=1)


def test_jitter_and_loss_are_the_seeds_and_nothing_overtakes(tmp_path: Path) -> None:
    links = [LinkConditions(delay=0.1, jitter=0.03, loss=0.2, seed=seed) for seed in (1, 1, 2)]
    sent = []
    for link in links:
        made = drive(tmp_path, link)
        made.run(1.0)
        service = made.harness.service
        assert isinstance(service, Straight)
        sent.append(service.sent)
        assert max(service.ages) > 0.11
    assert sent[0] == sent[1] != sent[2]
    assert sent[0] == sorted(set(sent[0]))
