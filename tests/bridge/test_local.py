import pytest

from skytether.bridge.local import GraphPort, LocalGraph
from skytether.wire.events import Connected, MessageReceived
from skytether.wire.topic import Direction, Role, Topic

TABLE = (Topic("up", "t", Direction.IN), Topic("down", "t", Direction.OUT))


class RecordingPublisher:
    def __init__(self):
        self.published = []

    def publish(self, topic, payload):
        self.published.append((topic, payload))
        return True


def test_every_subscriber_of_the_topic_gets_the_message_until_it_unsubscribes():
    graph, one, two = LocalGraph(), [], []
    graph.subscribe("a", one.append)
    leave = graph.subscribe("a", two.append)
    graph.subscribe("b", two.append)
    graph.publish("a", b"1")
    leave()
    graph.publish("a", b"2")
    graph.publish("nobody listens", b"3")
    assert one == [b"1", b"2"]
    assert two == [b"1"]


@pytest.mark.parametrize(("role", "sends", "takes"), [(Role.ROBOT, "up", "down"), (Role.SERVICE, "down", "up")])
def test_a_port_sends_what_its_end_sends_and_publishes_what_arrives(role, sends, takes):
    graph, publisher, got = LocalGraph(), RecordingPublisher(), []
    port = GraphPort(graph, TABLE, role)
    port.attach(publisher)
    graph.subscribe(takes, got.append)
    graph.publish(sends, b"out")
    graph.publish(takes, b"local only")
    assert publisher.published == [(sends, b"out")]
    port.deliver(MessageReceived(takes, b"in", 0, 0.0, 0.0, 0.0))
    assert got == [b"local only", b"in"]
    assert publisher.published == [(sends, b"out")]


def test_other_events_go_to_the_callback():
    events = []
    GraphPort(LocalGraph(), TABLE, Role.ROBOT, on_event=events.append).notify(Connected(TABLE))
    GraphPort(LocalGraph(), TABLE, Role.ROBOT).notify(Connected(TABLE))
    assert events == [Connected(TABLE)]
