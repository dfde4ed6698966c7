"""The fallback ``trail``: the robot holds the trail by itself when link or service are not good enough.

The same controller as the service's, on the robot: simpler only in that nothing else helps it. Loaded by the robot's
agent by entry point (group ``skytether.fallbacks``).
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, Protocol

from skytether.control.admittance import Velocity
from skytether.messages import JointState, Odometry, WrenchStamped
from skytether.service import ConfigError
from skytether.service.params import read_params
from skytether_services.virtual_trail.guide import Guide
from skytether_services.virtual_trail.params import Params
from skytether_services.virtual_trail.service import pose_of, wheels_of


class _Reading(Protocol):
    """A message of the robot's own sensors, and when it was read [monotonic s]."""

    @property
    def message(self) -> object: ...
    @property
    def read_at(self) -> float: ...


class HoldTrail:
    """Guides along the trail with the robot's readings ``force``, ``wheels`` and ``odom``.

    It watches while the service drives, so that it knows the place on the trail and the person's push when it takes
    over, and it goes on from the velocity that the wheels have.

    Args:
        **options: Parameters of the service ``virtual-trail``; give both the same.
    """

    drives = True

    def __init__(self, **options: Any) -> None:
        """Raises ValueError for parameters that the service would refuse."""
        try:
            params = read_params(Params, options)
        except ConfigError as error:
            raise ValueError(str(error)) from error
        self._guide = Guide(params)
        self._now = 0.0
        self._taken: dict[str, float] = {}
        self._wanted: Velocity | None = None

    def watch(self, velocity: Velocity, readings: Mapping[str, _Reading], dt: float) -> None:
        """Every tick, whoever drives."""
        self._now += dt
        for name, take in (("force", self._force), ("wheels", self._wheels), ("odom", self._odom)):
            reading = readings.get(name)
            if reading is not None and self._taken.get(name) != reading.read_at:
                self._taken[name] = reading.read_at
                take(reading.message)
        self._guide.go_on(velocity)
        self._wanted = self._guide.step(self._now)

    def step(self, _velocity: Velocity, _readings: Mapping[str, _Reading], _dt: float) -> tuple[Velocity, float] | None:
        """What was found in `watch`; None: the place on the trail is not known, or sensors are silent."""
        if self._wanted is None:
            return None
        return self._wanted, min(self._taken["force"], self._taken["wheels"])

    def _force(self, message: object) -> None:
        if isinstance(message, WrenchStamped):
            self._guide.force(message.wrench.force.x, self._now)

    def _wheels(self, message: object) -> None:
        if isinstance(message, JointState) and (sample := wheels_of(message)):
            self._guide.wheels(sample, self._now)

    def _odom(self, message: object) -> None:
        if isinstance(message, Odometry):
            self._guide.odometry(message.header.stamp.seconds(), pose_of(message))
