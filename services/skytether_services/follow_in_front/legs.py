"""Which clusters look like legs: bounds on their shape, taken from bodies, not fitted to a recording."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from .clusters import Clusters

_WIDTH = (0.03, 0.22)
"""Of one leg as a laser sees it, from an ankle of which three rays hit the front to wide trousers, m."""
_GIRTH = 0.30
"""Along one leg's surface at the most, m: half of what a tape goes round wide trousers."""
_HOLLOW = -0.004
"""A leg is round towards the laser; so much of a hollow may be noise, m."""
_ROUGH = 0.02
"""Points of a leg lie this near to a circle, root mean square, m: the noise of a usual laser."""
_BOTH = 0.50
"""Width of both legs at the most when they touch, m."""


def leg_like(clusters: Clusters) -> NDArray[np.bool_]:
    """Which clusters may be one leg: narrow, round, and with one end free at least."""
    widths = clusters.widths
    narrow = (widths >= _WIDTH[0]) & (widths <= _WIDTH[1]) & (clusters.girths <= _GIRTH)
    round_ = (clusters.bulges >= _HOLLOW) & (clusters.roundness <= _ROUGH)
    shape: NDArray[np.bool_] = narrow & round_ & ~clusters.hidden.all(axis=1)
    return shape


def both_legs(clusters: Clusters) -> NDArray[np.bool_]:
    """Which clusters may be two legs that touch: too wide for one, and both ends free.

    A person walks on with such a one, but none is found by it: a chair's seat is as wide.
    """
    wide: NDArray[np.bool_] = (clusters.widths > _WIDTH[1]) & (clusters.widths <= _BOTH)
    return wide & ~clusters.hidden.any(axis=1)
