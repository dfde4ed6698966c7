"""Health checks that an engine bears."""

from __future__ import annotations

from typing import Any

import pytest

from skytether.api.health_check import is_borne


@pytest.mark.parametrize(
    ("test", "good"),
    [
        (None, True),
        ([], True),
        (["NONE"], True),
        (["CMD", "true"], True),
        (["CMD", "echo", ""], True),
        (["CMD-SHELL", "curl a || exit 1"], True),
        (["CMD"], False),
        (["CMD-SHELL"], False),
        (["CMD", ""], False),
        ([""], False),
        (["NONE", "true"], False),
        (["cmd", "true"], False),
        (["true"], False),
        (["CMD", 1], False),
        (["CMD", ["true"]], False),
        ("CMD", False),
        ({"CMD": "true"}, False),
        (0, False),
    ],
)
def test_a_health_check_has_a_command_or_none_is_wanted(test: Any, good: bool) -> None:
    """An engine looks for the first word of one where there is none, and ends."""
    assert is_borne(test) is good
