"""What the agent carries between its service and the other robots of its group."""

import json
from itertools import count

import pytest

from skytether.api.client import ApiError, Unreachable
from skytether.api.manifest import TopicSpec
from skytether.api.rest import MOST_NEIGHBOURS, MOST_SHARED, Neighbours, Problem, Share, Shared
from skytether.messages import String, decode, encode
from skytether.robot.offload.shared_topics import Serving, SharedTopics, SharedTopicsExchange
from skytether.robot.session.session import LiveSession
from skytether.wire.events import Connected, MessageReceived
from skytether_services.navigation.shared_word import read_said

TOPICS = SharedTopics("seen", "heard")
OTHER = Shared(robot="other", age_s=0.5, text="a crate")


class Exchange:
    def __init__(self):
        self.answer = Neighbours(group="hall", others=(OTHER,))
        self.asked = []

    def share(self, instance, share):
        self.asked.append((instance, share))
        if isinstance(self.answer, Exception):
            raise self.answer
        return self.answer


class Scene:
    def __init__(self, bridge, topics=TOPICS, id_="ab"):
        self.now = 100.0
        self.bridge = bridge
        self.exchange = Exchange()
        self.refused = 0
        self.serving = self.session_of(topics, id_)
        self.sharing = SharedTopicsExchange(
            self.exchange, lambda: self.serving, on_refused=self.on_refused, clock=lambda: self.now
        )

    def on_refused(self):
        self.refused += 1

    def session_of(self, topics, id_):
        session = LiveSession(id_, frozenset(topics.readings), "cmd_vel", count(1), shared_topic=topics.said)
        session.open(lambda _: self.bridge, ("10.0.0.1", 4000))
        session.notify(Connected(()))
        return Serving(session, "i1", topics)

    def deliver(self, text, *, payload=None):
        payload = encode(String(text), "cdr") if payload is None else payload
        self.serving.session.deliver(MessageReceived("seen", payload, 0, self.now, 0.0, self.now))

    def after(self, seconds):
        self.now += seconds
        self.sharing.step()

    @property
    def heard(self):
        return [(topic, json.loads(decode(String, payload, "cdr").data)) for topic, payload in self.bridge.published]


@pytest.fixture
def scene(bridge):
    return Scene(bridge)


def test_what_the_service_says_goes_out_once_and_what_the_others_say_comes_in(scene):
    scene.deliver("old")
    scene.deliver("a wall")
    scene.after(0.25)
    assert scene.exchange.asked == [("i1", Share(text="a wall", age_s=0.25))]
    assert scene.heard == [("heard", [{"robot": "other", "age_s": 0.5, "text": "a crate"}])]
    scene.after(1.0)
    assert scene.exchange.asked[1:] == [("i1", Share())]


def test_without_a_group_the_service_hears_nothing_and_the_agent_looks_now_and_then(scene):
    scene.exchange.answer = Neighbours()
    for _ in range(12):
        scene.after(1.0)
    assert len(scene.exchange.asked) == 2
    assert scene.heard == []
    scene.exchange.answer = Neighbours(group="hall")
    scene.after(10.0)
    assert scene.heard == [("heard", [])], "now it knows that there is a group"


def test_another_session_is_shared_with_at_once(scene):
    scene.exchange.answer = Neighbours()
    scene.after(1.0)
    scene.serving = scene.session_of(TOPICS, "cd")
    scene.after(1.0)
    assert len(scene.exchange.asked) == 2


def test_nothing_is_asked_for_a_service_that_shares_nothing_or_that_is_not_there(bridge):
    scene = Scene(bridge, SharedTopics())
    scene.after(1.0)
    scene.serving = None
    scene.after(1.0)
    assert scene.exchange.asked == []


def test_a_service_that_only_tells_hears_nothing(bridge):
    scene = Scene(bridge, SharedTopics("seen", None))
    scene.deliver("a wall")
    scene.after(1.0)
    assert scene.exchange.asked == [("i1", Share(text="a wall", age_s=1.0))]
    assert scene.heard == []


def test_an_orchestrator_that_is_away_is_asked_again_later(scene):
    scene.exchange.answer = Unreachable("nobody there")
    for _ in range(10):
        scene.after(1.0)
    assert len(scene.exchange.asked) == 1
    scene.exchange.answer = ApiError(Problem(title="no", status=401))
    scene.after(1.0)
    assert (len(scene.exchange.asked), scene.refused) == (2, 1)


def test_what_is_no_text_or_too_long_is_left_out_and_named(scene, caplog):
    scene.deliver("", payload=b"\x00\x01\x00\x00\xff\xff\xff\xff")
    scene.after(1.0)
    scene.deliver("x" * (MOST_SHARED + 1))
    scene.after(1.0)
    scene.deliver("a bell \a")
    scene.after(1.0)
    scene.deliver("two\tlines\n")
    scene.after(1.0)
    assert [share.text for _, share in scene.exchange.asked] == [None, None, None, "two\tlines\n"]
    assert f"{MOST_SHARED} at most are carried" in caplog.text


@pytest.mark.parametrize("letter", ["\U0001f916", '"', "\n", "\a", "ü", "x"])
def test_whatever_liars_say_there_is_room_for_what_the_others_say(scene, letter):
    lie = letter * (MOST_SHARED // len(letter.encode()))
    liars = tuple(Shared(robot="r" * 62 + str(i), age_s=1e-300, text=lie) for i in range(MOST_NEIGHBOURS - 1))
    scene.exchange.answer = Neighbours(group="hall", others=(*liars, OTHER))
    scene.after(1.0)
    ((_, payload),) = scene.bridge.published
    assert len(payload) < 2 * MOST_NEIGHBOURS * (MOST_SHARED + 100)
    assert read_said(decode(String, payload, "cdr").data)[-1].text == OTHER.text


def test_the_topics_of_a_manifest_that_are_shared():
    string = {"type": "std_msgs/msg/String", "shared": True}
    rows = [
        TopicSpec(name="status", type="std_msgs/msg/String", direction="out"),
        TopicSpec(name="seen", direction="out", **string),
        TopicSpec(name="heard", direction="in", **string),
    ]
    assert SharedTopics.of(rows) == TOPICS
    assert SharedTopics.of(rows[:1]) == SharedTopics()
