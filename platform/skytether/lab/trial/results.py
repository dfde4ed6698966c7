"""What came of a trial, and the file in which trials are kept, so that a long run can go on later."""

from __future__ import annotations

import json
import math
import os
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, fields
from pathlib import Path
from typing import Any, ClassVar, Generic, Self, TypeVar

from skytether.wire.stats import TopicStats

Point = tuple[float, float]


def rounded(place: Sequence[float]) -> Point:
    """A place [m] to the millimetre."""
    return round(place[0], 3), round(place[1], 3)


@dataclass(frozen=True, slots=True)
class TopicRow:
    """Quality of service of one topic in one trial.

    Attributes:
        topic: Its name.
        sent: Messages.
        lost: Share of them that never arrived.
        delay_ms: Median, one way.
        jitter_ms: Mean difference between the delays of neighbours (RFC 3550).
        period_ms: Median time between arrivals: whose distribution the thesis calls jitter (section 5.5.2).
        period_p99_ms: 99 of 100 are shorter.
    """

    topic: str
    sent: int
    lost: float
    delay_ms: float
    jitter_ms: float
    period_ms: float
    period_p99_ms: float = math.nan

    @classmethod
    def of(cls, stats: TopicStats) -> TopicRow:
        """From the bridge's counters."""
        lost = stats.lost / stats.sent if stats.sent else 0.0
        times = (stats.delay_p50, stats.jitter, stats.period_p50, stats.period_p99)
        return cls(stats.topic, stats.sent, round(lost, 5), *(round(1000 * value, 2) for value in times))


@dataclass(frozen=True, slots=True)
class Traces:
    """For figures.

    Attributes:
        way: Where the robot truly was, each 0.1 s [m].
        sent_kbit_s: What left the robot for the network in each second.
        arrived_kbit_s: What of it came out of the network.
        back_sent_kbit_s: What left the service for the robot.
        back_arrived_kbit_s: What of it came out of the network.
    """

    way: tuple[Point, ...] = ()
    sent_kbit_s: tuple[float, ...] = ()
    arrived_kbit_s: tuple[float, ...] = ()
    back_sent_kbit_s: tuple[float, ...] = ()
    back_arrived_kbit_s: tuple[float, ...] = ()


@dataclass(frozen=True, slots=True, kw_only=True)
class Measured:
    """What the rig measured of a drive, whatever the task was.

    Attributes:
        scenario: Its name.
        seed: Of the trial.
        contacts: What the robot touched: walls, things, people.
        start_s: From the robot's request to the first command that it accepted [s].
        time_s: From the first motion to the end of the task [s].
        distance_m: Way covered in that time.
        mean_speed_m_s: That way per time.
        rtt_ms: Median round trip, as the bridge measured it.
        robot_cpu: Mean processors in use by agent and bridge, without the simulation.
        service_cpu: And by the service.
        service_memory_mb: Of the service, at the end.
        message: What the service said last.
        topics: Of each topic `TopicRow`.
        robot_memory_mb: Of agent and bridge, and of the simulation, which has the most of it, at the end.
        on_robot: The service ran on the robot, too.
        held_up_s: Time that the world stood still, for the machine was busy with other things [s]. What was measured
            with much of it says little.
    """

    scenario: str
    seed: int
    contacts: int
    start_s: float
    time_s: float
    distance_m: float
    mean_speed_m_s: float
    rtt_ms: float
    robot_cpu: float
    service_cpu: float
    service_memory_mb: float
    message: str
    topics: tuple[TopicRow, ...]
    robot_memory_mb: float = math.nan
    on_robot: bool = False
    held_up_s: float = math.nan

    def shared(self) -> dict[str, Any]:
        """These fields, for the result of one experiment, which has more of them."""
        return {one.name: getattr(self, one.name) for one in fields(Measured)}


@dataclass(frozen=True, slots=True, kw_only=True)
class TrialResult(Measured):
    """What came out. Experiments add what they measure beyond it.

    Attributes:
        completed: The task was done, and nothing was touched.
        traces: For figures.
    """

    TRACES: ClassVar[type[Traces]] = Traces
    """Of which class ``traces`` are."""

    completed: bool
    traces: Traces = Traces()

    def document(self, *, traces: bool = False) -> dict[str, Any]:
        """For JSON, which has no NaN: None instead. Without traces for people, with them for the file."""
        found = {key: _plain(value) for key, value in asdict(self).items()}
        if not traces:
            del found["traces"]
        return found

    @classmethod
    def of(cls, document: Mapping[str, Any]) -> Self:
        """From `document`.

        Raises:
            TypeError: It has other fields.
        """
        known = _read(document)
        topics = tuple(TopicRow(**_read(row)) for row in known.pop("topics"))
        traces = {key: _tuples(value) for key, value in known.pop("traces", {}).items()}
        return cls(**known, topics=topics, traces=cls.TRACES(**traces))


R = TypeVar("R", bound=TrialResult)


class KeptTrials(Generic[R]):
    """Trials in a file of JSON lines, each with what it was asked for. What is there need not be done again.

    A line that a crash cut off is passed over, and its trial is done again.
    """

    def __init__(self, file: Path, kind: type[R]) -> None:
        """Read what is there.

        Args:
            file: Made with the first trial, if missing.
            kind: Class of the results.

        Raises:
            OSError: It cannot be read.
            ValueError: A line other than the last is none of ours.
        """
        self._file = file
        self._found: dict[str, R] = {}
        text = file.read_text(encoding="utf-8") if file.exists() else ""
        self._cut = bool(text) and not text.endswith("\n")
        lines = text.splitlines()
        for number, line in enumerate(lines, 1):
            try:
                row = json.loads(line)
                self._found[_key(row["asked"])] = kind.of(row["result"])
            except (ValueError, KeyError, TypeError, AttributeError) as error:
                if number < len(lines) or not self._cut:
                    raise ValueError(f"line {number} of {file} is not a kept trial; give another file") from error

    def get(self, asked: Mapping[str, Any]) -> R | None:
        """The trial that was asked for like this, if it is there."""
        return self._found.get(_key(asked))

    def put(self, asked: Mapping[str, Any], result: R) -> None:
        """Keep one; on the disk when this returns.

        Raises:
            OSError: It cannot be written.
        """
        line = json.dumps({"asked": asked, "result": result.document(traces=True)}, separators=(",", ":"))
        if self._cut:
            whole = self._file.read_text(encoding="utf-8").rpartition("\n")[0]
            self._file.write_text(f"{whole}\n" if whole else "", encoding="utf-8")
            self._cut = False
        with self._file.open("a", encoding="utf-8") as file:
            file.write(f"{line}\n")
            file.flush()
            os.fsync(file.fileno())
        self._found[_key(asked)] = result


def _key(asked: Mapping[str, Any]) -> str:
    return json.dumps(asked, sort_keys=True)


def _read(document: Mapping[str, Any]) -> dict[str, Any]:
    return {key: math.nan if value is None else value for key, value in document.items()}


def _tuples(value: Any) -> Any:
    return tuple(_tuples(one) for one in value) if isinstance(value, list) else value


def _plain(value: Any) -> Any:
    if isinstance(value, float):
        return None if math.isnan(value) else round(value, 5)
    if isinstance(value, dict):
        return {key: _plain(one) for key, one in value.items()}
    if isinstance(value, Sequence) and not isinstance(value, str):
        return [_plain(one) for one in value]
    return value
