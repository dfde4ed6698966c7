from dataclasses import replace
from itertools import pairwise
from math import inf, isfinite, nan

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from skytether.api.manifest import Needs
from skytether.robot.offload.task_manager import (
    OWN_CONTROLLER,
    Mode,
    PathQuality,
    Policy,
    RobotView,
    SiteView,
    Window,
    decide,
    start,
    weigh,
)

NEEDS = Needs(cpu=1, max_rtt_ms=100, max_loss=0.1)
POLICY = Policy()
ROBOT = RobotView(load=0.2, cores=4)
EDGE = SiteView("edge", "edge", PathQuality(0.01, 0.002, 0.0))
CLOUD = SiteView("cloud", "cloud", PathQuality(0.05, 0.005, 0.0))


def costs(sites, robot=ROBOT, needs=NEEDS, policy=POLICY):
    return {option.name: option for option in weigh(policy, needs, sites, robot)}


def test_costs_are_those_of_the_model():
    robot = RobotView(load=0.2, cores=4, battery=0.4)
    found = costs([EDGE, SiteView("cloud", "cloud", PathQuality(0.05, 0.01, 0.02))], robot)
    # 1.0 * (10 + 2 * 2) / 100; 0.5 * (1 - 0.4) * 0.3
    assert found["edge"].parts == pytest.approx({"delay": 0.14, "loss": 0.0, "energy": 0.09})
    # 1.0 * (50 + 2 * 10) / 100; 1.0 * 0.02 / 0.1
    assert found["cloud"].parts == pytest.approx({"delay": 0.7, "loss": 0.2, "energy": 0.09})
    # 2; 0.5 * (0.2 + 0.1 / 4); 0.5 * 0.6 * 0.225
    assert found[OWN_CONTROLLER].parts == pytest.approx({"service": 2.0, "processor": 0.1125, "energy": 0.0675})
    onboard = costs([SiteView("me", "robot", PathQuality(0.001, 0.0, 0.0))], robot)["me"]
    assert onboard.parts["processor"] == pytest.approx(0.5 * (0.2 + 1 / 4))


def test_energy_costs_nothing_on_mains_or_without_a_battery():
    for robot in (ROBOT, replace(ROBOT, battery=0.1, plugged=True), replace(ROBOT, battery=nan)):
        assert costs([EDGE], robot)["edge"].parts["energy"] == 0.0


@pytest.mark.parametrize(
    ("site", "robot", "why"),
    [
        (replace(CLOUD, quality=PathQuality(0.3, 0, 0)), ROBOT, "round trip 300 ms, at most 100 ms"),
        (replace(CLOUD, quality=PathQuality(0.05, 0, 0.2)), ROBOT, "loses 20%, at most 10%"),
        (replace(CLOUD, quality=PathQuality(loss=1.0)), ROBOT, "answers no probe"),
        (replace(CLOUD, unreachable="the engine is down"), ROBOT, "the engine is down"),
        (SiteView("me", "robot"), RobotView(0.9, 4), "the robot's processors are 90% busy, and it needs 1 of 4"),
    ],
)
def test_what_cannot_be_is_ruled_out_with_its_number(site, robot, why):
    option = costs([site], robot)[site.name]
    assert option.refused == why
    assert option.cost == inf


def test_tiers_and_a_fallback_that_only_stops_are_ruled_out():
    found = costs([EDGE], replace(ROBOT, drives=False), Needs(tiers=("cloud",)))
    assert found["edge"].refused == "is of tier edge, needed is cloud"
    assert found[OWN_CONTROLLER].refused == "the fallback only stops"


def test_before_anything_is_measured_the_orchestrator_chooses():
    first = start(POLICY, 0.0)
    assert (first.offload, first.site) == (True, None)
    unmeasured = decide(POLICY, first, NEEDS, [SiteView("edge", "edge")], ROBOT, 1.0)
    assert (unmeasured.offload, unmeasured.site, unmeasured.since) == (True, None, 0.0)
    known = decide(POLICY, first, NEEDS, [EDGE, CLOUD], ROBOT, 2.0)
    assert (known.offload, known.site, known.since) == (True, "edge", 2.0)
    assert known.why == (
        "offload: edge 0.14 (delay 0.14, loss 0.00, energy 0.00); "
        "cloud 0.60 (delay 0.60, loss 0.00, energy 0.00); "
        "own controller 2.11 (service 2.00, processor 0.11, energy 0.00)"
    )


def run(decision, sites, began, seconds, policy=POLICY, robot=ROBOT):
    for i in range(round(seconds) + 1):
        decision = decide(policy, decision, NEEDS, sites, robot, began + i)
    return decision


