import errno
import os
import select
import socket
import struct
import sys
import time

import pytest

from skytether.bridge.datagrams import MAX_SEGMENTS, SO_TIMESTAMPNS, DatagramSocket


@pytest.fixture
def sockets():
    """Makes bound sockets and closes them."""
    made = []

    def make(host="127.0.0.1", port=0, **options):
        sock = DatagramSocket((host, port), **options)
        made.append(sock)
        return sock

    yield make
    for sock in made:
        sock.close()


def receive(sock, size):
    """All datagrams up to a total size, one by one."""
    datagrams = []
    while sum(map(len, datagrams)) < size:
        assert select.select([sock], (), (), 2)[0], f"only {len(datagrams)} datagrams came"
        while (batch := sock.receive()) is not None:
            data, _, segment = batch
            step = segment or len(data) or 1
            datagrams += [bytes(data[i : i + step]) for i in range(0, len(data), step)]
    return datagrams


def cut(data, segment):
    return [data[i : i + segment] for i in range(0, len(data), segment)]


@pytest.mark.parametrize("sender_batches", [True, False])
@pytest.mark.parametrize("receiver_batches", [True, False])
@pytest.mark.parametrize("size", [1, 1200, 1201, 2400, 47_611, 65_536, 200_000])
def test_a_batch_arrives_as_its_datagrams_whatever_the_kernels_can(sockets, size, sender_batches, receiver_batches):
    sender, receiver = sockets(batches=sender_batches), sockets(batches=receiver_batches)
    assert (sender.segmentation, receiver.coalescing) <= (sender_batches, receiver_batches)
    data = bytes(i * 7 % 251 for i in range(size))
    assert sender.send(data, receiver.address, 1200) == size
    assert receive(receiver, size) == cut(data, 1200)
    assert not sender.errors


def test_without_a_segment_size_it_is_one_datagram(sockets):
    sender, receiver = sockets(), sockets()
    assert sender.send(b"one", receiver.address) == 3
    assert receive(receiver, 3) == [b"one"]


def test_the_sender_is_told(sockets):
    sender, receiver = sockets(), sockets()
    sender.send(b"x", receiver.address)
    select.select([receiver], (), (), 2)
    assert receiver.receive()[1] == sender.address


@pytest.mark.skipif(sys.platform != "linux", reason="only Linux tells when a datagram came")
def test_how_long_a_datagram_waited_for_us_is_told(sockets):
    sender, receiver = sockets(), sockets()
    sender.send(b"x", receiver.address)
    assert select.select([receiver], (), (), 30)[0]
    time.sleep(0.05)
    assert receiver.receive() is not None
    assert 0.045 <= receiver.waited < 30


