import errno
import logging
import os
import queue
import resource
import socket
import sys
import threading
import time

import pytest

from skytether.bridge import BridgeError
from skytether.bridge.datagrams import UDP_GRO, UDP_SEGMENT, DatagramSocket
from skytether.bridge.endpoint import new_loop
from skytether.emulator.udp_link import LinkConditions, LinkEmulator
from skytether.wire import Config
from skytether.wire.events import Connected, Disconnected, PeerMoved, Refused
from skytether.wire.topic import Direction, Role, Topic


def topic_stats(bridge, name):
    return next(t for t in bridge.stats().topics if t.topic == name)


# --- messages -----------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("size", [0, 1, 80, 1_200, 47_611, 65_536, 1_000_000])
def test_messages_of_every_size_arrive_both_ways(ends, size):
    service, robot = ends.pair()
    payload = os.urandom(size)
    assert robot.publish("camera", payload)
    assert service.publish("cmd_vel", payload[::-1])
    service.graph.wait_messages(1)
    robot.graph.wait_messages(1)
    assert service.graph.messages == [("camera", payload)]
    assert robot.graph.messages == [("cmd_vel", payload[::-1])]


@pytest.mark.parametrize("kernel_lacks", [(UDP_SEGMENT, UDP_GRO), (UDP_GRO,), (UDP_SEGMENT,)])
def test_messages_arrive_where_the_kernel_has_no_batches(ends, monkeypatch, kernel_lacks):
    setsockopt = socket.socket.setsockopt

    def refuse(self, level, option, value):
        if level == socket.IPPROTO_UDP and option in kernel_lacks:
            raise OSError(errno.ENOPROTOOPT, "no such option")
        setsockopt(self, level, option, value)

    monkeypatch.setattr(socket.socket, "setsockopt", refuse)
    service, robot = ends.pair()
    payload = os.urandom(200_000)
    robot.publish("camera", payload)
    service.graph.wait_messages(1)
    assert service.graph.messages == [("camera", payload)]


def test_messages_pass_a_link_that_loses_delays_and_reorders(ends):
    bad = LinkConditions(delay=0.01, jitter=0.003, loss=0.05, reorder=0.02, duplicate=0.02, seed=3)
    made = []

    def link(address):
        made.append(LinkEmulator(address, up=bad, down=bad))
        return made[0].address

    try:
        service, robot = ends.pair(link=link)
        for i in range(100):
            robot.publish("force", i.to_bytes(2, "big"))
            service.publish("cmd_vel", i.to_bytes(2, "big"))
        # 0.05 ** 3 copies * 100 messages: one in eight runs may lose one; never three.
        service.graph.wait_messages(97)
        robot.graph.wait_messages(97)
        assert {m[1] for m in service.graph.messages} <= {i.to_bytes(2, "big") for i in range(100)}
        assert len(set(service.graph.messages)) == len(service.graph.messages)
        assert made[0].counters()["up"].lost > 0
    finally:
        made[0].close()


def test_publish_from_many_threads_loses_and_mixes_nothing(ends):
    service, robot = ends.pair()
    threads = [
        threading.Thread(
            target=lambda n=n: [robot.publish("force", bytes([n]) + i.to_bytes(2, "big")) for i in range(200)]
        )
        for n in range(8)
    ]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    service.graph.wait_messages(1600)
    for n in range(8):
        assert sorted(m[1][1:] for m in service.graph.messages if m[1][0] == n) == [
            i.to_bytes(2, "big") for i in range(200)
        ]
    assert topic_stats(robot, "force").offered == 1600


def test_no_message_of_a_burst_is_left_behind(ends):
    service, robot = ends.pair()
    sent = []
    for size in (1, 2, 3, 50, 1, 200) * 5:  # what comes close together is gathered; the last one waits for no other
        for _ in range(size):
            sent.append(("force", len(sent).to_bytes(4, "big")))
            robot.publish(*sent[-1])
        service.graph.wait(lambda graph: len(graph.messages) == len(sent), 30)
    assert service.graph.messages == sent


def test_the_publishers_buffer_may_be_used_again_at_once(ends):
    service, robot = ends.pair()
    buffer = bytearray(b"before")
    robot.publish("force", memoryview(buffer))
    buffer[:] = b"after!"
    service.graph.wait_messages(1)
    assert service.graph.messages == [("force", b"before")]


# --- what publish says --------------------------------------------------------------------------------------------


def test_publish_says_at_once_what_cannot_be_sent(ends):
    service, robot = ends.pair(config=Config(max_message=1000))
    with pytest.raises(KeyError, match="'nothing' is not one that this end"):
        robot.publish("nothing", b"")
    with pytest.raises(KeyError, match=r"'cmd_vel' is not one that this end \(robot\) sends"):
        robot.publish("cmd_vel", b"")
    with pytest.raises(ValueError, match="'force': 1001 bytes are more than a message may have, 1000"):
        robot.publish("force", bytes(1001))
    with pytest.raises(ValueError, match="1600 bytes"):
        service.publish("cmd_vel", memoryview(bytes(1600)).cast("d"))


