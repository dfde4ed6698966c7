"""What all parts of the section ``safety`` are made of."""

from __future__ import annotations

from typing import Annotated

from pydantic import ConfigDict, Field

from skytether.api.manifest import Strict

Metres = Annotated[float, Field(ge=-100, le=100)]
Topic = Annotated[str, Field(min_length=1, max_length=255)]


class Numbers(Strict):
    """Unknown keys, and numbers that are none, are refused; what was read does not change."""

    model_config = ConfigDict(extra="forbid", frozen=True, validate_default=True, allow_inf_nan=False)
