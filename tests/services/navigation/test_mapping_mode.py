"""The mode that maps: a laser in a room, made-up time, and no thread. Numba compiles for seconds in a fresh clone."""

from __future__ import annotations

import json
import math
from collections.abc import Callable
from concurrent.futures import Executor, Future
from pathlib import Path
from typing import Any, ParamSpec, TypeVar

import numpy as np
import pytest
from scipy.spatial import cKDTree

from skytether.lab.world.guide import Guide
from skytether.lab.world.occupancy import FREE as WHITE
from skytether.lab.world.occupancy import OCCUPIED as BLACK
from skytether.lab.world.occupancy import Occupancy
from skytether.lab.world.plan import building
from skytether.lab.world.simulation import TICK, Simulation
from skytether.messages import (
    Header,
    LaserScan,
    Odometry,
    Point,
    Pose,
    PoseWithCovariance,
    Time,
    TriggerRequest,
    quaternion_from_yaw,
)
from skytether.service import ConfigError
from skytether.testing.drive import Drive
from skytether.testing.service import Harness
from skytether_services.navigation.grid_map import FREE, OCCUPIED, load_map
from skytether_services.navigation.service import Navigation

pytestmark = pytest.mark.slow

P = ParamSpec("P")
T = TypeVar("T")
RAYS = np.radians(np.arange(-135, 135, 1.0))
MAPPING = {
    "mode": "map", "controller": "dwa", "sensors": {"laser": {"x": 0.2, "y": 0.0}}, "rates": {"publish_status": 30.0}
}  # fmt: skip


class AtOnce(Executor):
    """No thread: whatever is asked for is done at once."""

    def submit(self, fn: Callable[P, T], /, *args: P.args, **kwargs: P.kwargs) -> Future[T]:
        done: Future[T] = Future()
        try:
            done.set_result(fn(*args, **kwargs))
        except Exception as error:
            done.set_exception(error)
        return done


class Never(AtOnce):
    """A thread that hangs."""

    def submit(self, fn: Callable[P, T], /, *args: P.args, **kwargs: P.kwargs) -> Future[T]:
        return Future()


class MappingAtOnce(Navigation):
    """As it is, without a thread."""

    def executor(self) -> Executor:
        return AtOnce()


def seen(x: float, y: float, yaw: float) -> np.ndarray[Any, np.dtype[np.float32]]:
    """Ranges in a room from (-4, -3) to (4, 3)."""
    cos, sin = np.cos(yaw + RAYS), np.sin(yaw + RAYS)
    with np.errstate(divide="ignore", invalid="ignore"):
        along = np.maximum((4 - x) / cos, (-4 - x) / cos)
        across = np.maximum((3 - y) / sin, (-3 - y) / sin)
    return np.minimum(along, across).astype(np.float32)


def sense(harness: Harness[Any], x: float, y: float = 0.0, yaw: float = 0.0, *, scan: object = None) -> None:
    """A tenth of a second later the robot is there, and its laser 0.2 m ahead of it."""
    harness.now += 0.05
    header = Header(Time.from_seconds(harness.now), "odom")
    pose = PoseWithCovariance(Pose(Point(x, y), quaternion_from_yaw(yaw)))
    harness.send("odom", Odometry(header, "base_link", pose))
    ranges = seen(x + 0.2 * math.cos(yaw), y + 0.2 * math.sin(yaw), yaw) if scan is None else scan
    step = float(RAYS[1] - RAYS[0])
    harness.send(
        "scan",
        LaserScan(
            Header(header.stamp, "laser"), float(RAYS[0]), float(RAYS[-1]), step,
            range_min=0.05, range_max=20.0, ranges=np.asarray(ranges, dtype=np.float32),
        ),
    )  # fmt: skip
    harness.step(0.0)
    harness.step(0.05)


def served(tmp_path: Path, **mapping: object) -> Harness[MappingAtOnce]:
    return Harness(MappingAtOnce, {**MAPPING, "mapping": mapping}, data_dir=tmp_path)


def status(harness: Harness[Any]) -> dict[str, Any]:
    harness.step(1.0)
    return dict(json.loads(harness.newest("status").data))


