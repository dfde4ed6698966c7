"""The robot's own controllers, for when link or service are not good enough (Mello, thesis, section 3.3, figure 18).

A fallback goes on from the velocity that the wheels have, whoever drove before, so that taking over does not jump;
giving back needs nothing, because the supervisor limits the acceleration whoever drives. Found by entry point of the
group ``skytether.fallbacks``.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from importlib.metadata import entry_points
from math import isfinite
from typing import Any, Protocol, runtime_checkable

from skytether.control import admittance
from skytether.control.admittance import AdmittanceParams, Velocity
from skytether.messages import WrenchStamped

GROUP = "skytether.fallbacks"


@dataclass(frozen=True, slots=True)
class Reading:
    """The newest message of one of the robot's own sensors."""

    message: object
    read_at: float
    """Monotonic seconds."""


class Fallback(Protocol):
    """A controller that needs nothing but the robot. Constructed with the options of the robot's configuration."""

    drives: bool
    """False: it only ever stops; the source is then called ``stop``."""

    def step(self, velocity: Velocity, readings: Mapping[str, Reading], dt: float) -> tuple[Velocity, float] | None:
        """One tick in charge.

        Args:
            velocity: What the wheels were told in the tick before, by whomever.
            readings: The robot's newest readings by topic name.
            dt: Time since that tick [s].

        Returns:
            The velocity it wants and when the readings behind it were taken; None if it cannot say: the robot stops.
        """
        ...


@runtime_checkable
class Watching(Protocol):
    """What a fallback may have besides: eyes while somebody else drives."""

    def watch(self, velocity: Velocity, readings: Mapping[str, Reading], dt: float) -> None:
        """Called at every tick, whoever drives, and before `Fallback.step` when this one does.

        Args:
            velocity: What the wheels were told in the tick before, by whomever.
            readings: The robot's newest readings by topic name.
            dt: Time since that tick [s].
        """
        ...


class Stop:
    """No controller: the robot stops and waits."""

    drives = False

    def step(self, _velocity: Velocity, _readings: Mapping[str, Reading], _dt: float) -> None:
        """Nothing is wanted, so the supervisor brakes."""
        return


class Admittance:
    """Follows the person's forces, without guidance: the walker stays usable (thesis section 3.3).

    The torque of eq. 2.3 is the person's own, not the guiding one of eq. 2.4. It reads the topic ``force``
    (geometry_msgs/msg/WrenchStamped, net wrench of both forearm sensors): F of eq. 2.1 is half its ``force.x``.

    Args:
        **options: Fields of `skytether.control.admittance.AdmittanceParams`.
    """

    drives = True

    def __init__(self, **options: float) -> None:
        self._params = AdmittanceParams(**options)

    def step(self, velocity: Velocity, readings: Mapping[str, Reading], dt: float) -> tuple[Velocity, float] | None:
        """The admittance law, one step on from the wheels' velocity."""
        reading = readings.get("force")
        if reading is None or not isinstance(reading.message, WrenchStamped):
            return None
        force, torque = reading.message.wrench.force.x / 2, reading.message.wrench.torque.z
        if not (isfinite(force) and isfinite(torque)):
            return None
        return admittance.step(self._params, velocity, force, torque, dt), reading.read_at


class FallbackError(Exception):
    """The fallback cannot be had; the text says why and what to do."""


def load(name: str, options: Mapping[str, Any]) -> Fallback:
    """Find a fallback by the name of its entry point and construct it.

    Raises:
        FallbackError: There is none of that name, it cannot be imported, or it refuses its options.
    """
    found = {entry.name: entry for entry in entry_points(group=GROUP)}
    if name not in found:
        known = ", ".join(sorted(found)) or "none: is Skytether installed?"
        raise FallbackError(f"there is no fallback '{name}'; known are: {known}")
    try:
        factory = found[name].load()
    except Exception as error:  # whatever a broken plug-in raises at import
        raise FallbackError(f"fallback '{name}' cannot be loaded from {found[name].value}: {error}") from error
    try:
        fallback: Fallback = factory(**options)
    except (TypeError, ValueError) as error:
        raise FallbackError(f"fallback '{name}' refuses its options: {error}") from error
    return fallback
