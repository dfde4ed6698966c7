import threading
from random import Random

import pytest

from skytether.api.client import ApiError, Unreachable
from skytether.api.rest import InstanceCreate, Placement, Problem, Report, Session, State
from skytether.robot.offload.lease_client import InstanceReported, LeaseClient, MoveFailed, Wanted

REQUEST = InstanceCreate(robot="walker", service="virtual-trail")


class Turns:
    """An event to stop that lets a loop make so many turns, and does not wait."""

    def __init__(self, turns: int) -> None:
        self.turns = turns

    def wait(self, delay: float) -> bool:
        self.turns -= 1
        return self.turns < 0


class Robot:
    """Takes turns with a lease client: what it wants, and what it was told.

    Attributes:
        site: Where it wants its instance.
        serving: Id of the instance that serves it; None: whichever it was told of last.
        told: Of each answer about an instance, the instance.
        stayed: Of each move that failed, the id of the instance that was kept, and why.
    """

    def __init__(self, orchestrator, **options):
        self.orchestrator = orchestrator
        self.wanted: InstanceCreate | None = REQUEST
        self.site, self.serving = None, None
        self.told, self.stayed = [], []
        self.client = LeaseClient(orchestrator, random=Random(1), **options)

    def turn(self) -> float:
        serving = self.serving or (self.told[-1].id if self.told else None)
        delay = self.client.step(Wanted(self.wanted, self.site, serving, self.orchestrator.healthy))
        while (event := self.client.next_event()) is not None:
            match event:
                case InstanceReported(instance):
                    self.told.append(instance)
                case MoveFailed(kept, reason):
                    self.stayed.append((kept.id, reason))
        return delay

    def run(self, stop) -> None:
        self.client.run(stop, self.turn)


@pytest.fixture
def robot(orchestrator):
    return Robot(orchestrator, report=lambda: Report(rtt_s=0.1))


def test_it_asks_once_looks_until_it_runs_then_renews_with_a_report(orchestrator, robot):
    orchestrator.states = [State.PENDING, State.STARTING, State.RUNNING]
    assert [robot.turn() for _ in range(4)] == [0.03, 0.03, 2.0, 2.0]
    assert [name for name, _ in orchestrator.calls] == ["create", "get", "get", "renew"]
    assert [instance.state for instance in robot.told] == ["pending", "starting", "running", "running"]
    assert orchestrator.calls[-1][1].report == Report(rtt_s=0.1)
    assert robot.client.trouble == ""


def test_while_a_start_takes_long_its_lease_is_kept(orchestrator):
    now = 10.0
    robot = Robot(orchestrator, clock=lambda: now, renew_s=2.0)
    orchestrator.states = [State.STARTING]
    while now < 15.0:
        now += robot.turn()
    names = [name for name, _ in orchestrator.calls]
    assert (names.count("create"), names.count("renew")) == (1, 2)
    assert len(names) < 70, "every 30 ms at first, and less and less often"
    now += 60
    assert robot.turn() == 0.25
    assert orchestrator.calls[names.index("renew")][1].report is None


def test_a_restart_is_waited_for_like_a_start_however_long_it_ran(orchestrator):
    now = 10.0
    robot = Robot(orchestrator, clock=lambda: now)
    orchestrator.states = [State.RUNNING]
    for _ in range(3):
        robot.turn()
        now += 3600
    orchestrator.states = [State.STARTING]
    assert robot.turn() == 0.03


def test_when_the_link_goes_bad_it_looks_sooner(orchestrator, robot):
    orchestrator.healthy = False
    looks = [robot.turn() for _ in range(6)]
    assert looks[0] <= 0.2
    assert 1.0 <= looks[-1] <= 2.0
    orchestrator.healthy = True
    assert robot.turn() == 2.0
    orchestrator.healthy = False
    assert robot.turn() <= 0.2


def test_an_orchestrator_that_is_away_is_tried_again_with_back_off_and_the_same_key(orchestrator, robot, caplog):
    orchestrator.fail = Unreachable("nobody answers")
    delays = [robot.turn() for _ in range(8)]
    assert delays[0] <= 0.2 < 1.6 <= max(delays) <= 5.0
    assert (robot.client.trouble, robot.told, caplog.messages) == ("nobody answers", [], [])
    robot.run(Turns(3))
    assert caplog.messages == ["nobody answers"], "said once, by the loop: who makes steps looks at trouble"
    orchestrator.fail = None
    robot.turn()
    assert robot.client.trouble == ""
    assert len({key for name, key in orchestrator.calls if name == "create"}) == 1
    orchestrator.fail = Unreachable("nobody answers")
    assert robot.turn() <= 0.2, "the back-off starts anew"