def drive(harness: Harness[Any], metres: float = 2.0) -> None:
    for x in np.arange(0.0, metres, 0.05):
        sense(harness, float(x))


def save_map(harness: Harness[Any]) -> tuple[bool, str]:
    answer = harness.call("save_map", TriggerRequest())
    return answer.success, answer.message


def test_a_room_is_mapped_and_nobody_is_driven(tmp_path: Path) -> None:
    harness = served(tmp_path, save_every=0)
    drive(harness)
    told = json.loads(harness.newest("status").data)
    assert (told["state"], told["code"]) == ("mapping", "ok")
    assert 7 <= told["scans"] <= 11
    assert told["pose"] == pytest.approx([1.95, 0.0, 0.0], abs=0.02)
    assert not harness.outputs["cmd_vel"]
    assert harness.newest("pose").pose.pose.position.x == pytest.approx(1.95, abs=0.02)
    assert save_map(harness) == (True, str(tmp_path / "map.yaml"))
    grid = load_map(tmp_path / "map.yaml")
    assert grid.at(1.0, 0.0) == FREE
    # The laser was moved along x, so each cell of the wall ahead was met by several scans.
    assert OCCUPIED in (grid.at(3.98, 0.5), grid.at(4.02, 0.5))
    assert (tmp_path / "map.png").read_bytes().startswith(b"\x89PNG")
    assert status(harness)["saved"] == str(tmp_path / "map.yaml")
    assert harness.newest("new_map").info.resolution == pytest.approx(0.05)


def test_it_is_saved_every_so_often_and_at_the_end(tmp_path: Path) -> None:
    harness = served(tmp_path, save_every=1.0, save_as="hall")
    drive(harness, 0.2)
    harness.step(1.1)
    harness.step(0.1)
    first = (tmp_path / "hall.pgm").stat().st_mtime_ns
    shown = len(harness.outputs["new_map"])
    for _ in range(20):
        harness.step(1.0)
    # Nothing new was seen.
    assert ((tmp_path / "hall.pgm").stat().st_mtime_ns, len(harness.outputs["new_map"])) == (first, shown)
    drive(harness)
    harness.stop()
    assert (tmp_path / "hall.pgm").stat().st_mtime_ns > first
    assert harness.service.reports.recent[-1].code == "map_saved"
    # Whoever starts again in the same folder overwrites nothing.
    again = served(tmp_path, save_as="hall")
    drive(again, 0.2)
    assert save_map(again) == (True, str(tmp_path / "hall-2.yaml"))


def test_what_is_wrong_is_told_and_it_goes_on(tmp_path: Path) -> None:
    harness = served(tmp_path)
    assert status(harness)["code"] == "no_odometry"
    assert save_map(harness) == (False, "There is no map yet: no scan was kept.")
    drive(harness, 0.5)
    sense(harness, 0.5, scan=np.full(RAYS.size, np.nan))
    assert json.loads(harness.newest("status").data)["code"] == "scan_useless"
    sense(harness, 0.5, scan=np.full(7, 2.0))
    sense(harness, 0.55, scan=np.full(7, 2.0))
    assert json.loads(harness.newest("status").data)["code"] == "mapping_failed"
    sense(harness, math.nan)
    sense(harness, 9.0, scan=seen(0.8, 0.0, 0.0))
    for x in np.arange(9.0, 9.5, 0.05):
        sense(harness, float(x), scan=seen(float(x) - 8.2, 0.0, 0.0))
    for _ in range(60):
        sense(harness, 9.45, scan=seen(1.25, 0.0, 0.0))
    # The odometry's jump of 8.4 m is none of the map's.
    told = json.loads(harness.newest("status").data)
    assert (told["code"], told["pose"]) == ("ok", pytest.approx([1.05, 0.0, 0.0], abs=0.05))
    assert status(harness)["code"] == "no_odometry"


