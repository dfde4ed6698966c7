"""Action servers of a service: what actionlib and rclcpp_action do with goals, cancellations and results."""

from __future__ import annotations

import itertools

import pytest

from skytether.messages import (
    Header,
    MoveBase,
    MoveBaseFeedback,
    MoveBaseGoal,
    MoveBaseResult,
    NavigateToPose,
    NavigateToPoseFeedback,
    NavigateToPoseGoal,
    NavigateToPoseResult,
    PoseStamped,
)
from skytether.service import Action, CallError, Goal, GoalError, NoParams, Service
from skytether.service.actionlib import MAX_RESULTS, STATUS_KEEP
from skytether.service.actions import MAX_INBOX
from skytether.service.goals import ENDS, MAX_ENDED, MAX_WAITING, MOVES, ActionServer, State
from skytether.service.loop import Loop
from skytether.service.port import ServicePort
from skytether.service.rcl_action import MAX_ASKED, RESULT_KEEP
from skytether.testing.actions import ActionClient
from skytether.testing.service import FakeClock, Harness
from skytether.wire.events import Connected
from skytether.wire.topic import Direction, Topic

TO = MoveBaseGoal(PoseStamped(Header(frame_id="map")))
TO2 = NavigateToPoseGoal(PoseStamped(Header(frame_id="map")))
NAMES = {"ros1": ("old", TO), "cdr": ("new", TO2)}


class Go(Service[NoParams]):
    """Takes goals of both generations, and does what the test says."""

    rate_hz = 10.0
    old = Action(MoveBase)
    new = Action(NavigateToPose)
    takes = True
    taken: list[Goal]

    def start(self) -> None:
        self.taken = []

    def step(self, now: float) -> None:
        if self.takes:
            self.taken += [goal for server in (self.old, self.new) for goal in iter(server.take, None)]


def served(encoding: str) -> tuple[Harness[Go], ActionClient]:
    harness = Harness(Go, encoding=encoding)
    return harness, ActionClient(harness, NAMES[encoding][0])


def sent(harness: Harness[Go], client: ActionClient) -> tuple[str, Goal]:
    """A goal that the service has taken."""
    goal_id = client.send(NAMES[harness.encoding][1])
    harness.step()
    return goal_id, harness.service.taken[-1]


# What may become of a goal.


@pytest.mark.parametrize(("what", "state"), [*itertools.product(MOVES, State)])
def test_a_goal_moves_by_the_table_and_an_illegal_move_changes_nothing(what: str, state: State) -> None:
    goal = Goal(ActionServer(MoveBase, "go"), "a", TO.target_pose.header.stamp, TO)
    goal.state = state
    if state in MOVES[what]:
        goal.move(what, "why")
        assert (goal.state, goal.text) == (MOVES[what][state], "why")
    else:
        with pytest.raises(GoalError, match=state.name.lower()):
            goal.move(what, "why")
        assert (goal.state, goal.text) == (state, "")


def test_ends_are_ends() -> None:
    assert not [what for what in MOVES for state in ENDS if state in MOVES[what]]


@pytest.mark.parametrize("encoding", ["ros1", "cdr"])
def test_a_goal_is_accepted_told_of_and_reached(encoding: str) -> None:
    harness, client = served(encoding)
    goal_id, goal = sent(harness, client)
    assert goal.message == NAMES[encoding][1]
    assert client.state(goal_id) == ("pending" if encoding == "ros1" else None)
    goal.accept("on my way")
    assert client.state(goal_id) == "active"
    assert client.end(goal_id) is None
    feedback = MoveBaseFeedback(TO.target_pose) if encoding == "ros1" else NavigateToPoseFeedback(TO.target_pose)
    assert goal.feedback(feedback)
    assert client.feedback(goal_id) == [feedback]
    result = MoveBaseResult() if encoding == "ros1" else NavigateToPoseResult(7, "by luck")
    goal.succeed(result, "there")
    assert client.state(goal_id) == "succeeded"
    assert client.end(goal_id) == ("succeeded", "there" if encoding == "ros1" else "", result)
    with pytest.raises(GoalError, match="succeeded"):
        goal.abort()
    with pytest.raises(GoalError, match="nothing to tell"):
        goal.feedback(feedback)


