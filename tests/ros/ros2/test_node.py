"""Our node beside nodes of rmw_zenoh, as their documentation describes these, at a real Zenoh router."""

import struct
import threading
import time

import pytest
import zenoh
from ros2_graph import Router, Stage

from skytether.bridge.calls import CallError
from skytether.lab.bench.transports.certificate import write_certificate
from skytether.messages import hash_of
from skytether.ros.ros2.dialect import Endpoint, Kind, NodeName, Ros2Dds
from skytether.ros.ros2.node import Ros2Error, Ros2Node
from skytether.ros.ros2.qos import Qos

pytestmark = pytest.mark.slow

STRING, DDS_STRING = "std_msgs/msg/String", "std_msgs::msg::dds_::String_"
RIHS_STRING = "RIHS01_df668c740482bbd48fb39d76a70dfd4bd59db1288021743503259e948f6b1a18"
ADD, DDS_ADD = "example_interfaces/srv/AddTwoInts", "example_interfaces::srv::dds_::AddTwoInts_"
RIHS_ADD = "RIHS01_e118de6bf5eeb66a2491b5bda11202e7b68f198d6f67922cf30364858239c81a"
OWN, DDS_OWN, RIHS_OWN = "my_msgs/msg/Own", "my_msgs::msg::dds_::Own_", "RIHS01_" + "5" * 64


def chatter(kind, **changes):
    return Endpoint(**{"kind": kind, "name": "/chatter", "type": STRING, "type_hash": RIHS_STRING, **changes})


def add(kind):
    return Endpoint(kind, "/add_two_ints", ADD, RIHS_ADD)


def test_a_message_goes_to_ros2_and_shows_in_its_graph(stage):
    rmw = stage.rmw("listener")
    received = rmw.subscribe("/chatter", DDS_STRING, RIHS_STRING)
    node = stage.ours(name=NodeName("/bot", "skytether"))
    publication = node.publish(chatter(Kind.PUBLISHER, qos=Qos(depth=7)))
    (token,) = stage.until(lambda: rmw.sees("MP", "/chatter"), "no token")
    parts = token.split("/")
    assert parts[5:] == ["MP", "%", "%bot", "skytether", "%chatter", DDS_STRING, RIHS_STRING, "::,7:,:,:,,"]
    assert any(t.endswith("/NN/%/%bot/skytether") and f"/{parts[2]}/" in t for t in rmw.tokens)
    before = time.time_ns()
    stage.until(lambda: publication.put(stage.cdr_string("hello")) and received.samples, "nothing came")
    publication.put(stage.cdr_string("again"))
    stage.until(lambda: received.payloads[-1] == stage.cdr_string("again"), "the second did not come")
    assert received.payloads[0] == b"\0\1\0\0\6\0\0\0hello\0"
    sequences, stamps, lengths, gids = zip(*(struct.unpack("<qqB16s", a) for _, a in received.samples), strict=True)
    assert list(sequences) == list(range(sequences[0], sequences[0] + len(sequences)))
    assert all(before <= stamp <= time.time_ns() for stamp in stamps)
    assert set(lengths) == {16}
    assert len(set(gids)) == 1
    publication.close()
    stage.until(lambda: not rmw.sees("MP", "/chatter"), "the token stayed")


def test_a_publisher_may_be_closed_while_messages_are_put(stage):
    rmw = stage.rmw("listener")
    node = stage.ours()
    for _ in range(5):
        publication, ended = node.publish(chatter(Kind.PUBLISHER)), threading.Event()
        putting = [threading.Thread(target=put_until, args=(publication, ended)) for _ in range(3)]
        stage.until(lambda: rmw.sees("MP", "/chatter"), "no token")
        for thread in putting:
            thread.start()
        try:
            time.sleep(0.02)
            publication.close()
            stage.until(lambda: not rmw.sees("MP", "/chatter"), "the token stayed")
        finally:
            ended.set()
            for thread in putting:
                thread.join()
    assert not node.troubles


def put_until(publication, ended):
    while not ended.is_set():
        publication.put(bytes(50_000))


