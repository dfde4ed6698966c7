"""Keys, tokens, qualities and attachments, byte for byte as the two upstream projects document them.

Sources: ros2/rmw_zenoh docs/design.md (the examples of "Topic and Service name mapping" and "Graph Cache"),
rmw_zenoh_cpp/src/detail/{liveliness_utils,attachment_helpers,qos}.cpp; eclipse-zenoh/zenoh-plugin-ros2dds
zenoh-plugin-ros2dds/src/liveliness_mgt.rs.
"""

import pytest
from hypothesis import example, given
from hypothesis import strategies as st

from skytether.ros.ros2.attachment import Attachment, pull_attachment, push_attachment
from skytether.ros.ros2.dialect import Endpoint, Kind, NodeName, RmwZenoh, Ros2Dds
from skytether.ros.ros2.names import check_type, dds_type, full_name, ros_type
from skytether.ros.ros2.qos import MAX_DEPTH, Qos, pull_dds, pull_rmw, push_dds, push_rmw, qos_of
from skytether.wire.topic import Direction, Topic

STRING = "RIHS01_df668c740482bbd48fb39d76a70dfd4bd59db1288021743503259e948f6b1a18"
ADD = "RIHS01_e118de6bf5eeb66a2491b5bda11202e7b68f198d6f67922cf30364858239c81a"
TALKER = "8b20917502ee955ac4476e0266340d5c"
LISTENER = "aac3178e146ba6f1fc6e6a4085e77f21"
SERVER = "f9980ee0495eaafb3e38f0d19e2eae12"
CLIENT = "e1dc8d1b45ae8717fce78689cc655685"

# Examples of docs/design.md: session, node, number, endpoint, token. Their last part is for the liveliness that
# demo_nodes_cpp had; "::,7:,:,:,," is a depth of 7, and what is empty is rmw_zenoh's default.
TOKENS = [
    (
        LISTENER,
        "listener",
        10,
        Endpoint(Kind.SUBSCRIPTION, "/chatter", "std_msgs/msg/String", STRING, Qos(depth=10), "/listener"),
        f"@ros2_lv/2/{LISTENER}/0/10/MS/%/%/listener/%chatter/std_msgs::msg::dds_::String_/{STRING}/::,10:,:,:,,",
    ),
    (
        TALKER,
        "talker",
        10,
        Endpoint(Kind.PUBLISHER, "/chatter", "std_msgs/msg/String", STRING, Qos(depth=7), "/talker"),
        f"@ros2_lv/2/{TALKER}/0/10/MP/%/%/talker/%chatter/std_msgs::msg::dds_::String_/{STRING}/::,7:,:,:,,",
    ),
    (
        SERVER,
        "add_two_ints_server",
        10,
        Endpoint(
            Kind.SERVER,
            "/add_two_ints",
            "example_interfaces/srv/AddTwoInts",
            ADD,
            Qos(depth=10),
            "/add_two_ints_server",
        ),
        f"@ros2_lv/2/{SERVER}/0/10/SS/%/%/add_two_ints_server/%add_two_ints/"
        f"example_interfaces::srv::dds_::AddTwoInts_/{ADD}/::,10:,:,:,,",
    ),
    (
        CLIENT,
        "add_two_ints_client",
        10,
        Endpoint(
            Kind.CLIENT,
            "/add_two_ints",
            "example_interfaces/srv/AddTwoInts",
            ADD,
            Qos(depth=10),
            "/add_two_ints_client",
        ),
        f"@ros2_lv/2/{CLIENT}/0/10/SC/%/%/add_two_ints_client/%add_two_ints/"
        f"example_interfaces::srv::dds_::AddTwoInts_/{ADD}/::,10:,:,:,,",
    ),
]


@pytest.mark.parametrize(("session", "node", "number", "endpoint", "token"), TOKENS)
def test_tokens_of_rmw_zenoh(session, node, number, endpoint, token):
    dialect = RmwZenoh(domain=2)
    assert dialect.token(session, number, NodeName("/", node), endpoint) == token
    assert dialect.parse(token) == (session, endpoint)


def test_the_token_of_a_node():
    assert RmwZenoh(2).node_token(LISTENER, NodeName("/", "listener")) == f"@ros2_lv/2/{LISTENER}/0/0/NN/%/%/listener"
    assert RmwZenoh(0).node_token("ab", NodeName("/robot1", "x")) == "@ros2_lv/0/ab/0/0/NN/%/%robot1/x"
    assert RmwZenoh(2).parse(f"@ros2_lv/2/{LISTENER}/0/0/NN/%/%/listener") is None


