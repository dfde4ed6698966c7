"""Numba, with the settings that all inner loops of this service share."""

from __future__ import annotations

from collections.abc import Callable
from typing import TypeVar, cast

import numba

_F = TypeVar("_F", bound=Callable[..., object])


def compiled(function: _F) -> _F:
    """Machine code for a function of numbers and arrays; kept on disk (``NUMBA_CACHE_DIR``), so made once.

    It lets other threads run meanwhile, and divides by zero as NumPy does.
    """
    return cast(_F, numba.njit(cache=True, nogil=True, error_model="numpy")(function))
