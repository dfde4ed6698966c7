"""What the operator and the hall look like to a camera, as parts of a MuJoCo model.

Geoms without contacts, but for legs and trunk. The person is 1.7 m tall.
"""

from __future__ import annotations

from functools import cache
from importlib.resources import files

from .robot import RearParams

HEAD_HEIGHT = 1.56
"""Of the middle of the head above the floor, m."""
_FACE = ("head.obj", "head.png")
"""In the folder ``assets``, which says where they come from: a face, open at its back, and its picture."""

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
        '<headlight ambient="0.55 0.55 0.55" diffuse="0.35 0.35 0.35" specular="0 0 0"/></visual>'
        '<asset><texture name="sky" type="skybox" builtin="gradient" rgb1="0.83 0.83 0.80" rgb2="0.62 0.62 0.60"'
        ' width="64" height="384"/><texture name="face" type="2d" file="head.png"/><material name="face"'
        ' texture="face" specular="0" shininess="0"/><mesh name="face" file="head.obj" inertia="shell"/>'
        '<texture name="floor" type="2d" builtin="checker" rgb1="0.55 0.52 0.48"'
        ' rgb2="0.50 0.47 0.43" width="64" height="64"/><material name="floor" texture="floor" texrepeat="30 30"/>'
        "</asset>"
    )
    inside = (
        '<light directional="true" castshadow="false" pos="0 0 4" dir="0.2 0.1 -1" diffuse="0.35 0.35 0.35"'
        ' specular="0 0 0"/>'
        f'<geom name="floor" type="plane" size="{_FIELD / 2} {_FIELD / 2} 1" material="floor" {_SEEN_ONLY}/>'
    )
    return before, inside


@cache
def assets() -> dict[str, bytes]:
    """Files that the model of a scene names."""
    folder = files(__package__).joinpath("assets")
    return {name: folder.joinpath(name).read_bytes() for name in _FACE}


def trunk_xml(name: str, x: float, y: float) -> str:
    """Trunk, shoulders, arms and neck: a body that turns as the person does."""
    return (
        f'<body name="{name}-trunk" mocap="true" pos="{x} {y} 0">'
        f'<geom name="{name}-body" type="ellipsoid" size="0.13 0.20 0.36" pos="0 0 1.10" rgba="{_SHIRT}"/>'
        f'<geom type="capsule" size="0.07" fromto="0 -0.15 1.36 0 0.15 1.36" rgba="{_SHIRT}" {_SEEN_ONLY}/>'
        f'<geom type="capsule" size="0.045" fromto="0 0.21 1.34 0.02 0.25 0.85" rgba="{_SHIRT}" {_SEEN_ONLY}/>'
        f'<geom type="capsule" size="0.045" fromto="0 -0.21 1.34 0.02 -0.25 0.85" rgba="{_SHIRT}" {_SEEN_ONLY}/>'
        f'<geom type="capsule" size="0.045" fromto="-0.02 0 1.38 -0.03 0 1.50" rgba="{_SKIN}" {_SEEN_ONLY}/></body>'
    )


def head_xml(name: str, x: float, y: float, *, face: bool) -> str:
    """A head: a body of which x is where the face points. ``face``: it is in a scene that a camera sees."""
    seen = f'<geom type="mesh" mesh="face" material="face" pos="0 0 {HEAD_HEIGHT}" {_SEEN_ONLY}/>' if face else ""
    return (
        f'<body name="{name}-head" mocap="true" pos="{x} {y} 0">'
        f'{seen}<geom type="ellipsoid" size="0.09 0.088 0.105" pos="-0.075 0 {HEAD_HEIGHT + 0.015}" rgba="{_HAIR}"'
        f" {_SEEN_ONLY}/></body>"
    )
