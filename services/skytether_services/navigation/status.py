"""What the service says of itself: a state, a code that programs can rely on, and a sentence for people."""

from __future__ import annotations

from dataclasses import dataclass
from enum import StrEnum


class State(StrEnum):
    """What the robot does."""

    WAITING = "waiting"
    """It stands, and has no goal."""
    DRIVING = "driving"
    """It is on its way, or recovers from what stopped it."""
    STANDING = "standing"
    """It has a goal, stands for the reason that the code names, and goes on by itself once that is over."""
    PAUSED = "paused"
    """It was told to wait."""
    SUCCEEDED = "succeeded"
    """The last goal was reached."""
    FAILED = "failed"
    """The goals were given up, for the reason that the code names."""
    CANCELED = "canceled"
    """The goals were called off."""
    MAPPING = "mapping"
    """A map is built; somebody else drives."""


class Code(StrEnum):
    """Why."""

    OK = "ok"
    NO_MAP = "no_map"
    MAP_BROKEN = "map_broken"
    NO_SCAN = "no_scan"
    SCAN_USELESS = "scan_useless"
    NO_LASER_POSE = "no_laser_pose"
    NO_ODOMETRY = "no_odometry"
    ODOMETRY_JUMPED = "odometry_jumped"
    NO_POSE = "no_pose"
    LOST = "lost"
    NO_GOALS = "no_goals"
    BAD_GOAL = "bad_goal"
    GOAL_OFF_MAP = "goal_off_map"
    GOAL_BLOCKED = "goal_blocked"
    START_OFF_MAP = "start_off_map"
    START_BLOCKED = "start_blocked"
    NO_PATH = "no_path"
    NOT_FINITE = "not_finite"
    BLOCKED = "blocked"
    STUCK = "stuck"
    GAVE_UP = "gave_up"
    MAPPING_FAILED = "mapping_failed"
    NOT_SAVED = "not_saved"


@dataclass(frozen=True, slots=True)
class Trouble:
    """Why the robot stands, or why goals were given up.

    Attributes:
        code: For programs.
        message: A sentence for people.
    """

    code: Code | str
    message: str
