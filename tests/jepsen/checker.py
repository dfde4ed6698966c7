"""Judges a history; pure. Each rule is a function from a history to its violations."""

from __future__ import annotations

import math
from collections import defaultdict
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, field
from itertools import pairwise
from typing import Any

from .history import Entry

HOLDS = ("starting", "running", "stopping")
"""States in which an instance may have a run."""
FINAL = ("stopped", "failed")
VANISHED = "did not renew its lease"
NO_SITE = "no site can run"


@dataclass(frozen=True)
class Violation:
    """A promise that was broken."""

    rule: str
    t: float
    """Seconds since the run began: when it was first seen."""
    text: str


class Facts:
    """A history by kind of entry, in order of time."""

    def __init__(self, history: Iterable[Entry]) -> None:
        kinds: dict[str, list[Entry]] = defaultdict(list)
        for entry in history:
            kinds[entry["kind"]].append(entry)
        self.ops, self.events, self.streams = kinds["op"], kinds["event"], kinds["stream"]
        self.looks, self.leaders, self.faults = kinds["look"], kinds["leader"], kinds["fault"]
        self.tracebacks = kinds["traceback"]
        self.finals = {entry["when"]: entry for entry in kinds["final"]}
        self.invoked = {entry["n"]: entry for entry in self.ops if entry["step"] == "invoke"}
        self.end = max((entry["t"] for entries in kinds.values() for entry in entries), default=0.0)

    def answered(self, *names: str) -> Iterator[tuple[Entry, Entry]]:
        """What was asked and what was answered, of acknowledged operations of these names."""
        for entry in self.ops:
            if entry["step"] == "ok" and entry["op"] in names:
                yield self.invoked[entry["n"]], entry

    @property
    def stored(self) -> dict[str, dict[str, Any]]:
        """Every instance that the database has, as seen last."""
        return {i: row for name in ("settled", "drained") if name in self.finals for i, row in self._of(name)}

    def _of(self, name: str) -> Iterable[tuple[str, dict[str, Any]]]:
        instances: dict[str, dict[str, Any]] = self.finals[name]["instances"]
        return instances.items()

    @property
    def truth(self) -> dict[str, list[tuple[int, str, str]]]:
        """The events of each instance that the database has: number, state, reason; in order."""
        found: dict[str, list[tuple[int, str, str]]] = defaultdict(list)
        last = self.finals.get("drained") or self.finals.get("settled")
        for number, instance, state, reason in last["events"] if last else ():
            found[instance].append((number, state, reason))
        return {instance: sorted(rows) for instance, rows in found.items()}


def doubles(facts: Facts) -> Iterator[Violation]:
    """Two runs of one instance never live at one time, and none is two instances'."""
    told = set()
    for look in facts.looks:
        owners: dict[str, str] = {}
        for instance, name in ((i, name) for i, names in look["runs"].items() for name in names):
            other = owners.setdefault(name, instance)
            if other != instance and name not in told:
                told.add(name)
                yield Violation("runs twice", look["t"], f"{name} at {look['place']} is {other}'s and {instance}'s")
        for instance, names in look["runs"].items():
            if len(names) > 1 and instance not in told:
                told.add(instance)
                yield Violation("runs twice", look["t"], f"{instance} at {look['place']}: {', '.join(names)}")


def orphans(facts: Facts) -> Iterator[Violation]:
    """What lives belongs to a live instance, and each that runs has its run."""
    for when, final in facts.finals.items():
        for text in unsettled(final):
            yield Violation("left behind", final["t"], f"{when}: {text}")


def unsettled(final: Entry) -> list[str]:
    """What is not yet as it should be in the end, in words; of a ``final`` entry."""
    instances, runs, wrong = final["instances"], final["runs"], []
    for instance, names in runs.items():
        state = instances.get(instance, {}).get("state", "unknown to the database")
        if state not in HOLDS:
            wrong.append(f"{instance} ({state}) has {', '.join(names)}")
    for instance, row in instances.items():
        if row["state"] == "running" and not runs.get(instance):
            wrong.append(f"{instance} is running, and has no process")
        elif row["state"] not in ("running", *FINAL):
            wrong.append(f"{instance} stays {row['state']}: {row['reason']}")
        elif row["state"] == "running" and final["when"] == "drained":
            wrong.append(f"{instance} runs on")
    if final["when"] == "settled":
        wrong += _unsettled_standbys(final)
    return wrong


