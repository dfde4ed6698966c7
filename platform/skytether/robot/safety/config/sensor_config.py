"""The part of the section ``safety`` of robot.yaml that is about sensors: what people write, checked."""

from __future__ import annotations

from collections.abc import Mapping
from math import inf, radians, tan, tau
from typing import Annotated, Any, Literal

from pydantic import Field, model_validator

from skytether.messages import LaserScan, Message, PointCloud2, Range

from ...config_base import Metres, Numbers
from ..rules.contact import ContactKind, ContactParams
from ..sensing.clouds import CloudMount
from ..sensing.coverage import Action, UnseenParams, sector
from ..sensing.ranges import Mount
from ..sensing.sensing import RangeSensor
from ..sensing.stamps import StampRule

Degrees = Annotated[float, Field(ge=-360, le=360)]
Sector = tuple[Degrees, Degrees]
"""From, and counter-clockwise to; the second below the first goes over the seam."""


_MESSAGES: Mapping[str, type[Message]] = {"laser": LaserScan, "sonar": Range, "points": PointCloud2}
_OF_POINTS = ("z", "pitch_deg", "roll_deg", "optical", "min_z_m", "max_z_m", "slope_deg", "min_points")
_NOT_OF_POINTS = ("upside_down", "max_step_deg", "min_rays", "no_echo_is_free")
_NEEDED_OF_POINTS = {
    "z": "height of the sensor above the floor",
    "max_z_m": "height of the robot",
    "range_max": "a cloud does not say how far its sensor measures",
}


class SensorConfig(Numbers):
    """A laser, a sonar, a depth camera or a 3D lidar, as it is mounted, and what its messages must be."""

    kind: Literal["laser", "sonar", "points"] = "laser"
    """sensor_msgs/msg/LaserScan, sensor_msgs/msg/Range or sensor_msgs/msg/PointCloud2."""
    x: Metres = 0.0
    """Forward of the base's origin [m]."""
    y: Metres = 0.0
    """Left of it [m]."""
    yaw_deg: Degrees = 0.0
    """Where its middle looks; positive to the left."""
    z: Annotated[float, Field(ge=0)] = 0.0
    """Of ``points``: height above the floor [m]."""
    pitch_deg: Annotated[float, Field(ge=-90, le=90)] = 0.0
    """Of ``points``: how far it looks down."""
    roll_deg: Annotated[float, Field(ge=-180, le=180)] = 0.0
    """Of ``points``: positive: its left side is up; 180: head over."""
    optical: bool | None = None
    """Of ``points``: its clouds have z forward, x to the right; null: if their frame_id ends in ``_optical_frame``."""
    min_z_m: Annotated[float, Field(gt=0)] = 0.05
    """Of ``points``: what is lower is floor [m]."""
    max_z_m: Annotated[float, Field(ge=0)] = 0.0
    """Of ``points``: what is higher does not stop the robot [m]."""
    slope_deg: Annotated[float, Field(ge=0, le=45)] = 0.0
    """Of ``points``: the floor may rise by this from the sensor on, and is floor."""
    min_points: Annotated[int, Field(ge=1, le=500_000)] = 100
    """Of ``points``: readings of a cloud at least."""
    upside_down: bool = False
    range_min: Annotated[float, Field(ge=0)] = 0.0
    """[m]; 0: as its messages say."""
    range_max: Annotated[float, Field(ge=0)] = 0.0
    """[m]; 0: as its messages say."""
    ignore_deg: Annotated[tuple[Sector, ...], Field(max_length=32)] = ()
    """Sectors in its own angles in which it sees the robot itself; nothing else is seen there."""
    fov_deg: Sector | None = None
    """Sector in its own angles that it must look into; null: the widest that its messages have had so far."""
    max_gap_deg: Annotated[float, Field(ge=0, le=360)] = 5.0
    """Widest sector without a reading that is not blindness."""
    max_step_deg: Annotated[float, Field(gt=0, le=90)] = 2.0
    """From one ray of a laser to the next at most."""
    min_rays: Annotated[int, Field(ge=1, le=20_000)] = 10
    """Of a laser's scan."""
    no_echo_is_free: bool = False
    """NaN and zero mean that nothing is there (lasers outdoors); never where all readings are such."""
    frame_id: Annotated[str, Field(max_length=255)] = ""
    """Of its messages; others are not used. Empty: that of the first."""
    stamps: Literal["auto", "required", "order", "own"] = "auto"
    """What is asked of their stamps: used if the first has one; needed; only their order (simulators); of our clock."""
    max_age_s: Annotated[float, Field(gt=0, le=10)] = 0.3
    """Age of the newest measurement at which it is stale."""
    on_unknown: Literal["stop", "slow"] = "stop"
    """When it is blind, silent or makes no sense."""
    on_empty: Literal["stop", "slow", "free"] = "slow"
    """When a laser or a depth camera reports nothing within reach in any direction."""

    @model_validator(mode="after")
    def _fits_together(self) -> SensorConfig:
        fixed = self.kind == "sonar" and self.range_min == self.range_max
        if self.range_min and self.range_max and not (self.range_min < self.range_max or fixed):
            raise ValueError(f"range_min {self.range_min} must be below range_max {self.range_max}")
        if self.fov_deg is not None and self.fov_deg[0] == self.fov_deg[1]:
            raise ValueError("fov_deg must be a sector: two angles that differ")
        looks = sector(0.0, tau) if self.fov_deg is None else sector(*map(radians, self.fov_deg))
        for first, last in self.ignore_deg:
            looks &= ~sector(radians(first), radians(last))
        if not looks.any():
            raise ValueError("ignore_deg leaves nothing of its field of view: it would see nothing at all")
        return self

    @model_validator(mode="after")
    def _fits_its_kind(self) -> SensorConfig:
        points = self.kind == "points"
        for name in _NOT_OF_POINTS if points else _OF_POINTS:
            if getattr(self, name) != type(self).model_fields[name].default:
                raise ValueError(f"{name} means nothing {'with' if points else 'without'} kind: points")
        for name, what in _NEEDED_OF_POINTS.items() if points else ():
            if not getattr(self, name):
                raise ValueError(f"{name} is needed with kind: points ({what})")
        if points and not self.min_z_m < self.max_z_m:
            raise ValueError(f"min_z_m {self.min_z_m} must be below max_z_m {self.max_z_m}")
        return self

    def message(self) -> type[Message]:
        """Type of its messages."""
        return _MESSAGES[self.kind]

    def sensor(self) -> RangeSensor:
        """The sensor as the rules take it."""
        common: dict[str, Any] = {
            "x": self.x,
            "y": self.y,
            "yaw": radians(self.yaw_deg),
            "range_min": self.range_min,
            "range_max": self.range_max,
            "ignore": tuple((radians(first), radians(last)) for first, last in self.ignore_deg),
            "fov": None if self.fov_deg is None else (radians(self.fov_deg[0]), radians(self.fov_deg[1])),
            "max_gap": radians(self.max_gap_deg),
        }
        mount: Mount
        if self.kind == "points":
            mount = CloudMount(
                **common,
                z=self.z,
                pitch=radians(self.pitch_deg),
                roll=radians(self.roll_deg),
                optical=self.optical,
                min_z=self.min_z_m,
                max_z=self.max_z_m,
                slope=tan(radians(self.slope_deg)),
                min_points=self.min_points,
            )
        else:
            mount = Mount(
                **common,
                upside_down=self.upside_down,
                max_step=radians(self.max_step_deg),
                min_rays=self.min_rays,
                no_echo_is_free=self.no_echo_is_free,
            )
        return RangeSensor(
            mount,
            self.max_age_s,
            Action(self.on_unknown),
            Action(self.on_empty),
            self.frame_id,
            StampRule(self.stamps),
        )


