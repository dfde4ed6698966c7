"""Simulated drives for commissioning: dead time, a rate for speeding up and braking, a watchdog, an enable input."""

from collections import deque
from dataclasses import dataclass, field

from skytether.guard.velocity import STANDSTILL, Velocity

_BRAKING, _TURNED = Velocity(1.0, 2.0), Velocity(1.0, 1.0)


@dataclass
class Drives:
    """Two axes that go to what they were told, a dead time later, as fast as their rates let them.

    Attributes:
        braking: [m/s^2, rad/s^2]
        dead_s: From a word to its effect [s].
        watchdog_s: Silence after which they stop; None: they have none.
        enable_s: Time without an edge of the enable signal after which they have no power; None: they want none.
        turned: Signs with which the odometry shows the axes.
    """

    braking: Velocity = _BRAKING
    dead_s: float = 0.1
    watchdog_s: float | None = 0.2
    enable_s: float | None = None
    turned: Velocity = _TURNED
    velocity: Velocity = STANDSTILL
    told: deque[tuple[float, Velocity]] = field(default_factory=lambda: deque([(0.0, STANDSTILL)], maxlen=1000))
    edge_at: float = -1e9
    high: bool = False

    def write(self, velocity: Velocity, now: float) -> None:
        self.told.append((now, velocity))

    def enable(self, high: bool, now: float) -> None:
        if high != self.high:
            self.high, self.edge_at = high, now

    def roll(self, now: float, dt: float) -> None:
        wanted = next((velocity for at, velocity in reversed(self.told) if at <= now - self.dead_s), STANDSTILL)
        if self.watchdog_s is not None and now - self.told[-1][0] > self.watchdog_s:
            wanted = STANDSTILL
        if self.enable_s is not None and now - self.edge_at > self.enable_s:
            wanted = STANDSTILL
        pairs = zip(self.velocity, wanted, self.braking, strict=True)
        self.velocity = Velocity(*(old + min(max(new - old, -rate * dt), rate * dt) for old, new, rate in pairs))

    @property
    def shown(self) -> Velocity:
        return Velocity(self.velocity.linear * self.turned.linear, self.velocity.angular * self.turned.angular)