def _unsettled_standbys(final: Entry) -> list[str]:
    live = [row for row in final["instances"].values() if row["spare"] and row["state"] == "running"]
    there = {service: sum(row["service"] == service for row in live) for service in final["standbys"]}
    return [
        f"{service} is to have {wanted} standbys, and has {there[service]}"
        for service, wanted in final["standbys"].items()
        if there[service] != wanted
    ]


def lost(facts: Facts) -> Iterator[Violation]:
    """What was acknowledged is there, and nobody says that it never was."""
    known = facts.stored
    acknowledged = {}
    for _, answer in facts.answered("create", "migrate"):
        acknowledged.setdefault(answer["id"], answer["t"])
    for _, answer in facts.answered("renew"):
        if answer.get("successor"):
            acknowledged.setdefault(answer["successor"], answer["t"])
    if facts.finals:
        for instance, t in acknowledged.items():
            if instance not in known:
                yield Violation("lost", t, f"{instance} was acknowledged, and the database has none")
    told = set()
    for entry in facts.ops:
        asked = facts.invoked.get(entry["n"], entry)
        instance = asked.get("id")
        if entry["step"] == "fail" and entry["status"] == 404 and instance in acknowledged and instance not in told:
            told.add(instance)
            yield Violation("lost", entry["t"], f"{instance} was acknowledged, then: {entry['reason']}")


def made_twice(facts: Facts) -> Iterator[Violation]:
    """One idempotency key makes one instance, and what is no successor was made with one."""
    by_key: dict[str, set[str]] = defaultdict(set)
    for asked, answer in facts.answered("create"):
        made = by_key[asked["key"]]
        if made and answer["id"] not in made:
            yield Violation("made twice", answer["t"], f"key {asked['key']}: {answer['id']}, {', '.join(made)}")
        made.add(answer["id"])
    stored: dict[str, list[str]] = defaultdict(list)
    for instance, row in facts.stored.items():
        for key in row["keys"]:
            stored[key].append(instance)
        if not (row["keys"] or row["replaces"] or row["spare"]):
            yield Violation("made twice", facts.end, f"{instance} of {row['robot']} was made with no key")
    for key, made_for in stored.items():
        if len(made_for) > 1 and len(by_key[key]) < 2:
            yield Violation("made twice", facts.end, f"key {key}, in the database: {', '.join(made_for)}")


def standbys(facts: Facts) -> Iterator[Violation]:
    """A standby is nobody's, until it is given to one request, or as one instance's successor."""
    asked_with: dict[str, set[str]] = defaultdict(set)
    for asked, answer in facts.answered("create"):
        keys = asked_with[answer["id"]]
        if keys and asked["key"] not in keys:
            text = f"{answer['id']} was given to the requests {asked['key']} and {', '.join(keys)}"
            yield Violation("standby", answer["t"], text)
        keys.add(asked["key"])
    for instance, row in facts.stored.items():
        keys = asked_with[instance] | {*row["keys"]}
        if row["replaces"] and keys:
            text = f"{instance} was given to the request {', '.join(keys)}, and as successor of {row['replaces']}"
            yield Violation("standby", facts.end, text)
        if row["spare"] is bool(row["robot"]):
            owner = f"robot {row['robot']}'s" if row["robot"] else "nobody's"
            kind = "a standby" if row["spare"] else "no standby"
            yield Violation("standby", facts.end, f"{instance} is {owner}, and {kind}")
    for instance, times in given(facts).items():
        if times > 1:
            yield Violation("standby", facts.end, f"{instance} was given {times} times")


def given(facts: Facts) -> dict[str, int]:
    """Standbys that a robot got, and how often: that alone is told as an event without a change."""
    repeats = {i: sum(a[1:] == b[1:] for a, b in pairwise(rows)) for i, rows in facts.truth.items()}
    return {instance: times for instance, times in repeats.items() if times}


