"""What goes over the socket between agent and node."""

import io

from hypothesis import given
from hypothesis import strategies as st

from skytether.ros.ros2.native.side.frames import (
    HEAD,
    MAX_BODY,
    Frame,
    Kind,
    control,
    numbered,
    pull_frame,
    pull_number,
    push_head,
)

FRAMES = st.builds(Frame, st.sampled_from(Kind), st.integers(0, 2**32 - 1), st.binary(max_size=100))


@given(st.lists(FRAMES, max_size=5), st.integers(0, 8))
def test_frames_come_as_they_went_and_half_a_frame_is_the_end(frames, cut):
    data = b"".join(push_head(frame) + frame.body for frame in frames)
    stream = io.BytesIO(data)
    assert [pull_frame(stream) for _ in frames] == frames
    assert pull_frame(stream) is None
    if frames:
        stream = io.BytesIO(data[: len(data) - 1 - cut])
        assert [f for f in (pull_frame(stream) for _ in frames) if f is not None] == frames[: len(frames) - 1] or cut


@given(st.binary(max_size=40))
def test_bytes_that_are_no_frame_raise_nothing(data):
    assert pull_frame(io.BytesIO(data)) is None or len(data) >= HEAD.size


def test_a_frame_that_is_too_large_is_not_waited_for():
    assert pull_frame(io.BytesIO(HEAD.pack(MAX_BODY + 1, Kind.DATA, 1))) is None


def test_a_call_has_its_number():
    frame = numbered(Kind.REQUEST, 7, 2**40, b"asked")
    assert (frame.channel, pull_number(frame.body)) == (7, (2**40, b"asked"))
    assert control(do="close", channel=3) == Frame(Kind.CONTROL, 0, b'{"do": "close", "channel": 3}')