class UnseenConfig(Numbers):
    """Moving where no sensor looks: backwards without eyes there, with a corner that swings out in a turn."""

    action: Literal["stop", "slow", "free"] = "slow"
    """``slow``: no part of the outline moves there faster than ``zones.slow_speed``."""
    near_m: Annotated[float, Field(ge=0.01, le=2)] = 0.05
    """So near to the outline nothing needs to be looked at: what stands there was seen before it came there."""

    def params(self) -> UnseenParams:
        """As the rules take it."""
        return UnseenParams(Action(self.action), self.near_m)


class ContactConfig(Numbers):
    """A bumper or a cliff sensor: it stops the robot until a reset."""

    kind: Literal["bumper", "cliff"] = "bumper"
    pressed_is: bool = True
    """std_msgs/msg/Bool: the value that stops; false for a circuit that opens."""
    below_m: Annotated[float, Field(gt=0, le=10)] | None = None
    """sensor_msgs/msg/Range instead: nearer than this stops [m]."""
    above_m: Annotated[float, Field(gt=0, le=10)] | None = None
    """sensor_msgs/msg/Range instead: farther than this stops [m], as over a step down."""
    max_age_s: Annotated[float, Field(gt=0, le=60)] | None = 0.5
    """Silence after which the robot stands; null: it speaks only when it changes."""

    def params(self) -> ContactParams:
        """As the rules take it."""
        age = inf if self.max_age_s is None else self.max_age_s
        return ContactParams(ContactKind(self.kind), self.pressed_is, self.below_m, self.above_m, age)