def undead(facts: Facts) -> Iterator[Violation]:
    """What was acknowledged as ended has ended, and nothing of it lives."""
    told = set()
    for asked, answer in facts.answered("delete"):
        instance = asked["id"]
        for when, final in facts.finals.items():
            row, runs = final["instances"].get(instance), final["runs"].get(instance)
            if instance in told or answer["t"] > final["t"] or not (runs or (row and row["state"] not in FINAL)):
                continue
            told.add(instance)
            state = row["state"] if row else "forgotten"
            text = f"{instance} was deleted; {when}: {state}, {', '.join(runs or ['no process'])}"
            yield Violation("does not end", answer["t"], text)


def leases(facts: Facts) -> Iterator[Violation]:
    """A lease that was renewed in time does not run out.

    It was good from the beginning of the last request that kept it on, at the earliest; if its end was seen before that
    and its length, the robot is blamed for what it did not do.
    """
    kept: dict[str, list[tuple[float, float, float]]] = defaultdict(list)
    for asked, answer in facts.answered("create", "migrate", "renew"):
        # Who asks to move what is being moved already is told of what is coming, and renews nothing by that.
        coming = answer["op"] == "migrate" and (answer["id"] in kept or answer["state"] != "pending")
        if answer["state"] not in ("stopping", *FINAL) and not coming:
            kept[answer["id"]].append((answer["t"], asked["t"], asked["lease_s"]))
    for instance, (t, reason) in _ran_out(facts).items():
        good = max((begun + length for answered, begun, length in kept[instance] if answered <= t), default=-math.inf)
        if t < good:
            yield Violation("lease", t, f"{instance}: {reason}; it was good for {good - t:.1f} s more at least")


def _ran_out(facts: Facts) -> dict[str, tuple[float, str]]:
    """Instances of which somebody was told that their robot did not renew; when that was first."""
    found: dict[str, tuple[float, str]] = {}
    for entry in sorted([*facts.ops, *facts.events], key=lambda entry: float(entry["t"])):
        if VANISHED in entry.get("reason", "") and entry.get("id") and entry.get("step", "ok") == "ok":
            found.setdefault(entry["id"], (entry["t"], entry["reason"]))
    return found


def leases_not_kept(facts: Facts) -> int:
    """How many leases ran out of robots that were asking all the time, without an answer."""
    gone = {entry.get("id") for entry in facts.ops if entry["op"] in ("vanish", "delete")}
    return len(_ran_out(facts).keys() - gone)


def streams(facts: Facts) -> Iterator[Violation]:
    """A stream tells each event once, in order, from the first on; and all of them, if it was followed to its end."""
    truth = facts.truth
    if "drained" not in facts.finals:
        return  # nobody knows what there was to tell
    got: dict[int, list[Entry]] = defaultdict(list)
    for event in facts.events:
        got[event["stream"]].append(event)
    steps = {(entry["stream"], entry["step"]): entry for entry in facts.streams}
    for (stream, step), begun in steps.items():
        if step != "begin":
            continue
        told = [(event["event"], event["state"], event["reason"]) for event in got[stream]]
        expected = truth.get(begun["id"], [])
        ended = steps.get((stream, "end"))
        wrong = _first_wrong(told, expected, whole=ended is not None)
        if wrong:
            t = got[stream][-1]["t"] if got[stream] else begun["t"]
            yield Violation("stream", t, f"{begun['id']}, stream {stream}: {wrong}")
        elif ended is None:
            last = told[-1] if told else "nothing"
            yield Violation("stream", begun["t"], f"{begun['id']}, stream {stream}: never ended, last {last}")


def _first_wrong(told: Sequence[Any], expected: Sequence[Any], *, whole: bool) -> str:
    for at, event in enumerate(told):
        if at >= len(expected) or event != expected[at]:
            wanted = expected[at] if at < len(expected) else "nothing more"
            kind = "twice" if event in told[:at] else "out of order or lost"
            return f"{kind}: {event} instead of {wanted}"
    return f"lost: {expected[len(told)]}" if whole and len(told) < len(expected) else ""


