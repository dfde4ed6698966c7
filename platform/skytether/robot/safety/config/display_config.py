"""The part ``display`` of the section ``safety``: what people write, checked."""

from __future__ import annotations

from typing import Annotated

from pydantic import Field

from ...config_base import Numbers, Topic


class DisplayConfig(Numbers):
    """What the gate knows, for RViz and Foxglove: visualization_msgs/MarkerArray on the robot's graph."""

    topic: Topic = "gate_display"
    """Nobody else may publish it."""
    rate_hz: Annotated[float, Field(gt=0, le=50)] = 5.0
    """How often."""
    frame: Annotated[str, Field(pattern=r"^[^\s/][^\s]{0,199}$")] = "base_link"
    """The base frame, in which outline and sensors are configured."""
