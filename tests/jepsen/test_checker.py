"""The checker finds what is wrong in made-up histories, and nothing in a good one."""

from __future__ import annotations

from collections.abc import Iterable
from copy import deepcopy
from typing import Any

import pytest

from .checker import Facts, check, given, table
from .history import Entry, History

LEASE = 10.0


def op(t: float, name: str, step: str, n: int, **fields: Any) -> Entry:
    return {"t": t, "kind": "op", "op": name, "step": step, "n": n, "who": "robot", "replica": 0, **fields}


def asked(t: float, name: str, n: int, answer: dict[str, Any], **fields: Any) -> list[Entry]:
    """An operation that took 0.1 s and was acknowledged."""
    known = {"lease_s": LEASE, **fields}
    ok = op(t + 0.1, name, "ok", n, **{"id": fields.get("id"), "state": "running", "reason": "", **answer})
    return [op(t, name, "invoke", n, **known), ok]


def event(t: float, number: int, state: str, reason: str = "", *, stream: int = 90, instance: str = "i1") -> Entry:
    fields = {"stream": stream, "id": instance, "event": number, "state": state, "reason": reason}
    return {"t": t, "kind": "event", **fields}


def look(t: float, **runs: list[str]) -> Entry:
    return {"t": t, "kind": "look", "place": "processes", "runs": runs}


def fault(t: float, name: str, step: str = "begin", hits: Iterable[str] = ()) -> Entry:
    return {"t": t, "kind": "fault", "fault": name, "step": step, "hits": list(hits)}


def final(t: float, when: str, state: str, runs: dict[str, list[str]]) -> Entry:
    row = stored(state, "key 1")
    states = ["pending", "placing", "starting", "running"] + (["stopping", "stopped"] if state == "stopped" else [])
    events = [[number, "i1", name, ""] for number, name in enumerate(states, start=11)]
    found = {"instances": {"i1": row}, "events": events, "runs": runs, "standbys": {}}
    return {"t": t, "kind": "final", "when": when, **found}


def stored(state: str, *keys: str, **more: Any) -> dict[str, Any]:
    """A row of the database."""
    row = {"state": state, "reason": "", "keys": [*keys], "replaces": None, "robot": "walker", "service": "toy"}
    return {**row, "spare": False, **more}


def good() -> list[Entry]:
    """One instance from its request to its end, and a leader that is killed meanwhile."""
    return [
        {"t": 0.0, "kind": "leader", "leaders": [0]},
        *asked(1.0, "create", 1, {"id": "i1", "state": "pending"}, key="key 1"),
        *asked(1.2, "create", 2, {"id": "i1", "state": "starting"}, key="key 1"),
        {"t": 1.3, "kind": "stream", "stream": 90, "id": "i1", "step": "begin"},
        event(1.4, 11, "pending"),
        event(1.5, 12, "placing"),
        event(1.6, 13, "starting"),
        look(1.7, i1=["session 7"]),
        event(2.0, 14, "running"),
        fault(3.0, "kill leader"),
        {"t": 3.0, "kind": "leader", "leaders": []},
        *asked(4.0, "renew", 3, {}, id="i1"),
        {"t": 5.5, "kind": "leader", "leaders": [1]},
        *asked(9.0, "renew", 4, {}, id="i1"),
        final(20.0, "settled", "running", {"i1": ["session 7"]}),
        *asked(21.0, "delete", 5, {}, id="i1"),
        event(21.2, 15, "stopping"),
        event(21.3, 16, "stopped"),
        {"t": 21.4, "kind": "stream", "stream": 90, "id": "i1", "step": "end"},
        final(25.0, "drained", "stopped", {}),
    ]


def rules(history: list[Entry]) -> list[str]:
    return [violation.rule for violation in check(sorted(history, key=lambda entry: float(entry["t"])))]


def without(history: list[Entry], **fields: Any) -> list[Entry]:
    return [entry for entry in history if not fields.items() <= entry.items()]


def of(history: list[Entry], **fields: Any) -> Entry:
    """The only entry with these."""
    [found] = [entry for entry in history if fields.items() <= entry.items()]
    return found


def test_a_good_history_has_no_violations() -> None:
    assert check(good()) == []


def test_two_processes_of_one_instance_are_one_violation_however_often_they_are_seen() -> None:
    both = ["session 7", "session 8"]
    assert rules([*good(), look(5.0, i1=both), look(5.1, i1=both)]) == ["runs twice"]
    assert rules([*good(), look(5.0, i1=["session 7"], i2=["session 8"])]) == []


