"""What is drawn of a snapshot: outlines and ways, by the functions by which the gate decided. Pure."""

from __future__ import annotations

from dataclasses import dataclass

from skytether.control.admittance import Velocity
from skytether.robot.safety.geometry.footprint import Footprint, Points
from skytether.robot.safety.geometry.sweep import swept
from skytether.robot.safety.rules.places import Place
from skytether.robot.safety.rules.zones import Asked

Pieces = tuple[Footprint, ...]
"""That overlap."""
_STANDS = 1e-6
"""What is slower than this has no way worth drawing [m/s]."""


@dataclass(frozen=True, slots=True, eq=False)
class Picture:
    """All in the base frame.

    Attributes:
        footprint: With the modes that hold.
        stop: The stop zone, with what is not known of where the robot is.
        slow: On the wanted curve: what is seen in there makes the robot slower, or stops it. None: nobody wants to
            move.
        stopping: What the robot covers until it stands, had it to brake now and every stage took its longest. None: it
            stands.
        in_the_way: What is seen and makes the robot slower, or stops it, shape (n, 2) [m].
    """

    footprint: Footprint
    stop: Footprint
    slow: Pieces | None
    stopping: Pieces | None
    in_the_way: Points


def picture(place: Place, asked: Asked, told: Velocity) -> Picture:
    """Draw what the zones were asked, and what follows from what the wheels were told."""
    zones, wanted = place.zones, asked.velocity
    stop = zones.outline(wanted, asked.varied)
    speed = zones.speed(wanted)
    slow, in_the_way = None, asked.points[:0]
    if speed > _STANDS:
        time = zones.counts(wanted, asked.before) / speed
        slow = swept(stop, wanted, time)
        in_the_way = asked.points[stop.times_to_contact(asked.points, *wanted) <= time]
    stopping = None
    if (told_speed := zones.speed(told)) > _STANDS:
        stopping = swept(place.footprint, told, zones.stopping(told) / told_speed)
    return Picture(place.footprint, stop, slow, stopping, in_the_way)
