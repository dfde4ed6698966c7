import threading
from random import Random

import pytest

from skytether.api.client import ApiError, Unreachable
from skytether.api.rest import InstanceCreate, Problem, Report, Session, State
from skytether.robot.offload.lease_client import LeaseClient

REQUEST = InstanceCreate(robot="walker", service="virtual-trail")


class Turns:
    """An event to stop that lets a loop make so many turns, and does not wait."""

    def __init__(self, turns: int) -> None:
        self.turns = turns

    def wait(self, delay: float) -> bool:
        self.turns -= 1
        return self.turns < 0


@pytest.fixture
def asked(orchestrator):
    """A lease client and what it told about the instance."""
    told = []
    client = LeaseClient(
        orchestrator,
        REQUEST,
        on_instance=told.append,
        report=lambda: Report(rtt_s=0.1),
        healthy=lambda: orchestrator.healthy,
        random=Random(1),
    )
    return client, told


def test_it_asks_once_looks_until_it_runs_then_renews_with_a_report(orchestrator, asked):
    client, told = asked
    orchestrator.states = [State.PENDING, State.STARTING, State.RUNNING]
    assert [client.step() for _ in range(4)] == [0.03, 0.03, 2.0, 2.0]
    assert [name for name, _ in orchestrator.calls] == ["create", "get", "get", "renew"]
    assert [instance.state for instance in told] == ["pending", "starting", "running", "running"]
    assert orchestrator.calls[-1][1].report == Report(rtt_s=0.1)
    assert client.trouble == ""


def test_while_a_start_takes_long_its_lease_is_kept(orchestrator):
    now = 10.0
    client = LeaseClient(
        orchestrator, REQUEST, on_instance=lambda _: None, clock=lambda: now, renew_s=2.0, random=Random(1)
    )
    orchestrator.states = [State.STARTING]
    while now < 15.0:
        now += client.step()
    names = [name for name, _ in orchestrator.calls]
    assert (names.count("create"), names.count("renew")) == (1, 2)
    assert len(names) < 70, "every 30 ms at first, and less and less often"
    now += 60
    assert client.step() == 0.25
    assert orchestrator.calls[names.index("renew")][1].report is None


def test_a_restart_is_waited_for_like_a_start_however_long_it_ran(orchestrator):
    now = 10.0
    client = LeaseClient(orchestrator, REQUEST, on_instance=lambda _: None, clock=lambda: now, random=Random(1))
    orchestrator.states = [State.RUNNING]
    for _ in range(3):
        client.step()
        now += 3600
    orchestrator.states = [State.STARTING]
    assert client.step() == 0.03


def test_when_the_link_goes_bad_it_looks_sooner(orchestrator, asked):
    client, _ = asked
    orchestrator.healthy = False
    looks = [client.step() for _ in range(6)]
    assert looks[0] <= 0.2
    assert 1.0 <= looks[-1] <= 2.0
    orchestrator.healthy = True
    assert client.step() == 2.0
    orchestrator.healthy = False
    assert client.step() <= 0.2


def test_an_orchestrator_that_is_away_is_tried_again_with_back_off_and_the_same_key(orchestrator, asked, caplog):
    client, told = asked
    orchestrator.fail = Unreachable("nobody answers")
    delays = [client.step() for _ in range(8)]
    assert delays[0] <= 0.2 < 1.6 <= max(delays) <= 5.0
    assert (client.trouble, told, caplog.messages) == ("nobody answers", [], [])
    client.run(Turns(3))
    assert caplog.messages == ["nobody answers"], "said once, by the loop: who makes steps looks at trouble"
    orchestrator.fail = None
    client.step()
    assert client.trouble == ""
    assert len({key for name, key in orchestrator.calls if name == "create"}) == 1
    orchestrator.fail = Unreachable("nobody answers")
    assert client.step() <= 0.2, "the back-off starts anew"


def test_an_orchestrator_that_goes_away_later_does_not_lose_the_instance(orchestrator, asked):
    client, told = asked
    client.step()
    orchestrator.fail = Unreachable("nobody answers")
    for _ in range(3):
        client.step()
    orchestrator.fail = None
    client.step()
    assert {instance.id for instance in told} == {"i1"}
    assert [name for name, _ in orchestrator.calls].count("create") == 1


