"""Trials of `follow_in_front` in a few numbers, beside those of the thesis (Mello, section 5.5.3)."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from types import MappingProxyType
from typing import Any

from .follow_in_front_result import FollowResult
from .trial import report
from .trial.report import Pair

FIGURES = (
    "start_s",
    "time_s",
    "distance_m",
    "mean_speed_m_s",
    "kte_m",
    "deviation_max_m",
    "following",
    "held_up_s",
    "rtt_ms",
    "up_mbit_s",
    "up_arrived_mbit_s",
    "down_mbit_s",
    "down_arrived_mbit_s",
    "robot_cpu",
    "robot_memory_mb",
    "service_cpu",
    "service_memory_mb",
)
"""Of each trial: fields of `FollowResult`."""
_NONE = float("nan")
THESIS: Mapping[str, Mapping[str, Pair]] = MappingProxyType(
    {
        "embedded": {
            "time_s": (60.12, 4.0),
            "mean_speed_m_s": (0.33, 0.74),
            "kte_m": (0.1217, 0.0007),
        },
        "edge": {
            "time_s": (51.22, 1.3),
            "mean_speed_m_s": (0.37, 0.76),
            "kte_m": (0.15404, 0.0029),
            "rtt_ms": (9.9, 10.1),
            "up_mbit_s": (4.64, _NONE),
            "up_arrived_mbit_s": (4.54, _NONE),
        },
        "commercial": {
            "time_s": (53.91, 5.7),
            "mean_speed_m_s": (0.33, 0.81),
            "kte_m": (0.16804, 0.0007),
            "rtt_ms": (124.1, 14.4),
            "up_mbit_s": (5.07, _NONE),
            "up_arrived_mbit_s": (4.95, _NONE),
        },
    }
)
"""By scenario, five trials each; throughputs are medians over the seconds of all of them. What is printed as deviation
of the speed is above its mean."""
THESIS_TRIALS = 5
DEVICES: Mapping[str, Sequence[tuple[str, Pair, Pair]]] = MappingProxyType(
    {
        "embedded": [("robot", (85.6, 6.2), (588, 12)), ("Raspberry Pi", (52.9, 4.7), (284, 28))],
        "edge": [("robot", (37.2, 3.8), (544, 8)), ("service", (40.3, 4.9), (2064, 48))],
        "commercial": [("robot", (38.6, 4.7), (534, 2)), ("service", (13.2, 2.6), (960, 384))],
    }
)
"""Table 3: of each device the processors in use [% of the device's], the memory in use [MB], of all that ran on it. In
the first part of the experiment the faces were found by a Raspberry Pi on the robot."""
IMAGE, SCAN, POSE, LASER = "usb_cam/image_raw/compressed", "scan", "RosAria/pose", "RosAria/laserscan"
SONAR = "RosAria/sonar"
DRAWN_TOPICS = ("cmd_vel", "tf", SONAR, POSE, SCAN, LASER, IMAGE)
"""Those of Table 2 in ascending size of their messages, as in Fig. 32."""
TIMED_TOPICS = ("cmd_vel", SCAN, IMAGE)
"""Those that matter for control, as in Fig. 33."""
LABELS: Mapping[str, str] = MappingProxyType({IMAGE: "image", SONAR: "sonar", POSE: "pose", LASER: "laserscan"})
"""Short names for figures."""
PERIODS_MS: Mapping[str, float] = MappingProxyType(
    {"tf": 10.0, IMAGE: 66.0, SCAN: 100.0, POSE: 100.0, LASER: 120.0, SONAR: 100.0, "cmd_vel": 100.0}
)
"""Table 2: of the messages as they are sent."""


def summary(results: Sequence[FollowResult]) -> list[dict[str, Any]]:
    """Each scenario in one row, with `FIGURES`; see `skytether.lab.trial.report.summary`."""
    return report.summary(results, FIGURES)


def topics(results: Sequence[FollowResult], names: Sequence[str] = DRAWN_TOPICS) -> list[dict[str, Any]]:
    """Each topic of each scenario in one row; see `skytether.lab.trial.report.topics`."""
    return report.topics(results, names, ideal_ms)


def ideal_ms(_: str, topic: str) -> float | None:
    """The period with which messages are sent, in any scenario."""
    return PERIODS_MS.get(topic)
