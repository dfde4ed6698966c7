"""The hand-over of the thesis, section 3.5, with real sockets."""

import pytest

from skytether.lab.handover import VARIANTS, handover


@pytest.mark.slow
@pytest.mark.parametrize("variant", VARIANTS)
def test_nothing_is_lost_when_the_network_changes(variant):
    rows = handover(variant, seconds=1.6, at=0.8)
    assert [row.direction for row in rows] == ["robot to service", "service to robot"]
    for row in rows:
        assert row.sent == 160
        assert row.lost == 0
        # Far less than a second without a path; how much less is shown by the scenario on a quiet machine.
        assert row.gap_max_ms < 500


@pytest.mark.parametrize(
    ("options", "says"), [({"variant": "wild"}, "planned"), ({"variant": "planned", "at": 30}, "within")]
)
def test_what_cannot_be_done_is_refused(options, says):
    with pytest.raises(ValueError, match=says):
        handover(**options)
