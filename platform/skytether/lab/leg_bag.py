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
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Literal, NamedTuple

import numpy as np
from numpy.typing import NDArray

from skytether.messages import DecodeError, LaserScan, Odometry, Quaternion, TFMessage, decode
from skytether.robot.replay.bag import Bag, BagError, BagTopic

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
        lasers: Pose of the laser at each scan by ``/tf`` or odometry, n by (x [m], y [m], heading [rad]).
        moved: Whether these poses differ; they do not where nothing tells of a motion.
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


class _Found:
    """What was read so far."""

    def __init__(self) -> None:
        self.scans: list[LaserScan] = []
        self.begun: list[float] = []
        self.truth: list[tuple[float, int, float, float]] = []
        self.links: dict[str, _Link] = {}
        """From each frame to the one that it is told in; what ``/tf`` says goes before odometry."""
        self.odometry: dict[str, _Link] = {}

    def add(self, at: float, topic: BagTopic, data: bytes) -> None:
        """One message that is no truth.

        Raises:
            DecodeError: It is damaged.
        """
        encoding: Literal["cdr", "ros1"] = "ros1" if topic.offer.encoding == "ros1" else "cdr"
        if topic.offer.type == _SCAN:
            self.scans.append(decode(LaserScan, data, encoding))
            self.begun.append(at)
        elif topic.offer.type == _ODOMETRY:
            odometry = decode(Odometry, data, encoding)
            place = odometry.pose.pose
            link = self.odometry.setdefault(_name(odometry.child_frame_id), _Link(_name(odometry.header.frame_id), []))
            link.add(odometry.header.stamp.seconds(), place.position.x, place.position.y, place.orientation)
        else:
            for told in decode(TFMessage, data, encoding).transforms:
                shift = told.transform.translation
                parent = _name(told.header.frame_id)
                link = self.links.setdefault(_name(told.child_frame_id), _Link(parent, []))
                if link.parent == parent:
                    link.add(told.header.stamp.seconds(), shift.x, shift.y, told.transform.rotation)


class _Link(NamedTuple):
    """A frame's pose in its parent, by time: [s], [m], [m], [rad]."""

    parent: str
    samples: list[tuple[float, float, float, float]]

    def add(self, stamp: float, x: float, y: float, rotation: Quaternion) -> None:
        sample = (stamp, x, y, _yaw(rotation))
        if all(map(math.isfinite, sample)):
            self.samples.append(sample)


def _name(frame: str) -> str:
    return frame.lstrip("/")


def _read(bag: Bag, path: Path, topic: str) -> LegBag:
    wanted = {name for name, found in bag.topics.items() if found.offer.type in (_ODOMETRY, _TF)} | {topic}
    wanted |= {TRUTH} & bag.topics.keys()
    found = _Found()
    for at, name, data in bag.messages(wanted):
        try:
            if name == TRUTH:
                x, y, *_, number = _PERSON.unpack(data[: _PERSON.size])
                found.truth.append((at, number, x, y))
            else:
                found.add(at, bag.topics[name], data)
        except (DecodeError, struct.error) as error:
            raise BagError(f"{path}: a message of {name} is damaged: {error}") from error
    scans = found.scans
    if not scans:
        raise BagError(f"{path}: no scan on {topic}")
    stamps = _rising([scan.header.stamp.seconds() for scan in scans], found.begun)
    lasers = _climb(_name(scans[0].header.frame_id), stamps, found.odometry | found.links)
    return LegBag(
        topic,
        stamps,
        [scan.ranges for scan in scans],
        scans[0].angle_min,
        scans[0].angle_increment,
        (scans[0].range_min, scans[0].range_max),
        lasers,
        bool(np.ptp(lasers, axis=0).max() > 0),
        _by_scan(found.truth, found.begun) if TRUTH in bag.topics else None,
    )


def _yaw(q: Quaternion) -> float:
    return math.atan2(2 * (q.w * q.z + q.x * q.y), 1 - 2 * (q.y * q.y + q.z * q.z))


def _rising(stamps: list[float], begun: list[float]) -> Floats:
    """The scans' own stamps; where they do not rise, the times at which they were recorded."""
    own = np.array(stamps)
    if np.all(np.diff(own) > 0):
        return own
    return np.maximum.accumulate(np.array(begun) + np.arange(len(begun)) * 1e-6)


def _climb(frame: str, stamps: Floats, links: Mapping[str, _Link]) -> Floats:
    """Poses of a frame at these times in ``odom``, or in the topmost frame that is known: n by (x, y, heading).

    Planar: the rotation of a laser that hangs upside down is not understood.
    """
    x, y, heading = np.zeros((3, len(stamps)))
    climbed: set[str] = set()
    while frame in links and links[frame].samples and frame != "odom" and frame not in climbed:
        climbed.add(frame)
        frame, samples = links[frame]
        known = np.array(sorted(samples))
        turn = np.interp(stamps, known[:, 0], np.unwrap(known[:, 3]))
        cos, sin = np.cos(turn), np.sin(turn)
        x, y = (
            np.interp(stamps, known[:, 0], known[:, 1]) + cos * x - sin * y,
            np.interp(stamps, known[:, 0], known[:, 2]) + sin * x + cos * y,
        )
        heading = heading + turn
    return np.column_stack([x, y, heading])


def _by_scan(truth: list[tuple[float, int, float, float]], begun: list[float]) -> list[dict[int, tuple[float, float]]]:
    """What was written after a scan and before the next is about that scan, as the annotator's own program takes it."""
    found: list[dict[int, tuple[float, float]]] = [{} for _ in begun]
    for at, number, x, y in truth:
        found[max(bisect_right(begun, at) - 1, 0)][number] = (x, y)
    return found
