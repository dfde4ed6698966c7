"""ROS 2 and Cyclone DDS across the emulated link, for real, for half a second each."""

from __future__ import annotations

from pathlib import Path

import pytest

from skytether.lab.bench import conditions
from skytether.lab.bench.bridge import make_plan
from skytether.lab.bench.pair import BenchError, Pair
from skytether.lab.bench.traffic import CAMERA, COMMANDS
from skytether.lab.bench.transports import EndSpec, TransportError, load
from skytether.lab.bench.transports import ros2 as transport
from skytether.lab.bench.transports.ros2 import TunedReliable
from skytether.lab.bench.transports.ros2_settings import fastdds_profile
from skytether.lab.ros2_python import PYTHON
from skytether.wire.topic import Role

FLOWS = (*COMMANDS, CAMERA)


@pytest.mark.slow
@pytest.mark.ros2
@pytest.mark.parametrize("name", ["ros2-best-effort", "ros2-tuned-reliable", "cyclone-reliable"])
def test_messages_of_ros2_cross_the_link(name: str, ros2: str, netns: None, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv(PYTHON, ros2)
    ideal = conditions.find(["ideal"])[0]
    with Pair(name, FLOWS, condition="ideal", link=ideal.link, emulator="tun", congestion="reno") as pair:
        rows = pair.measure(0.5, warm_up=0.5)
    assert [row.topic for row in rows] == [flow.name for flow in FLOWS]
    for row in rows:
        assert row.delivered > 0
        assert row.cpu_robot_s > 0
        # Through shared memory they would not be on the link at all.
        assert row.overhead is not None
        assert row.overhead > 0


@pytest.mark.slow
@pytest.mark.ros2
def test_a_profile_that_is_not_understood_is_not_measured_as_if_it_were(
    ros2: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv(PYTHON, ros2)
    monkeypatch.setattr(transport, "fastdds_profile", lambda topics: fastdds_profile(topics).replace("period>", "p>"))
    end = TunedReliable(EndSpec(Role.SERVICE, ("127.0.0.1", 4200), COMMANDS, str(tmp_path), {}))
    try:
        with pytest.raises(TransportError, match=r"does not understand the profile.*XMLPARSER"):
            end.start()
    finally:
        end.stop()


def test_what_is_missing_is_said_with_what_to_install(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv(PYTHON, "/nowhere/python")
    with pytest.raises(TransportError, match=r"/nowhere/python: No such file .*run `make ros2`"):
        load("ros2-reliable").check()
    with pytest.raises(BenchError, match=r"nothing to measure: cyclone-reliable is left out: .*make ros2"):
        make_plan("table2", transport=["cyclone-reliable"], emulator="user")


def test_the_emulator_in_user_space_has_one_port_only(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(TunedReliable, "check", lambda: None)
    plan = make_plan("table2", transport=["ros2-tuned-reliable", "udp"], emulator="user")
    assert plan.setup.transports == ("udp",)
    assert any("ros2-tuned-reliable is left out: it uses several ports" in note for note in plan.notes)