@pytest.mark.parametrize(
    ("domain", "name", "type_name", "type_hash", "key"),
    [
        (0, "/chatter", "std_msgs/msg/String", STRING, f"0/chatter/std_msgs::msg::dds_::String_/{STRING}"),
        (
            0,
            "/robot1/chatter",
            "std_msgs/msg/String",
            STRING,
            f"0/robot1/chatter/std_msgs::msg::dds_::String_/{STRING}",
        ),
        (
            2,
            "/add_two_ints",
            "example_interfaces/srv/AddTwoInts",
            ADD,
            f"2/add_two_ints/example_interfaces::srv::dds_::AddTwoInts_/{ADD}",
        ),
        (0, "/x", "my_msgs/msg/Own", "", "0/x/my_msgs::msg::dds_::Own_/*"),
    ],
)
def test_keys_of_rmw_zenoh(domain, name, type_name, type_hash, key):
    assert RmwZenoh(domain).key(Endpoint(Kind.PUBLISHER, name, type_name, type_hash)) == key


def test_humble_has_no_hashes():
    chatter = Endpoint(Kind.PUBLISHER, "/chatter", "std_msgs/msg/String", STRING)
    humble = RmwZenoh(hashes=False)
    assert humble.key(chatter) == "0/chatter/std_msgs::msg::dds_::String_/TypeHashNotSupported"
    token = humble.token("ab", 1, NodeName(), chatter)
    assert "/TypeHashNotSupported/" in token
    parsed = humble.parse(token)
    assert parsed is not None
    assert parsed[1].type_hash == ""


@pytest.mark.parametrize(
    ("qos", "text"),
    [
        (Qos(), "::,:,:,:,,"),
        (Qos(reliable=False, depth=5), "2::,5:,:,:,,"),
        (Qos(transient_local=True, depth=1), ":1:,1:,:,:,,"),
    ],
)
def test_qualities_of_rmw_zenoh(qos, text):
    assert push_rmw(qos) == text
    assert pull_rmw(text) == qos


def test_qualities_that_others_write():
    assert pull_rmw("1:2:1,10:0,100:9223372036,854775807:1,0,0") == Qos(depth=10)
    assert pull_rmw("::2,:,:,:,,") == Qos(depth=MAX_DEPTH)  # keep all
    # test_qos_key_expr of liveliness_mgt.rs
    assert pull_dds(":::") == (Qos(reliable=False, depth=1), "")
    assert pull_dds("K:1::0,3") == (Qos(depth=3), "")
    assert pull_dds(f":1:1:1,0:typehash={STRING};") == (Qos(transient_local=True, depth=MAX_DEPTH), STRING)
    assert push_dds(Qos(transient_local=True, depth=3), STRING) == f":1:1:0,3:typehash={STRING};"
    assert push_dds(Qos(reliable=False, depth=3), "") == ":0:0:0,3"


@pytest.mark.parametrize(
    "token",
    [
        "",
        "/",
        "@ros2_lv",
        "@ros2_lv/0/a/0/1/MP/%/%/n/%x/std_msgs::msg::dds_::String_/RIHS01_0/::,x:,:,:,,",
        "@ros2_lv/0/a/0/1/MP/%/%/n/%x/std_msgs::msg::dds_::String_/RIHS01_0/::,9999999999:,:,:,,",
        "@ros2_lv/0/a/0/1/MP/%/%/n/%x/std_msgs::msg::dds_::String_/RIHS01_0/::",
        "@ros2_lv/0/a/0/1/XX/%/%/n/%x/std_msgs::msg::dds_::String_/RIHS01_0/::,:,:,:,,",
        "@ros2_lv/0/a/0/1/MP/%/%/n/%x/String/RIHS01_0/::,:,:,:,,",
        "@ros2_lv/7/a/0/1/MP/%/%/n/%x/std_msgs::msg::dds_::String_/RIHS01_0/::,:,:,:,,",
        "@/a/@ros2_lv",
        "@/a/@ros2_lv/MP/x/std_msgs§msg§String",
        "@/a/@ros2_lv/MP/x/std_msgs§msg§String/::",
        "@/a/@ros2_lv/SS/x/std_srvs§srv§Trigger/more",
        "@/a/@ros2_lv/AS/x/y/z",
    ],
)
def test_what_is_no_endpoint_is_none(token):
    assert RmwZenoh().parse(token) is None
    assert Ros2Dds().parse(token) is None