def test_a_message_comes_from_ros2(stage):
    got = []
    node = stage.ours()
    subscription = node.subscribe(chatter(Kind.SUBSCRIPTION, qos=Qos(reliable=False, depth=1)), got.append)
    rmw = stage.rmw("talker")
    publish = rmw.publisher("/chatter", DDS_STRING, RIHS_STRING)
    stage.until(lambda: rmw.sees("MS", "/chatter", "2::,1:,:,:,,"), "no token")
    stage.until(lambda: publish(stage.cdr_string("hello")) or got, "nothing came")
    assert got[0] == stage.cdr_string("hello")
    stage.until(lambda: node.endpoints("/chatter"), "the publisher is not known")
    (seen,) = node.endpoints("/chatter", Kind.PUBLISHER)
    assert (seen.type, seen.type_hash, seen.node, seen.qos) == (STRING, RIHS_STRING, "/talker", Qos(depth=10))
    assert not node.troubles
    subscription.close()
    stage.until(lambda: not rmw.sees("MS", "/chatter"), "the token stayed")


def test_a_late_joiner_of_theirs_gets_our_latched_message(stage):
    node = stage.ours()
    publication = node.publish(chatter(Kind.PUBLISHER, qos=Qos(transient_local=True, depth=1)))
    publication.put(stage.cdr_string("old"))  # before there is a session
    assert node.wait_until_joined(30)
    publication.put(stage.cdr_string("map"))
    rmw = stage.rmw("late")
    received = rmw.subscribe("/chatter", DDS_STRING, RIHS_STRING, depth=1)
    stage.until(lambda: received.samples, "a late joiner got nothing")
    assert received.payloads == [stage.cdr_string("map")]
    assert rmw.sees("MP", "/chatter", ":1:,1:,:,:,,")


def test_a_message_that_came_before_the_graph_is_kept_if_latched(own_stage):
    node = own_stage.ours()
    publication = node.publish(chatter(Kind.PUBLISHER, qos=Qos(transient_local=True, depth=1)))
    assert not publication.put(own_stage.cdr_string("early"))
    own_stage.router.start()
    received = own_stage.rmw("late").subscribe("/chatter", DDS_STRING, RIHS_STRING, depth=1)
    own_stage.until(lambda: received.samples, "the early message is gone")
    assert received.payloads == [own_stage.cdr_string("early")]


def test_we_as_late_joiner_get_their_latched_messages(stage):
    publish = stage.rmw("map_server").publisher("/chatter", DDS_STRING, RIHS_STRING, depth=2)
    for text in ("one", "two", "three"):
        publish(stage.cdr_string(text))
    got = []
    stage.ours().subscribe(chatter(Kind.SUBSCRIPTION, qos=Qos(transient_local=True, depth=1)), got.append)
    stage.until(lambda: got, "a late joiner got nothing")
    assert got == [stage.cdr_string("three")]
    # A publisher that comes later tells its own.
    stage.rmw("second").publisher("/chatter", DDS_STRING, RIHS_STRING, depth=1)(stage.cdr_string("four"))
    stage.until(lambda: got[-1] == stage.cdr_string("four"), "a later publisher was not heard")


def test_who_has_joined_knows_the_graph_on_a_busy_machine_too(stage, monkeypatch):
    """The router tells the graph to the subscription, and then nothing new in its answer."""
    stage.rmw("talker").publisher("/chatter", DDS_STRING, RIHS_STRING)
    at_once = zenoh.handlers.Callback

    def late(told, **options):
        return at_once(lambda sample: (time.sleep(0.2), told(sample)), **options)

    monkeypatch.setattr(zenoh.handlers, "Callback", late)
    node = stage.ours()
    assert node.wait_until_joined(30)
    assert [e.node for e in node.endpoints("/chatter", Kind.PUBLISHER)] == ["/talker"]


def test_another_type_hash_is_refused_and_both_are_named_once(stage):
    rmw, wrong = stage.rmw("talker"), "RIHS01_" + "0" * 64
    publish = rmw.publisher("/chatter", DDS_STRING, wrong)
    got = []
    node = stage.ours()
    node.subscribe(chatter(Kind.SUBSCRIPTION), got.append)
    stage.until(lambda: node.troubles, "nothing was said")
    sentence = (
        f"/chatter: the publisher of /talker has {STRING} with type hash {wrong}, this end's is {RIHS_STRING};"
        " it is not joined"
    )
    assert stage.said == [sentence]
    # One that fits is heard all the same, and a further change of the graph says nothing again.
    right = stage.rmw("other").publisher("/chatter", DDS_STRING, RIHS_STRING)
    stage.until(lambda: publish(b"wrong") or right(stage.cdr_string("hello")) or got, "the right one was not heard")
    assert set(got) == {stage.cdr_string("hello")}
    assert stage.said == [sentence]
    rmw.close()
    stage.until(lambda: not node.troubles, "the trouble stayed")


