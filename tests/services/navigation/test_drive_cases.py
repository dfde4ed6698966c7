"""The whole service drives in one made-up room: what people ask on the way, zones, and sensors that fail."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path as FilePath
from typing import Any

import numpy as np
import pytest

from skytether.lab.trail import Pose
from skytether.lab.world.plan import Box, Cylinder, Plan
from skytether.messages import Header, LaserScan, Message, Odometry, Path, Point, PoseStamped, SetBoolRequest
from skytether.messages import Pose as PoseMessage
from skytether.testing.drive import Drive
from skytether_services.navigation.service import Navigation

pytestmark = pytest.mark.slow

ROOM = Plan(
    "room",
    (
        Box("south", 4.0, 0.0, 8.0, 0.1, wall=True, height=2.0),
        Box("north", 4.0, 5.0, 8.0, 0.1, wall=True, height=2.0),
        Box("west", 0.0, 2.5, 0.1, 5.0, wall=True, height=2.0),
        Box("east", 8.0, 2.5, 0.1, 5.0, wall=True, height=2.0),
        Box("shelf", 2.0, 4.6, 1.2, 0.6),
        Box("cupboard", 7.3, 3.2, 0.8, 0.5),
    ),
    (Cylinder("pillar", 5.0, 3.8, 0.3),),
    (Pose(1.0, 1.2, 0.0),),
    (Pose(6.5, 1.2, 0.0),),
)
"""8 m by 5 m, with a way along y = 1.2 m, and no two corners alike."""
FAR = {"x": 6.5, "y": 1.2}
Altered = Callable[[str, Message], Message | None]


def drive(folder: FilePath, **params: Any) -> Drive:
    return Drive(Navigation, folder, {"controller": "dwa", **params}, ROOM)


def on_the_way(folder: FilePath, **params: Any) -> Drive:
    """To the far end, and 1.5 m of it are driven."""
    driven = drive(folder, goals=[FAR], **params)
    assert driven.run(15.0, lambda: driven.robot.distance > 1.5), driven.status
    return driven


def pose(x: float, y: float) -> PoseStamped:
    return PoseStamped(Header(frame_id="map"), PoseMessage(Point(x, y)))


def stands(driven: Drive, seconds: float = 1.0) -> bool:
    """Whether it stays where it is for so long."""
    before = driven.robot.distance
    driven.run(seconds)
    return bool(driven.robot.distance - before < 0.02)


def goes_on(driven: Drive) -> bool:
    """Whether it drives another 0.5 m, soon."""
    before = driven.robot.distance
    return driven.run(10.0, lambda: driven.state == "driving" and driven.robot.distance - before > 0.5)


def zone(folder: FilePath, name: str, percent: int, x: tuple[float, float], y: tuple[float, float]) -> None:
    """A mask with one rectangle of a value, in mode ``raw``."""
    shades = np.zeros((100, 160), dtype=np.uint8)
    shades[int(y[0] * 20) : int(y[1] * 20), int(x[0] * 20) : int(x[1] * 20)] = percent
    (folder / f"{name}.pgm").write_bytes(b"P5\n160 100\n255\n" + shades[::-1].tobytes())
    text = f"image: {name}.pgm\nresolution: 0.05\norigin: [0, 0, 0]\nmode: raw\n"
    (folder / f"{name}.yaml").write_text(text)


def test_it_waits_and_goes_on(tmp_path: FilePath) -> None:
    driven = on_the_way(tmp_path)
    assert driven.harness.call("pause", SetBoolRequest(True)).success
    driven.run(1.0)
    assert driven.status["state"] == "paused"
    assert stands(driven)
    assert driven.harness.call("pause", SetBoolRequest(False)).success
    assert goes_on(driven), driven.status


def test_another_goal_replaces_the_one_that_it_drives_to(tmp_path: FilePath) -> None:
    driven = on_the_way(tmp_path)
    driven.harness.send("goal", pose(1.0, 2.5))
    assert driven.run(40.0, lambda: math.dist(driven.robot.pose[:2], (1.0, 2.5)) < 0.5), driven.status
    assert not driven.world.contacts


@pytest.mark.parametrize(
    ("request_", "code"),
    [
        (("goal", pose(5.0, 3.8)), "goal_blocked"),
        (("goal", pose(30.0, 1.0)), "goal_off_map"),
        (("goals", Path(poses=(pose(2.0, 1.2), pose(30.0, 1.0)))), "goal_off_map"),
        (("goals", Path()), "no_goals"),
    ],
)
def test_what_cannot_be_driven_to_stops_it_and_the_service_lives(
    tmp_path: FilePath, request_: tuple[str, Message], code: str
) -> None:
    driven = on_the_way(tmp_path)
    driven.harness.send(*request_)
    assert driven.until("failed", 1.0, code), driven.status
    driven.run(1.0)
    assert stands(driven)
    assert driven.harness.service.reports.recent[-1].code == code
    driven.harness.send("goal", pose(FAR["x"], FAR["y"]))
    assert goes_on(driven), driven.status


def test_a_zone_to_keep_out_of_is_driven_around(tmp_path: FilePath) -> None:
    zone(tmp_path, "closed", 100, (3.5, 4.5), (0.0, 2.2))
    driven = drive(tmp_path, goals=[FAR], keep_out="closed.yaml")
    inside: list[Pose] = []

    def ended() -> bool:
        x, y, _ = driven.robot.pose
        if 3.5 < x < 4.5 and y < 2.2:
            inside.append(driven.robot.pose)
        return bool(driven.status.get("state") == "succeeded")

    assert driven.run(60.0, ended), driven.status
    assert not inside


def test_a_goal_behind_a_zone_that_closes_the_room_has_no_path(tmp_path: FilePath) -> None:
    zone(tmp_path, "closed", 100, (3.5, 4.5), (0.0, 5.0))
    driven = drive(tmp_path, goals=[FAR], keep_out="closed.yaml")
    assert driven.until("failed", 20.0, "no_path"), driven.status
    assert driven.harness.service.reports.recent[-1].code == "no_path"
    assert stands(driven)


def silent(topic: str, message: Message) -> Message | None:
    """A laser that publishes nothing."""
    return None if topic == "scan" else message


def blind(topic: str, message: Message) -> Message | None:
    """A laser that measures nothing."""
    del topic
    return replace(message, ranges=np.full_like(message.ranges, np.nan)) if isinstance(message, LaserScan) else message


def jumped(topic: str, message: Message) -> Message | None:
    """Odometry that is 0.6 m further than it was, as after wheels that slipped; `tf` says nothing."""
    if isinstance(message, Odometry):
        at = message.pose.pose.position
        pose = replace(message.pose.pose, position=replace(at, x=at.x + 0.6))
        return replace(message, pose=replace(message.pose, pose=pose))
    return None if topic == "tf" and message else message


@pytest.mark.parametrize(("alter", "code"), [(silent, "no_scan"), (blind, "scan_useless")])
def test_without_its_laser_it_stands_says_so_and_goes_on(tmp_path: FilePath, alter: Altered, code: str) -> None:
    driven = on_the_way(tmp_path)
    sees, driven.alter = driven.alter, alter
    assert driven.until("standing", 1.5, code), driven.status
    driven.run(1.5)
    assert stands(driven)
    assert driven.harness.service.reports.recent[-1].code == code
    driven.alter = sees
    assert goes_on(driven), driven.status
    assert not driven.world.contacts


def test_odometry_that_jumps_stops_it_and_it_goes_on(tmp_path: FilePath) -> None:
    driven = on_the_way(tmp_path)
    driven.alter = jumped
    assert driven.until("standing", 1.0, "odometry_jumped"), driven.status
    assert driven.until("succeeded", 60.0), driven.status
    assert math.dist(driven.robot.pose[:2], (6.5, 1.2)) < 0.4
    assert not driven.world.contacts


def test_a_robot_that_was_carried_elsewhere_stands_and_says_so(tmp_path: FilePath) -> None:
    driven = on_the_way(tmp_path)
    driven.world.place(0, Pose(6.0, 2.4, math.pi / 2))
    assert driven.run(15.0, lambda: driven.status["code"] == "lost"), driven.status
    assert stands(driven)
    assert not driven.world.contacts


def test_a_list_is_driven_through_without_a_stop_and_again(tmp_path: FilePath) -> None:
    goals = [{"x": 3.0, "y": 1.2}, {"x": 5.0, "y": 1.8}, {"x": 3.0, "y": 3.0}]
    driven = drive(tmp_path, goals=goals, rounds=2, stop_at_each=False)
    assert driven.run(10.0, lambda: driven.status.get("goal") == 2), driven.status
    assert driven.robot.motion.forward > 0.2, "it does not stop at the first"
    assert driven.until("succeeded", 90.0), driven.status
    assert driven.status["round"] == 2
    assert math.dist(driven.robot.pose[:2], (3.0, 3.0)) < 0.3
    assert not driven.world.contacts


@pytest.mark.parametrize("controller", ["dwa", "mppi"])
def test_a_zone_of_40_percent_is_driven_through_no_faster(tmp_path: FilePath, controller: str) -> None:
    zone(tmp_path, "slow", 40, (3.0, 5.0), (0.0, 5.0))
    driven = drive(tmp_path, goals=[FAR], speed_zones="slow.yaml", controller=controller)
    fastest = [0.0, 0.0]

    def look() -> bool:
        x, forward = driven.robot.pose[0], driven.robot.motion.forward
        inside = 3.3 < x < 4.9  # there it brakes, and goes on
        fastest[inside] = max(fastest[inside], forward)
        return driven.state == "succeeded"

    assert driven.run(60.0, look), driven.status
    assert fastest[False] > 0.35
    assert fastest[True] < 0.23, "0.2 m/s, and what the wheels overshoot"


@pytest.mark.parametrize("controller", ["dwa", "mppi"])
def test_it_stops_at_its_goal_and_not_behind_it(tmp_path: FilePath, controller: str) -> None:
    driven = drive(tmp_path, goals=[FAR], controller=controller)
    assert driven.until("succeeded", 30.0), driven.status
    assert driven.robot.pose[0] == pytest.approx(FAR["x"], abs=0.1)
