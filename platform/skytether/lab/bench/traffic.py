"""What is sent in a measurement: topics with their size, rate and quality of service. Names units once."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from skytether.wire.topic import Direction

from .ros2_program.schedule import HEADER

KB = 1024


@dataclass(frozen=True, slots=True)
class Flow:
    """One topic of a measurement. Every transport is told the same.

    Attributes:
        name: Topic name.
        size: Payload in bytes.
        hz: Messages a second.
        direction: ``in`` is from robot to service.
        rank: Importance, 1 is the highest (as in Table 2 of the thesis).
        depth: Messages that may wait at the sender before the oldest is dropped.
        delivery: Share of messages that should arrive; for transports that can be told.
        lifespan: Seconds after which a message that still waits is of no use; likewise.
    """

    name: str
    size: int
    hz: float
    direction: Direction = Direction.IN
    rank: int = 1
    depth: int = 10
    delivery: float = 0.9995
    lifespan: float = 0.2

    def __post_init__(self) -> None:
        """Refuse what cannot be measured.

        Raises:
            ValueError: The payload has no room for sequence number and time.
        """
        if self.size < HEADER.size:
            raise ValueError(f"{self.name}: a message needs at least {HEADER.size} bytes, not {self.size}")


CAMERA = Flow("camera", 47_611, 1 / 0.066, rank=2, depth=1, delivery=0.998)

TABLE2 = (
    Flow("/tf", 180, 100.0, rank=1),
    CAMERA,
    Flow("/scan", 2_222, 10.0, rank=3),
    Flow("/RosAria/pose", 745, 10.0, rank=4),
    Flow("/RosAria/laserscan", 2_284, 1 / 0.12, rank=5),
    Flow("/RosAria/sonar", 269, 10.0, rank=6),
    Flow("/cmd_vel", 80, 10.0, Direction.OUT, rank=1),
)
"""Mello, thesis, Table 2, with its sizes, periods and priorities."""

TABLE4 = (
    Flow("/tf", 172, 100.0, rank=1),
    Flow("/RosAria/pose", 745, 10.0, rank=2),
    Flow("/RosAria/laserscan", 2_284, 1 / 0.12, rank=3),
    Flow("/cmd_vel", 80, 1 / 0.033, Direction.OUT, rank=1),
)
"""Mello, thesis, Table 4, with its periods and priorities; of /tf's 125 to 220 bytes the middle."""


def camera_last(flows: tuple[Flow, ...]) -> tuple[Flow, ...]:
    """The same traffic with the camera ranked below everything else."""
    last = max(f.rank for f in flows) + 1
    return tuple(replace(f, rank=last) if f.name == CAMERA.name else f for f in flows)


SIZES_KB = tuple(float(s) for s in np.linspace(1, 16, 7))
"""Thesis, figure 26: 1, 3.5, ... 16 kB."""
RATES_HZ = tuple(float(r) for r in np.linspace(10, 200, 7))
"""Thesis, figure 26: 10 to 200 messages a second, over all topics."""
FRAME_KB = 64.0
FRAME_RATES_HZ = (15.0, 30.0, 60.0)


def fig26(topics: int, size_kb: float, hz: float) -> tuple[Flow, ...]:
    """One cell of figure 26: the rate is divided among the topics (thesis, section 4.3.4).

    The queues hold what a publisher that was stalled for half a second sends at once: that is not the transport's loss.
    """
    return tuple(
        Flow(f"flow{i + 1}", int(size_kb * KB), hz / topics, rank=i + 1, depth=100, lifespan=1.0) for i in range(topics)
    )


def stream(size: int, hz: float) -> tuple[Flow, ...]:
    """One topic of which no message may be dropped for want of room in a queue."""
    return (Flow("stream", size, hz, depth=10_000, lifespan=10.0),)


COMMANDS = (
    Flow("/cmd_vel", 80, 50.0, Direction.OUT),
    Flow("/teleop/cmd_vel", 80, 50.0),
)
"""Velocity commands both ways: the second shares the camera's direction."""
LATENCY = (
    Flow("80 B", 80, 200.0),
    Flow("2,222 B", 2_222, 50.0, rank=2),
    Flow("47,611 B", 47_611, 5.0, rank=3),
)