@pytest.mark.parametrize("encoding", ["ros1", "cdr"])
def test_one_is_rejected_and_one_is_given_up(encoding: str) -> None:
    harness, client = served(encoding)
    bad, goal = sent(harness, client)
    with pytest.raises(GoalError, match="pending"):
        goal.abort()
    goal.reject("no such place")
    end = client.end(bad)
    assert end is not None
    assert end[:2] == ("rejected", "no such place" if encoding == "ros1" else "")
    other, goal = sent(harness, client)
    goal.accept()
    goal.abort(text="a wall")
    assert client.state(other) == "aborted"
    with pytest.raises(TypeError, match="ends with"):
        goal.succeed(TO)


@pytest.mark.parametrize("encoding", ["ros1", "cdr"])
def test_a_client_calls_its_goal_off(encoding: str) -> None:
    harness, client = served(encoding)
    one, first = sent(harness, client)
    two, second = sent(harness, client)
    first.accept()
    second.accept()
    assert client.cancel(one) == 0
    harness.step()
    assert (first.cancel_requested, second.cancel_requested) == (True, False)
    assert client.state(one) == "preempting"
    first.cancel(text="as you wish")
    assert client.states() == {one: "preempted", two: "active"}
    end = client.end(one)
    assert end is not None
    assert end[0] == "preempted"


@pytest.mark.parametrize("encoding", ["ros1", "cdr"])
def test_a_goal_that_gives_way_to_a_newer_one(encoding: str) -> None:
    """In ROS 2 it is aborted, as by Nav2: none is canceled there unless its client asked for it."""
    harness, client = served(encoding)
    goal_id, goal = sent(harness, client)
    goal.accept()
    goal.cancel(text="something newer")
    assert client.state(goal_id) == ("preempted" if encoding == "ros1" else "aborted")


@pytest.mark.parametrize("encoding", ["ros1", "cdr"])
def test_all_goals_are_called_off(encoding: str) -> None:
    harness, client = served(encoding)
    goals = [sent(harness, client)[1] for _ in range(3)]
    for goal in goals:
        goal.accept()
    client.cancel()
    harness.step()
    assert all(goal.cancel_requested for goal in goals)


@pytest.mark.parametrize("encoding", ["ros1", "cdr"])
def test_more_goals_than_can_wait_are_rejected(encoding: str) -> None:
    harness, client = served(encoding)
    harness.service.takes = False
    goals = [client.send(NAMES[encoding][1]) for _ in range(MAX_WAITING + 1)]
    harness.step()
    ends = [client.end(goal_id) for goal_id in goals]
    assert [end for end in ends[:-1] if end] == []
    assert ends[-1] is not None
    assert ends[-1][0] == "rejected"


@pytest.mark.parametrize("encoding", ["ros1", "cdr"])
def test_a_robot_has_the_actions_of_its_own_ros_only(encoding: str) -> None:
    harness, client = served(encoding)
    sent(harness, client)[1].accept()
    harness.step()
    named = {name.split("/")[0] for name in harness.outputs}
    assert named == {NAMES[encoding][0]}


# ROS 1: actionlib.


def test_status_comes_five_times_a_second_and_a_goal_stays_in_it_for_five_seconds() -> None:
    harness, client = served("ros1")
    for _ in range(10):
        harness.step()
    assert len(harness.outputs["old/status"]) == 5
    goal_id, goal = sent(harness, client)
    goal.accept()
    goal.succeed()
    harness.step(STATUS_KEEP - 0.5)
    assert client.state(goal_id) == "succeeded"
    harness.step(1.0)
    assert client.states() == {}


def test_the_same_goal_twice_is_one() -> None:
    harness, client = served("ros1")
    client.send(TO, "a")
    client.send(TO, "a")
    harness.step()
    assert [goal.id for goal in harness.service.taken] == ["a"]
    harness.service.taken[0].accept()
    harness.service.taken[0].succeed()
    client.send(TO, "a")
    harness.step()
    assert len(harness.service.taken) == 1


