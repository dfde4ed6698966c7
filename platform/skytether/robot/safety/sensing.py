"""What the robot's own range sensors see, all of them together. Pure: time is an argument.

What one message says is `ranges`'; how fast the robot may go among what is seen is `zones`'.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from enum import StrEnum
from math import inf

import numpy as np

from skytether.messages import LaserScan, Message, Range

from .dead_reckoning import DeadReckoning
from .footprint import Points
from .ranges import UNKNOWN, Mount, Sight, View, view

_NOTHING: Points = np.empty((0, 2))


class Action(StrEnum):
    """What to do about a sensor that does not see."""

    STOP = "stop"
    SLOW = "slow"
    FREE = "free"


@dataclass(frozen=True, slots=True)
class RangeSensor:
    """A laser or a sonar.

    Attributes:
        mount: Where it is and how far it is to be believed.
        max_age_s: Silence after which it is stale [s].
        on_unknown: When it is blind, silent or makes no sense.
        on_empty: When it reports nothing within reach in any direction.
    """

    mount: Mount = field(default_factory=Mount)
    max_age_s: float = 0.3
    on_unknown: Action = Action.STOP
    on_empty: Action = Action.SLOW


@dataclass(frozen=True, eq=False)
class Scene:
    """What all sensors together see now.

    Attributes:
        points: Everything that is seen, where it lies by now, base frame, shape (n, 2) [m].
        age: Of the oldest of them [s].
        action: What the poorest sensor asks for.
        troubles: Of each sensor that does not see: a sentence for people, by kind.
    """

    points: Points
    age: float
    action: Action
    troubles: Mapping[str, str]


@dataclass(frozen=True, eq=False)
class _Seen:
    view: View
    at: float
    stamp: tuple[int, int]


class Sensing:
    """Takes readings in as they come, and says what is seen.

    Args:
        sensors: By topic.
        tolerance_s: How far ahead of now a reading may have come [s].
    """

    def __init__(self, sensors: Mapping[str, RangeSensor], tolerance_s: float) -> None:
        self._sensors = sensors
        self._tolerance = tolerance_s
        self._seen: dict[str, _Seen] = {}

    def look(self, topic: str, message: Message, now: float) -> tuple[str, str] | None:
        """Take a message of one of the sensors in. Never raises for what it holds.

        Returns:
            Kind and sentence of what is wrong with it; None: it is used.
        """
        header = message.header if isinstance(message, LaserScan | Range) else None
        stamp = (header.stamp.sec, header.stamp.nanosec) if header else (0, 0)
        before = self._seen.get(topic)
        if before is not None and stamp == before.stamp and any(stamp):
            return f"sensor:{topic}:repeated", f"{topic}: sends the same scan again, which counts as silence"
        self._seen[topic] = _Seen(view(self._sensors[topic].mount, message), now, stamp)
        return None

    def see(self, now: float, reckoning: DeadReckoning) -> Scene:
        """What is seen now, moved by how the robot moved since."""
        points, oldest, worst = [_NOTHING], 0.0, Action.FREE
        troubles = {}
        for topic, sensor in self._sensors.items():
            seen = self._seen.get(topic)
            age = inf if seen is None else now - seen.at
            if seen is None or not -self._tolerance <= age <= sensor.max_age_s:
                sight, detail = Sight.STALE, "nothing has come yet" if seen is None else f"silent for {age:.1f} s"
            else:
                sight, detail = seen.view.sight, seen.view.detail
                points.append(reckoning.now_at(seen.view.points, seen.at, now))
                oldest = max(oldest, age)
            action = _action(sensor, sight)
            if action is not Action.FREE:
                verb = "the robot stands" if action is Action.STOP else "the robot goes slowly"
                troubles[f"sensor:{topic}:{sight}"] = f"{topic}: is {sight}: {detail}; {verb}"
                worst = Action.STOP if Action.STOP in (action, worst) else Action.SLOW
        return Scene(np.concatenate(points), oldest, worst, troubles)


def _action(sensor: RangeSensor, sight: Sight) -> Action:
    if sight in UNKNOWN:
        return sensor.on_unknown
    return sensor.on_empty if sight is Sight.EMPTY else Action.FREE