def test_a_hash_that_we_do_not_know_is_learned(stage):
    got = []
    node = stage.ours()
    publication = node.publish(Endpoint(Kind.PUBLISHER, "/own", OWN))
    node.subscribe(Endpoint(Kind.SUBSCRIPTION, "/theirs", OWN), got.append)
    assert node.wait_until_joined(30)
    assert not publication.put(b"nobody listens")
    rmw = stage.rmw("both")
    received = rmw.subscribe("/own", DDS_OWN, RIHS_OWN)
    publish = rmw.publisher("/theirs", DDS_OWN, RIHS_OWN)
    stage.until(lambda: publication.put(b"\0\1\0\0mine") and received.samples, "they got nothing")
    stage.until(lambda: publish(b"\0\1\0\0theirs") or got, "we got nothing")
    assert received.payloads[0] == b"\0\1\0\0mine"
    stage.until(lambda: [t for t in rmw.sees("MS", "/theirs") if RIHS_OWN in t], "our token has no hash")


def test_a_service_of_ours_answers_their_client(stage):
    def answer(request):
        a, b = struct.unpack("<4xqq", request)
        if a < 0:
            raise CallError("/add_two_ints: no negative numbers today")
        return b"\0\1\0\0" + struct.pack("<q", a + b)

    node = stage.ours()
    node.serve(add(Kind.SERVER), answer)
    rmw = stage.rmw("client")
    call = rmw.client("/add_two_ints", DDS_ADD, RIHS_ADD)
    # As service_server_is_available does it: by the server's token.
    stage.until(lambda: rmw.sees("SS", "/add_two_ints"), "no token")
    response, attachment = call(b"\0\1\0\0" + struct.pack("<qq", 2, 40), 77)
    assert response == b"\0\1\0\0" + struct.pack("<q", 42)
    sequence, _, length, gid = struct.unpack("<qqB16s", attachment)
    assert (sequence, length, gid) == (77, 16, rmw.GID)
    with pytest.raises(RuntimeError, match="no negative numbers today"):
        call(b"\0\1\0\0" + struct.pack("<qq", -1, 0), 78)


def test_slow_calls_do_not_stand_in_each_others_way(stage):
    gate, inside = threading.Event(), threading.Semaphore(0)

    def answer(request):
        if request.endswith(b"slow"):
            inside.release()
            assert gate.wait(30)
        return request

    stage.ours().serve(add(Kind.SERVER), answer)
    rmw = stage.rmw("client")
    call = rmw.client("/add_two_ints", DDS_ADD, RIHS_ADD)
    stage.until(lambda: rmw.sees("SS", "/add_two_ints"), "no token")
    slow = [threading.Thread(target=call, args=(b"\0\1\0\0slow", i)) for i in range(5)]
    for thread in slow:
        thread.start()
    for _ in slow:
        assert inside.acquire(timeout=30)
    assert call(b"\0\1\0\0fast", 9)[0] == b"\0\1\0\0fast"
    gate.set()
    for thread in slow:
        thread.join(30)


def test_a_service_of_theirs_answers_us(stage):
    node = stage.ours()
    client = node.client(add(Kind.CLIENT))
    assert node.wait_until_joined(30)
    with pytest.raises(CallError, match="/add_two_ints: no node of the ROS 2 graph offers this service"):
        client.call(b"\0\1\0\0", 5)
    rmw = stage.rmw("server")
    seen = rmw.serve("/add_two_ints", DDS_ADD, RIHS_ADD, lambda request: request[:4] + request[4:12])
    assert stage.until(lambda: rmw.sees("SC", "/add_two_ints"), "no token")

    def answered():
        try:
            return client.call(b"\0\1\0\0" + struct.pack("<qq", 5, 6), 10)
        except CallError:
            return None

    assert stage.until(answered, "no answer") == b"\0\1\0\0" + struct.pack("<q", 5)
    assert struct.unpack("<qqB16s", seen[-1])[2] == 16