def test_goals_without_an_id_get_one_and_the_time_of_their_arrival() -> None:
    harness = Harness(Go, encoding="ros1", epoch=1e9)
    for _ in range(2):
        harness.send("old/goal", MoveBase.wrappers["ActionGoal"](goal=TO))
    harness.step()
    one, two = harness.service.taken
    assert one.id != two.id
    assert one.stamp.seconds() == pytest.approx(1e9 + harness.now, abs=0.2)


def test_a_cancellation_by_time_takes_all_up_to_it_and_what_comes_late() -> None:
    harness, client = served("ros1")
    for stamp in (1.0, 2.0, 3.0):
        client.send(TO, f"at {stamp}", stamp)
    harness.step()
    for goal in harness.service.taken:
        goal.accept()
    client.cancel(stamp=2.0)
    harness.step()
    assert [goal.cancel_requested for goal in harness.service.taken] == [True, True, False]
    client.send(TO, "late", 1.5)
    harness.step()
    end = client.end("late")
    assert end is not None
    assert end[0] == "recalled"
    assert len(harness.service.taken) == 3


def test_a_cancellation_by_id_and_time_takes_both() -> None:
    harness, client = served("ros1")
    for stamp in (1.0, 5.0):
        client.send(TO, f"at {stamp}", stamp)
    harness.step()
    for goal in harness.service.taken:
        goal.accept()
    client.cancel("at 5.0", stamp=1.0)
    harness.step()
    assert all(goal.cancel_requested for goal in harness.service.taken)


def test_a_cancellation_that_overtakes_its_goal_recalls_it() -> None:
    harness, client = served("ros1")
    client.cancel("a")
    harness.step()
    assert client.state("a") == "recalling"
    client.send(TO, "a")
    harness.step()
    assert client.state("a") == "recalled"
    assert client.end("a") is not None
    assert harness.service.taken == []
    harness.step(STATUS_KEEP + 1)
    assert client.states() == {}


def test_one_that_is_called_off_before_it_is_taken_is_recalled() -> None:
    harness, client = served("ros1")
    client.send(TO, "a")
    client.cancel("a")
    harness.step()
    assert client.state("a") == "recalled"
    assert harness.service.taken == []


def test_a_result_waits_for_the_robot_and_only_then_is_the_goal_forgotten() -> None:
    harness, client = served("ros1")
    goal_id, goal = sent(harness, client)
    goal.accept()
    harness.disconnect()
    goal.succeed(text="there")
    harness.step(100.0)
    assert client.end(goal_id) is None
    harness.connect()
    harness.step()
    assert client.end(goal_id) == ("succeeded", "there", MoveBaseResult())
    assert client.state(goal_id) == "succeeded"
    harness.step(STATUS_KEEP + 1)
    assert client.states() == {}


def test_results_for_a_robot_that_never_comes_back_are_bounded() -> None:
    harness, client = served("ros1")
    goals = [client.send(TO, f"{n}") for n in range(MAX_WAITING)]
    harness.step()
    goals += [client.send(TO, f"{n + 100}") for n in range(MAX_RESULTS)]
    harness.step()
    harness.disconnect()
    for goal in harness.service.taken:
        goal.accept()
        goal.succeed()
    harness.step(STATUS_KEEP + 1)
    harness.connect()
    harness.step()
    assert [goal_id for goal_id in goals if client.end(goal_id)] == goals[-MAX_RESULTS:]


def test_what_is_no_goal_and_what_is_too_much_is_counted_and_said_once(caplog: pytest.LogCaptureFixture) -> None:
    harness, client = served("ros1")
    harness.send("old/goal", b"nonsense")
    harness.step()
    for n in range(MAX_INBOX + 5):
        client.cancel(f"{n}")
    harness.step()
    assert harness.service.inbox.dropped == 6
    assert len([r for r in caplog.records if r.levelname == "WARNING"]) == 1
    assert len(client.states()) <= MAX_ENDED