@pytest.mark.parametrize("state", ["stopped", "failed"])
def test_a_process_of_what_has_ended_is_an_orphan(state: str) -> None:
    history = good()
    of(history, when="settled")["instances"]["i0"] = stored(state, "key 0")
    of(history, when="settled")["runs"]["i0"] = ["session 8"]
    assert rules(history) == ["left behind"]


def test_a_process_of_what_nobody_knows_is_an_orphan() -> None:
    history = good()
    of(history, when="drained")["runs"]["i0"] = ["session 8"]
    assert rules(history) == ["left behind"]


def test_what_runs_has_a_process_and_what_waits_does_not_wait_for_ever() -> None:
    history = good()
    of(history, when="settled")["runs"].clear()
    assert rules(history) == ["left behind"]
    history = good()
    of(history, when="settled")["instances"]["i1"]["state"] = "stopping"
    assert rules(history) == ["left behind"]


def test_what_was_acknowledged_may_not_be_missing() -> None:
    more = asked(2.0, "create", 50, {"id": "i2", "state": "pending"}, key="key 2")
    assert rules([*good(), *more]) == ["lost"]
    assert rules([*good(), more[0], op(4.0, "create", "unknown", 50)]) == []


def test_nobody_may_say_that_it_never_was() -> None:
    wrong = [op(6.0, "renew", "invoke", 51, id="i1"), op(6.1, "renew", "fail", 51, status=404, reason="never was")]
    assert rules([*good(), *wrong]) == ["lost"]


def test_a_key_makes_one_instance() -> None:
    history = good()
    other = stored("stopped", "key 1")
    of(history, when="drained")["instances"]["i2"] = other
    assert rules(history) == ["made twice"], "nobody was told of the second"
    assert rules([*history, *asked(2.0, "create", 50, {"id": "i2", "state": "pending"}, key="key 1")]) == ["made twice"]
    other["keys"] = []
    assert rules(history) == ["made twice"], "nobody asked for it"
    other["replaces"] = "i1"
    assert rules(history) == [], "a successor is made with no key"


def with_standby() -> list[Entry]:
    """A standby that runs, is given to a request, and ends; and another one in its place."""
    history = good()
    settled, drained = of(history, when="settled"), of(history, when="drained")
    settled["standbys"] = {"toy": 1}
    given = ["pending", "placing", "starting", "running", "running"]
    for final_, state, second in ((settled, "running", "running"), (drained, "stopped", "stopped")):
        final_["instances"]["i2"] = stored(state, "key 2")
        final_["instances"]["i3"] = stored(second, robot="", spare=True)
        final_["events"] += [[number, "i2", name, ""] for number, name in enumerate(given, start=1)]
    settled["runs"] |= {"i2": ["session 8"], "i3": ["session 9"]}
    return [*history, *asked(10.0, "create", 50, {"id": "i2"}, key="key 2")]


def test_a_standby_is_nobodys_until_it_is_given_to_one_request() -> None:
    assert rules(with_standby()) == []
    assert given(Facts(with_standby())) == {"i2": 1}
    again = asked(11.0, "create", 51, {"id": "i2"}, key="key 3")
    assert rules([*with_standby(), *again]) == ["standby"]
    for column, wrong in (("replaces", "i1"), ("robot", "")):
        history = with_standby()
        of(history, when="drained")["instances"]["i2"][column] = wrong
        assert rules(history) == ["standby"], column
    history = with_standby()
    of(history, when="drained")["instances"]["i3"]["robot"] = "walker"
    assert rules(history) == ["standby"], "nobody may have it yet"
    history = with_standby()
    of(history, when="drained")["events"].append([6, "i2", "running", ""])
    assert rules(history) == ["standby"], "given twice"


def test_in_the_end_there_are_as_many_standbys_as_there_are_to_be() -> None:
    history = with_standby()
    of(history, when="settled")["standbys"] = {"toy": 2}
    assert rules(history) == ["left behind"]
    history = with_standby()
    of(history, when="drained")["instances"]["i3"]["state"] = "running"
    of(history, when="drained")["runs"]["i3"] = ["session 9"]
    assert rules(history) == ["left behind"]
    history = with_standby()
    of(history, when="settled")["runs"]["i2"] = ["session 9"]
    assert rules([*history, look(12.0, i2=["session 9"], i3=["session 9"])]) == ["runs twice"]


