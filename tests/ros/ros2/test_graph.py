"""What tokens tell of a graph, and what does not fit."""

from types import SimpleNamespace

import zenoh

from skytether.ros.ros2.dialect import Endpoint, Kind, NodeName, RmwZenoh
from skytether.ros.ros2.graph import Graph, learned_hash, mismatches
from skytether.ros.ros2.node import Ros2Node

TALKER = Endpoint(Kind.PUBLISHER, "/chatter", "std_msgs/msg/String", "RIHS01_aa", node="/talker")
OURS = Endpoint(Kind.SUBSCRIPTION, "/chatter", "std_msgs/msg/String", "RIHS01_aa")


def other(**changes):
    values = {name: getattr(TALKER, name) for name in Endpoint.__slots__}
    return Endpoint(**{**values, **changes})


def test_endpoints_come_and_go_by_their_tokens():
    graph = Graph(RmwZenoh(), "ours")
    token = RmwZenoh().token("theirs", 1, NodeName("/", "talker"), TALKER)
    assert graph.update(token, True) == TALKER
    assert graph.update(token, True) is None
    assert graph.update(RmwZenoh().token("ours", 1, NodeName(), TALKER), True) is None
    assert graph.update("@ros2_lv/nonsense", True) is None
    assert graph.endpoints() == graph.endpoints("/chatter", Kind.PUBLISHER) == [TALKER]
    assert graph.endpoints("/other") == graph.endpoints(kind=Kind.CLIENT) == []
    assert graph.update(token, False) == TALKER
    assert graph.update(token, False) is None
    assert graph.endpoints() == []


def test_another_hash_is_told_with_both():
    (found,) = mismatches(OURS, [TALKER, other(type_hash="RIHS01_bb")])
    assert found.reason == (
        "/chatter: the publisher of /talker has std_msgs/msg/String with type hash RIHS01_bb,"
        " this end's is RIHS01_aa; it is not joined"
    )


def test_another_type_is_told_with_both():
    (found,) = mismatches(OURS, [other(type="std_msgs/msg/Bool", node="")])
    assert found.reason == (
        "/chatter: the publisher has type std_msgs/msg/Bool, this end's is std_msgs/msg/String; it is not joined"
    )


def test_what_does_not_meet_does_not_have_to_fit():
    fine = [other(kind=Kind.SUBSCRIPTION, type_hash="RIHS01_bb"), other(name="/x", type_hash="RIHS01_bb"), TALKER]
    assert mismatches(OURS, [*fine, other(type_hash="")]) == []


def test_a_hash_is_learned_from_the_other_side_only():
    assert learned_hash(OURS, [TALKER]) == "RIHS01_aa"
    assert learned_hash(OURS, [other(kind=Kind.SUBSCRIPTION), other(type="x/msg/Y"), other(type_hash="")]) == ""


class Session:
    """Of a router that tells of the graph as the test says, and can be asked no oftener."""

    def __init__(self, *answers):
        self.answers = list(answers)
        self.waited = []
        self.info = SimpleNamespace(routers_zid=lambda: ["router"], peers_zid=list)

    def zid(self):
        return "ours"

    def liveliness(self):
        return self

    def declare_token(self, token):
        return SimpleNamespace(undeclare=lambda: None)

    def declare_subscriber(self, *_, **options):
        return SimpleNamespace(undeclare=lambda: None)

    def get(self, _, timeout):
        self.waited.append(timeout)
        return self.answers.pop(0)

    def close(self):
        pass


def reply(number, name):
    token = RmwZenoh(0).token("theirs", number, NodeName("/", name), other(node=f"/{name}"))
    return SimpleNamespace(ok=SimpleNamespace(key_expr=token))


def test_an_answer_that_took_too_long_is_no_graph_without_anybody(monkeypatch):
    """Zenoh tells it by a reply that is an error, beside those that came in time."""
    said = []
    node = Ros2Node(RmwZenoh(0), router="tcp/127.0.0.1:1", say=said.append)
    first, second = reply(1, "talker"), reply(2, "singer")
    session = Session([first, SimpleNamespace(ok=None)], [first, second])
    monkeypatch.setattr(zenoh, "open", lambda config: session)
    node.start()
    assert node.wait_until_joined(30)
    assert {endpoint.node for endpoint in node.endpoints()} == {"/talker", "/singer"}
    node.close()
    assert "does not tell of all the graph within 2 s" in said[0]
    assert session.waited == [2.0, 4.0]


def test_who_is_alone_has_joined_at_once(monkeypatch):
    node = Ros2Node(RmwZenoh(0), router="tcp/127.0.0.1:1")
    session = Session([])
    monkeypatch.setattr(zenoh, "open", lambda config: session)
    node.start()
    assert node.wait_until_joined(30)
    assert node.endpoints() == []
    node.close()
    assert session.waited == [2.0]