# ROS 2: rcl_action.


def test_a_goal_of_a_known_id_is_not_accepted() -> None:
    harness, client = served("cdr")
    goal_id, goal = sent(harness, client)
    goal.accept()
    assert client.is_accepted(goal_id)
    client.send(TO2, goal_id)
    assert client.is_accepted(goal_id) is False
    assert goal.state is State.ACTIVE


def test_cancellations_answer_as_rcl_does() -> None:
    harness, client = served("cdr")
    assert client.cancel("ab" * 16) == 2  # unknown
    goal_id, goal = sent(harness, client)
    goal.accept()
    later, other = sent(harness, client)
    other.accept()
    assert client.cancel(stamp=goal.stamp.seconds()) == 0
    assert (goal.cancel_requested, other.cancel_requested) == (True, False)
    goal.cancel()
    assert client.cancel(goal_id) == 3  # it has ended
    assert client.cancel(later, stamp=1e-3) == 0
    assert other.cancel_requested


def test_a_result_is_kept_for_whoever_comes_back() -> None:
    harness, client = served("cdr")
    goal_id, goal = sent(harness, client)
    goal.accept()
    assert client.end(goal_id) is None
    harness.disconnect()
    goal.succeed(NavigateToPoseResult(1, "so so"))
    harness.step(60.0)
    harness.connect()
    harness.step()
    assert client.state(goal_id) == "succeeded"  # told again: it may be another robot
    client.ask_result(goal_id)
    assert client.end(goal_id) == ("succeeded", "", NavigateToPoseResult(1, "so so"))
    harness.step(RESULT_KEEP)
    assert client.states() == {}
    client.ask_result(goal_id)
    end = client.end(goal_id)
    assert end is not None
    assert end[0] == "unknown"


def test_status_is_sent_when_it_changes_and_not_else() -> None:
    harness, client = served("cdr")
    for _ in range(10):
        harness.step()
    assert len(harness.outputs["new/_action/status"]) == 1
    sent(harness, client)[1].accept()
    assert len(harness.outputs["new/_action/status"]) == 2


def test_a_result_that_is_asked_for_again_and_again_takes_no_room() -> None:
    harness, client = served("cdr")
    goal_id, goal = sent(harness, client)
    goal.accept()
    asked = [client.ask_result(goal_id) for _ in range(MAX_ASKED + 1)]
    with pytest.raises(CallError, match="asked for again"):
        asked[0].result(0)
    goal.succeed()
    assert all(request.result(0).status == 4 for request in asked[1:])


def test_a_service_that_ends_leaves_nobody_waiting() -> None:
    harness, client = served("cdr")
    goal_id, goal = sent(harness, client)
    goal.accept()
    assert client.end(goal_id) is None
    harness.port.close()
    assert client.end(goal_id) == ("failed", "the service ends", None)
    goal.succeed()  # nobody is told any more, and nothing breaks


# Beside the steps.


class Waits(Service[NoParams]):
    """Steps when a goal's goal moves it, which is never: only the loop serves the action."""

    rate_hz = 0.01
    go = Action(MoveBase)

    def step(self, now: float) -> None:
        pass


def test_status_comes_between_two_steps_of_a_slow_service() -> None:
    service, clock = Waits(NoParams()), FakeClock(0.0)
    port = ServicePort(service, clock.wake)
    loop = Loop(service, port, clock, idle_exit=60.0)

    class Robot:
        """Counts."""

        times: list[float]

        def publish(self, topic: str, payload: bytes) -> bool:
            self.times.append(clock.now())
            return topic == "go/status"

        def answer(self, name: str, handler: object) -> None:
            pass

    robot = Robot()
    robot.times = []
    port.attach(robot)  # type: ignore[arg-type]
    port.notify(Connected((Topic("go/status", "actionlib_msgs/msg/GoalStatusArray", Direction.OUT, encoding="ros1"),)))
    clock.at(2.05, loop.stop)
    loop.run()
    assert len(robot.times) == 11
    assert loop.steps == 1
