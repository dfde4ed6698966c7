"""For programs under libfaketime, which takes a sleep whose end is over already, on a busy machine, for a mistake."""

import contextlib
import time
from typing import SupportsIndex

_sleep = time.sleep


def _sleep_or_go_on(seconds: float | SupportsIndex) -> None:
    with contextlib.suppress(OSError):
        _sleep(seconds)


time.sleep = _sleep_or_go_on
