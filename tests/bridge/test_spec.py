import base64

import pytest

from skytether.api.manifest import TopicSpec
from skytether.bridge import Bridge, LocalPath
from skytether.bridge.spec import SessionSpec, topic_from_api
from skytether.wire.topic import Direction, Role, Topic

KEY = bytes(range(32))
TEXT_KEY = base64.b64encode(KEY).decode()


def test_every_field_of_a_topic_is_converted_and_milliseconds_become_seconds():
    spec = TopicSpec(
        name="force",
        type="geometry_msgs/msg/WrenchStamped",
        direction="in",
        type_hash="RIHS01_ab",
        encoding="ros1",
        priority=120,
        period_ms=10,
        lifespan_ms=50,
        depth=3,
        delivery=0.999,
    )
    assert topic_from_api(spec) == Topic(
        name="force",
        type="geometry_msgs/msg/WrenchStamped",
        direction=Direction.IN,
        type_hash="RIHS01_ab",
        encoding="ros1",
        priority=120,
        period=0.01,
        lifespan=0.05,
        depth=3,
        delivery=0.999,
    )


def test_defaults_agree_with_those_of_the_wire():
    assert topic_from_api(TopicSpec(name="a", type="b", direction="out")) == Topic("a", "b", Direction.OUT)


def test_id_and_key_are_read_and_the_key_is_not_shown():
    spec = SessionSpec.from_api(Role.ROBOT, "00000000000000ff", TEXT_KEY, [])
    assert (spec.id, spec.key, spec.role, spec.topics) == (255, KEY, Role.ROBOT, ())
    assert repr(KEY) not in repr(spec)
    assert TEXT_KEY not in repr(spec)


@pytest.mark.parametrize("text", ["", "ff", "00000000000000fg", "00 00 00 00 00 ff", "0000000000000000ff"])
def test_a_wrong_id_is_refused(text):
    with pytest.raises(ValueError, match="id must be 16 hexadecimal digits"):
        SessionSpec.from_api(Role.ROBOT, text, TEXT_KEY, [])


@pytest.mark.parametrize("text", ["", "secret not base64!", base64.b64encode(bytes(31)).decode(), TEXT_KEY[:-4]])
def test_a_wrong_key_is_refused_without_telling_it(text):
    with pytest.raises(ValueError, match="key must be 32 bytes in base64") as caught:
        SessionSpec.from_api(Role.ROBOT, "00000000000000ff", text, [])
    assert not text or text not in str(caught.value)


def test_a_topic_that_is_listed_twice_is_refused():
    topic = Topic("a", "b", Direction.IN)
    with pytest.raises(ValueError, match="topic 'a' is listed twice"):
        SessionSpec(1, KEY, Role.ROBOT, (topic, topic))


def test_an_id_out_of_range_is_refused():
    with pytest.raises(ValueError, match="64 bits"):
        SessionSpec(1 << 64, KEY, Role.ROBOT, ())


@pytest.mark.parametrize(
    ("role", "options", "says"),
    [
        (Role.ROBOT, {"bind": ("127.0.0.1", 70_000)}, "bind: port must be 0 to 65535, not 70000"),
        (Role.ROBOT, {"bind": ("127.0.0.1", -1)}, "bind: port must be 0 to 65535, not -1"),
        (Role.ROBOT, {"peer": ("127.0.0.1", 0)}, "peer: port must be 1 to 65535, not 0"),
        (Role.ROBOT, {"paths": "all"}, "paths: must be 'auto' or a list of LocalPath, not 'all'"),
        (Role.SERVICE, {"paths": "auto"}, "paths: only the robot's end has them"),
    ],
)
def test_wrong_arguments_of_a_bridge_are_named(role, options, says):
    spec = SessionSpec(1, bytes(32), role, ())
    with pytest.raises(ValueError, match=says):
        Bridge(spec, None, **options)


def test_a_robot_is_told_to_look_at_a_port_that_there_is():
    bridge = Bridge(SessionSpec(1, bytes(32), Role.ROBOT, ()), None)
    with pytest.raises(ValueError, match="peer: port must be 1 to 65535, not 65536"):
        bridge.set_peer("127.0.0.1", 65_536)


@pytest.mark.parametrize(
    ("options", "says"),
    [(("eth0", 256), "cost of eth0 must be 0 to 255, not 256"), (("", 0), "local must be an interface's name")],
)
def test_wrong_arguments_of_a_path_are_named(options, says):
    with pytest.raises(ValueError, match=says):
        LocalPath(*options)
