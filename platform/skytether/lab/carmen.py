"""Recordings of robots with a laser: CARMEN logs, and the official relations of the SLAM benchmark.

The format is that of the Radish collection: one message a line, ``FLASER n r1 ... rn x y theta odom_x odom_y odom_theta
stamp host logger_stamp`` and ``ODOM x y theta tv rv acceleration stamp host logger_stamp``; other messages are passed
over. Lines are recorded by programs that are killed, so single broken ones are named and left out.
"""

from __future__ import annotations

import gzip
import math
import re
import zlib
from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import IO, cast

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]

MAX_RAYS = 10_000
"""Of one scan; more is a broken line."""
MAX_LINE = 200_000
"""Characters of one line."""
MAX_BROKEN = 0.05
"""Part of the laser and odometry lines that may be broken; beyond it the file is something else."""
_NAMED = 5
"""Broken lines that an error names."""
_TAIL = 9
"""Fields of a FLASER line behind its ranges."""
_FIELDS_OF_VIEW = ((101, 100), (201, 100), (401, 100), (541, 270), (1081, 270), (682, 240), (683, 240), (726, 240))
"""Numbers of rays that are usual with other fields of view than 180 degrees [degrees]."""


class CarmenError(ValueError):
    """A log or a file of relations cannot be used; the text names file and line, and says why."""


@dataclass(frozen=True)
class CarmenLog:
    """A log as arrays, scans by their stamps.

    Attributes:
        stamps: Of the scans, n [s], never falling.
        ranges: n by rays, float32 [m]. What the laser did not see is ``max_range`` or more, or NaN.
        angles: Of the rays, anticlockwise from straight ahead [rad].
        max_range: From here on a reading means that nothing was seen [m].
        laser: Pose of the laser at each scan, n by (x [m], y [m], theta [rad]). In a corrected log that is the truth.
        odometry: Pose of the robot by its odometry at each scan, in the same form. Some logs repeat the laser's pose.
        odom_stamps: Of the ODOM lines, in the order of the file [s]; a recorder may have written zeros.
        odom: Their poses, m by (x, y, theta).
        broken: What was left out: number of the line, and why.
    """

    stamps: Floats
    ranges: NDArray[np.float32]
    angles: Floats
    max_range: float
    laser: Floats
    odometry: Floats
    odom_stamps: Floats
    odom: Floats
    broken: tuple[tuple[int, str], ...] = ()

    @property
    def laser_is_odometry(self) -> bool:
        """Whether the odometry is but the laser's pose once more."""
        return bool(np.allclose(self.laser, self.odometry, atol=1e-6))

    def part(self, first: int, last: int) -> CarmenLog:
        """The scans from number ``first`` up to, without, ``last``; ODOM lines stay as they are."""
        s = slice(first, last)
        return CarmenLog(
            self.stamps[s],
            self.ranges[s],
            self.angles,
            self.max_range,
            self.laser[s],
            self.odometry[s],
            self.odom_stamps,
            self.odom,
            self.broken,
        )


@dataclass(frozen=True)
class Relations:
    """True motions between pairs of scans (Kümmerle et al., On measuring the accuracy of SLAM algorithms, 2009).

    Attributes:
        stamps: m by 2 [s], of the clock of the relations' authors.
        motions: m by (x [m], y [m], yaw [rad]): the second scan's pose, seen from the first.
    """

    stamps: Floats
    motions: Floats


def read_log(path: Path | str, *, fov: float | None = None) -> CarmenLog:
    """Read a CARMEN log, plain or gzipped.

    Args:
        path: The file.
        fov: Field of view [rad]. None: by the number of rays, as CARMEN guesses it: 541 and 1081 have 270 degrees, 682
            to 726 240, 101, 201 and 401 100, and all others 180.

    Raises:
        CarmenError: It cannot be read, has no scans, or more than one line in twenty is broken.
    """
    path = Path(path)
    scans: list[tuple[int, list[float], NDArray[np.float32]]] = []
    odom: list[list[float]] = []
    broken: list[tuple[int, str]] = []
    limit = math.inf
    for number, line in _lines(path):
        word, _, rest = line.partition(" ")
        try:
            if word == "FLASER":
                ranges, values = _flaser(rest)
                scans.append((number, values, ranges))
            elif word == "ODOM":
                odom.append(_odom(rest))
            elif word == "PARAM":
                found = re.match(r"(?:robot_front_laser_max|laser_front_laser_max\w*) (\d+(?:\.\d+)?)\s", rest)
                limit = float(found[1]) if found and float(found[1]) > 0 else limit
        except ValueError as error:
            broken.append((number, f"{word}: {error}"))
    if scans:
        rays = Counter(ranges.size for _, _, ranges in scans).most_common(1)[0][0]
        broken += [(n, f"FLASER: {r.size} ranges, others have {rays}") for n, _, r in scans if r.size != rays]
        broken.sort()
    if len(broken) > MAX_BROKEN * (len(scans) + len(odom) + len(broken)):
        named = "; ".join(f"line {number}: {why}" for number, why in broken[:_NAMED])
        raise CarmenError(f"{path}: {len(broken)} lines are broken: {named}")
    scans = [scan for scan in scans if scan[2].size == rays] if scans else []
    if not scans:
        raise CarmenError(f"{path}: there is no FLASER line; is this a CARMEN log?")
    scans.sort(key=lambda scan: scan[1][6])
    table = np.array([scan[1] for scan in scans])
    stacked = np.stack([scan[2] for scan in scans])
    drives = np.array(odom).reshape(-1, 4)
    return CarmenLog(
        stamps=table[:, 6],
        ranges=stacked,
        angles=ray_angles(rays, fov),
        max_range=min(limit, 0.98 * float(np.nanmax(stacked))),
        laser=table[:, 0:3],
        odometry=table[:, 3:6],
        odom_stamps=drives[:, 3],
        odom=drives[:, 0:3],
        broken=tuple(broken),
    )


