"""How much one robot, service or site may have, so that none of them starves the others."""

from __future__ import annotations

import logging
import threading
from collections import Counter
from collections.abc import Iterable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass

from skytether.api.rest import RobotUse, Size

from ..config.settings import Quotas as Settings
from ..domain.errors import Fault, InvalidError, QuotaError, TooManyError
from ..domain.records import Record
from ..store.store import Store
from .access import Principal
from .disk_usage import DiskUsage, mb

log = logging.getLogger(__name__)

_COME_AGAIN = 5.0
"""Seconds until somebody who has too many streams is to try again."""


@dataclass(frozen=True, slots=True)
class Bound:
    """One quota, what is taken of it with what is asked for, and what there is."""

    key: str
    """Of the settings."""
    whose: str
    unit: str
    wanted: float
    most: float
    advice: str = "let one end first"

    def __str__(self) -> str:
        return f"{self.whose} would have {self.wanted:g} {self.unit}, and may have {self.most:g} (quotas.{self.key})"


def use_of(records: Iterable[Record]) -> RobotUse:
    """What instances that have not ended ask for."""
    held = [record.holds for record in records]
    memory = sum(size.memory_mb for size in held)
    return RobotUse(instances=len(held), cpu=round(sum(size.cpu for size in held), 6), memory_mb=memory)


def use_by_robot(records: Iterable[Record]) -> dict[str, RobotUse]:
    """The same by robot; standbys are nobody's."""
    of: dict[str, list[Record]] = {}
    for record in records:
        if not record.standby:
            of.setdefault(record.robot, []).append(record)
    return {robot: use_of(theirs) for robot, theirs in of.items()}


