"""A picture as markers of RViz and Foxglove: lines, points and a text in the base frame. Pure.

Each is there every time, or is taken away: who starts to listen late sees all of it. They are locked to their frame
and have no stamp, so that neither of the two waits for a transform of just that time.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from enum import IntEnum

import numpy as np

from skytether.messages import (
    ColorRGBA,
    Duration,
    Header,
    Marker,
    MarkerArray,
    Point,
    Pose,
    Quaternion,
    Vector3,
)
from skytether.robot.control.command import Hand
from skytether.robot.safety.geometry.footprint import Footprint, Points
from skytether.robot.safety.geometry.sweep import boundary
from skytether.robot.safety.rules.zones import Zone

from .picture import Picture, Pieces
from .snapshot import Snapshot

_ADD, _DELETE = 0, 2
_NAMESPACE = "gate"
_LINE_M, _THIN_M, _POINT_M, _TEXT_M = 0.02, 0.01, 0.04, 0.12
_TEXT_HEIGHT_M = 0.6
_TROUBLES, _LONGEST = 3, 80

GREEN, YELLOW, RED = ColorRGBA(0.1, 0.8, 0.2, 1.0), ColorRGBA(1.0, 0.8, 0.0, 1.0), ColorRGBA(0.9, 0.1, 0.1, 1.0)
VIOLET, GREY, BLUE = ColorRGBA(0.7, 0.3, 0.9, 1.0), ColorRGBA(0.6, 0.6, 0.6, 1.0), ColorRGBA(0.1, 0.6, 1.0, 1.0)
_OF_ZONE = {Zone.CLEAR: GREEN, Zone.SLOW: YELLOW, Zone.STOP: RED, Zone.UNKNOWN: VIOLET}


class Kind(IntEnum):
    """Types of markers."""

    LINE_STRIP = 4
    LINE_LIST = 5
    POINTS = 8
    TEXT = 9


class Id(IntEnum):
    """Of the markers, all in the namespace ``gate``."""

    FOOTPRINT = 0
    STOP_ZONE = 1
    SLOW_ZONE = 2
    STOPPING_WAY = 3
    IN_THE_WAY = 4
    STATE = 5


def markers(seen: Snapshot, drawn: Picture, frame: str, lifetime_s: float) -> MarkerArray:
    """What is published.

    Args:
        seen: Of the gate.
        drawn: Of it.
        frame: The base frame.
        lifetime_s: After which all of it goes, should nothing come any more [s].
    """
    colour = colour_of(seen)
    made = [
        _marker(Id.FOOTPRINT, Kind.LINE_STRIP, _LINE_M, colour, _closed(drawn.footprint)),
        _marker(Id.STOP_ZONE, Kind.LINE_STRIP, _THIN_M, RED, _closed(drawn.stop)),
        _marker(Id.SLOW_ZONE, Kind.LINE_LIST, _THIN_M, YELLOW, _lines(drawn.slow)),
        _marker(Id.STOPPING_WAY, Kind.LINE_LIST, _LINE_M, BLUE, _lines(drawn.stopping)),
        _marker(Id.IN_THE_WAY, Kind.POINTS, _POINT_M, RED, drawn.in_the_way),
        _text(state(seen), colour),
    ]
    return _framed(made, frame, lifetime_s)


def silence(frame: str, lifetime_s: float) -> MarkerArray:
    """What is published while the gate says nothing."""
    none = np.empty((0, 2))
    gone = [_marker(which, Kind.POINTS, 0.0, GREY, none) for which in Id if which is not Id.STATE]
    return _framed([*gone, _text("the gate says nothing", RED)], frame, lifetime_s)


def colour_of(seen: Snapshot) -> ColorRGBA:
    """Of the state: red stopped or in the way, yellow slow, violet unknown, green clear, grey nobody drives."""
    if seen.stopped:
        return RED
    return GREY if seen.hand == Hand.NOBODY else _OF_ZONE[seen.zone]


def state(seen: Snapshot) -> str:
    """Who drives, or why nobody does; what lies ahead; the first troubles."""
    said = [f"stopped: {seen.stopped}" if seen.stopped else "nobody drives"]
    if not seen.stopped and seen.hand != Hand.NOBODY:
        said = [f"{seen.hand}: {seen.told.linear:.2f} m/s, {seen.told.angular:.2f} rad/s", _ahead(seen)]
    return "\n".join(line[:_LONGEST] for line in (*said, *seen.troubles[:_TROUBLES]))


def _ahead(seen: Snapshot) -> str:
    if seen.zone is Zone.UNKNOWN:
        return "unknown: not all of it is seen"
    return str(seen.zone) if seen.way == float("inf") else f"{seen.zone}: {seen.way:.2f} m to the stop zone"


def _closed(outline: Footprint) -> Points:
    return np.concatenate((outline.vertices, outline.vertices[:1]))


def _lines(pieces: Pieces | None) -> Points:
    return np.empty((0, 2)) if pieces is None else boundary(pieces)


def _marker(which: Id, kind: Kind, size: float, colour: ColorRGBA, points: Points) -> Marker:
    action = _ADD if len(points) else _DELETE
    across = size if kind is Kind.POINTS else 0.0  # lines have no second size
    drawn = [Point(x, y, 0.0) for x, y in points.tolist()]
    return Marker(id=which, type=kind, action=action, scale=Vector3(size, across, 0.0), color=colour, points=drawn)


def _text(text: str, colour: ColorRGBA) -> Marker:
    pose = Pose(Point(0.0, 0.0, _TEXT_HEIGHT_M), Quaternion())
    return Marker(id=Id.STATE, type=Kind.TEXT, scale=Vector3(0.0, 0.0, _TEXT_M), color=colour, pose=pose, text=text)


def _framed(made: Sequence[Marker], frame: str, lifetime_s: float) -> MarkerArray:
    header, lifetime = Header(frame_id=frame), Duration.from_seconds(lifetime_s)
    return MarkerArray([replace(m, header=header, ns=_NAMESPACE, lifetime=lifetime, frame_locked=True) for m in made])
