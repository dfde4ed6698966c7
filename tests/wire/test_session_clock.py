"""Clocks of two ends that differ and drift: what a session says of times holds within the error that it states."""

import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st

from skytether.emulator.link_model import LinkConditions
from skytether.wire import Role
from skytether.wire.measure.clock import MAX_DRIFT

ROBOT, SERVICE = Role.ROBOT, Role.SERVICE
MICRO = 2e-6
"""Time stamps travel as whole microseconds."""


@given(
    offset=st.floats(0, 1e6),
    drift=st.floats(-MAX_DRIFT / 2, MAX_DRIFT / 2),
    up=st.floats(0, 0.2),
    down=st.floats(0, 0.2),
    jitter=st.floats(0, 0.05),
    loss=st.sampled_from([0.0, 0.1]),
    seed=st.integers(0, 1000),
)
@settings(max_examples=15)
@example(
    offset=0.0, drift=-4.406879510045998e-05, up=0.125, down=0.0, jitter=0.048828125, loss=0.0, seed=26
)  # drift during the delay counts
@example(
    offset=0.0, drift=-3.911481891887072e-05, up=0.2, down=0.0, jitter=0.0, loss=0.0, seed=0
)  # so does what is not known of when it was sent
def test_every_message_at_both_ends(make_world, offset, drift, up, down, jitter, loss, seed):
    link = make_world(seed).link(
        connect=False,
        service_clock=(offset, drift),
        up=LinkConditions(delay=up, jitter=jitter, loss=loss, seed=seed),
        down=LinkConditions(delay=down, jitter=jitter, loss=loss, seed=seed + 1),
    )
    published = {ROBOT: {}, SERVICE: {}}

    def publish(role, topic):
        number = len(published[role]).to_bytes(4, "big")
        published[role][number] = link.now
        link.publish(role, topic, number)

    link.every(0.05, 1.5, lambda: publish(ROBOT, "log"))
    link.every(0.05, 1.5, lambda: publish(SERVICE, "map"))
    link.run(2.0)
    for role, sender in ((SERVICE, ROBOT), (ROBOT, SERVICE)):
        known = [m for _, m in link.messages[role] if m.sent_at_error < float("inf")]
        assert known or loss
        for message in known:
            when = published[sender][bytes(message.payload)]
            truth = when if role is ROBOT else link.service_time(when)
            assert abs(message.sent_at - truth) <= message.sent_at_error + MICRO
        stats = link.sessions[role].stats(link.time_of(role))
        if known:  # never worse than the worst exchange: half of both delays at their longest
            assert stats.clock_error <= (up + down) / 2 + 10 * jitter + 0.01


@pytest.mark.slow
@pytest.mark.parametrize("drift", [-MAX_DRIFT, MAX_DRIFT])
def test_minutes_of_drift_is_followed(world, drift):
    link = world.link(service_clock=(50.0, drift), up=LinkConditions(delay=0.03), down=LinkConditions(delay=0.01))
    for _ in range(4):
        link.run(15.0)
        for role in Role:
            stats = link.sessions[role].stats(link.time_of(role))
            truth = link.service_time(link.now) - link.now
            assert abs(stats.clock_offset - (truth if role is ROBOT else -truth)) <= stats.clock_error + MICRO
            assert stats.clock_error <= 0.021 + 2 * MAX_DRIFT
    assert abs(truth - 50.0) > 0.005
