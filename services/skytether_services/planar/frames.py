"""Coordinate frames as `tf` tells of them, in the plane: who is where on whom."""

from __future__ import annotations

import math
from dataclasses import dataclass

from skytether.messages import TFMessage, TransformStamped, yaw_of

from .geometry import Pose
from .transforms import compose

MAX_FRAMES = 500
"""Of one robot; what comes beyond is left out."""
MOST_BYTES = 200_000
"""Of a message of `tf`: 2,000 frames, which take 30 ms to read. A service takes no larger ones."""
_DEEPEST = 20
"""Frames between two that are asked for; more, or a circle, is no answer."""


@dataclass(frozen=True, slots=True)
class _Link:
    parent: str
    pose: Pose
    stamp: float


class Frames:
    """The newest transform of each frame."""

    def __init__(self) -> None:
        self._links: dict[str, _Link] = {}

    def set_transforms(self, message: TFMessage) -> None:
        """Keep transforms, as tf2's Buffer does; what is not finite is left out."""
        for transform in message.transforms:
            pose = pose_of(transform)
            child = bare(transform.child_frame_id)
            if all(math.isfinite(value) for value in pose) and (child in self._links or len(self._links) < MAX_FRAMES):
                self._links[child] = _Link(bare(transform.header.frame_id), pose, transform.header.stamp.seconds())

    def lookup(self, parent: str, child: str) -> tuple[Pose, float] | None:
        """Pose of a frame in one above it, and the newest stamp on the way [s]; None: no transforms lead there."""
        parent, frame = bare(parent), bare(child)
        pose, stamp = Pose(0.0, 0.0, 0.0), -math.inf
        for _ in range(_DEEPEST):
            if frame == parent:
                return pose, stamp
            link = self._links.get(frame)
            if link is None:
                return None
            pose, stamp, frame = compose(link.pose, pose), max(stamp, link.stamp), link.parent
        return None


def pose_of(transform: TransformStamped) -> Pose:
    """A transform in the plane."""
    at = transform.transform.translation
    return Pose(at.x, at.y, yaw_of(transform.transform.rotation))


def bare(frame: str) -> str:
    """The name without the slash that ROS 1 may begin it with."""
    return frame.removeprefix("/")
