import dataclasses

import numpy as np
import pytest

from skytether.control.admittance import Velocity
from skytether.lab.person import Person, PersonParams
from skytether.lab.trail import ORIGIN, Pose, Trail
from skytether.lab.walker import Arms

DT = 0.01
D = 0.5
STILL = Velocity(0.0, 0.0)
CALM = PersonParams(speed_error=0, sight_error=0, step_force=0, sway_torque=0, tremor=0)


def person(params: PersonParams = CALM, trail: Trail | None = None, seed: int = 0) -> Person:
    return Person(params, trail or Trail([{"length": 20.0}]), np.random.default_rng(seed))


def push(p: Person, steps: int, *, pose: Pose = ORIGIN, velocity: Velocity = STILL) -> Arms:
    arms = [p.step(pose, velocity, D, DT) for _ in range(steps)]
    return arms[-1]


def test_does_nothing_before_the_reaction_time_is_over() -> None:
    p = person()
    assert push(p, 20) == (0, 0)
    assert push(p, 1).left > 0


def test_pushes_an_unmoving_walker_until_stretch_and_wish_balance() -> None:
    # wish 0.45 m/s = yielding 2.5/s * stretch -> 0.18 m * 300 N/m = 54 N, half on each arm
    assert push(person(), 1000) == pytest.approx((27.0, 27.0), rel=1e-3)


def test_is_at_ease_at_the_speed_wanted_and_pulls_on_a_faster_walker() -> None:
    assert push(person(), 1000, velocity=Velocity(0.45, 0)) == pytest.approx((0, 0), abs=0.05)
    assert push(person(), 1000, velocity=Velocity(0.7, 0)).left < -5


def test_never_pushes_harder_than_a_person_can() -> None:
    strong = dataclasses.replace(CALM, speed=9.0)
    arms = push(person(strong), 1000)
    assert arms.left + arms.right == pytest.approx(strong.strongest)


def test_turns_towards_the_way_with_a_difference_of_the_arms() -> None:
    left = push(person(), 300, pose=Pose(0, 0, -0.3))
    right = push(person(), 300, pose=Pose(0, 0.3, 0))
    assert left.right > left.left + 1
    assert right.left > right.right + 1


def test_waits_until_told_to_walk() -> None:
    p = person()
    assert all(p.step(ORIGIN, STILL, D, DT, walking=False) == (0, 0) for _ in range(100))
    assert push(p, 100).left > 1


def test_lets_go_at_the_end() -> None:
    p = person(trail=Trail([{"length": 0.3}]))
    push(p, 200)
    assert push(p, 500, pose=Pose(0.31, 0, 0)) == pytest.approx((0, 0), abs=0.5)


@pytest.mark.slow
def test_steps_show_in_the_push_at_the_step_rate() -> None:
    stepping = dataclasses.replace(CALM, step_force=5.0, step_rate=1.7)
    p = person(stepping)
    series = np.array([sum(p.step(ORIGIN, Velocity(0.22, 0), D, DT)) for _ in range(6000)])[1000:]
    spectrum = np.abs(np.fft.rfft(series - series.mean()))
    peak = np.fft.rfftfreq(len(series), DT)[int(spectrum.argmax())]
    assert peak == pytest.approx(1.7, abs=0.15)


@pytest.mark.slow
def test_unsteadiness_has_the_size_asked_for() -> None:
    shaky = dataclasses.replace(CALM, speed=0.0, tremor=2.0)
    p = person(shaky)
    forces = np.array([p.step(ORIGIN, STILL, D, DT) for _ in range(8000)])
    assert forces.std(axis=0) == pytest.approx([2.0, 2.0], rel=0.15)
