"""People tracked by their legs, in scans that were drawn: who is found, who is kept apart, and what is no person."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator

import numpy as np
from leg_scans import FIRST, LIMITS, STEP, feet, scan

from skytether.lab.trail import Pose
from skytether.lab.world.gait import Gait
from skytether_services.follow_in_front.person import Person
from skytether_services.follow_in_front.tracker import PeopleTracker

PERIOD = 0.1
WALL = [((4.0, -4.0), (4.0, 4.0))]


def run(
    tracker: PeopleTracker,
    legs: Callable[[float], list[tuple[float, float]]],
    seconds: float,
    *,
    walls: list[tuple[tuple[float, float], tuple[float, float]]] = WALL,
    laser: Callable[[float], tuple[float, float, float]] = lambda _: (0.0, 0.0, 0.0),
    begin: float = 100.0,
    seed: int = 1,
) -> Iterator[tuple[float, tuple[Person, ...]]]:
    """Time since the beginning and the people, after each scan."""
    random = np.random.default_rng(seed)
    for number in range(round(seconds / PERIOD)):
        at = number * PERIOD
        ranges = scan(legs(at), walls, laser(at), random)
        yield at, tracker.step(ranges, FIRST, STEP, LIMITS, laser(at), begin + at)


def walker(
    start: tuple[float, float], heading: float, speed: float
) -> Callable[[float], tuple[tuple[float, float], list[tuple[float, float]]]]:
    """Place and feet of one who walks straight on, by time [s]."""

    def at(time: float) -> tuple[tuple[float, float], list[tuple[float, float]]]:
        way = speed * time
        place = (start[0] + math.cos(heading) * way, start[1] + math.sin(heading) * way)
        return place, feet(place, heading, way)

    return at


def test_one_who_walks_is_one_person_at_the_right_place_and_speed() -> None:
    tracker, one = PeopleTracker(), walker((1.5, -3.0), math.pi / 2, 1.0)
    numbers, errors, speeds = set(), [], []
    for at, people in run(tracker, lambda t: one(t)[1], 6.0):
        if at < 1.0:
            continue
        assert len(people) == 1
        numbers.add(people[0].id)
        errors.append(math.dist(people[0].place, one(at)[0]))
        speeds.append(math.hypot(*people[0].velocity))
    assert len(numbers) == 1
    assert people[0].walks
    assert np.mean(errors) < 0.08
    assert max(errors) < 0.2
    assert abs(np.mean(speeds) - 1.0) < 0.1


def test_one_leg_hides_the_other_and_the_person_stays_the_same() -> None:
    # Walks across the laser's view, near: each step hides the far leg.
    tracker, one = PeopleTracker(), walker((1.0, -2.5), math.pi / 2, 0.6)
    alone, numbers = 0, set()
    for at, people in run(tracker, lambda t: one(t)[1], 8.0):
        if at >= 1.5:
            numbers.update(person.id for person in people)
            assert len(people) == 1
            alone += people[0].legs == 1
            assert math.dist(people[0].place, one(at)[0]) < 0.25
    assert len(numbers) == 1
    assert alone > 5


def test_two_who_pass_each_other_keep_their_numbers() -> None:
    # One in front of the other, so that the nearer hides the farther for some scans.
    tracker = PeopleTracker()
    near, far = walker((1.5, -2.5), math.pi / 2, 0.9), walker((2.3, 2.5), -math.pi / 2, 0.9)
    by_place: dict[str, set[int]] = {"near": set(), "far": set()}
    for at, people in run(tracker, lambda t: near(t)[1] + far(t)[1], 5.0):
        if at < 1.2:
            continue
        for name, one in (("near", near), ("far", far)):
            mine = [person for person in people if math.dist(person.place, one(at)[0]) < 0.35]
            by_place[name].update(person.id for person in mine)
    assert len(by_place["near"]) == 1
    assert len(by_place["far"]) == 1
    assert by_place["near"] != by_place["far"]


def test_a_person_behind_a_pillar_walks_on_in_mind() -> None:
    tracker, one = PeopleTracker(), walker((2.0, -2.0), math.pi / 2, 1.0)
    pillar = [((1.0, -0.15), (1.0, 0.15)), *WALL]
    unseen, numbers = 0, set()
    for at, people in run(tracker, lambda t: one(t)[1], 4.0, walls=pillar):
        if at >= 1.0:
            assert len(people) == 1, at
            numbers.add(people[0].id)
            unseen += people[0].legs == 0
    assert len(numbers) == 1
    assert unseen >= 2


def test_one_who_stands_is_found_by_both_legs() -> None:
    tracker = PeopleTracker()
    *_, (_, people) = run(tracker, lambda _: feet((1.2, 0.0), math.pi, 0.0), 2.0)
    assert len(people) == 1
    assert people[0].stands
    assert not people[0].walks


def test_a_mannequin_or_a_chair_is_no_person_for_long_and_never_one_who_walks() -> None:
    tracker = PeopleTracker()
    chair = [(1.2, 0.2), (1.2, -0.2), (1.6, 0.2), (1.6, -0.2)]
    for at, people in run(tracker, lambda _: chair, 10.0):
        assert not any(person.walks for person in people)
        if at > 6.5:
            assert not people


def test_what_stands_is_no_walker_when_the_robot_drives_and_turns() -> None:
    tracker = PeopleTracker()
    posts = [(2.0, 1.0), (2.6, -1.2), (3.4, 0.4)]

    def laser(time: float) -> tuple[float, float, float]:
        return 0.3 * time, 0.0, 0.3 * math.sin(time)

    for _, people in run(tracker, lambda _: posts, 5.0, laser=laser):
        assert not any(person.walks for person in people)


def test_a_walker_is_tracked_from_a_robot_that_drives_and_turns() -> None:
    tracker, one = PeopleTracker(), walker((2.5, -2.0), math.pi / 2, 0.8)

    def laser(time: float) -> tuple[float, float, float]:
        return 0.2 * time, 0.0, 0.4 * math.sin(time)

    numbers = set()
    for at, people in run(tracker, lambda t: one(t)[1], 5.0, laser=laser):
        if at >= 1.5:
            assert len(people) == 1
            numbers.add(people[0].id)
            assert math.dist(people[0].place, one(at)[0]) < 0.25
    assert len(numbers) == 1


def test_scans_that_say_nothing_or_come_twice_change_nothing_for_the_worse() -> None:
    tracker, one = PeopleTracker(), walker((1.5, -3.0), math.pi / 2, 1.0)
    *_, (_, before) = run(tracker, lambda t: one(t)[1], 2.0)
    state = before[0].state.copy()
    # The same moment again, and one just before it.
    for now in (101.9, 101.5):
        again = tracker.step(np.full(772, np.nan, np.float32), FIRST, STEP, LIMITS, (0.0, 0.0, 0.0), now)
        assert np.array_equal(again[0].state, state)
    # Silence: forgotten after a second, and nobody is invented.
    for step in range(1, 14):
        people = tracker.step(np.zeros(0, np.float32), FIRST, STEP, LIMITS, (0.0, 0.0, 0.0), 101.9 + step * PERIOD)
    assert people == ()
    # A clock that was set back: all anew.
    *_, (_, people) = run(tracker, lambda t: one(t)[1], 2.0, begin=5.0)
    assert len(people) == 1


def test_a_scan_full_of_posts_costs_a_bounded_number_of_tracks() -> None:
    tracker = PeopleTracker()
    posts = [(2 + 0.5 * row, 0.4 * column) for row in range(8) for column in range(-12, 13)]
    for _, people in run(tracker, lambda _: posts, 1.0, walls=[]):
        assert len(tracker.tracks) <= 60
        assert len(people) <= 60


def test_a_slow_walker_is_one_who_walks_also_after_a_rest() -> None:
    # As slow as in front of the thesis's walker: 0.3 m/s, seen from ahead; after 8 s of standing.
    def place(time: float) -> tuple[float, float]:
        return 2.5 - 0.3 * max(time - 8, 0), 0.0

    tracker = PeopleTracker()
    numbers: set[int] = set()
    for at, _ in run(tracker, lambda t: feet(place(t), math.pi, 2.5 - place(t)[0]), 12.0):
        near = [person for person in tracker.tracks if math.dist(person.place, place(at)) < 0.3]
        assert len(near) == 1, at
        numbers.add(near[0].id)
        if at > 7:
            assert near[0].paired
        if 6.5 < at < 8:
            assert not near[0].known, "it may be a chair"
        if at > 11.5:
            assert near[0].walks
    assert len(numbers) == 1


def test_a_coarse_laser_sees_people_too() -> None:
    # 245 rays over 270 degrees: at 3 m two rays meet a leg.
    random, step = np.random.default_rng(2), math.radians(270 / 245)
    tracker, one = PeopleTracker(), walker((3.0, -1.5), math.pi / 2, 0.9)
    found = 0
    for number in range(35):
        at = number * PERIOD
        ranges = scan(one(at)[1], WALL, random=random, step=step)
        people = tracker.step(ranges, FIRST, step, LIMITS, (0.0, 0.0, 0.0), at)
        found += any(math.dist(person.place, one(at)[0]) < 0.35 for person in people)
        assert len(people) <= 1
    assert found >= 15


def slow_walk(laser: Callable[[float], tuple[float, float, float]]) -> list[float]:
    """How far the track of one who walks along x at 0.4 m/s, with feet that rest, is from their middle [m]."""
    tracker, errors, random = PeopleTracker(), [], np.random.default_rng(1)
    pose = Pose(0.0, 0.0, 0.0)
    gait = Gait(pose)
    for tick in range(1200):
        pose = Pose(pose.x + 0.004, 0.0, 0.0)
        gait.step(pose, 0.004, 0.01)
        if tick % 10 == 0:
            at = laser(pose.x)
            people = tracker.step(scan(gait.feet, laser=at, random=random), FIRST, STEP, LIMITS, at, 0.01 * tick)
            if tick > 300:
                assert len(people) == 1
                errors.append(math.dist(people[0].place, pose[:2]))
    return errors


def test_the_foot_of_a_slow_walker_rests_for_more_than_a_second_and_is_theirs() -> None:
    errors = slow_walk(lambda x: (6.0, 0.3, math.pi))
    assert np.sqrt(np.mean(np.square(errors))) < 0.07
    assert max(errors) < 0.12


def test_a_leg_that_the_other_one_hides_is_still_there() -> None:
    """As a robot ahead and aside sees them: with each step to its side the other leg is hidden for a moment."""
    errors = slow_walk(lambda x: (x + 0.8, 0.45, math.pi))
    assert np.sqrt(np.mean(np.square(errors))) < 0.07
    assert max(errors) < 0.15
