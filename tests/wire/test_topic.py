"""Rows of the topic table: what no endpoint could honour is refused, with the field and its range."""

import pytest

from skytether.wire.topic import Direction, Role, Topic


@pytest.mark.parametrize(
    ("field", "value", "says"),
    [
        ("name", "", "name must have 1 to 255 characters"),
        ("name", "n" * 256, "name must have 1 to 255 characters"),
        ("priority", 128, "priority must be 0 to 127, not 128"),
        ("priority", -1, "priority must be 0 to 127, not -1"),
        ("period", 0.0, "period must be above 0 and below 3600 s"),
        ("lifespan", 0.0, "lifespan must be above 0 and at most 3600 s"),
        ("lifespan", float("nan"), "lifespan must be above 0 and at most 3600 s"),
        ("depth", 0, "depth must be 1 to 10000, not 0"),
        ("delivery", 1.0, "delivery must be between 0 and 1, not 1.0"),
        ("latched", True, "latched needs reliable"),
        ("compression", "gzip", "compression must be 'zstd' or empty, not 'gzip'"),
    ],
)
def test_what_no_endpoint_could_honour_is_refused(field, value, says):
    row = {"name": "scan", "type": "sensor_msgs/msg/LaserScan", "direction": Direction.IN, field: value}
    with pytest.raises(ValueError, match="topic") as refused:
        Topic(**row)
    assert says in str(refused.value)


def test_who_sends_follows_from_the_direction_as_the_service_sees_it():
    assert (Direction.IN.sender, Direction.OUT.sender) == (Role.ROBOT, Role.SERVICE)