def test_a_successor_that_a_robot_was_told_of_may_not_be_missing() -> None:
    assert rules([*good(), *asked(6.0, "renew", 50, {"id": "i1", "successor": "i2"}, id="i1")]) == ["lost"]


def test_what_was_deleted_ends() -> None:
    history = [*good(), *asked(10.0, "delete", 50, {}, id="i1")]
    assert rules(history) == ["does not end"]
    history = good()
    of(history, when="drained")["runs"]["i1"] = ["session 7"]
    assert sorted(rules(history)) == ["does not end", "left behind"]


def ended(t: float) -> list[Entry]:
    history = good()
    end = of(history, event=15)
    end.update(t=t, reason="the robot did not renew its lease of 10 s")
    for when in ("settled", "drained"):
        rows = of(history, when=when)["events"]
        rows[4:5] = [[15, "i1", "stopping", end["reason"]]] if len(rows) > 4 else []
    return history


def test_a_lease_that_was_kept_does_not_run_out() -> None:
    assert rules(ended(18.9)) == ["lease"], "kept at 9.0"
    assert rules(ended(19.1)) == []
    told = asked(12.0, "renew", 50, {"state": "stopping", "reason": "the robot did not renew its lease"}, id="i1")
    assert rules([*good(), *told]) == ["lease"], "and so is one of which only a renewal tells"
    moved = asked(18.0, "migrate", 50, {"id": "i1", "state": "running"}, of="i0")
    assert rules([*ended(19.1), *moved]) == [], "it is coming already, and nobody renews it"


def test_an_event_is_told_once_and_in_order() -> None:
    history = good()
    assert rules(without(history, event=13)) == ["stream"]
    assert rules([*history, event(2.1, 14, "running")]) == ["stream"]
    assert rules(without(history, event=16)) == ["stream"], "the end was said to be there"
    of(history, event=12)["t"] = 1.39
    assert rules(history) == ["stream"]
    assert rules(without(without(good(), event=16), step="end")) == ["stream"], "it never ended"


def restarted(hits: Iterable[str]) -> list[Entry]:
    history = deepcopy(good())
    reason = "the service is gone; starting it again"
    of(history, event=14)["t"] = 1.65
    more = [event(3.2, 17, "starting", reason), event(3.3, 18, "running")]
    for entry, moved in ((of(history, event=15), 19), (of(history, event=16), 20)):
        entry["event"] = moved
    for when in ("settled", "drained"):
        rows = of(history, when=when)["events"]
        for row in rows[4:]:
            row[0] += 4
        rows[4:4] = [[17, "i1", "starting", reason], [18, "i1", "running", ""]]
    return [*history, *more, fault(3.1, "kill service", hits=hits)]


def test_what_runs_well_is_not_started_again() -> None:
    assert rules(restarted(hits=())) == ["restart"]
    assert rules(restarted(hits=["i1"])) == []


@pytest.mark.parametrize(("status", "rule"), [(409, ["refused"]), (500, ["mistake"]), (503, [])])
def test_refusals(status: int, rule: list[str]) -> None:
    fields = {"status": status, "reason": "no site can run 'toy'"}
    wrong = [op(6.0, "create", "invoke", 50, key="key 9"), op(6.1, "create", "fail", 50, **fields)]
    assert rules([*good(), *wrong]) == rule


def test_a_traceback_in_a_log() -> None:
    assert rules([*good(), {"t": 4.0, "kind": "traceback", "line": "ERROR GET /x failed"}]) == ["mistake"]


def test_the_table_says_what_came_of_each_fault() -> None:
    history = [*good(), look(2.5, i2=["session 1", "session 2"]), look(5.0, i1=["session 7", "session 8"])]
    none, kill = table(sorted(history, key=lambda entry: float(entry["t"])))
    assert (none.fault, none.times, len(none.violations), none.gap_s) == ("(none)", 0, 1, 0)
    assert (kill.fault, kill.times, len(kill.violations), kill.gap_s) == ("kill leader", 1, 1, 2.5)
    assert none.wait_s == pytest.approx(1.0)


def test_a_history_numbers_and_dates_its_entries() -> None:
    history = History()
    assert history.number() < history.number()
    first, second = history.add("look", runs={}), history.add("look", runs={})
    assert history.entries == [first, second]
    assert first["t"] <= second["t"]
