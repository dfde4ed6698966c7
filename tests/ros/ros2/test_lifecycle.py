"""States of lifecycle nodes, as bytes."""

import pytest

from skytether.ros.ros2.lifecycle import label_of


@pytest.mark.parametrize(
    ("response", "label"),
    [
        (b"\0\1\0\0\3\0\0\0\7\0\0\0active\0", "active"),
        (b"\0\0\0\0\2\0\0\0\0\0\0\11inactive\0\0\0\0", "inactive"),
        (b"\0\1\0\0\3", ""),
        (b"", ""),
    ],
)
def test_the_label_of_a_state(response, label):
    assert label_of(response) == label
