"""What the operator and the hall look like to a camera, as parts of a MuJoCo model.

Geoms without contacts, but for legs and trunk. The person is 1.7 m tall.
"""

from __future__ import annotations

from .robot import RearParams

HEAD_HEIGHT = 1.56
"""Of the middle of the head above the floor, m."""

_SKIN, _HAIR, _SHIRT, _TROUSERS, _SHOES = (
    "0.80 0.62 0.52 1",
    "0.16 0.11 0.08 1",
    "0.23 0.33 0.49 1",
    "0.20 0.20 0.24 1",
    "0.1 0.1 0.1 1",
)
_SEEN_ONLY = 'contype="0" conaffinity="0" mass="0"'
_FIELD = 30.0
"""Side of the floor, m."""


def scene_xml(rear: RearParams) -> tuple[str, str]:
    """What goes before the bodies of the world, and what into it: light, size of pictures, floor."""
    before = (
        f'<visual><global offwidth="{rear.width}" offheight="{rear.height}"/><quality shadowsize="0" offsamples="0"/>'
        '<headlight ambient="0.45 0.45 0.45" diffuse="0.35 0.35 0.35" specular="0 0 0"/></visual>'
        '<asset><texture name="sky" type="skybox" builtin="gradient" rgb1="0.83 0.83 0.80" rgb2="0.62 0.62 0.60"'
        ' width="64" height="384"/><texture name="floor" type="2d" builtin="checker" rgb1="0.55 0.52 0.48"'
        ' rgb2="0.50 0.47 0.43" width="64" height="64"/><material name="floor" texture="floor" texrepeat="30 30"/>'
        "</asset>"
    )
    inside = (
        '<light directional="true" castshadow="false" pos="0 0 4" dir="0.2 0.1 -1" diffuse="0.35 0.35 0.35"'
        ' specular="0 0 0"/>'
        f'<geom name="floor" type="plane" size="{_FIELD / 2} {_FIELD / 2} 1" material="floor" {_SEEN_ONLY}/>'
    )
    return before, inside


def trunk_xml(name: str, x: float, y: float) -> str:
    """Trunk, shoulders, arms and neck: a body that turns as the person does."""
    return (
        f'<body name="{name}-trunk" mocap="true" pos="{x} {y} 0">'
        f'<geom name="{name}-body" type="ellipsoid" size="0.13 0.20 0.36" pos="0 0 1.10" rgba="{_SHIRT}"/>'
        f'<geom type="capsule" size="0.07" fromto="0 -0.15 1.36 0 0.15 1.36" rgba="{_SHIRT}" {_SEEN_ONLY}/>'
        f'<geom type="capsule" size="0.045" fromto="0 0.21 1.34 0.02 0.25 0.85" rgba="{_SHIRT}" {_SEEN_ONLY}/>'
        f'<geom type="capsule" size="0.045" fromto="0 -0.21 1.34 0.02 -0.25 0.85" rgba="{_SHIRT}" {_SEEN_ONLY}/>'
        f'<geom type="capsule" size="0.05" fromto="0 0 1.38 0.01 0 1.48" rgba="{_SKIN}" {_SEEN_ONLY}/></body>'
    )


def head_xml(name: str, x: float, y: float) -> str:
    """A head: a body of which x is where the face points."""
    return (
        f'<body name="{name}-head" mocap="true" pos="{x} {y} 0">'
        f'<geom type="ellipsoid" size="0.095 0.075 0.12" pos="0 0 {HEAD_HEIGHT}" rgba="{_SKIN}" {_SEEN_ONLY}/>'
        f'<geom type="ellipsoid" size="0.10 0.085 0.11" pos="-0.03 0 {HEAD_HEIGHT + 0.035}" rgba="{_HAIR}"'
        f" {_SEEN_ONLY}/>"
        f'<geom type="ellipsoid" size="0.025 0.015 0.02" pos="0.095 0 {HEAD_HEIGHT - 0.01}" rgba="{_SKIN}"'
        f" {_SEEN_ONLY}/></body>"
    )
