"""Settings that cannot work are refused with their name and their range."""

from dataclasses import fields

import pytest

from skytether.wire import Config


@pytest.mark.parametrize("value", [-1, float("nan"), float("inf")])
@pytest.mark.parametrize("name", [field.name for field in fields(Config)])
def test_every_setting_has_a_range_that_is_told(name, value):
    with pytest.raises(ValueError, match=rf"^{name} (must|should) be (above )?\d|^{name} must be at least") as refused:
        Config(**{name: value})
    assert str(refused.value) != name


@pytest.mark.parametrize(
    ("options", "says"),
    [
        ({"mtu": 100}, "mtu must be 512 to 65507 bytes, not 100"),
        ({"max_mtu": 70_000}, "max_mtu must be 512 to 65507 bytes"),
        ({"burst": 1000}, "burst must be at least mtu and max_mtu"),
        ({"max_message": 0}, "max_message must be 1 to"),
        ({"max_message": 30 * 2**20}, "reassembly_limit must be at least"),
        ({"queue_limit": 1000}, "queue_limit must be at least max_message"),
        ({"rate_bps": 0}, "rate_bps must be above 0"),
        ({"assumed_loss": 1}, "assumed_loss must be 0 to below 0.9, not 1"),
        ({"max_copies": 0}, "max_copies must be 1 to 100, not 0"),
        ({"copy_spacing": -0.1}, "copy_spacing must be 0 or more"),
    ],
)
def test_refused(options, says):
    with pytest.raises(ValueError, match=says):
        Config(**options)


def test_the_defaults_work():
    assert Config().mtu == 1200