def test_an_instance_that_is_gone_is_asked_for_again_under_a_new_key(orchestrator, asked, caplog):
    client, told = asked
    client.step()
    orchestrator.fail = problem(404, "no such instance")
    client.run(Turns(1))
    orchestrator.fail = None
    client.run(Turns(1))
    assert [instance.id for instance in told] == ["i1", "i2"]
    keys = [key for name, key in orchestrator.calls if name == "create"]
    assert len(set(keys)) == 2
    assert caplog.messages == ["instance i1 is gone; asking for virtual-trail again"]


@pytest.mark.parametrize("state", [State.FAILED, State.STOPPED, State.STOPPING])
def test_an_instance_that_ended_is_asked_for_again(orchestrator, asked, state):
    client, told = asked
    orchestrator.states = [State.RUNNING, state, State.RUNNING]
    orchestrator.reason = "it crashed 5 times"
    client.step()
    client.step()
    assert client.trouble == f"instance i1 is {state}: it crashed 5 times"
    client.step()
    assert [instance.id for instance in told] == ["i1", "i2"]


def test_a_token_that_is_refused_is_said_once_and_tried_slowly(orchestrator, asked, caplog):
    client, _ = asked
    orchestrator.fail = problem(401, "the token is not known")
    assert client.step() == 10.0
    client.run(Turns(3))
    assert caplog.messages == ["the token is not known"]


def test_an_unknown_service_is_said_and_tried_again(orchestrator, asked):
    orchestrator.fail = problem(404, "there is no service virtual-trail")
    assert asked[0].step() <= 0.2
    assert asked[0].trouble == "there is no service virtual-trail"


def test_release_lets_the_instance_go(orchestrator, asked):
    client, _ = asked
    assert client.release() is None
    client.step()
    assert client.release() == "i1"
    assert [name for name, _ in orchestrator.calls[-2:]] == ["renew", "delete"], "what was counted last is told"
    assert orchestrator.calls[-2][1].report == Report(rtt_s=0.1)
    assert client.release() is None


def test_release_does_not_fail_when_nobody_answers(orchestrator, asked, caplog):
    client, _ = asked
    client.step()
    orchestrator.fail = Unreachable("nobody answers")
    assert client.release() is None
    assert "its lease will end it" in caplog.text


def test_run_goes_on_after_what_nobody_expected_and_ends_when_told(orchestrator, asked, monkeypatch):
    client, told = asked
    stop = threading.Event()
    answers = iter([ZeroDivisionError("strange"), None])

    def wait(delay: float) -> bool:
        orchestrator.fail = next(answers, None)
        return bool(told)

    monkeypatch.setattr(stop, "wait", wait)
    client.run(stop)
    assert [name for name, _ in orchestrator.calls] == ["create", "create"]
    assert client.trouble == ""


def test_a_service_that_is_not_wanted_any_more_is_let_go_and_asked_for_later(orchestrator):
    wanted = [REQUEST]
    client = LeaseClient(orchestrator, REQUEST, on_instance=lambda _: None, wanted=lambda: wanted[0])
    client.step()
    wanted[0] = None
    assert client.step() == 0.5
    assert client.step() == 0.5
    assert [name for name, _ in orchestrator.calls] == ["create", "delete"]
    wanted[0] = REQUEST
    client.step()
    keys = [key for name, key in orchestrator.calls if name == "create"]
    assert len(set(keys)) == 2


class Mover:
    """A lease client that wants to be elsewhere once, and what it was told."""

    def __init__(self, orchestrator):
        self.now, self.elsewhere, self.told, self.stayed = 0.0, False, [], []
        self.client = LeaseClient(
            orchestrator,
            REQUEST,
            on_instance=lambda instance: self.told.append(instance.id),
            elsewhere=lambda _: self.elsewhere,
            on_stayed=lambda instance, why: self.stayed.append((instance.id, why)),
            clock=lambda: self.now,
        )
        self.client.step()
        self.elsewhere = True