def test_an_orchestrator_that_goes_away_later_does_not_lose_the_instance(orchestrator, robot):
    robot.turn()
    orchestrator.fail = Unreachable("nobody answers")
    for _ in range(3):
        robot.turn()
    orchestrator.fail = None
    robot.turn()
    assert {instance.id for instance in robot.told} == {"i1"}
    assert [name for name, _ in orchestrator.calls].count("create") == 1


def test_an_instance_that_is_gone_is_asked_for_again_under_a_new_key(orchestrator, robot, caplog):
    robot.turn()
    orchestrator.fail = problem(404, "no such instance")
    robot.run(Turns(1))
    orchestrator.fail = None
    robot.run(Turns(1))
    assert [instance.id for instance in robot.told] == ["i1", "i2"]
    keys = [key for name, key in orchestrator.calls if name == "create"]
    assert len(set(keys)) == 2
    assert caplog.messages == ["instance i1 is gone; asking for virtual-trail again"]


@pytest.mark.parametrize("state", [State.FAILED, State.STOPPED, State.STOPPING])
def test_an_instance_that_ended_is_asked_for_again(orchestrator, robot, state):
    orchestrator.states = [State.RUNNING, state, State.RUNNING]
    orchestrator.reason = "it crashed 5 times"
    robot.turn()
    robot.turn()
    assert robot.client.trouble == f"instance i1 is {state}: it crashed 5 times"
    robot.turn()
    assert [instance.id for instance in robot.told] == ["i1", "i2"]


def test_a_token_that_is_refused_is_said_once_and_tried_slowly(orchestrator, robot, caplog):
    orchestrator.fail = problem(401, "the token is not known")
    assert robot.turn() == 10.0
    robot.run(Turns(3))
    assert caplog.messages == ["the token is not known"]


def test_an_unknown_service_is_said_and_tried_again(orchestrator, robot):
    orchestrator.fail = problem(404, "there is no service virtual-trail")
    assert robot.turn() <= 0.2
    assert robot.client.trouble == "there is no service virtual-trail"


def test_release_lets_the_instance_go(orchestrator, robot):
    assert robot.client.release() is None
    robot.turn()
    assert robot.client.release() == "i1"
    assert [name for name, _ in orchestrator.calls[-2:]] == ["renew", "delete"], "what was counted last is told"
    assert orchestrator.calls[-2][1].report == Report(rtt_s=0.1)
    assert robot.client.release() is None


def test_release_does_not_fail_when_nobody_answers(orchestrator, robot, caplog):
    robot.turn()
    orchestrator.fail = Unreachable("nobody answers")
    assert robot.client.release() is None
    assert "its lease will end it" in caplog.text


def test_run_goes_on_after_what_nobody_expected_and_ends_when_told(orchestrator, robot, monkeypatch):
    stop = threading.Event()
    answers = iter([ZeroDivisionError("strange"), None])

    def wait(delay: float) -> bool:
        orchestrator.fail = next(answers, None)
        return bool(robot.told)

    monkeypatch.setattr(stop, "wait", wait)
    robot.run(stop)
    assert [name for name, _ in orchestrator.calls] == ["create", "create"]
    assert robot.client.trouble == ""


def test_a_service_that_is_not_wanted_any_more_is_let_go_and_asked_for_later(orchestrator):
    robot = Robot(orchestrator)
    robot.turn()
    robot.wanted = None
    assert robot.turn() == 0.5
    assert robot.turn() == 0.5
    assert [name for name, _ in orchestrator.calls] == ["create", "delete"]
    robot.wanted = REQUEST
    robot.turn()
    keys = [key for name, key in orchestrator.calls if name == "create"]
    assert len(set(keys)) == 2


@pytest.fixture
def mover(orchestrator):
    """A robot whose instance runs at one site, and that wants one at another."""
    orchestrator.placement = Placement(site="cloud")
    robot = Robot(orchestrator, clock=lambda: robot.now)
    robot.now = 0.0
    robot.turn()
    robot.site = "edge"
    return robot