def test_publish_is_false_while_no_session_is_up(ends):
    service = ends.make(Role.SERVICE)
    assert not service.publish("cmd_vel", b"")  # not started
    service.start()
    assert not service.publish("cmd_vel", b"")  # nobody there
    robot = ends.start(Role.ROBOT, peer=service.address)
    robot.graph.wait_connected()
    service.graph.wait_connected()
    assert service.publish("cmd_vel", b"")
    robot.stop()
    service.graph.wait(lambda port: port.count(Disconnected))
    assert not service.publish("cmd_vel", b"")  # said goodbye
    assert not robot.publish("force", b"")  # stopped


def test_a_topic_that_the_peer_does_not_know_is_not_sent(ends):
    service = ends.start(Role.SERVICE)
    extra = Topic("extra", "t/msg/E", Direction.IN)
    robot = ends.start(Role.ROBOT, peer=service.address, topics=(*ends.topics, extra))
    robot.graph.wait_connected()
    assert not robot.publish("extra", b"")
    assert robot.publish("force", b"")


# --- connecting ---------------------------------------------------------------------------------------------------


def test_a_service_that_restarts_on_the_same_port_is_joined_again(ends):
    service, robot = ends.pair()
    address = service.address
    service.stop()
    service = ends.start(Role.SERVICE, bind=address)
    robot.graph.wait_connected(2)
    service.graph.wait_connected()
    robot.publish("force", b"again")
    service.graph.wait_messages(1)


def test_a_robot_that_restarts_is_joined_again(ends):
    service, robot = ends.pair()
    robot.stop()
    robot = ends.start(Role.ROBOT, peer=service.address)
    robot.graph.wait_connected()
    service.graph.wait_connected(2)
    service.publish("cmd_vel", b"again")
    robot.graph.wait_messages(1)


def test_nobody_at_the_peers_port_is_waited_for(ends, wait_for):
    """The kernel answers with ICMP "port unreachable" meanwhile."""
    service = ends.start(Role.SERVICE)
    address = service.address
    service.stop()
    robot = ends.start(Role.ROBOT, peer=address)
    wait_for(lambda: any(p.packets_sent >= 2 for p in robot.stats().paths))
    service = ends.start(Role.SERVICE, bind=address)
    robot.graph.wait_connected()


def test_a_service_elsewhere_is_spoken_to_after_set_peer(ends):
    first, robot = ends.pair()
    second = ends.start(Role.SERVICE)
    robot.set_peer(*second.address)
    second.graph.wait_connected()
    robot.graph.wait_connected(2)
    robot.publish("force", b"here")
    second.graph.wait_messages(1)
    assert not first.graph.messages


def test_the_peer_may_be_named_after_the_start(ends):
    service = ends.start(Role.SERVICE)
    robot = ends.start(Role.ROBOT)
    robot.set_peer(*service.address)
    robot.graph.wait_connected()


def test_a_robot_whose_address_changes_stays_in_its_session(ends):
    made = []

    def link(address):
        made.append(LinkEmulator(address))
        return made[0].address

    try:
        service, robot = ends.pair(link=link)
        robot.publish("force", b"1")
        service.graph.wait_messages(1)
        made[0].rebind()
        service.graph.wait(lambda port: port.count(PeerMoved))  # the next ping tells
        service.publish("cmd_vel", b"back")
        robot.graph.wait_messages(1)
        assert robot.graph.count(Connected) == 1
    finally:
        made[0].close()


def test_goodbye_tells_the_peer_at_once(ends):
    service, robot = ends.pair()
    start = time.monotonic()
    robot.stop()
    service.graph.wait(lambda port: Disconnected("goodbye") in port.events)
    assert time.monotonic() - start < Config().silence  # not merely found silent


def test_topic_tables_that_do_not_fit_are_refused_with_the_reason(ends):
    service = ends.start(Role.SERVICE, topics=(Topic("force", "t/msg/F", Direction.IN),))
    robot = ends.start(Role.ROBOT, peer=service.address, topics=(Topic("force", "t/msg/Other", Direction.IN),))
    robot.graph.wait(lambda port: port.count(Refused))
    reason = next(e.reason for e in robot.graph.events if isinstance(e, Refused))
    assert "force" in reason
    assert "t/msg/Other" in reason


# --- robustness ---------------------------------------------------------------------------------------------------


