"""Settings that cannot work are refused with their name."""

import pytest

from skytether.wire import Config


@pytest.mark.parametrize(
    ("options", "word"),
    [
        ({"mtu": 100}, "mtu"),
        ({"mtu": 70_000}, "mtu"),
        ({"burst": 1000}, "burst"),
        ({"max_message": 0}, "max_message"),
        ({"max_message": 30 * 2**20}, "reassembly_limit"),
        ({"queue_limit": 1000}, "queue_limit"),
        ({"rate_bps": 0}, "rate_bps"),
        ({"silence": -1}, "silence"),
        ({"hello_retry": float("nan")}, "hello_retry"),
        ({"assumed_loss": 1}, "assumed_loss"),
        ({"max_copies": 0}, "max_copies"),
    ],
)
def test_refused(options, word):
    with pytest.raises(ValueError, match=word):
        Config(**options)


def test_the_defaults_work():
    assert Config().mtu == 1200