CHUNK = st.sampled_from(
    [
        "@ros2_lv",
        "@",
        "0",
        "a",
        "MP",
        "SS",
        "%",
        "%x",
        "std_msgs::msg::dds_::String_",
        "RIHS01_0",
        "::,:,:,:,,",
        "std§msg§S",
    ]
) | st.text("0123456789:,;=K*$?§%x", max_size=12)


@given(st.lists(CHUNK, max_size=14).map("/".join) | st.text(max_size=60))
@example("@/a/@ros2_lv/MP/x/std_msgs§msg§String/:1:1:0,1,2")
def test_no_token_raises(token):
    for dialect in (RmwZenoh(), Ros2Dds()):
        dialect.parse(token)


def test_a_hash_that_could_be_no_part_of_a_key_is_none():
    """A learned hash becomes part of our own keys."""
    token = "@ros2_lv/0/a/0/1/MP/%/%/n/%x/std_msgs::msg::dds_::String_/{}/::,:,:,:,,"
    for wrong in ("*", "$*", "a?b", "RIHS01_é"):
        parsed = RmwZenoh().parse(token.format(wrong))
        assert parsed is not None
        assert parsed[1].type_hash == ""


def test_the_bridge_to_dds_writes_names_as_keys():
    dds = Ros2Dds()
    scan = Endpoint(Kind.PUBLISHER, "/base/scan", "sensor_msgs/msg/LaserScan", "RIHS01_0", Qos(reliable=False, depth=5))
    trigger = Endpoint(Kind.SERVER, "/stop", "std_srvs/srv/Trigger")
    assert dds.key(scan) == "base/scan"
    assert dds.node_token("ab", NodeName()) == "@/ab/@ros2_lv"
    token = "@/ab/@ros2_lv/MP/base§scan/sensor_msgs§msg§LaserScan/:0:0:0,5:typehash=RIHS01_0;"
    assert dds.token("ab", 1, NodeName(), scan) == token
    assert dds.parse(token) == ("ab", scan)
    assert dds.token("ab", 2, NodeName(), trigger) == "@/ab/@ros2_lv/SS/stop/std_srvs§srv§Trigger"
    assert dds.parse("@/ab/@ros2_lv/SS/stop/std_srvs§srv§Trigger") == ("ab", trigger)
    assert Ros2Dds("/bot").key(scan) == "bot/base/scan"
    parsed = Ros2Dds("/bot").parse("@/ab/@ros2_lv/SS/bot§stop/std_srvs§srv§Trigger")
    assert parsed == ("ab", trigger)


def test_attachments():
    # docs/design.md, "Publishers": int64 sequence, int64 time, one byte 16, 16 bytes; little-endian.
    gid = bytes(range(16))
    data = bytes.fromhex("010000000000000000407a6df1d0c01710") + gid
    assert push_attachment(Attachment(1, 0x17C0D0F16D7A4000, gid)) == data
    assert pull_attachment(data) == Attachment(1, 0x17C0D0F16D7A4000, gid)
    for wrong in (b"", data[:-1], data + b"\0", data[:16] + b"\x0f" + gid):
        assert pull_attachment(wrong) is None


def test_names():
    assert dds_type("example_interfaces/action/Fibonacci_SendGoal") == (
        "example_interfaces::action::dds_::Fibonacci_SendGoal_"
    )
    assert ros_type("std_msgs::msg::dds_::String_") == "std_msgs/msg/String"
    assert ros_type("std_msgs::msg::String") is None
    assert full_name("scan", "/bot") == "/bot/scan"
    assert full_name("/scan", "/bot") == "/scan"
    assert full_name("nav/_action/feedback") == "/nav/_action/feedback"
    for wrong in ("", "a b", "a//b", "/a/", "3po", "a/*", "a/%"):
        with pytest.raises(ValueError, match="is not a valid name of ROS 2"):
            full_name(wrong)
    for wrong in ("String", "std_msgs/String", "std_msgs/msg/", "*", "a/msg/B/c"):
        with pytest.raises(ValueError, match="is no type of ROS 2"):
            check_type(wrong)


@pytest.mark.parametrize(
    ("row", "published", "subscribed"),
    [
        ({}, Qos(reliable=True, depth=1), Qos(reliable=False, depth=1)),
        ({"reliable": True, "depth": 7}, Qos(depth=7), Qos(depth=7)),
        ({"reliable": True, "latched": True, "depth": 7}, *[Qos(transient_local=True, depth=1)] * 2),
    ],
)
def test_rows_have_a_quality_in_ros2(row, published, subscribed):
    topic = Topic("t", "std_msgs/msg/String", Direction.IN, **row)
    assert qos_of(topic, publishes=True) == published
    assert qos_of(topic, publishes=False) == subscribed