def test_a_busy_application_does_not_stop_the_bridge(ends):
    """Half a second of pure Python in one go: the worst that a service's step can do."""
    sys.setswitchinterval(0.005)  # the interpreter's default
    service, robot = ends.pair()
    started, over = threading.Event(), threading.Event()

    def step():
        started.set()
        end = time.monotonic() + 0.5
        while time.monotonic() < end:
            sum(range(1000))
        over.set()

    thread = threading.Thread(target=step)
    thread.start()
    started.wait()
    echoed = 0
    while not over.is_set():
        robot.publish("force", b"ping")
        service.graph.wait_messages(echoed + 1)
        service.publish("cmd_vel", b"pong")
        robot.graph.wait_messages(echoed + 1)
        echoed += not over.is_set()
    thread.join()
    # Each round trip hands the interpreter over some ten times: 0.5 ms each, or 5 ms without the bridge's care.
    assert echoed >= 40


class FailingPort:
    """A graph whose every call fails."""

    def attach(self, publisher):
        pass

    def deliver(self, message):
        raise RuntimeError("deliver failed")

    def notify(self, event):
        raise RuntimeError("notify failed")


def test_faults_of_a_graph_are_logged_once_a_kind_and_end_nothing(ends, caplog):
    caplog.set_level(logging.ERROR, "skytether")
    service = ends.start(Role.SERVICE, FailingPort())
    robot = ends.start(Role.ROBOT, peer=service.address)
    robot.graph.wait_connected()
    for _ in range(3):
        robot.publish("force", b"x")
    service_saw = lambda: topic_stats(service, "force").delivered  # noqa: E731
    end = time.monotonic() + 5
    while service_saw() < 3:
        assert time.monotonic() < end
        time.sleep(0.002)
    assert service.publish("cmd_vel", b"still here")
    robot.graph.wait_messages(1)
    assert sorted(r.message.split("'s ")[1].split(" failed")[0] for r in caplog.records) == ["deliver", "notify"]


class BlockingPort:
    """A graph that does not return from a delivery until released."""

    def __init__(self):
        self.entered, self.release = threading.Event(), threading.Event()

    def attach(self, publisher):
        pass

    def deliver(self, message):
        self.entered.set()
        self.release.wait(5)

    def notify(self, event):
        pass


def test_what_waits_for_a_stalled_thread_is_bounded_and_counted(ends):
    port = BlockingPort()
    service = ends.start(
        Role.SERVICE, port, config=Config(max_message=10_000, queue_limit=10_000, reassembly_limit=20_000)
    )
    robot = ends.start(Role.ROBOT, peer=service.address)
    robot.graph.wait_connected()
    robot.publish("force", b"x")
    port.entered.wait(5)
    for i in range(30):
        assert service.publish("cmd_vel", bytes([i]) * 800)  # and 200 for each entry
    port.release.set()
    robot.graph.wait(lambda graph: graph.messages and graph.messages[-1][1][0] == 29)
    assert [m[1][0] for m in robot.graph.messages] == list(range(20, 30))
    stats = topic_stats(service, "cmd_vel")
    assert (stats.offered, stats.replaced) == (30, 20)


def test_garbage_from_strangers_is_counted_and_harms_nothing(ends, wait_for):
    service, robot = ends.pair()
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as stranger:
        for i in range(50):
            stranger.sendto(os.urandom(i * 7), service.address)
    wait_for(lambda: sum(service.stats().rejected.values()) >= 49)  # an empty datagram may be no packet at all
    robot.publish("force", b"x")
    service.graph.wait_messages(1)


def test_packets_that_the_system_refuses_are_counted(ends, wait_for):
    robot = ends.start(Role.ROBOT, peer=("203.0.113.1", 9))  # bound to loopback: there is no way
    wait_for(lambda: any(name.startswith("socket_") for name in robot.stats().rejected))


def test_a_process_with_many_open_files_still_gets_a_bridge(ends):
    soft, hard = resource.getrlimit(resource.RLIMIT_NOFILE)
    if hard != resource.RLIM_INFINITY and hard < 2048:
        pytest.skip("this user may not open so many files")
    resource.setrlimit(resource.RLIMIT_NOFILE, (2048, hard))
    files = []
    try:
        with open(os.devnull) as null:
            while not files or files[-1] < 1030:
                files.append(os.dup(null.fileno()))
            service, robot = ends.pair()
            robot.publish("force", b"x")
            service.graph.wait_messages(1)
            service.stop()
            robot.stop()
    finally:
        for file in files:
            os.close(file)
        resource.setrlimit(resource.RLIMIT_NOFILE, (soft, hard))