def test_the_hash_of_a_service_is_learned(stage):
    rihs, dds = "RIHS01_" + "7" * 64, "my_msgs::srv::dds_::Ask_"
    node = stage.ours()
    node.serve(Endpoint(Kind.SERVER, "/mine", "my_msgs/srv/Ask"), lambda request: request + b"!")
    client = node.client(Endpoint(Kind.CLIENT, "/theirs", "my_msgs/srv/Ask"))
    assert node.wait_until_joined(30)
    with pytest.raises(CallError, match="/theirs: no node"):
        client.call(b"", 1)
    rmw = stage.rmw("both")
    rmw.serve("/theirs", dds, rihs, lambda request: request + b"?")
    call = rmw.client("/mine", dds, rihs)
    stage.until(lambda: [t for t in rmw.sees("SS", "/mine") if rihs in t], "our token has no hash")
    assert call(b"x", 1)[0] == b"x!"
    stage.until(lambda: "*" not in node.dialect.key(client.endpoint), "nothing was learned")
    assert client.call(b"x", 10) == b"x?"


def test_the_router_may_come_later_and_may_be_restarted(own_stage):
    said, router = own_stage.said, own_stage.router
    got = []
    node = own_stage.ours()
    publication = node.publish(chatter(Kind.PUBLISHER))
    node.subscribe(chatter(Kind.SUBSCRIPTION, name="/back"), got.append)
    client = node.client(add(Kind.CLIENT))
    own_stage.until(lambda: said, "nothing was said")
    assert f"router ({router.address}) is not there" in said[0]
    assert not publication.put(b"x")
    with pytest.raises(CallError, match="out of reach"):
        client.call(b"", 1)
    assert not node.wait_until_joined(1)
    assert len(said) == 1  # after several attempts

    router.start()
    assert node.wait_until_joined(30)
    own_stage.until(lambda: len(said) == 2, "nothing was said")
    assert "is there now" in said[1]

    def carries_both_ways():
        rmw = own_stage.rmw("node")
        received = rmw.subscribe("/chatter", DDS_STRING, RIHS_STRING)
        publish = rmw.publisher("/back", DDS_STRING, RIHS_STRING)
        got.clear()
        own_stage.until(lambda: publication.put(own_stage.cdr_string("a")) and received.samples, "they got nothing")
        own_stage.until(lambda: publish(own_stage.cdr_string("b")) or got, "we got nothing")
        assert len(rmw.sees("MP", "/chatter")) == len(rmw.sees("MS", "/back")) == 1
        rmw.close()

    carries_both_ways()
    router.stop()
    own_stage.until(lambda: len(said) == 3, "nothing was said")
    assert "went away" in said[2]
    assert node.troubles
    router.start()
    own_stage.until(lambda: len(said) == 4, "it did not come back")
    assert "is there now" in said[3]
    assert not node.troubles
    carries_both_ways()


def test_closing_without_a_router_does_not_hang(own_stage):
    node = Ros2Node(own_stage.ours().dialect, router=own_stage.router.address)
    with node:
        node.publish(chatter(Kind.PUBLISHER))


