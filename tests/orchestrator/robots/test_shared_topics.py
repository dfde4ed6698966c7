"""What robots of a group share: told to the group's others with the same service, to nobody else, and not for long."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import pytest
from sqlalchemy.exc import OperationalError

from skytether.api.client import ApiError
from skytether.api.manifest import Manifest
from skytether.api.rest import MOST_NEIGHBOURS, MOST_SHARED, InstanceCreate, Neighbours, RobotCreate, Share, State
from skytether.orchestrator.access.access import Principal
from skytether.orchestrator.domain.errors import ConflictError, ForbiddenError, NotFoundError
from skytether.orchestrator.domain.records import Record
from skytether.orchestrator.domain.security import TokenHash, new_token
from skytether.orchestrator.robots.shared_topics import KEPT_S, SharedTopics
from skytether.orchestrator.store.database import RobotRow, TokenRow
from skytether.orchestrator.store.store import Store

STRING = "std_msgs/msg/String"
TOPICS = [
    {"name": "seen", "type": STRING, "direction": "out", "shared": True},
    {"name": "heard", "type": STRING, "direction": "in", "shared": True},
]
GROUPS = {"a": "hall", "b": "hall", "c": "yard", "d": None}


def add(store: Store, robot: str, group: str | None) -> None:
    token = TokenRow(robot, robot, robot, (), TokenHash.of(new_token()), 0.0)
    store.add_robot(RobotRow(robot, ("*",), 0.0, group=group), token)


class Robots:
    """Asks an shared_topics as robots do."""

    def __init__(self, shared_topics: SharedTopics, new_record: Any, manifest: Any) -> None:
        self.shared_topics = shared_topics
        self._record = new_record
        self._manifest = manifest

    def record(self, robot: str, service: str = "toy", topics: Any = TOPICS, **changes: Any) -> Record:
        made: Record = self._record(
            f"{robot}-{service}",
            robot=robot,
            service=service,
            manifest=self._manifest(service, topics=topics),
            **changes,
        )
        return made

    def ask(self, robot: str, text: str | None = None, service: str = "toy", age: float = 0.0) -> Neighbours:
        share = Share(text=text, age_s=age)
        return self.shared_topics.share(Principal(robot), self.record(robot, service), share)

    def heard(self, robot: str, service: str = "toy") -> dict[str, tuple[str, float]]:
        return {one.robot: (one.text, one.age_s) for one in self.ask(robot, service=service).others}


@pytest.fixture
def robots(store: Store, clock: Any, new_record: Any, manifest: Any) -> Robots:
    for robot, group in GROUPS.items():
        add(store, robot, group)
    return Robots(SharedTopics(store, clock), new_record, manifest)


def test_a_word_goes_to_the_same_service_of_the_groups_others(robots: Robots, clock: Any) -> None:
    assert robots.ask("a", "a crate") == Neighbours(group="hall")
    clock.forward(2.0)
    assert robots.heard("b") == {"a": ("a crate", 2.0)}
    assert robots.heard("b", service="other") == {}
    assert robots.heard("a") == {}, "nobody hears himself"
    assert robots.heard("c") == {}
    assert robots.ask("d", "mine") == Neighbours(), "it is in no group"
    robots.ask("a", "two crates", age=0.5)
    assert robots.heard("b") == {"a": ("two crates", 0.5)}


def test_who_is_in_no_group_tells_nobody_even_later(robots: Robots) -> None:
    robots.ask("d", "mine")
    robots.shared_topics.put("d", "hall")
    assert robots.heard("a") == {}


def test_who_changes_its_group_takes_nothing_along(robots: Robots) -> None:
    robots.ask("a", "in the hall")
    robots.shared_topics.put("a", "yard")
    assert robots.heard("b") == {}
    assert robots.heard("c") == {}
    robots.ask("a", "in the yard")
    assert robots.heard("c") == {"a": ("in the yard", 0.0)}
    robots.shared_topics.put("a", None)
    assert robots.heard("c") == {}
    with pytest.raises(NotFoundError, match="there is no robot 'nobody'"):
        robots.shared_topics.put("nobody", "hall")


def test_a_word_is_forgotten_after_its_time(robots: Robots, store: Store, clock: Any) -> None:
    robots.ask("a", "a crate", age=10.0)
    robots.shared_topics.sync()
    clock.forward(KEPT_S - 10.5)
    assert robots.heard("b") == {"a": ("a crate", KEPT_S - 0.5)}
    clock.forward(1.0)
    assert robots.heard("b") == {}
    robots.shared_topics.sync()
    assert store.shared() == []


def test_a_clock_that_was_set_back_keeps_no_word(robots: Robots, clock: Any) -> None:
    robots.ask("a", "a crate")
    clock.set_by(-3600)
    assert robots.heard("b") == {}


def test_only_the_robot_itself_shares_and_only_what_runs_and_shares(robots: Robots) -> None:
    for who in (Principal("b"), Principal(None)):
        with pytest.raises(ForbiddenError, match="only robot 'a' itself"):
            robots.shared_topics.share(who, robots.record("a"), Share(text="a lie"))
    with pytest.raises(ConflictError, match="shares nothing"):
        robots.shared_topics.share(Principal("a"), robots.record("a", topics=[]), Share(text="x"))
    with pytest.raises(ConflictError, match="is stopped"):
        robots.shared_topics.share(Principal("a"), robots.record("a", state=State.STOPPED), Share(text="x"))
    assert robots.heard("b") == {}


@pytest.mark.parametrize(("kept", "told", "hears"), [(0, True, False), (1, False, True)])
def test_a_service_may_only_tell_or_only_hear(robots: Robots, kept: int, told: bool, hears: bool) -> None:
    robots.ask("b", "from b")
    one_way = robots.record("a", topics=[TOPICS[kept]])
    answer = robots.shared_topics.share(Principal("a"), one_way, Share(text="from a"))
    assert bool(answer.others) == hears
    assert ("a" in robots.heard("b")) == told


def test_of_a_crowd_those_heard_last_are_told(robots: Robots, store: Store, clock: Any) -> None:
    names = [f"r{n:02}" for n in range(MOST_NEIGHBOURS + 5)]
    for name in names:
        add(store, name, "hall")
    robots.shared_topics.sync()
    for name in names:
        robots.ask(name, name)
        clock.forward(0.1)
    assert sorted(robots.heard("a")) == names[5:]


def test_any_of_several_orchestrators_may_be_asked(robots: Robots, store: Store, clock: Any) -> None:
    here, there = robots.shared_topics, SharedTopics(store, clock)
    robots.ask("a", "from a")
    here.sync()
    robots.shared_topics = there
    robots.ask("b", "from b")
    there.sync()
    assert robots.heard("b") == {"a": ("from a", 0.0)}
    robots.shared_topics = here
    here.sync()
    assert robots.heard("a") == {"b": ("from b", 0.0)}
    robots.shared_topics = there
    there.put("b", None)
    robots.shared_topics = here
    here.sync()
    assert robots.heard("a") == {}


def test_what_cannot_be_written_is_kept_for_the_next_time(
    robots: Robots, store: Store, clock: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    def away(*_: Any) -> None:
        raise OperationalError("", {}, Exception("away"))

    robots.ask("a", "a crate")
    with monkeypatch.context() as patch:
        patch.setattr(store, "save_shared", away)
        with pytest.raises(OperationalError):
            robots.shared_topics.sync()
    assert robots.heard("b") == {"a": ("a crate", 0.0)}
    robots.shared_topics.sync()
    assert [(row.robot, row.group, row.text) for row in store.shared()] == [("a", "hall", "a crate")]


def test_words_go_with_their_robot(robots: Robots, store: Store) -> None:
    robots.ask("a", "a crate")
    robots.shared_topics.sync()
    store.delete_robot("a")
    robots.shared_topics.sync()
    assert store.shared() == []
    assert robots.heard("b") == {}


def test_over_rest(served: Any, manifest: Callable[..., dict[str, Any]]) -> None:
    served.operator.put_service("toy", manifest(topics=TOPICS))
    served.site("lab")
    token = served.operator.create_robot(RobotCreate(name="a", group="hall")).token
    one, other = served.client(token), served.robot("b")
    ids = {}
    for name, client in (("a", one), ("b", other)):
        ids[name] = client.create_instance(InstanceCreate(robot=name, service="toy")).id
    one.share(ids["a"], Share(text="a crate"))
    assert other.share(ids["b"], Share()) == Neighbours()
    served.operator.set_group("b", "hall")
    (heard,) = other.share(ids["b"], Share()).others
    assert (heard.robot, heard.text) == ("a", "a crate")
    assert [robot.group for robot in served.operator.robots()] == ["hall", "hall"]
    with pytest.raises(ApiError, match="there is no instance"):
        other.share(ids["a"], Share(text="a lie"))
    long = ({"text": "x" * (MOST_SHARED + 1)}, {"text": "\U0001f916" * (MOST_SHARED // 4 + 1)})
    for wrong in (*long, {"text": "a\x01"}, {"text": "a\0"}, {"age_s": -1.0}):
        with pytest.raises(ApiError) as refused:
            one.share(ids["a"], Share.model_construct(**{"text": None, "age_s": 0.0, **wrong}))
        assert refused.value.problem.status == 422


@pytest.mark.parametrize(
    ("changes", "says"),
    [
        ([{"type": "sensor_msgs/msg/LaserScan"}, {}], "shared: true is for a topic of type std_msgs/msg/String"),
        ([{"direction": "in"}, {}], "one topic of each direction may be shared"),
    ],
)
def test_a_manifest_shares_one_text_each_way(
    manifest: Callable[..., dict[str, Any]], changes: list[dict[str, Any]], says: str
) -> None:
    topics = [row | change for row, change in zip(TOPICS, changes, strict=True)]
    with pytest.raises(ValueError, match=says):
        Manifest.model_validate(manifest(topics=topics))
