"""Recordings of a laser at the height of legs, read for ``skytether lab bench legs``.

Their conventions are those of the leg tracker's benchmarks (Leigh et al., ICRA 2015): a bag, or a zipped one, with
scans; maybe the robot's odometry, the laser's place on the robot, and where people were.
"""

from __future__ import annotations

import math
import shutil
import struct
import tempfile
import zipfile
from bisect import bisect_right
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from skytether.messages import DecodeError, LaserScan, Odometry, Quaternion, TFMessage, decode
from skytether.robot.bag import Bag, BagError

Floats = NDArray[np.float64]

TRUTH = "/ground_truth_people_tracks"
_SCAN, _ODOMETRY, _TF = "sensor_msgs/msg/LaserScan", "nav_msgs/msg/Odometry", "tf2_msgs/msg/TFMessage"
_PERSON = struct.Struct("<7dI")
"""``leg_tracker/msg/Person``: a pose (x, y, z, quaternion) in the scan's frame, and a number."""
_MOST_BYTES = 4 << 30
"""Of a bag in a ZIP file."""


@dataclass(frozen=True)
class LegBag:
    """A recording.

    Attributes:
        topic: Of the scans.
        stamps: Of the n scans, always later than the one before [s].
        ranges: Of each [m].
        first: Angle of the first ray [rad].
        step: Between neighbouring rays [rad].
        limits: Smallest and largest range that means something [m].
        lasers: Pose of the laser at each scan by odometry, n by (x [m], y [m], heading [rad]); zeros without odometry.
        moved: Whether odometry was found.
        truth: People of each scan by number, (x, y) [m] in the laser's frame; None: the recording does not say.
    """

    topic: str
    stamps: Floats
    ranges: list[NDArray[np.float32]]
    first: float
    step: float
    limits: tuple[float, float]
    lasers: Floats
    moved: bool
    truth: list[dict[int, tuple[float, float]]] | None


def read_leg_bag(path: Path, topic: str | None = None) -> LegBag:
    """Read a recording.

    Args:
        path: What `Bag` reads, or a ZIP file with one ROS 1 bag.
        topic: Of the scans; None: the only one there is, or ``/scan``.

    Raises:
        BagError: It cannot be read, or has no scans.
    """
    with _unzipped(path) as plain, Bag(plain) as bag:
        return _read(bag, path, _scan_topic(bag, path, topic))


@contextmanager
def _unzipped(path: Path) -> Iterator[Path]:
    if path.suffix != ".zip":
        yield path
        return
    with tempfile.TemporaryDirectory() as folder:
        plain = Path(folder) / "recording.bag"
        try:
            with zipfile.ZipFile(path) as archive:
                bags = [info for info in archive.infolist() if info.filename.endswith(".bag")]
                if len(bags) != 1 or bags[0].file_size > _MOST_BYTES:
                    raise BagError(f"{path} is to hold one ROS 1 bag of {_MOST_BYTES >> 30} GiB at the most")
                with archive.open(bags[0]) as source, plain.open("wb") as sink:
                    shutil.copyfileobj(source, sink)
        except (zipfile.BadZipFile, OSError, EOFError, RuntimeError) as error:
            raise BagError(f"{path} cannot be unpacked: {error}") from error
        yield plain


def _scan_topic(bag: Bag, path: Path, topic: str | None) -> str:
    scans = sorted(name for name, found in bag.topics.items() if found.offer.type == _SCAN)
    if topic is None and len(scans) > 1 and "/scan" in scans:
        topic = "/scan"
    if topic is None and len(scans) == 1:
        topic = scans[0]
    if topic not in scans:
        known = ", ".join(scans) or "none"
        raise BagError(f"{path}: name the topic of the scans (--topic); there is {known}")
    return topic


