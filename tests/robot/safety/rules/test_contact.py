from dataclasses import replace
from math import inf, nan

import pytest

from skytether.messages import Bool, Range, Twist
from skytether.robot.control.command import Command, Hand
from skytether.robot.safety.geometry.footprint import circle
from skytether.robot.safety.rules.contact import ContactKind, ContactParams, Contacts, feels
from skytether.robot.safety.rules.rules import Gate, Rules
from skytether.robot.safety.sensing.coverage import Action, UnseenParams

BUMPER = ContactParams()
CLIFF = ContactParams(ContactKind.CLIFF, above_m=0.1)
RULES = Rules(circle(0.3), unseen=UnseenParams(Action.FREE), contacts={"bumper": BUMPER, "cliff": CLIFF})


def floor(distance: float) -> Range:
    return Range(min_range=0.02, max_range=0.4, range=distance)


@pytest.mark.parametrize(
    ("params", "message", "felt"),
    [
        (BUMPER, Bool(data=True), True),
        (BUMPER, Bool(data=False), False),
        (ContactParams(pressed_is=False), Bool(data=False), True),
        (BUMPER, floor(0.05), None),  # not its type
        (BUMPER, Twist(), None),
        (CLIFF, floor(0.05), False),
        (CLIFF, floor(0.11), True),
        (CLIFF, floor(inf), True),  # nothing in reach: no floor
        (CLIFF, floor(-inf), False),
        (CLIFF, floor(nan), None),
        (CLIFF, floor(0.0), None),
        (CLIFF, floor(-1.0), None),  # as many drivers say that they failed; no floor is that near
        (CLIFF, Bool(data=True), None),
        (ContactParams(below_m=0.03), floor(0.02), True),
        (ContactParams(below_m=0.03), floor(-inf), True),
        (ContactParams(below_m=0.03), floor(-1.0), True),
        (ContactParams(below_m=0.03), floor(0.04), False),
    ],
)
def test_what_is_felt(params, message, felt):
    assert feels(params, message) is felt


class Bench:
    def __init__(self, rules: Rules = RULES) -> None:
        self.gate = Gate(rules)
        self.now, self.sequence = 10.0, 0
        self.says = {"bumper": Bool(data=False), "cliff": floor(0.05)}
        self.run(0.3, 0.0)

    def run(self, seconds: float, wanted: float = 0.2):
        for _ in range(round(seconds / 0.01)):
            self.now += 0.01
            self.sequence += 1
            for topic, message in self.says.items():
                self.gate.sense(topic, message, self.now)
            self.gate.command(Command(Hand.AGENT, wanted, 0.0, 1, self.sequence, self.now, 0.0, self.now), self.now)
            decision = self.gate.step(self.now)
        return decision


@pytest.mark.parametrize(
    ("topic", "message", "says"),
    [("bumper", Bool(data=True), "the bumper bumper was touched"), ("cliff", floor(0.3), "cliff sensor cliff sees no")],
)
def test_a_touch_of_a_moment_stops_until_a_reset_which_waits_until_it_is_over(topic, message, says):
    bench = Bench()
    assert bench.run(1.0).velocity == pytest.approx((0.2, 0.0))
    bench.gate.sense(topic, message, bench.now)
    decision = bench.run(1.0)
    assert (decision.velocity, decision.hand) == ((0.0, 0.0), Hand.NOBODY)
    assert says in bench.gate.stopped
    good, bench.says[topic] = bench.says[topic], message
    bench.run(0.1)
    for refused in (bench.gate.refuses_reset(bench.now), bench.gate.reset(bench.now)):
        assert f"{topic} is still" in refused
    bench.says[topic] = good
    bench.run(0.1)
    assert bench.gate.reset(bench.now) == ""
    bench.run(0.3, 0.0)
    assert bench.run(1.0).velocity == pytest.approx((0.2, 0.0))


@pytest.mark.parametrize("topic", ["bumper", "cliff"])
def test_one_that_falls_silent_stops_the_robot_as_long_as_it_is(topic):
    bench = Bench()
    bench.run(1.0)
    said = bench.says.pop(topic)
    decision = bench.run(1.0)
    assert (decision.velocity, decision.hand) == ((0.0, 0.0), Hand.NOBODY)
    assert f"{topic}: the {topic} sensor is not heard" in decision.troubles[f"contact:{topic}"]
    assert bench.gate.stopped == ""
    bench.says[topic] = said
    assert bench.run(1.0).velocity == pytest.approx((0.2, 0.0))


def test_a_cliff_sensor_without_readings_is_silent():
    bench = Bench()
    bench.says["cliff"] = floor(nan)
    assert bench.run(1.0).velocity == (0.0, 0.0)


def test_a_bumper_that_speaks_only_when_it_changes_is_heard_once():
    params = replace(BUMPER, max_age_s=inf)
    bench = Bench(replace(RULES, contacts={"bumper": params}))
    del bench.says["bumper"]
    assert bench.run(5.0).velocity == pytest.approx((0.2, 0.0))
    assert Contacts({"bumper": params}).silent(1.0)  # never heard: not known
    assert "see that its driver runs" in Contacts({"bumper": params}).refuses_reset(1.0)