class Quotas:
    """Refuses what is too much. Safe from any thread."""

    def __init__(self, store: Store, settings: Settings, disk_usage: DiskUsage | None = None) -> None:
        self.settings = settings
        self._disk_usage = disk_usage
        self._store = store
        self._admitting = threading.Lock()
        self._counting = threading.Lock()
        self._streams: Counter[str] = Counter()
        self._logs = 0
        self._full: set[str] = set()
        """Robots of which it was said that they have too many names."""
        self.refused: Counter[str] = Counter()
        """By quota."""

    @contextmanager
    def admitting(self, record: Record) -> Iterator[None]:
        """Around the storing of a new instance: two that come at once, at any orchestrators, are not both the last one.

        Raises:
            QuotaError: It would be too much.
        """
        with self._admitting, self._store.admitting():
            for bound in self._bounds(record):
                if bound.wanted > bound.most + 1e-9:
                    self._refuse(bound.key)
                    raise QuotaError(f"{bound}: {bound.advice}")
            yield

    @contextmanager
    def resizing(self, record: Record, wanted: Size) -> Iterator[None]:
        """Around the storing of what an instance is to have: see ``admitting``.

        Raises:
            QuotaError: Its robot would have too much.
        """
        with self._admitting, self._store.admitting():
            use, whose, most = use_of(self._store.live_of(record.robot)), f"robot '{record.robot}'", self.settings
            after = record.after({"resize": wanted.model_dump()}).holds
            cpu = round(use.cpu + after.cpu - record.holds.cpu, 6)
            memory_mb = use.memory_mb + after.memory_mb - record.holds.memory_mb
            for bound, before in (
                (Bound("robot_cpu", whose, "cores", cpu, most.robot_cpu), use.cpu),
                (Bound("robot_memory_mb", whose, "MiB of memory", memory_mb, most.robot_memory_mb), use.memory_mb),
            ):
                if bound.wanted > max(bound.most, before) + 1e-9:
                    self._refuse(bound.key)
                    raise QuotaError(f"{bound}: {bound.advice}")
            yield

    def left(self, robot: str) -> Size:
        """What a robot may have beside what it has, of cores and memory; less than nothing, too."""
        use, most = use_of(self._store.live_of(robot)), self.settings
        return Size(cpu=round(most.robot_cpu - use.cpu, 6), memory_mb=most.robot_memory_mb - use.memory_mb)

    def _bounds(self, record: Record) -> Iterator[Bound]:
        most, needs = self.settings, record.spec.needs
        use, whose = use_of(self._store.live_of(record.robot)), f"robot '{record.robot}'"
        yield Bound("robot_instances", whose, "instances", use.instances + 1, most.robot_instances)
        yield Bound("robot_cpu", whose, "cores", use.cpu + needs.cpu, most.robot_cpu)
        yield Bound("robot_memory_mb", whose, "MiB of memory", use.memory_mb + needs.memory_mb, most.robot_memory_mb)
        data = mb(self._disk_usage.of(record.robot)) if self._disk_usage is not None else 0
        advice = "delete what is not needed"
        yield Bound("robot_data_mb", whose, "MiB of data", data, most.robot_data_mb, advice)
        there = self._store.count_live(record.service) + 1
        yield Bound("service_instances", f"service '{record.service}'", "instances", there, most.service_instances)

    def lease(self, principal: Principal, lease_s: float | None) -> float | None:
        """What a robot gets that renews with another length; an operator gets what they ask for."""
        if lease_s is None or principal.robot is None:
            return lease_s
        return min(lease_s, self.settings.robot_lease_s)

    def check_lease(self, principal: Principal, lease_s: float) -> None:
        """May it ask for a lease of this length?

        Raises:
            InvalidError: It is too long for a robot.
        """
        if principal.robot is not None and lease_s > self.settings.robot_lease_s:
            self._refuse("robot_lease_s")
            text = f"is {lease_s:g} s, and a robot may have {self.settings.robot_lease_s:g} s (quotas.robot_lease_s)"
            raise InvalidError([Fault("lease_s", text)])

    @contextmanager
    def stream(self, principal: Principal, *, log: bool = False) -> Iterator[None]:
        """Around an answer that goes on and on.

        Raises:
            TooManyError: There are too many, of this caller or of all.
        """
        owner, most = principal.owner, self.settings
        with self._counting:
            mine, everyone = self._streams[owner], self._streams.total()
            key = (
                "robot_streams"
                if principal.robot is not None and mine >= most.robot_streams
                else "streams"
                if everyone >= most.streams
                else "log_streams"
                if log and self._logs >= most.log_streams
                else ""
            )
            if not key:
                self._streams[owner] += 1
                self._logs += log
        if key:
            self._refuse(key)
            text = f"{getattr(most, key)} streams are open (quotas.{key}): close one, or try again"
            raise TooManyError(_COME_AGAIN, text)
        try:
            yield
        finally:
            with self._counting:
                self._streams[owner] -= 1
                self._logs -= log
                if not self._streams[owner]:
                    del self._streams[owner]

    def data(self) -> Mapping[str, int]:
        """Bytes on disk by robot, at all sites, as far as they are known."""
        return self._disk_usage.by_robot() if self._disk_usage is not None else {}

    def data_at(self) -> Mapping[str, int]:
        """The same by site."""
        return self._disk_usage.by_site() if self._disk_usage is not None else {}

    def streams(self) -> dict[str, int]:
        """Logs and events that robots follow here, by robot."""
        with self._counting:
            held = dict(self._streams)
        return {owner.removeprefix("robot:"): n for owner, n in held.items() if owner.startswith("robot:")}

    def with_rest(self, robot: str, use: RobotUse, data: Mapping[str, int]) -> RobotUse:
        """What a robot uses, with what is no instance's: streams here, and of `data` its own."""
        rest = {"streams": self._streams[f"robot:{robot}"], "data_mb": mb(data.get(robot, 0))}
        return use.model_copy(update=rest)

    @property
    def of_robot(self) -> RobotUse:
        """The most that one may have of each."""
        most = self.settings
        return RobotUse(
            instances=most.robot_instances,
            cpu=most.robot_cpu,
            memory_mb=most.robot_memory_mb,
            streams=most.robot_streams,
            data_mb=most.robot_data_mb,
        )

    @property
    def open_streams(self) -> int:
        """How many there are."""
        return self._streams.total()

    def limits(self) -> Mapping[str, float]:
        """Each quota by its key."""
        return {key: float(value) for key, value in self.settings.model_dump().items()}

    def drop_names(self, beyond: Mapping[str, int]) -> None:
        """By robot, names that it reported and for which there is no room."""
        with self._counting:
            self.refused["robot_names"] += sum(beyond.values())
            new = sorted(beyond.keys() - self._full)
            self._full |= beyond.keys()
        for robot in new:
            log.warning(
                "robot '%s' has made up %d names of topics and reasons (quotas.robot_names): what it reports under "
                "more gets no series",
                robot,
                self.settings.robot_names,
            )

    def _refuse(self, key: str) -> None:
        with self._counting:
            self.refused[key] += 1
