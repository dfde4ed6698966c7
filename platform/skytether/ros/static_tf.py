"""/tf_static as one latched message: transforms of all publishers, the newest of each child frame. Pure."""

from __future__ import annotations

from skytether.messages import DecodeError, Encoding, TFMessage, TransformStamped, decode, encode

TOPIC = "/tf_static"
MAX_FRAMES = 4096
"""Child frames that are kept; a robot has some ten."""


class StaticTransforms:
    """In ROS each publisher latches its own part; a latched topic of the bridge keeps one message: it must hold all."""

    def __init__(self, encoding: Encoding) -> None:
        self._encoding = encoding
        self._frames: dict[str, TransformStamped] = {}

    def merge(self, payload: bytes) -> bytes:
        """Take in a message; gives the one that holds everything so far. Bytes that are none pass as they are."""
        try:
            message = decode(TFMessage, payload, self._encoding)
        except DecodeError:
            return payload
        for transform in message.transforms:
            if transform.child_frame_id in self._frames or len(self._frames) < MAX_FRAMES:
                self._frames[transform.child_frame_id] = transform
        return encode(TFMessage(list(self._frames.values())), self._encoding)