def test_it_moves_to_an_instance_elsewhere_once_that_serves_and_lets_the_first_go(orchestrator, mover):
    orchestrator.states = [State.RUNNING, State.PENDING, State.RUNNING, State.STARTING, State.RUNNING]
    mover.turn()  # renews, asks elsewhere
    mover.site = None
    mover.turn()  # renews, looks: starting
    mover.turn()  # it runs
    assert "delete" not in [name for name, _ in orchestrator.calls]
    assert mover.told[-1].id == "i2"
    mover.turn()  # it serves
    assert [call for call in orchestrator.calls if call[0] == "delete"] == [("delete", "i1")]
    assert mover.stayed == []
    assert mover.client.release() == "i2"


def test_an_instance_elsewhere_that_fails_or_dawdles_is_given_up_and_the_first_kept(orchestrator, mover):
    orchestrator.states = [State.RUNNING, State.PENDING, State.RUNNING, State.FAILED, State.RUNNING]
    orchestrator.reason = "no such image"
    mover.turn()
    mover.turn()
    assert mover.stayed == [("i1", "no such image")]
    orchestrator.states = [State.RUNNING, State.PENDING, State.RUNNING, State.STARTING, State.RUNNING]
    mover.turn()
    mover.now = 21.0
    mover.turn()
    assert len(mover.stayed) == 2
    assert mover.client.trouble == ""


def test_an_instance_that_the_orchestrator_has_just_moved_is_not_asked_for_elsewhere(orchestrator, mover):
    """The robot decides anew once it was told of the move."""
    orchestrator.placement = Placement(site="fog")
    mover.turn()
    assert [name for name, _ in orchestrator.calls] == ["create", "renew"]
    mover.turn()
    assert [name for name, _ in orchestrator.calls] == ["create", "renew", "renew", "create"]


def test_a_successor_is_followed_and_the_first_let_go_when_it_serves(orchestrator):
    robot = Robot(orchestrator)
    robot.turn()
    robot.serving = "i1"
    orchestrator.successor = "i7"
    robot.turn()  # renews, learns of it
    orchestrator.successor = None
    robot.turn()
    robot.turn()
    assert robot.told[-1].id == "i7"
    assert "delete" not in [name for name, _ in orchestrator.calls], "the first drives until the other one does"
    robot.serving = "i7"
    robot.turn()
    assert [call for call in orchestrator.calls if call[0] == "delete"] == [("delete", "i1")]
    assert robot.client.release() == "i7"


def test_when_the_first_ends_while_another_is_coming_that_one_is_kept(orchestrator):
    robot = Robot(orchestrator)
    robot.turn()
    robot.serving = "i1"
    orchestrator.successor = "i7"
    robot.turn()
    orchestrator.successor = None
    orchestrator.states = [State.FAILED, State.RUNNING]
    robot.turn()
    assert robot.client.release() == "i7"


def test_a_refused_token_is_looked_for_again_and_a_new_one_tried_soon(orchestrator):
    fresh = [True, False]
    robot = Robot(orchestrator, another_token=lambda: fresh.pop(0))
    orchestrator.fail = problem(401, "the token has expired")
    assert robot.turn() <= 0.2
    assert robot.turn() == 10.0


def test_what_came_of_an_exchange_waits_until_it_is_taken(orchestrator):
    client = LeaseClient(orchestrator)
    client.step(Wanted(REQUEST))
    client.step(Wanted(REQUEST))
    assert [client.next_event().instance.id for _ in range(2)] == ["i1", "i1"]
    assert client.next_event() is None


def problem(status: int, detail: str) -> ApiError:
    return ApiError(Problem(title="no", status=status, detail=detail))


def test_a_key_is_claimed_once_and_given_to_who_opens_the_session(orchestrator):
    robot = Robot(orchestrator)
    orchestrator.session = Session(id="ab" * 8, host="127.0.0.1", port=4711)
    for _ in range(3):
        robot.turn()
    assert [call for call in orchestrator.calls if call[0] == "claim"] == [("claim", "i1")]
    assert [instance.session.key for instance in robot.told] == [orchestrator.KEY] * 3


def test_a_key_that_somebody_else_has_is_said_and_another_instance_asked_for(orchestrator):
    robot = Robot(orchestrator)
    orchestrator.session = Session(id="ab" * 8, host="127.0.0.1", port=4711)
    orchestrator.key_taken = True
    robot.turn()
    assert robot.client.trouble == "was handed out already"
    orchestrator.key_taken = False
    robot.turn()
    assert [name for name, _ in orchestrator.calls] == ["create", "claim", "delete", "create", "claim"]
    keys = [what for name, what in orchestrator.calls if name == "create"]
    assert keys[0] != keys[1]
    assert [instance.session.key for instance in robot.told] == [orchestrator.KEY]
