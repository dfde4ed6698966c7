"""Every message that is handed to `publish` is found again in the counters, whether or not there is a session."""

from skytether.wire.events import Disconnected
from skytether.wire.topic import Direction, Role, Topic

RELIABLE = Topic("goal", "t/msg/G", Direction.IN, depth=4, lifespan=60.0, reliable=True)
NEWEST = Topic("scan", "t/msg/S", Direction.IN)


def counted(bridge, name):
    (found,) = (t for t in bridge.stats().topics if t.topic == name)
    return found


def adds_up(topic):
    return (
        topic.published == topic.refused + topic.dropped + topic.sent
        and topic.sent == topic.delivered + topic.superseded + topic.lost + topic.unsettled
    )


def test_what_is_published_without_a_session_is_refused_and_counted(ends):
    robot = ends.make(Role.ROBOT, peer=("127.0.0.1", 9))
    assert not robot.publish("force", b"before the start")
    robot.start()
    answers = [robot.publish("force", b"nobody there") for _ in range(5)]
    assert answers == [False] * 5
    assert counted(robot, "force").refused == 6
    robot.stop()
    answers = [robot.publish("force", b"after the end") for _ in range(3)]
    assert answers == [False] * 3
    assert (counted(robot, "force").refused, counted(robot, "force").offered) == (9, 0)


def test_every_message_is_found_again_over_a_session_that_comes_and_goes(ends):
    service = ends.make(Role.SERVICE)
    robot = ends.make(Role.ROBOT, peer=("127.0.0.1", 9))
    robot.start()
    taken = [robot.publish("force", b"early") for _ in range(7)]
    service.start()
    robot.set_peer(*service.address)
    robot.graph.wait_connected()
    taken += [robot.publish("force", b"%d" % n) for n in range(200)]
    service.graph.wait_messages(sum(taken))
    service.stop()
    robot.graph.wait(lambda port: port.count(Disconnected))
    taken += [robot.publish("force", b"late") for _ in range(11)]
    robot.stop()
    found = counted(robot, "force")
    assert found.published == len(taken)
    assert found.refused == taken.count(False) == 18
    assert adds_up(found)
    assert found.delivered == 200


def test_reliable_messages_that_wait_and_are_refused_add_up(ends):
    robot = ends.start(Role.ROBOT, topics=(RELIABLE, NEWEST), peer=("127.0.0.1", 9))
    for n in range(10):
        robot.publish("goal", b"%d" % n)
    robot.stop()
    assert not robot.publish("goal", b"after the end")
    assert not robot.publish("goal", b"and again")
    found = counted(robot, "goal")
    assert (found.refused, found.offered, found.sent, found.dropped) == (2, 10, 0, 10)
    assert adds_up(found)


def test_what_the_peer_does_not_know_is_refused(ends):
    service = ends.start(Role.SERVICE)
    robot = ends.start(Role.ROBOT, topics=(*ends.topics, NEWEST), peer=service.address)
    robot.graph.wait_connected()
    assert not robot.publish("scan", b"x")
    assert counted(robot, "scan").refused == 1
