"""Admittance: forces of a person become velocities of a walker (Mello, thesis, section 2.5.1, eq. 2.2 and 2.3).

The thesis's law is ``v_c = (F - m v') / d``, the same for rotation. Taken literally, with the acceleration v' measured
on the walker, it is an algebraic loop: the command follows the walker's acceleration, which follows the command through
a motor lag T and a network delay. Its gain at high frequency is (m / d) / T; above 1 it oscillates at any delay, and
the useful m / d (0.2 to 0.5 s) is well above T = 0.1 s. So v' is the acceleration of the commanded velocity itself: the
law is the differential equation ``m v' + d v = F``, solved implicitly per step (backward Euler), which is stable for
every m, d > 0 and every step. For a walker that follows its commands both are the same law.

The state is the velocity itself and is limited, not only the output, so nothing winds up behind a limit.
"""

from __future__ import annotations

from dataclasses import dataclass

from skytether.guard.velocity import STANDSTILL as STANDSTILL
from skytether.guard.velocity import Velocity as Velocity


@dataclass(frozen=True, slots=True)
class AdmittanceParams:
    """The walker that the person is to feel, and its limits (thesis section 2.5.1).

    Attributes:
        mass: m_v, virtual mass [kg].
        damping: d_v, virtual damping [N s/m].
        angular_mass: m_omega, virtual moment of inertia [kg m^2].
        angular_damping: d_omega, virtual angular damping [N m s/rad].
        max_linear: Largest forward velocity [m/s]; the smallest is 0: never backwards.
        max_angular: Largest angular velocity to either side [rad/s].
    """

    mass: float = 15.0
    damping: float = 60.0
    angular_mass: float = 1.2
    angular_damping: float = 6.0
    max_linear: float = 0.25
    max_angular: float = 0.5

    def __post_init__(self) -> None:
        """Refuse what is not a passive walker.

        Raises:
            ValueError: A field is not above 0; the text names it.
        """
        for name in self.__slots__:
            if not getattr(self, name) > 0:
                raise ValueError(f"admittance: {name} must be above 0, not {getattr(self, name)}")


def linear_step(params: AdmittanceParams, linear: float, force: float, dt: float) -> float:
    """Eq. 2.2: the next forward velocity [m/s].

    Args:
        params: The virtual walker.
        linear: The previous step's result [m/s].
        force: Forward force F of eq. 2.1, the mean of both forearms [N].
        dt: Step [s].
    """
    return _clip(_relax(params.mass, params.damping, linear, force, dt), 0.0, params.max_linear)


def angular_step(params: AdmittanceParams, angular: float, torque: float, dt: float) -> float:
    """Eq. 2.3: the next angular velocity [rad/s].

    Args:
        params: The virtual walker.
        angular: The previous step's result [rad/s].
        torque: The modified torque of eq. 2.4, or the person's own (F_r - F_l) d / 2 [N m].
        dt: Step [s].
    """
    omega = _relax(params.angular_mass, params.angular_damping, angular, torque, dt)
    return _clip(omega, -params.max_angular, params.max_angular)


def step(params: AdmittanceParams, velocity: Velocity, force: float, torque: float, dt: float) -> Velocity:
    """Both laws at once: from the previous step's velocity to the next one's.

    A walker that takes over control starts from the velocity it has, so that nothing jumps.
    """
    return Velocity(linear_step(params, velocity.linear, force, dt), angular_step(params, velocity.angular, torque, dt))


def _relax(mass: float, damping: float, velocity: float, force: float, dt: float) -> float:
    """One backward Euler step of m v' + d v = F: m (v1 - v0) / dt + d v1 = F, solved for v1."""
    return (mass * velocity + force * dt) / (mass + damping * dt)


def _clip(value: float, low: float, high: float) -> float:
    return min(max(value, low), high)
