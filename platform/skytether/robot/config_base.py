"""What the sections of robot.yaml on gate and graph are made of."""

from __future__ import annotations

from typing import Annotated, Any

from pydantic import ConfigDict, Field, ValidationInfo, field_validator

from skytether.api.manifest import Strict

Metres = Annotated[float, Field(ge=-100, le=100)]
Topic = Annotated[str, Field(min_length=1, max_length=255)]
_NO_SWITCH = "is neither yes nor no"


class Numbers(Strict):
    """Unknown keys, and numbers that are none, are refused; what was read does not change."""

    model_config = ConfigDict(extra="forbid", frozen=True, validate_default=True, allow_inf_nan=False)

    @field_validator("*", mode="before")
    @classmethod
    def _yes_is_no_number(cls, value: Any, info: ValidationInfo) -> Any:
        if isinstance(value, bool) and cls.model_fields[info.field_name or ""].annotation not in (bool, bool | None):
            raise ValueError(_NO_SWITCH)
        return value


def no_switches(numbers: Any) -> Any:
    """Refuse true and false among numbers: they would be taken for 1 and 0.

    Raises:
        ValueError: There is one; the text names its key.
    """
    for key, value in numbers.items() if isinstance(numbers, dict) else ():
        if isinstance(value, bool):
            raise ValueError(f"{key}: {_NO_SWITCH}")
    return numbers
