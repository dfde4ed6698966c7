"""What came of a trial of `nine_goals`, and the file in which trials are kept, so that a long run can go on later."""

from __future__ import annotations

import json
import math
import os
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from skytether.wire.stats import TopicStats

Point = tuple[float, float]


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
        goals: For each goal the index in ``way`` at which it was reached.
        person: Where the person was who stepped into the way [m].
        plans: Paths that the service planned between the first goal and the second [m].
        sent_kbit_s: What left the robot for the network in each second.
        arrived_kbit_s: What of it came out of the network.
    """

    way: tuple[Point, ...] = ()
    goals: tuple[int, ...] = ()
    person: tuple[Point, ...] = ()
    plans: tuple[tuple[Point, ...], ...] = ()
    sent_kbit_s: tuple[float, ...] = ()
    arrived_kbit_s: tuple[float, ...] = ()


@dataclass(frozen=True, slots=True)
class TrialResult:
    """What came out.

    Attributes:
        scenario: Its name.
        seed: Of the trial.
        completed: All goals were reached, and nothing was touched.
        contacts: What the robot touched: walls, things, people.
        goals: Reached.
        start_s: From the robot's request to the first command that it accepted [s].
        time_s: From the first motion to the last goal [s].
        distance_m: Way covered in that time.
        first_leg_m: Of it, from the first goal to the second, where the person stands in the way.
        mean_speed_m_s: That way per time.
        rtt_ms: Median round trip, as the bridge measured it.
        robot_cpu: Mean processors in use by agent and bridge, without the simulation.
        service_cpu: And by the service.
        service_memory_mb: Of the service, at the end.
        message: What the service said last.
        topics: Of each topic `TopicRow`.
        robot_memory_mb: Of agent and bridge, and of the simulation, which has the most of it, at the end.
        on_robot: The service ran on the robot, too.
        traces: For figures.
    """

    scenario: str
    seed: int
    completed: bool
    contacts: int
    goals: int
    start_s: float
    time_s: float
    distance_m: float
    first_leg_m: float
    mean_speed_m_s: float
    rtt_ms: float
    robot_cpu: float
    service_cpu: float
    service_memory_mb: float
    message: str
    topics: tuple[TopicRow, ...]
    robot_memory_mb: float = math.nan
    on_robot: bool = False
    traces: Traces = Traces()

    def document(self, *, traces: bool = False) -> dict[str, Any]:
        """For JSON, which has no NaN: None instead. Without traces for people, with them for the file."""
        found = {key: _plain(value) for key, value in asdict(self).items()}
        if not traces:
            del found["traces"]
        return found

    @classmethod
    def of(cls, document: Mapping[str, Any]) -> TrialResult:
        """From `document`.

        Raises:
            TypeError: It has other fields.
        """
        known = _read(document)
        topics = tuple(TopicRow(**_read(row)) for row in known.pop("topics"))
        traces = known.pop("traces", {})
        return cls(**known, topics=topics, traces=Traces(**{key: _tuples(value) for key, value in traces.items()}))


class KeptTrials:
    """Trials in a file of JSON lines, each with what it was asked for. What is there need not be done again.

    A line that a crash cut off is passed over, and its trial is done again.
    """

    def __init__(self, file: Path) -> None:
        """Read what is there.

        Raises:
            OSError: It cannot be read.
            ValueError: A line other than the last is none of ours.
        """
        self._file = file
        self._found: dict[str, TrialResult] = {}
        text = file.read_text(encoding="utf-8") if file.exists() else ""
        self._cut = bool(text) and not text.endswith("\n")
        lines = text.splitlines()
        for number, line in enumerate(lines, 1):
            try:
                row = json.loads(line)
                self._found[_key(row["asked"])] = TrialResult.of(row["result"])
            except (ValueError, KeyError, TypeError, AttributeError) as error:
                if number < len(lines) or not self._cut:
                    raise ValueError(f"line {number} of {file} is not a kept trial; give another file") from error

    def get(self, asked: Mapping[str, Any]) -> TrialResult | None:
        """The trial that was asked for like this, if it is there."""
        return self._found.get(_key(asked))

    def put(self, asked: Mapping[str, Any], result: TrialResult) -> None:
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