def test_a_choice_is_left_only_for_one_that_has_been_cheaper_for_long_enough():
    at_cloud = decide(POLICY, start(POLICY, 0.0), NEEDS, [CLOUD], ROBOT, 0.0)
    assert at_cloud.site == "cloud"
    both = [EDGE, CLOUD]
    waiting = run(at_cloud, both, 1.0, 9)
    assert waiting.site == "cloud"
    assert waiting.challenger[0].site == "edge"
    blip = decide(POLICY, waiting, NEEDS, [replace(EDGE, quality=PathQuality(0.09, 0, 0)), CLOUD], ROBOT, 10.5)
    assert blip.challenger is None
    assert run(blip, both, 11.0, 9).site == "cloud", "the spell began anew"
    moved = run(blip, both, 11.0, 10)
    assert moved.site == "edge"
    assert moved.why.endswith("; against cloud 0.60 (delay 0.60, loss 0.00, energy 0.00)")


def test_a_little_cheaper_is_not_worth_a_change():
    at_cloud = decide(POLICY, start(POLICY, 0.0), NEEDS, [CLOUD], ROBOT, 0.0)
    near = replace(EDGE, quality=PathQuality(0.04, 0.005, 0.0))
    assert run(at_cloud, [near, CLOUD], 1.0, 100).site == "cloud"


def test_a_choice_that_is_ruled_out_is_left_soon_and_with_nowhere_to_go_kept():
    at_edge = decide(POLICY, start(POLICY, 0.0), NEEDS, [EDGE, CLOUD], ROBOT, 0.0)
    down = replace(EDGE, unreachable="the engine is down")
    assert run(at_edge, [down, CLOUD], 1.0, 2).site == "edge"
    moved = run(at_edge, [down, CLOUD], 1.0, 3)
    assert (moved.site, moved.offload) == ("cloud", True)
    assert moved.why.endswith("; edge: the engine is down")
    home = run(at_edge, [down, replace(CLOUD, unreachable="down too")], 1.0, 3)
    assert (home.site, home.offload) == (None, False)
    stuck = run(at_edge, [down], 1.0, 100, robot=replace(ROBOT, drives=False))
    assert (stuck.site, stuck.offload) == ("edge", True)


def test_from_local_it_goes_back_when_a_site_is_good_again():
    local = replace(start(POLICY, 0.0), offload=False)
    assert run(local, [EDGE], 0.0, 9).offload is False
    assert run(local, [EDGE], 0.0, 10).site == "edge"


def test_a_site_called_local_is_not_taken_for_the_robot_s_own_controller():
    names = [option.name for option in weigh(POLICY, NEEDS, [SiteView("local", "edge")], ROBOT)]
    assert names == ["local", OWN_CONTROLLER]


def test_modes_decide_for_the_costs():
    local = Policy(mode=Mode.LOCAL)
    assert run(start(local, 0.0), [EDGE], 0.0, 100, local).offload is False
    offload = Policy(mode=Mode.OFFLOAD)
    assert OWN_CONTROLLER not in costs([EDGE], policy=offload)
    assert run(start(offload, 0.0), [], 0.0, 100, offload).offload is True


def test_a_clock_that_jumps_back_neither_hastens_nor_blocks_a_change():
    at_cloud = decide(POLICY, start(POLICY, 0.0), NEEDS, [CLOUD], ROBOT, 1000.0)
    waiting = decide(POLICY, at_cloud, NEEDS, [EDGE, CLOUD], ROBOT, 1001.0)
    back = decide(POLICY, waiting, NEEDS, [EDGE, CLOUD], ROBOT, 5.0)
    assert back.site == "cloud"
    assert run(back, [EDGE, CLOUD], 6.0, 10).site == "edge"


QUALITY = st.builds(
    PathQuality,
    st.one_of(st.just(nan), st.floats(0, 2)),
    st.one_of(st.just(nan), st.floats(0, 1)),
    st.one_of(st.just(nan), st.floats(0, 1)),
)


@pytest.mark.slow
@settings(max_examples=40)
@given(st.lists(st.tuples(QUALITY, QUALITY, st.floats(0, 1), st.booleans()), max_size=30))
def test_the_choice_never_changes_more_often_than_hysteresis_allows(looks):
    decision, changes = start(POLICY, 0.0), []
    for i, (edge, cloud, load, drives) in enumerate(looks):
        sites = [replace(EDGE, quality=edge), replace(CLOUD, quality=cloud)]
        after = decide(POLICY, decision, NEEDS, sites, RobotView(load, 2, drives=drives), float(i))
        if (after.offload, after.site) != (decision.offload, decision.site):
            changes.append(float(i))
            assert after.why
            assert "\n" not in after.why
        decision = after
    gaps = [b - a for a, b in pairwise(changes)]
    assert all(gap >= POLICY.bad_s for gap in gaps)


def test_a_window_knows_median_jitter_and_loss_after_three_probes():
    window = Window()
    window.add(0.01)
    window.add(0.012)
    assert not isfinite(window.quality().rtt)
    window.add(None)
    found = window.quality()
    assert (found.rtt, found.loss) == (pytest.approx(0.011), pytest.approx(1 / 3))
    assert found.jitter == pytest.approx(0.001)
    for _ in range(20):
        window.add(None)
    assert window.quality().loss == 1.0


@pytest.mark.parametrize("name", ["delay", "margin", "hold_s"])
def test_weights_that_turn_costs_round_are_refused(name):
    with pytest.raises(ValueError, match=f"task: {name} must be 0 or above"):
        Policy(**{name: -1.0})
