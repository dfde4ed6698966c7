"""The plan as a MuJoCo model: walls and things that stand, robots that roll, people whose legs are moved.

A robot is one rigid body with two slides and a hinge; its drive is a force, see `robot`. So nothing wobbles, casters
need no tricks, and contacts with walls and people are MuJoCo's own. Only robots take part in contacts.
"""

from __future__ import annotations

import math
from types import ModuleType
from typing import Any
from xml.sax.saxutils import quoteattr

from .figure import assets, head_xml, scene_xml, trunk_xml
from .plan import Box, Plan, Walk
from .robot import RearParams, RobotParams

PHYSICS_STEP = 0.005
"""Of MuJoCo, s."""

LEGS = ("left", "right")
_LEG_RADIUS, _LEG_HEIGHT = 0.06, 0.85
_BODY_RADIUS, _BODY_TOP = 0.2, 1.55


class WorldError(Exception):
    """The world cannot be made; the text says why, in one sentence."""


def load_mujoco() -> ModuleType:
    """The library.

    Raises:
        WorldError: It is not installed.
    """
    try:
        import mujoco
    except ModuleNotFoundError as error:
        if error.name != "mujoco":
            raise
        raise WorldError(
            "the simulated world needs the library mujoco; install it with: pip install 'skytether[lab]'"
        ) from error
    return mujoco  # type: ignore[no-any-return]


def compile_model(
    plan: Plan, people: tuple[Walk, ...], robots: int, params: RobotParams, operator: str | None = None
) -> Any:
    """An ``MjModel``; ``operator`` is the name of one who has a head.

    Raises:
        WorldError: MuJoCo is missing, or does not take the plan.
    """
    mujoco = load_mujoco()
    try:
        xml = model_xml(plan, people, robots, params, operator)
        return mujoco.MjModel.from_xml_string(xml, assets() if params.rear is not None else {})
    except ValueError as error:
        raise WorldError(f"MuJoCo does not take the plan {plan.name}: {error}") from error


def model_xml(
    plan: Plan, people: tuple[Walk, ...], robots: int, params: RobotParams, operator: str | None = None
) -> str:
    """MJCF of all of it."""
    before, inside = scene_xml(params.rear) if params.rear is not None else ("", "")
    parts = [
        f'<mujoco model={quoteattr(plan.name)}><option timestep="{PHYSICS_STEP}" gravity="0 0 0"'
        ' integrator="implicitfast"/><default><geom condim="3" friction="0.3 0.005 0.0001" contype="0"'
        f' conaffinity="1"/></default>{before}<worldbody>{inside}'
    ]
    parts += [_box(box) for box in plan.boxes]
    parts += [
        f'<geom name={quoteattr(c.name)} type="cylinder" size="{c.radius} {c.height / 2}"'
        f' pos="{c.x} {c.y} {c.height / 2}"/>'
        for c in plan.cylinders
    ]
    parts += [_robot(index, params) for index in range(robots)]
    parts += [_person(person) for person in people]
    if operator is not None:
        parts += [
            _legs(operator, 0.0, 0.0),
            trunk_xml(operator, 0.0, 0.0),
            head_xml(operator, 0.0, 0.0, face=params.rear is not None),
        ]
    parts.append("</worldbody></mujoco>")
    return "".join(parts)


def _box(box: Box) -> str:
    half = f"{box.length / 2} {box.width / 2} {box.height / 2}"
    return (
        f'<geom name={quoteattr(box.name)} type="box" size="{half}" pos="{box.x} {box.y} {box.height / 2}"'
        f' quat="{math.cos(box.turn / 2)!r} 0 0 {math.sin(box.turn / 2)!r}"/>'
    )


def _robot(index: int, params: RobotParams) -> str:
    """Two boxes that cross: the outline is a rectangle without its corners, as the real one's nearly is."""
    name, p = f"robot-{index}", params
    z, half = p.ground_clearance + p.height / 2, p.height / 2
    inertia = p.mass * (p.length**2 + p.width**2) / 12
    shapes = ((p.length, p.width - 2 * p.corner), (p.length - 2 * p.corner, p.width))
    geoms = "".join(
        f'<geom name="{name}-{i}" type="box" size="{x / 2} {y / 2} {half}" pos="0 0 {z}" contype="1" conaffinity="1"/>'
        for i, (x, y) in enumerate(shapes)
    )
    return (
        f'<body name="{name}"><inertial pos="0 0 {z}" mass="{p.mass}" diaginertia="{inertia} {inertia} {inertia}"/>'
        f'<joint name="{name}-x" type="slide" axis="1 0 0"/><joint name="{name}-y" type="slide" axis="0 1 0"/>'
        f'<joint name="{name}-turn" type="hinge" axis="0 0 1"/>{geoms}{_camera(name, p.rear)}</body>'
    )


def _camera(name: str, rear: RearParams | None) -> str:
    """Looks back and up; x is to the right in the picture, y up."""
    if rear is None:
        return ""
    sin, cos = math.sin(rear.camera_up), math.cos(rear.camera_up)
    high = 2 * math.atan(math.tan(rear.camera_field / 2) * rear.height / rear.width)
    return (
        f'<camera name="{name}-camera" pos="{rear.camera_x} 0 {rear.camera_z}" xyaxes="0 1 0 {sin} 0 {cos}"'
        f' fovy="{math.degrees(high)}"/>'
    )


def _person(person: Walk) -> str:
    """Legs that the laser sees, and a trunk above them; each is moved by itself."""
    x, y = person.way[0]
    low = _LEG_HEIGHT
    return (
        f'{_legs(person.name, x, y)}<body name={quoteattr(f"{person.name}-trunk")} mocap="true" pos="{x} {y} 0">'
        '<geom type="cylinder"'
        f' name={quoteattr(f"{person.name}-body")} size="{_BODY_RADIUS} {(_BODY_TOP - low) / 2}"'
        f' pos="0 0 {(_BODY_TOP + low) / 2}"/></body>'
    )


def _legs(name: str, x: float, y: float) -> str:
    return "".join(
        f'<body name={quoteattr(f"{name}-{leg}")} mocap="true" pos="{x} {y} 0"><geom type="cylinder"'
        f' name={quoteattr(f"{name}-{leg}-leg")} size="{_LEG_RADIUS} {_LEG_HEIGHT / 2}"'
        f' pos="0 0 {_LEG_HEIGHT / 2}" rgba="0.20 0.20 0.24 1"/></body>'
        for leg in LEGS
    )
