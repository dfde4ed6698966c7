"""What the gate decided at one turn and by what, as a datagram to the process that draws it. Pure."""

from __future__ import annotations

import json
import struct
from collections.abc import Sequence
from dataclasses import dataclass
from math import inf, isfinite

import numpy as np

from skytether.control.admittance import STANDSTILL, Velocity
from skytether.robot.safety.geometry.dead_reckoning import Variation
from skytether.robot.safety.rules.rules import GateDecision
from skytether.robot.safety.rules.zones import Asked, Zone

MOST_POINTS = 4000
"""The nearest; the sum of all fits into a datagram of this machine."""
LARGEST = 128 * 1024
_MOST_TROUBLES = 4
_LONGEST = 200
"""Characters of a sentence."""
_HEAD = struct.Struct("<4sI")
_MAGIC = b"SkV1"
_NOTHING = Asked(STANDSTILL, np.empty((0, 2)), Variation(0.0, 0.0), Zone.UNKNOWN)


@dataclass(frozen=True, slots=True, eq=False)
class Snapshot:
    """One turn.

    Attributes:
        told: What the wheels were told.
        stopped: Why the robot stands until a person resets it; empty: it does not.
        hand: Who drives.
        zone: What lies ahead.
        way: Until the stop zone [m]; inf: nothing that is seen is near.
        modes: That hold.
        troubles: All that stands in the way, a sentence each.
        asked: What the zones were asked.
    """

    told: Velocity
    stopped: str
    hand: str
    zone: Zone
    way: float
    modes: frozenset[str]
    troubles: tuple[str, ...]
    asked: Asked


def snapshot(
    decision: GateDecision, asked: Asked | None, told: Velocity, stopped: str, modes: Sequence[str]
) -> Snapshot:
    """Of the last turn; ``asked`` is None if it failed."""
    troubles = tuple(decision.troubles.values())
    return Snapshot(
        told, stopped, decision.hand, decision.zone, decision.way, frozenset(modes), troubles, asked or _NOTHING
    )


def pack(seen: Snapshot) -> bytes:
    """For the process that draws it."""
    asked, points = seen.asked, seen.asked.points
    if len(points) > MOST_POINTS:
        points = points[np.einsum("ij,ij->i", points, points).argpartition(MOST_POINTS)[:MOST_POINTS]]
    text = json.dumps(
        {
            "told": seen.told,
            "stopped": seen.stopped[:_LONGEST],
            "hand": seen.hand,
            "zone": seen.zone,
            "way": seen.way if isfinite(seen.way) else None,
            "modes": sorted(seen.modes),
            "troubles": [sentence[:_LONGEST] for sentence in seen.troubles[:_MOST_TROUBLES]],
            "wanted": asked.velocity,
            "varied": asked.varied,
            "before": asked.before,
        },
        allow_nan=False,
    ).encode()
    return _HEAD.pack(_MAGIC, len(text)) + text + np.ascontiguousarray(points, np.float64).tobytes()


def unpack(data: bytes) -> Snapshot | None:
    """From the gate; None: the bytes are none."""
    try:
        magic, length = _HEAD.unpack_from(data)
        rest = data[_HEAD.size :]
        if magic != _MAGIC or len(rest) < length:
            return None
        said = json.loads(rest[:length])
        points = np.frombuffer(rest[length:], np.float64).reshape(-1, 2)
        return Snapshot(
            Velocity(*map(float, said["told"])),
            str(said["stopped"]),
            str(said["hand"]),
            Zone(said["zone"]),
            inf if said["way"] is None else float(said["way"]),
            frozenset(map(str, said["modes"])),
            tuple(map(str, said["troubles"])),
            Asked(
                Velocity(*map(float, said["wanted"])),
                points,
                Variation(*map(float, said["varied"])),
                Zone(said["before"]),
            ),
        )
    except (struct.error, ValueError, KeyError, TypeError):
        return None
