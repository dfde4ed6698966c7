import pytest

from skytether.messages import String, Twist, Vector3, Wrench, WrenchStamped, decode, encode
from skytether.robot.graphs.graph_base import GraphBase

FORCE = {"force": WrenchStamped}


def wrench(x: float) -> bytes:
    return encode(WrenchStamped(wrench=Wrench(force=Vector3(x=x))), "ros1")


def test_the_newest_reading_is_decoded_once():
    base = GraphBase(FORCE, "ros1", lambda _: None)
    base.put("force", wrench(1.0))
    base.put("force", wrench(2.0))
    ((name, message),) = base.read(10.0)
    assert (name, message.wrench.force.x) == ("force", 2.0)
    assert list(base.read(10.01)) == []


def test_bytes_that_are_no_reading_are_named_once(caplog):
    base = GraphBase(FORCE, "ros1", lambda _: None)
    for now in range(100):
        base.put("force", b"\x01\x02")
        assert list(base.read(now)) == []
    assert len(caplog.records) == 1
    assert "reading force" in caplog.text
    base.put("force", wrench(3.0))
    assert len(list(base.read(101.0))) == 1


def drive(base, now, speed):
    list(base.read(now))
    base.write(Twist(linear=Vector3(x=speed)))


def test_a_lasting_standstill_leaves_the_wheels_to_others_and_motion_takes_them_back():
    sent = []
    base = GraphBase({}, "ros1", sent.append, idle_s=1.0)
    for tick in range(300):
        drive(base, tick / 100, 0.0)
    assert 99 <= len(sent) <= 102
    sent.clear()
    drive(base, 3.0, 0.2)
    for tick in range(50):
        drive(base, 3.01 + tick / 100, 0.0)
    assert [decode(Twist, data, "ros1").linear.x for data in sent] == [0.2] + 50 * [0.0]


def test_a_standstill_that_could_not_be_told_is_told_when_it_can_be():
    """The wheels' last word would else be the velocity from before."""
    sent, lost = [], [False]

    def send(data):
        if lost[0]:
            raise ConnectionError("the node hangs")
        sent.append(decode(Twist, data, "ros1").linear.x)

    base = GraphBase({}, "ros1", send, idle_s=1.0)
    drive(base, 0.0, 0.2)
    lost[0] = True
    for tick in range(300):
        with pytest.raises(ConnectionError):
            drive(base, 0.01 + tick / 100, 0.0)
    lost[0] = False
    for tick in range(300):
        drive(base, 4.0 + tick / 100, 0.0)
    assert sent[0] == 0.2
    assert 99 <= len(sent[1:]) <= 102
    assert not any(sent[1:])


def test_wheels_that_do_not_hear_are_told_to_stand_and_that_is_an_error_once_it_is_taken():
    """Who begins to hear would else hear a velocity in its middle."""
    sent, can = [], {"heard": False, "taken": False}

    def send(data):
        sent.append(decode(Twist, data, "ros1").linear.x)
        return can["taken"]

    base = GraphBase({}, "ros1", send, idle_s=1.0, heard=lambda: can["heard"])
    drive(base, 0.0, 0.2)
    can["taken"] = True
    with pytest.raises(ConnectionError, match="told to stand until their node listens and hears us"):
        drive(base, 0.1, 0.2)
    for tick in range(20):
        drive(base, 0.2 + tick, 0.0)
    assert sent == 22 * [0.0]
    can["heard"] = True
    drive(base, 30.0, 0.2)
    assert sent[22:] == [0.2]


def test_a_standstill_is_told_for_ever_if_asked_to_and_the_message_is_the_graph_s_own():
    sent = []
    base = GraphBase({}, "cdr", sent.append, idle_s=None, make=lambda twist: String(str(twist.linear.x)))
    for tick in range(300):
        drive(base, tick / 10, 0.0)
    assert len(sent) == 300
    assert decode(String, sent[0]).data == "0.0"