def test_the_loops_timers_are_finer_than_a_millisecond():
    sock = DatagramSocket(("127.0.0.1", 0))
    loop = new_loop(sock)
    try:
        late = []
        for _ in range(20):
            due = loop.time() + 0.0002
            loop.call_at(due, loop.stop)
            loop.run_forever()
            late.append(loop.time() - due)
        assert sorted(late)[5] < 0.0007  # epoll's would be late by 0.8 ms at least
    finally:
        loop.close()
        sock.close()


# --- starting, stopping, asking -----------------------------------------------------------------------------------


def test_a_taken_port_is_one_clear_sentence(ends):
    service = ends.start(Role.SERVICE)
    port = service.address[1]
    with pytest.raises(BridgeError, match=f"cannot listen on UDP 127.0.0.1:{port}: Address already in use"):
        ends.start(Role.SERVICE, bind=service.address)


def test_an_address_that_is_not_ours_is_one_clear_sentence(ends):
    with pytest.raises(BridgeError, match=r"cannot listen on UDP 203\.0\.113\.1:0: "):
        ends.start(Role.SERVICE, bind=("203.0.113.1", 0))


def test_a_peer_without_an_address_is_one_clear_sentence(ends):
    with pytest.raises(BridgeError, match=r"peer no\.such\.host\.invalid:1 has no address"):
        ends.start(Role.ROBOT, peer=("no.such.host.invalid", 1))
    robot = ends.start(Role.ROBOT)
    with pytest.raises(BridgeError, match=r"peer no\.such\.host\.invalid:1 has no address"):
        robot.set_peer("no.such.host.invalid", 1)


def test_stop_ends_the_thread_frees_the_port_and_may_be_called_again(ends):
    service = ends.start(Role.SERVICE)
    name = f"bridge-{service.address[1]}"
    assert name in {t.name for t in threading.enumerate()}
    service.stop()
    service.stop()
    assert name not in {t.name for t in threading.enumerate()}
    ends.start(Role.SERVICE, bind=service.address)


def test_a_graph_that_cannot_be_attached_fails_the_start_and_leaves_nothing_open(ends, monkeypatch):
    port = FailingPort()
    monkeypatch.setattr(port, "attach", lambda publisher: publisher.no_such_method())
    with pytest.raises(AttributeError, match="no_such_method"):
        ends.start(Role.SERVICE, port)  # an open socket or loop would fail this test with a ResourceWarning


def test_a_bridge_that_was_never_started_can_be_stopped_and_one_starts_once(ends):
    ends.make(Role.SERVICE).stop()
    service = ends.start(Role.SERVICE)
    with pytest.raises(BridgeError, match="started before"):
        service.start()


def test_a_graph_may_stop_its_bridge(ends, wait_for):
    service, robot = ends.pair()
    service.graph.deliver = lambda message: service.stop()
    robot.publish("force", b"x")
    robot.graph.wait(lambda port: port.count(Disconnected))
    thread = f"bridge-{service.address[1]}"
    wait_for(lambda: thread not in {t.name for t in threading.enumerate()})


def test_statistics_are_there_before_during_and_after(ends):
    service = ends.make(Role.SERVICE)
    assert not service.stats().connected
    service.start()
    robot = ends.start(Role.ROBOT, peer=service.address)
    robot.graph.wait_connected()
    robot.publish("force", b"12345")
    service.graph.wait_messages(1)
    during = service.stats()
    assert during.connected
    assert next(t for t in during.topics if t.topic == "force").delivered == 1
    service.stop()
    after = service.stats()
    assert not after.connected
    assert next(t for t in after.topics if t.topic == "force").bytes_delivered == 5


def test_a_graph_may_ask_for_statistics(ends):
    service, robot = ends.pair()
    answers = queue.SimpleQueue()
    service.graph.deliver = lambda message: answers.put(service.stats().connected)
    robot.publish("force", b"x")
    assert answers.get(timeout=5)


def test_ipv6(ends):
    try:
        service = ends.start(Role.SERVICE, bind=("::1", 0))
    except BridgeError:
        pytest.skip("no IPv6 here")
    robot = ends.start(Role.ROBOT, bind=("::", 0), peer=service.address)
    robot.graph.wait_connected()
    robot.publish("force", b"x")
    service.graph.wait_messages(1)


def test_a_port_may_publish_reliably_from_the_moment_it_is_attached(ends):
    from skytether.wire.topic import Direction, Topic

    class Eager(type(ends.make(Role.SERVICE).graph)):
        def attach(self, publisher):
            super().attach(publisher)
            self.taken = publisher.publish("map", b"early")

    table = (Topic("map", "t/msg/M", Direction.IN, reliable=True, latched=True, lifespan=60.0),)
    service = ends.start(Role.SERVICE, topics=table)
    robot = ends.start(Role.ROBOT, Eager(), topics=table, peer=service.address)
    assert robot.graph.taken
    service.graph.wait_messages(1)
    assert service.graph.messages == [("map", b"early")]
