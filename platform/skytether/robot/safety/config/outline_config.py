"""The robot's outline in the section ``safety`` of robot.yaml: what people write, checked."""

from __future__ import annotations

from typing import Annotated

from pydantic import Field, model_validator

from ...config_base import Metres, Numbers
from ..geometry.footprint import Footprint, circle, polygon


class OutlineConfig(Numbers):
    """The robot with all that it carries, seen from above: a polygon or a circle about the origin."""

    polygon: Annotated[tuple[tuple[Metres, Metres], ...], Field(min_length=3, max_length=100)] | None = None
    """Corners (x forward, y left) in the base frame [m], in any order; of a dented outline the hull is taken."""
    radius: Annotated[float, Field(gt=0, le=100)] | None = None
    """[m]"""

    @model_validator(mode="after")
    def _is_one(self) -> OutlineConfig:
        if (self.polygon is None) == (self.radius is None):
            raise ValueError("give either polygon or radius")
        self.footprint()
        return self

    def footprint(self) -> Footprint:
        """The outline as geometry."""
        return polygon(self.polygon) if self.polygon is not None else circle(self.radius or 0.0)
