"""What the robot's own range sensors see, all of them together. Pure: time is an argument.

What one message says is `ranges`' and `clouds`', what its stamp says is `stamps`'; how fast the robot may go among what
is seen is `zones`', and where nothing looks `coverage`'s.

Each sensor has a contract: a field of view, a frame, an order of its stamps. What is not configured of it is learned
from its messages: a field of view only ever grows, a frame is that of the first. A message that breaks the contract
is blindness, or counts as silence; `Sensing.relearn` begins anew.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from math import inf, nan

import numpy as np

from skytether.messages import Header, Message

from ..geometry.dead_reckoning import DeadReckoning
from ..geometry.footprint import Footprint, Points
from .clouds import CloudMount, view_of_cloud
from .coverage import Action, Cells, Cover
from .ranges import UNKNOWN, Mount, Sight, View, view
from .stamps import StampRule, Stamps, date

_NOTHING: Points = np.empty((0, 2))
_MOST_TOLERANCE_S = 0.5
"""Of a clock that went back; more is silence."""


@dataclass(frozen=True, slots=True)
class RangeSensor:
    """A laser, a sonar, a depth camera or a 3D lidar.

    Attributes:
        mount: Where it is, how far it is to be believed, where it must look.
        max_age_s: Age of its newest measurement at which it is stale [s].
        on_unknown: When it is blind, silent or makes no sense.
        on_empty: When it reports nothing within reach in any direction.
        frame: Its messages' frame_id; empty: that of the first.
        stamps: What is asked of its stamps.
    """

    mount: Mount = field(default_factory=Mount)
    max_age_s: float = 0.3
    on_unknown: Action = Action.STOP
    on_empty: Action = Action.SLOW
    frame: str = ""
    stamps: StampRule = StampRule.AUTO


@dataclass(frozen=True, eq=False)
class Part:
    """What one sensor sees now.

    Attributes:
        points: Where they lie by now, base frame, shape (n, 2) [m].
        edge: Where its sight ends on rays that saw nothing, the same way.
        age: Of the measurement [s].
        cover: Where it looks.
        far: How far it measures in all directions [m]; 0: not known, as nothing was beyond.
    """

    points: Points
    edge: Points
    age: float
    cover: Cover
    far: float


@dataclass(frozen=True, eq=False)
class Scene:
    """What all sensors together see now.

    Attributes:
        parts: One for each sensor that says something.
        action: What the poorest sensor asks for.
        unknown: Some sensor does not see, or there is none.
        troubles: Of each sensor that does not see: a sentence for people, by kind.
    """

    parts: tuple[Part, ...]
    action: Action
    unknown: bool
    troubles: Mapping[str, str]

    @property
    def points(self) -> Points:
        """Everything that is seen, base frame, shape (n, 2) [m]."""
        return np.concatenate([_NOTHING, *(part.points for part in self.parts)])

    @property
    def edge(self) -> Points:
        """Where the sight of all together ends on rays that saw nothing, base frame, shape (n, 2) [m].

        Where one sensor's sight ends and another's, who looks there too, goes on, there is no end.
        """
        ends = [_NOTHING]
        for part in self.parts:
            edge = part.edge
            for other in self.parts:
                if other.far > part.far and len(edge):
                    away = np.hypot(edge[:, 0] - other.cover.x, edge[:, 1] - other.cover.y)
                    edge = edge[~(other.cover.looks_at(edge) & (away < other.far))]
            ends.append(edge)
        return np.concatenate(ends)

    @property
    def age(self) -> float:
        """Of the oldest of them [s]."""
        return max((part.age for part in self.parts), default=0.0)


@dataclass(frozen=True, eq=False)
class _Known:
    """What is remembered of one sensor."""

    view: View | None = None
    at: float = -inf
    delay: float = 0.0
    stamps: Stamps = field(default_factory=Stamps)
    frame: str | None = None
    spans: Cells | None = None


class Sensing:
    """Takes readings in as they come, and says what is seen.

    Args:
        sensors: By topic.
        outline: Of the robot.
        tolerance_s: How far ahead of now a reading may have come [s].
    """

    def __init__(self, sensors: Mapping[str, RangeSensor], outline: Footprint, tolerance_s: float) -> None:
        self._sensors = sensors
        self._outline = outline
        self._tolerance = min(tolerance_s, _MOST_TOLERANCE_S)
        self._known: dict[str, _Known] = {}

    def on_message(self, topic: str, message: Message, now: float, wall: float = nan) -> tuple[str, str] | None:
        """Take a message of one of the sensors in. Never raises for what it holds. ``wall``: see `stamps.date`.

        Returns:
            Kind and sentence of what is wrong with it; None: it is used.
        """
        sensor, before = self._sensors[topic], self._known.get(topic, _Known())
        header = getattr(message, "header", Header())
        frame = header.frame_id.removeprefix("/")
        expected = sensor.frame.removeprefix("/") or (frame if before.frame is None else before.frame)
        if frame != expected:
            return f"sensor:{topic}:frame", (
                f"{topic}: its frame_id is '{frame[:64]}', not '{expected[:64]}': not used, which counts as silence"
            )
        stamp = (header.stamp.sec, header.stamp.nanosec)
        dated = date(sensor.stamps, before.stamps, stamp, now, sensor.max_age_s, wall)
        if dated.wrong:
            self._known[topic] = replace(before, stamps=dated.stamps)
            return f"sensor:{topic}:{dated.wrong}", f"{topic}: {_SAYS[dated.wrong]}, which counts as silence"
        if isinstance(sensor.mount, CloudMount):
            seen = view_of_cloud(sensor.mount, self._outline, message, before.spans)
        else:
            seen = view(sensor.mount, self._outline, message, before.spans)
        spans = before.spans
        if seen.sight is not Sight.NONSENSE:
            spans = seen.spans if spans is None else spans | seen.spans
        self._known[topic] = _Known(seen, now, dated.delay, dated.stamps, frame, spans)
        return None

    def relearn(self) -> None:
        """Forget what was learned of fields of view, frames and stamps, because a person looked at the robot."""
        self._known = {
            topic: replace(known, stamps=Stamps(), frame=None, spans=None) for topic, known in self._known.items()
        }

    def see(self, now: float, reckoning: DeadReckoning) -> Scene:
        """What is seen now, moved by how the robot moved since."""
        parts: list[Part] = []
        worst, unknown, troubles = Action.FREE, not self._sensors, {}
        for topic, sensor in self._sensors.items():
            sight, detail = self._sight(topic, now)
            known = self._known.get(topic)
            if sight is not Sight.STALE and known is not None and known.view is not None:
                age = max(0.0, now - known.at) + known.delay
                parts.append(_part(sensor.mount, known.view, age, now, reckoning))
            action = _action(sensor, sight)
            unknown |= action is not Action.FREE
            if action is not Action.FREE:
                verb = "the robot stands" if action is Action.STOP else "the robot goes slowly"
                troubles[f"sensor:{topic}:{sight}"] = f"{topic}: is {sight}: {detail}; {verb}"
                worst = Action.STOP if Action.STOP in (action, worst) else Action.SLOW
        return Scene(tuple(parts), worst, unknown, troubles)

    def _sight(self, topic: str, now: float) -> tuple[Sight, str]:
        known = self._known.get(topic)
        if known is None or known.view is None:
            return Sight.STALE, "nothing has come yet" if known is None else "nothing that can be used has come yet"
        silent = now - known.at
        if not -self._tolerance <= silent <= self._sensors[topic].max_age_s:
            return Sight.STALE, f"silent for {silent:.1f} s"
        if not silent + known.delay <= self._sensors[topic].max_age_s:
            return Sight.STALE, f"silent for {silent:.1f} s, and by its stamp it came {known.delay:.1f} s late"
        return known.view.sight, known.view.detail


def _part(mount: Mount, seen: View, age: float, now: float, reckoning: DeadReckoning) -> Part:
    points, edge = (reckoning.now_at(these, now - age, now) for these in (seen.points, seen.edge))
    reach = np.where(seen.looks, inf, 0.0)
    far = float(np.hypot(seen.edge[:, 0] - mount.x, seen.edge[:, 1] - mount.y).min()) if len(seen.edge) else 0.0
    return Part(points, edge, age, Cover(mount.x, mount.y, mount.yaw, mount.sense, reach, seen.near), far)


def _action(sensor: RangeSensor, sight: Sight) -> Action:
    if sight in UNKNOWN:
        return sensor.on_unknown
    return sensor.on_empty if sight is Sight.EMPTY else Action.FREE


_SAYS: Mapping[str, str] = {
    "repeated": "sends the same reading again",
    "older": "sends a reading older than one before, or its clock was set back",
    "unstamped": "sends a reading without a stamp",
    "ahead": "sends a reading with a stamp that is ahead of this computer's clock",
}