def test_the_bridge_to_dds(stage):
    """Keys and tokens of zenoh-bridge-ros2dds, played by a bare session: there are no attachments."""
    session, got, sent, tokens = stage.session(), [], [], set()
    live = session.liveliness()
    watch = live.declare_subscriber("@/*/@ros2_lv/**", lambda s: tokens.add(str(s.key_expr)), history=True)
    taker = session.declare_subscriber("chatter", sent.append)
    server = session.declare_queryable("ask", lambda q: (q.reply(q.key_expr, q.payload.to_bytes() + b"!"), q.drop()))
    node = stage.ours(Ros2Dds())
    publication = node.publish(chatter(Kind.PUBLISHER))
    node.subscribe(chatter(Kind.SUBSCRIPTION, name="/base/chatter"), got.append)
    node.serve(Endpoint(Kind.SERVER, "/mine", "std_srvs/srv/Trigger"), lambda request: request + b"?")
    client = node.client(Endpoint(Kind.CLIENT, "/ask", "std_srvs/srv/Trigger"))
    assert node.wait_until_joined(30)
    stage.until(lambda: publication.put(stage.cdr_string("to them")) and sent, "they got nothing")
    assert (sent[0].payload.to_bytes(), sent[0].attachment) == (stage.cdr_string("to them"), None)
    stage.until(lambda: session.put("base/chatter", stage.cdr_string("to us")) or got, "we got nothing")
    assert got[0] == stage.cdr_string("to us")
    (reply,) = stage.until(lambda: list(session.get("mine", payload=b"\0\1\0\0", timeout=10)), "no answer")
    assert reply.ok.payload.to_bytes() == b"\0\1\0\0?"
    assert client.call(b"\0\1\0\0", 10) == b"\0\1\0\0!"
    ours = {t.partition("@ros2_lv")[2] for t in tokens}
    assert ours >= {
        "",
        f"/MP/chatter/std_msgs§msg§String/:1:0:0,10:typehash={RIHS_STRING};",
        f"/MS/base§chatter/std_msgs§msg§String/:1:0:0,10:typehash={RIHS_STRING};",
        "/SS/mine/std_srvs§srv§Trigger",
        "/SC/ask/std_srvs§srv§Trigger",
    }
    # A publisher of another hash: nothing of the topic is taken until it is gone, for keys do not tell them apart.
    wrong = live.declare_token(
        "@/0/@ros2_lv/MP/base§chatter/std_msgs§msg§String/:1:0:0,5:typehash=RIHS01_" + "0" * 64 + ";"
    )
    stage.until(lambda: node.troubles, "nothing was said")
    assert "RIHS01_" + "0" * 64 in node.troubles[0]
    assert RIHS_STRING in node.troubles[0]
    for _ in range(5):
        session.put("base/chatter", b"wrong")
        time.sleep(0.05)
    wrong.undeclare()
    stage.until(lambda: not node.troubles, "the trouble stayed")
    stage.until(lambda: session.put("base/chatter", b"right") or got[-1] == b"right", "nothing comes any more")
    assert b"wrong" not in got  # Zenoh keeps the order
    for thing in (watch, taker, server):
        thing.undeclare()


def test_a_configuration_that_cannot_be_used_is_named(stage, tmp_path):
    dialect = stage.ours().dialect
    with pytest.raises(Ros2Error, match="does not take the address nonsense"):
        Ros2Node(dialect, router="nonsense")
    file = tmp_path / "zenoh.json5"
    file.write_text("{mode: 'peer', scouting: {")
    with pytest.raises(Ros2Error, match=r"does not take the configuration .*zenoh\.json5"):
        Ros2Node(dialect, config_file=file)
    file.write_text("{mode: 'peer'}")
    with pytest.raises(Ros2Error, match="names no connect/endpoints"):
        Ros2Node(dialect, config_file=file)
    file.write_text(f"{{connect: {{endpoints: ['{stage.router.address}']}}}}")
    assert stage.ours(router=None, config_file=file).wait_until_joined(30)


def test_hashes_in_these_tests_are_those_of_the_codec():
    assert (hash_of(STRING, "cdr"), hash_of(ADD, "cdr"), hash_of(OWN, "cdr")) == (RIHS_STRING, RIHS_ADD, "")


def test_certificates_come_from_a_configuration_file_of_zenoh(tmp_path):
    authority, certificate, key = write_certificate("127.0.0.1", tmp_path)
    router = Router(
        **{"transport/link/tls/listen_certificate": str(certificate), "transport/link/tls/listen_private_key": str(key)}
    )
    router.protocol = "tls"
    stage = Stage(router, 0)
    file = tmp_path / "zenoh.json5"
    file.write_text(f"{{transport: {{link: {{tls: {{root_ca_certificate: '{authority}'}}}}}}}}")
    try:
        router.start()
        stranger = stage.ours()
        stage.until(lambda: stage.said, "an unknown authority was not refused")
        assert "is not there" in stage.said[0]
        assert stage.ours(config_file=file).wait_until_joined(30)
        assert not stranger.wait_until_joined(0)
    finally:
        stage.close()
        router.stop()
