"""Low-pass filter for the forearm forces (thesis section 2.5.1: "filtered to remove high-frequency noise")."""

from __future__ import annotations

import math


class LowPass:
    """First order, unit gain; the first value passes as it is, so that a restart makes no transient."""

    def __init__(self, cutoff: float) -> None:
        """Cut-off frequency, at -3 dB [Hz]."""
        self._time_constant = 1 / (math.tau * cutoff)
        self.value: float | None = None

    def step(self, value: float, dt: float) -> float:
        """Filter one sample that stands for the last dt seconds."""
        # Exact for an input that is constant over the step, so the cut-off holds at any rate of samples.
        if self.value is None:
            self.value = value
        self.value += (value - self.value) * -math.expm1(-dt / self._time_constant)
        return self.value

    def reset(self) -> None:
        """Forget the past."""
        self.value = None
