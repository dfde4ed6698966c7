"""A camera's picture: from a message's bytes to pixels, or why not."""

from __future__ import annotations

import io

import numpy as np
from numpy.typing import NDArray
from PIL import Image, UnidentifiedImageError

from .picture_parts import pixels_only

Picture = NDArray[np.uint8]
"""height x width x 3, red, green, blue."""

_LARGEST = 4_000_000
"""Pixels: what claims more is no camera of a robot, and would take the memory of whoever decodes it."""
_LEAST = 64
"""Pixels of the shorter side: a smaller one shows no face."""
_BLACK = 12
"""Mean brightness below which nothing is to be seen: a lens that is covered, of 255."""


class PictureError(Exception):
    """These bytes are no picture that shows anything; the text says why."""


def decode(data: bytes) -> Picture:
    """JPEG or PNG, whichever it is.

    Raises:
        PictureError: It is broken, too large or too small, or black.
    """
    try:
        with Image.open(io.BytesIO(pixels_only(data)), formats=("JPEG", "PNG")) as image:
            width, height = image.size
            if width * height > _LARGEST:
                raise PictureError(f"the picture has {width} x {height} pixels, more than {_LARGEST} in all")
            if min(width, height) < _LEAST:
                raise PictureError(f"the picture has {width} x {height} pixels: too few to show a face")
            picture = np.asarray(image.convert("RGB"))
    except PictureError:
        raise
    except UnidentifiedImageError:
        raise PictureError("the picture is broken: its header cannot be read") from None
    except Exception as error:  # Pillow lets errors of every kind through where bytes are broken
        raise PictureError(f"the picture is broken: {error}") from error
    if picture[::8, ::8].mean() < _BLACK:
        raise PictureError("the picture is black: is the lens covered?")
    return picture