def test_a_full_disk_is_told_until_it_is_not(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    harness = served(tmp_path, save_every=0)
    drive(harness, 0.5)

    def full(*_: object, **__: object) -> None:
        raise OSError(28, "No space left on device")

    with monkeypatch.context() as patched:
        patched.setattr("skytether_services.navigation.grid_map.tempfile.mkstemp", full)
        done, text = save_map(harness)
        assert not done
        assert "No space left on device" in text
        sense(harness, 0.5)
        assert json.loads(harness.newest("status").data)["code"] == "not_saved"
    assert not list(tmp_path.iterdir())
    assert save_map(harness)[0]
    sense(harness, 0.5)
    assert json.loads(harness.newest("status").data)["code"] == "ok"


def test_scans_wait_in_a_queue_that_has_an_end(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(MappingAtOnce, "executor", lambda _: Never())
    monkeypatch.setattr("skytether_services.navigation.mapping_mode.PATIENCE", 0.01)
    harness = served(tmp_path)
    drive(harness, 3.0)
    assert status(harness)["dropped"] == 10
    assert "still being drawn" in save_map(harness)[1]


@pytest.mark.parametrize("name", ["", "../map", "a/b", ".hidden"])
def test_a_name_with_folders_is_refused(tmp_path: Path, name: str) -> None:
    with pytest.raises(ConfigError, match=r"mapping\.save_as"):
        served(tmp_path, save_as=name)


def test_who_navigates_saves_no_map(tmp_path: Path) -> None:
    harness = Harness(Navigation, {"controller": "dwa"}, data_dir=tmp_path)
    assert not save_map(harness)[0]
    harness.stop()
    assert not list(tmp_path.iterdir())


def test_the_thread_maps_too(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    # It may have to compile first.
    monkeypatch.setattr("skytether_services.navigation.mapping_mode.PATIENCE", 120.0)
    harness = Harness(Navigation, MAPPING, data_dir=tmp_path)
    drive(harness, 1.0)
    harness.stop()
    assert load_map(tmp_path / "map.yaml").at(1.0, 0.0) == FREE


def test_the_building_is_mapped_and_then_driven_through(tmp_path: Path) -> None:
    plan = building()
    world, start = Simulation(plan, seed=1), plan.starts[0]
    begin = {"x": start.x, "y": start.y, "yaw": start.heading}
    harness = Harness(MappingAtOnce, {"mode": "map", "controller": "dwa", "start": begin}, data_dir=tmp_path)
    robot, guide = world.robots[0], Guide(plan.goals, world.params)
    period, due = 1 / 30, harness.now
    while not guide.done and world.time < 240.0:
        harness.now += TICK
        robot.write(guide.step(robot.pose, robot.scan))
        for topic, message in world.tick(harness.now)[0]:
            if topic in ("tf", "odom", "scan"):
                harness.send(topic, message)
        if harness.now + 1e-9 >= due:
            due += period
            harness.step(0.0)
    assert guide.done
    harness.stop()
    assert not harness.outputs["cmd_vel"]

    grid, truth = load_map(tmp_path / "map.yaml"), Occupancy(plan)
    rows, columns = np.nonzero(grid.cells == OCCUPIED)
    walls = grid.to_points(np.column_stack((columns, rows)) + 0.5)
    near = plan.clearance(walls) <= 0.1
    assert near.mean() > 0.99, (near.mean(), near.size)
    # What looks at free floor, of what the true map shows: most of it is seen from the way, not the backs of things.
    beside = np.zeros_like(truth.grey, dtype=bool)
    for axis, by in ((0, 1), (0, -1), (1, 1), (1, -1)):
        beside |= np.roll(truth.grey == WHITE, by, axis)
    true_rows, true_columns = np.nonzero((truth.grey == BLACK) & beside)
    true_walls = (np.column_stack((true_columns, true_rows)) + 0.5) * truth.resolution + truth.origin
    found = cKDTree(walls).query(true_walls)[0] <= 0.1
    assert found.mean() > 0.75, (found.mean(), found.size)

    goals = [{"x": goal.x, "y": goal.y, "yaw": goal.heading} for goal in plan.goals[:2]]
    params = {"goals": goals, "map": str(tmp_path / "map.yaml"), "controller": "dwa"}
    (tmp_path / "truth").mkdir()
    again = Drive(Navigation, tmp_path / "truth", params, plan)
    assert again.until("succeeded", 60.0), again.status
    assert not again.world.contacts