@pytest.mark.parametrize("batches", [True, False])
def test_taken_ahead_nothing_is_lost_reordered_or_mixed_up(sockets, batches):
    receiver, senders = sockets(batches=batches), [sockets(), sockets()]
    sent = []
    for i in range(300):
        sender, size = senders[i // 7 % 2], 1200 if i % 23 else 40
        sent.append((sender.address, i.to_bytes(2, "big") + bytes(size - 2)))
        sender.send(sent[-1][1], receiver.address)
    got = []
    while len(got) < len(sent):
        assert select.select([receiver], (), (), 2)[0], f"only {len(got)} datagrams came"
        for left in (5, 4, 3, 2, 1, 0):
            if (batch := receiver.receive(ahead=left > 0)) is None:
                break
            data, address, segment = batch
            got += [(address, one) for one in cut(bytes(data), segment or len(data))]
            if receiver.drained:
                break
    assert got == sent


def script_the_kernel(monkeypatch, script):
    """Have it hand over these datagrams, with the times at which they came, in microseconds."""
    left = list(script)

    def recvmsg_into(_self, buffers, _space):
        if not left:
            raise BlockingIOError
        data, address, micros = left.pop(0)
        buffers[0][: len(data)] = data
        stamp = struct.pack("@ll", 1_700_000_000, 1000 * micros)
        return len(data), [(socket.SOL_SOCKET, SO_TIMESTAMPNS, stamp)], 0, address

    monkeypatch.setattr(socket.socket, "recvmsg_into", recvmsg_into)


def test_only_equal_datagrams_of_one_moment_and_address_are_put_together(sockets, monkeypatch):
    receiver = sockets(batches=False)
    a, b = ("10.0.0.1", 1), ("10.0.0.2", 1)
    script = [
        (b"11", a, 0),
        (b"22", a, 30),
        (b"33", a, 50),
        (b"44", a, 60),
        (b"55", b, 60),
        (b"6", b, 60),
        (b"", b, 60),
    ]
    script_the_kernel(monkeypatch, script)
    got = []
    while (batch := receiver.receive(ahead=True)) is not None:
        data, address, segment = batch
        got.append((bytes(data), address, segment))
    assert receiver.drained
    assert got == [(b"112233", a, 2), (b"44", a, None), (b"55", b, None), (b"6", b, None), (b"", b, None)]


def test_a_batch_put_together_has_its_bound_and_a_last_call_leaves_nothing_behind(sockets, monkeypatch):
    receiver = sockets(batches=False)
    script = [(bytes([i]) * 1200, ("10.0.0.1", 1), 0) for i in range(150)]
    script_the_kernel(monkeypatch, script)
    sizes = []
    for ahead in (True, True, False):
        data, _, _ = receiver.receive(ahead=ahead)
        sizes.append(len(data) // 1200)
        assert bytes(data[::1200]) == bytes(range(sum(sizes[:-1]), sum(sizes)))
    assert max(sizes) <= MAX_SEGMENTS
    assert sizes[2] == 1
    while (batch := receiver.receive()) is not None:
        sizes.append(len(batch[0]) // 1200)
    assert sizes[2:] == [1] * (150 - sum(sizes[:2]))
    assert receiver.receive() is None


@pytest.mark.parametrize("number", [errno.EINVAL, errno.EIO])
def test_a_kernel_that_refuses_batches_gets_datagrams_from_then_on(sockets, monkeypatch, number):
    sender, receiver = sockets(), sockets()
    if not sender.segmentation:
        pytest.skip("this kernel has no UDP_SEGMENT")

    def refuse_to_cut(*_):
        raise OSError(number, "refused")

    monkeypatch.setattr(socket.socket, "sendmsg", refuse_to_cut)
    data = bytes(range(250)) * 20
    assert sender.send(data, receiver.address, 1200) == len(data)
    assert receive(receiver, len(data)) == cut(data, 1200)
    assert not sender.segmentation
    assert not sender.errors


def test_a_batch_beyond_what_the_kernel_cuts_at_once_is_split(sockets):
    sender, receiver = sockets(), sockets()
    data = bytes(100 * (2 * MAX_SEGMENTS + 1))
    assert sender.send(data, receiver.address, 100) == len(data)
    assert len(receive(receiver, len(data))) == 2 * MAX_SEGMENTS + 1


def test_a_datagram_too_large_for_the_path_is_dropped_and_counted_never_fragmented(sockets):
    sender, receiver = sockets(), sockets()
    assert sender.send(bytes(70_000), receiver.address) == 70_000
    assert sender.errors == {"EMSGSIZE": 1}
    sender.send(b"next", receiver.address)
    assert receive(receiver, 4) == [b"next"]


def test_no_route_is_counted_and_the_next_datagram_goes_out(sockets):
    sender, receiver = sockets(), sockets()
    sender.send(b"x", ("203.0.113.1", 9))  # bound to loopback: the kernel refuses to send it outside
    assert sum(sender.errors.values()) == 1
    sender.send(b"next", receiver.address)
    assert receive(receiver, 4) == [b"next"]


def test_a_full_buffer_returns_how_far_it_got(sockets, monkeypatch):
    sender, receiver = sockets(batches=False), sockets()
    sendto, sent = socket.socket.sendto, []

    def send_two(self, data, address):
        if len(sent) == 2:
            raise BlockingIOError(errno.EAGAIN, "full")
        sent.append(data)
        return sendto(self, data, address)

    monkeypatch.setattr(socket.socket, "sendto", send_two)
    data = bytes(range(250)) * 20
    assert sender.send(data, receiver.address, 1200) == 2400
    assert receive(receiver, 2400) == cut(data, 1200)[:2]


def test_an_icmp_answer_harms_nothing(sockets):
    sender, receiver, gone = sockets(), sockets(), sockets()
    # With IP_RECVERR Linux reports ICMP answers on unconnected sockets too, as other systems always do.
    with socket.socket(fileno=os.dup(sender.fileno())) as same:
        same.setsockopt(socket.IPPROTO_IP, 11, 1)
    nobody = gone.address
    gone.close()
    sender.send(b"x", nobody)
    assert sender.receive() is None
    receiver.send(b"y", sender.address)
    assert receive(sender, 1) == [b"y"]
    assert sender.errors["ECONNREFUSED"] >= 1


def test_ipv6(sockets):
    try:
        sender, receiver = sockets("::1"), sockets("::1")
    except OSError:
        pytest.skip("no IPv6 here")
    data = bytes(5000)
    assert sender.send(data, sender.resolve("::1", receiver.address[1]), 1200) == 5000
    assert receive(receiver, 5000) == cut(data, 1200)


def test_a_dual_stack_socket_reaches_an_ipv4_peer(sockets):
    try:
        sender = sockets("::")
    except OSError:
        pytest.skip("no IPv6 here")
    receiver = sockets()
    sender.send(b"x", sender.resolve(*receiver.address))
    assert receive(receiver, 1) == [b"x"]


def test_a_taken_port_is_an_error_and_leaves_no_socket_behind(sockets):
    with pytest.raises(OSError, match="in use"):
        sockets(port=sockets().address[1])  # an open socket would fail this test with a ResourceWarning