def ray_angles(rays: int, fov: float | None = None) -> Floats:
    """Directions of a scan's rays, anticlockwise from straight ahead [rad].

    An even number lacks the last ray, as CARMEN has it: 360 over half a circle are half a degree apart from -90 on.

    Args:
        rays: How many.
        fov: Field of view [rad], or None for the usual one of so many rays.
    """
    if fov is None:
        fov = math.radians(dict(_FIELDS_OF_VIEW).get(rays, 180))
    steps = rays if rays % 2 == 0 else rays - 1
    return cast(Floats, -fov / 2 + np.arange(rays) * (fov / max(steps, 1)))


def read_relations(path: Path | str) -> Relations:
    """Read relations, plain or gzipped: ``stamp stamp x y z roll pitch yaw`` a line.

    Raises:
        CarmenError: It cannot be read, a line is broken, or there is none.
    """
    path = Path(path)
    rows: list[list[float]] = []
    for number, line in _lines(path):
        if line.startswith("#") or not line.strip():
            continue
        fields = line.split()
        if len(fields) != 8:
            raise CarmenError(f"{path}: line {number}: 8 numbers are a relation, not {len(fields)}")
        try:
            rows.append(_numbers(fields))
        except ValueError as error:
            raise CarmenError(f"{path}: line {number}: {error}") from error
    if not rows:
        raise CarmenError(f"{path}: there is no relation in it")
    table = np.array(rows)
    return Relations(table[:, 0:2], table[:, [2, 3, 7]])


def _lines(path: Path) -> Iterator[tuple[int, str]]:
    """The lines with their numbers, from 1."""
    try:
        with path.open("rb") as probe:
            zipped = probe.read(2) == b"\x1f\x8b"
        with cast(IO[bytes], gzip.open(path, "rb") if zipped else path.open("rb")) as file:
            number = 0
            while line := file.readline(MAX_LINE):
                number += 1
                yield number, line.decode("ascii", "replace").strip()
    except (OSError, EOFError, zlib.error) as error:
        raise CarmenError(f"{path}: cannot be read: {error}") from error


def _flaser(text: str) -> tuple[NDArray[np.float32], list[float]]:
    fields = text.split()
    if not fields or not fields[0].isdigit() or not 1 <= int(fields[0]) <= MAX_RAYS:
        raise ValueError(f"the number of ranges is {fields[0][:20] if fields else 'missing'}")
    rays = int(fields[0])
    if not rays + _TAIL - 1 <= len(fields) - 1 <= rays + _TAIL:  # some recorders leave out the logger's stamp
        raise ValueError(f"{rays} ranges and {_TAIL} fields are expected behind their number, not {len(fields) - 1}")
    try:
        ranges = np.array(fields[1 : rays + 1], dtype=np.float32)
    except ValueError as error:
        raise ValueError(f"a range is no number ({error})") from error
    # What is no number, or negative, was not seen.
    ranges[~(ranges >= 0)] = np.nan
    if np.isnan(ranges).all():
        raise ValueError("no range is a number")
    return ranges, _numbers(fields[rays + 1 : rays + 8])


def _odom(text: str) -> list[float]:
    fields = text.split()
    if not 8 <= len(fields) <= 9:
        raise ValueError(f"9 fields are expected, not {len(fields)}")
    return [*_numbers(fields[0:3]), *_numbers(fields[6:7])]


def _numbers(fields: list[str]) -> list[float]:
    values = []
    for field in fields:
        try:
            value = float(field)
        except ValueError:
            raise ValueError(f"'{field[:20]}' is no number") from None
        if not math.isfinite(value):
            raise ValueError(f"'{field[:20]}' is not finite")
        values.append(value)
    return values