def test_it_moves_to_an_instance_elsewhere_once_that_runs_and_lets_the_first_go(orchestrator):
    mover = Mover(orchestrator)
    orchestrator.states = [State.RUNNING, State.PENDING, State.RUNNING, State.STARTING, State.RUNNING]
    mover.client.step()  # renews, asks elsewhere
    mover.elsewhere = False
    mover.client.step()  # renews, looks: starting
    assert "delete" not in [name for name, _ in orchestrator.calls]
    mover.client.step()
    assert [call for call in orchestrator.calls if call[0] == "delete"] == [("delete", "i1")]
    assert mover.told[-1] == "i2"
    assert mover.stayed == []
    assert mover.client.release() == "i2"


def test_an_instance_elsewhere_that_fails_or_dawdles_is_given_up_and_the_first_kept(orchestrator):
    mover = Mover(orchestrator)
    orchestrator.states = [State.RUNNING, State.PENDING, State.RUNNING, State.FAILED, State.RUNNING]
    orchestrator.reason = "no such image"
    mover.client.step()
    mover.client.step()
    assert mover.stayed == [("i1", "no such image")]
    orchestrator.states = [State.RUNNING, State.PENDING, State.RUNNING, State.STARTING, State.RUNNING]
    mover.client.step()
    mover.now = 21.0
    mover.client.step()
    assert len(mover.stayed) == 2
    assert mover.client.trouble == ""


def test_a_successor_is_followed_and_the_first_let_go_when_it_serves(orchestrator):
    serves = []
    told = []
    client = LeaseClient(
        orchestrator,
        REQUEST,
        on_instance=lambda instance: told.append(instance.id),
        taken_over=lambda instance: instance.id in serves,
    )
    client.step()
    orchestrator.successor = "i7"
    client.step()  # renews, learns of it
    orchestrator.successor = None
    client.step()
    client.step()
    assert told[-1] == "i7"
    assert "delete" not in [name for name, _ in orchestrator.calls], "the first drives until the other one does"
    serves.append("i7")
    client.step()
    assert [call for call in orchestrator.calls if call[0] == "delete"] == [("delete", "i1")]
    assert client.release() == "i7"


def test_when_the_first_ends_while_another_is_coming_that_one_is_kept(orchestrator):
    client = LeaseClient(orchestrator, REQUEST, on_instance=lambda _: None, taken_over=lambda _: False)
    client.step()
    orchestrator.successor = "i7"
    client.step()
    orchestrator.successor = None
    orchestrator.states = [State.FAILED, State.RUNNING]
    client.step()
    assert client.release() == "i7"


def test_a_refused_token_is_looked_for_again_and_a_new_one_tried_soon(orchestrator):
    fresh = [True, False]
    client = LeaseClient(orchestrator, REQUEST, on_instance=lambda _: None, on_refused=lambda: fresh.pop(0))
    orchestrator.fail = problem(401, "the token has expired")
    assert client.step() <= 0.2
    assert client.step() == 10.0


def problem(status: int, detail: str) -> ApiError:
    return ApiError(Problem(title="no", status=status, detail=detail))


def test_a_key_is_claimed_once_and_given_to_who_opens_the_session(orchestrator):
    told = []
    orchestrator.session = Session(id="ab" * 8, host="127.0.0.1", port=4711)
    client = LeaseClient(orchestrator, REQUEST, on_instance=told.append)
    for _ in range(3):
        client.step()
    assert [call for call in orchestrator.calls if call[0] == "claim"] == [("claim", "i1")]
    assert [instance.session.key for instance in told] == [orchestrator.KEY] * 3


def test_a_key_that_somebody_else_has_is_said_and_another_instance_asked_for(orchestrator):
    told = []
    orchestrator.session = Session(id="ab" * 8, host="127.0.0.1", port=4711)
    orchestrator.key_taken = True
    client = LeaseClient(orchestrator, REQUEST, on_instance=told.append)
    client.step()
    assert client.trouble == "was handed out already"
    orchestrator.key_taken = False
    client.step()
    assert [name for name, _ in orchestrator.calls] == ["create", "claim", "delete", "create", "claim"]
    keys = [what for name, what in orchestrator.calls if name == "create"]
    assert keys[0] != keys[1]
    assert [instance.session.key for instance in told] == [orchestrator.KEY]