def _read(bag: Bag, path: Path, topic: str) -> LegBag:
    odometry_topic = next((name for name, found in bag.topics.items() if found.offer.type == _ODOMETRY), None)
    wanted = {topic, TRUTH, "/tf", "/tf_static"} | ({odometry_topic} if odometry_topic else set())
    scans: list[LaserScan] = []
    begun: list[float] = []
    truth: list[tuple[float, int, float, float]] = []
    odometry: list[tuple[float, float, float, float]] = []
    fixed: dict[tuple[str, str], tuple[float, float, float]] = {}
    base = ""
    for at, name, data in bag.messages({name for name in wanted if name in bag.topics}):
        kind = bag.topics[name].offer
        encoding: Literal["cdr", "ros1"] = "ros1" if kind.encoding == "ros1" else "cdr"
        try:
            if name == TRUTH:
                x, y, *_, number = _PERSON.unpack(data[: _PERSON.size])
                truth.append((at, number, x, y))
            elif name == topic:
                scans.append(decode(LaserScan, data, encoding))
                begun.append(at)
            elif name == odometry_topic:
                message = decode(Odometry, data, encoding)
                base = message.child_frame_id.lstrip("/")
                place = message.pose.pose
                odometry.append(
                    (message.header.stamp.seconds(), place.position.x, place.position.y, _yaw(place.orientation))
                )
            elif kind.type == _TF:
                for link in decode(TFMessage, data, encoding).transforms:
                    key = (link.header.frame_id.lstrip("/"), link.child_frame_id.lstrip("/"))
                    shift = link.transform.translation
                    fixed[key] = (shift.x, shift.y, _yaw(link.transform.rotation))
        except (DecodeError, struct.error) as error:
            raise BagError(f"{path}: a message of {name} is damaged: {error}") from error
    if not scans:
        raise BagError(f"{path}: no scan on {topic}")
    stamps = _rising([scan.header.stamp.seconds() for scan in scans], begun)
    mount = fixed.get((base, scans[0].header.frame_id.lstrip("/")))
    moved = len(odometry) > 1 and mount is not None
    lasers = _lasers(stamps, odometry, mount) if moved and mount is not None else np.zeros((len(scans), 3))
    return LegBag(
        topic,
        stamps,
        [scan.ranges for scan in scans],
        scans[0].angle_min,
        scans[0].angle_increment,
        (scans[0].range_min, scans[0].range_max),
        lasers,
        moved,
        _by_scan(truth, begun) if TRUTH in bag.topics else None,
    )


def _yaw(q: Quaternion) -> float:
    return math.atan2(2 * (q.w * q.z + q.x * q.y), 1 - 2 * (q.y * q.y + q.z * q.z))


def _rising(stamps: list[float], begun: list[float]) -> Floats:
    """The scans' own stamps; where they do not rise, the times at which they were recorded."""
    own = np.array(stamps)
    if np.all(np.diff(own) > 0):
        return own
    return np.maximum.accumulate(np.array(begun) + np.arange(len(begun)) * 1e-6)


def _lasers(
    stamps: Floats, odometry: list[tuple[float, float, float, float]], mount: tuple[float, float, float]
) -> Floats:
    """Poses of a laser that is mounted so (x [m], y [m], heading [rad]) on the robot."""
    ordered = np.array(sorted(odometry))
    heading = np.interp(stamps, ordered[:, 0], np.unwrap(ordered[:, 3]))
    x = np.interp(stamps, ordered[:, 0], ordered[:, 1]) + np.cos(heading) * mount[0] - np.sin(heading) * mount[1]
    y = np.interp(stamps, ordered[:, 0], ordered[:, 2]) + np.sin(heading) * mount[0] + np.cos(heading) * mount[1]
    return np.column_stack([x, y, heading + mount[2]])


def _by_scan(truth: list[tuple[float, int, float, float]], begun: list[float]) -> list[dict[int, tuple[float, float]]]:
    """What was written after a scan and before the next is about that scan, as the annotator's own program takes it."""
    found: list[dict[int, tuple[float, float]]] = [{} for _ in begun]
    for at, number, x, y in truth:
        found[max(bisect_right(begun, at) - 1, 0)][number] = (x, y)
    return found
