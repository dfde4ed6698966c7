"""Parameters of the virtual trail, named after what the thesis's symbols mean."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

from skytether.service import param
from skytether_services.virtual_trail.path import Path


@dataclass(frozen=True)
class Straight:
    """A straight piece of the trail."""

    length: float = param(unit="m", gt=0, doc="its length")


@dataclass(frozen=True)
class Arc:
    """A curved piece of the trail."""

    radius: float = param(
        unit="m", gt=0, doc="its radius; below max_linear / max_angular it cannot be followed at full speed"
    )
    angle: float = param(unit="rad", ge=-math.tau, le=math.tau, doc="change of heading; positive: to the left")


THESIS_TRAIL: tuple[Straight | Arc, ...] = (
    Straight(1.5),
    Arc(1.2, 0.75),
    Straight(1.2),
    Arc(1.2, -1.5),
    Straight(1.2),
    Arc(1.2, 0.75),
    Straight(1.5),
)
"""9 m of straight lines with smooth curves to both sides (thesis section 2.5.2; the pieces' measures are ours)."""


@dataclass(frozen=True)
class Params:
    """What a robot may set when it asks for the service."""

    trail: tuple[Straight | Arc, ...] = param(
        THESIS_TRAIL,
        min_length=1,
        max_length=1000,
        doc="pieces, each {length} or {radius, angle}; from the origin of the robot's odometry, heading along x",
    )
    admittance_mass: float = param(15.0, unit="kg", gt=0, doc="m_v of eq. 2.2")
    admittance_damping: float = param(60.0, unit="N s/m", gt=0, doc="d_v of eq. 2.2: force per speed")
    angular_mass: float = param(1.2, unit="kg m^2", gt=0, doc="m_omega of eq. 2.3")
    angular_damping: float = param(6.0, unit="N m s/rad", gt=0, doc="d_omega of eq. 2.3")
    torque_gain: float = param(50.0, unit="N s/m", gt=0, doc="k_tau of eq. 2.4: how firmly the trail guides")
    sensor_distance: float = param(0.5, unit="m", gt=0, doc="d of eq. 2.4: between both forearm sensors")
    lateral_gain: float = param(1.2, unit="1/m", gt=0, doc="how sharply the walker turns back to the trail")
    force_cutoff: float = param(3.0, unit="Hz", gt=0, doc="cut-off frequency of the force filter")
    wheel_radius: float = param(0.1, unit="m", gt=0, doc="of the driven wheels")
    wheel_track: float = param(0.55, unit="m", gt=0, doc="distance between the driven wheels")
    input_timeout: float = param(0.1, unit="s", gt=0, doc="no commands are given from forces or wheels older than this")
    end_rate: float = param(0.8, unit="1/s", gt=0, doc="speed per way left, near the end of the trail")
    end_creep: float = param(0.03, unit="m/s", gt=0, doc="speed with which the end is reached")
    max_linear: float = param(0.25, unit="m/s", gt=0, le=1.5, doc="largest forward speed; never backwards")
    max_angular: float = param(0.5, unit="rad/s", gt=0, le=3.0, doc="largest turning rate")


def path_of(trail: Sequence[Straight | Arc]) -> Path:
    """The geometry of the parameter ``trail``.

    Raises:
        ValueError: A piece has no length.
    """
    return Path(
        [
            (piece.length, 0.0)
            if isinstance(piece, Straight)
            else (piece.radius * abs(piece.angle), math.copysign(1 / piece.radius, piece.angle))
            for piece in trail
        ]
    )