def restarts(facts: Facts) -> Iterator[Violation]:
    """What runs well is not started again, unless it was hit itself."""
    hits: dict[str, list[float]] = defaultdict(list)
    for fault in facts.faults:
        for instance in fault.get("hits", ()):
            hits[instance].append(fault["t"])
    seen: dict[str, float] = {}
    for event in facts.events:
        if "starting it again" in event["reason"]:
            seen.setdefault(event["id"], event["t"])
    for instance, rows in facts.truth.items():
        again = [
            reason
            for (_, before, _), (_, after, reason) in pairwise(rows)
            if (before, after) == ("running", "starting")
        ]
        if len(again) > len(hits[instance]):
            text = f"{instance} was hit {len(hits[instance])} times, and started again: {'; '.join(again)}"
            yield Violation("restart", seen.get(instance, facts.end), text)


def refusals(facts: Facts) -> Iterator[Violation]:
    """There are sites all the time: nobody is told for good that there is none."""
    for entry in facts.ops:
        if entry["step"] == "fail" and entry["op"] == "create" and entry["status"] == 409:
            yield Violation("refused", entry["t"], f"{entry['who']} at {entry['replica']}: {entry['reason']}")


def mistakes(facts: Facts) -> Iterator[Violation]:
    """Whatever happens, an answer says what to do: 500 is a mistake of the program, and so is a traceback in a log."""
    for entry in facts.ops:
        if entry["step"] == "fail" and entry["status"] == 500:
            yield Violation("mistake", entry["t"], f"{entry['op']} at {entry['replica']}: {entry['reason']}")
    for entry in facts.tracebacks:
        yield Violation("mistake", entry["t"], f"traceback after: {entry['line']}")


RULES: tuple[Callable[[Facts], Iterator[Violation]], ...] = (
    doubles,
    orphans,
    lost,
    made_twice,
    standbys,
    undead,
    leases,
    streams,
    restarts,
    refusals,
    mistakes,
)


def check(history: Iterable[Entry]) -> list[Violation]:
    """All violations, in order of time."""
    facts = Facts(history)
    return sorted((found for rule in RULES for found in rule(facts)), key=lambda violation: violation.t)


@dataclass
class Row:
    """What came of one kind of fault."""

    fault: str
    times: int = 0
    violations: list[Violation] = field(default_factory=list)
    gap_s: float = 0.0
    """The longest time in which nobody led."""
    wait_s: float = 0.0
    """The longest time from a request to a service that runs."""


def table(history: Sequence[Entry]) -> list[Row]:
    """By kind of fault. What was seen between one fault's begin and the next one's is counted as the first one's."""
    facts = Facts(history)
    begins = [(fault["t"], fault["fault"]) for fault in facts.faults if fault["step"] == "begin"]
    rows = {"(none)": Row("(none)")}
    for _, name in begins:
        rows.setdefault(name, Row(name)).times += 1

    def row(t: float) -> Row:
        return rows[next((name for begun, name in reversed(begins) if begun <= t), "(none)")]

    for violation in check(history):
        row(violation.t).violations.append(violation)
    for t, gap in gaps(facts):
        row(t).gap_s = max(row(t).gap_s, gap)
    for t, wait in waits(facts):
        row(t).wait_s = max(row(t).wait_s, wait)
    return list(rows.values())


def gaps(facts: Facts) -> Iterator[tuple[float, float]]:
    """When nobody began to lead, and for how long; after somebody led first."""
    since, led = None, False
    for entry in facts.leaders:
        if entry["leaders"]:
            if since is not None:
                yield since, entry["t"] - since
            since, led = None, True
        elif led and since is None:
            since = entry["t"]
    if since is not None:
        yield since, facts.end - since


def waits(facts: Facts) -> Iterator[tuple[float, float]]:
    """When each acknowledged instance was first asked for, and how long it took until somebody saw it running."""
    began: dict[str, float] = {}
    for asked, answer in facts.answered("create", "migrate"):
        began.setdefault(answer["id"], asked["t"])
    for entry in sorted([*facts.ops, *facts.events], key=lambda entry: float(entry["t"])):
        if entry.get("state") == "running" and entry.get("id") in began:
            begun = began.pop(entry["id"])
            yield begun, entry["t"] - begun
