"""Health checks that an engine bears. Pure."""

from __future__ import annotations

from typing import Any

_COMMANDS = ("CMD", "CMD-SHELL")


def is_borne(test: Any) -> bool:
    """Whether an engine bears a container whose health check this is.

    Of ``["CMD"]`` it takes a first word that is not there: it ends, and all its containers with it. What no engine that
    we know has a meaning for is not said to be borne either.

    Args:
        test: The engine's ``Test``, of an image or of what a container is made of.
    """
    if test is None or test in ([], ["NONE"]):
        return True
    words = isinstance(test, list) and all(isinstance(word, str) for word in test)
    return words and test[0] in _COMMANDS and any(test[1:2])
