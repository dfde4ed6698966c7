import socket
import threading
import time
from collections import Counter
from dataclasses import replace
from itertools import groupby

import pytest

from skytether.emulator.link_model import IP_UDP_HEADERS, LinkModel
from skytether.emulator.udp_link import LinkConditions, LinkEmulator

# --- what is decided: made-up time --------------------------------------------------------------------------------


def arrivals(conditions, count=10_000, *, period=0.01, size=172, direction="up"):
    """Feed packets at a fixed period; returns the model and, for each packet, when it arrives."""
    model = LinkModel(conditions, direction)
    return model, [model.decide(size, i * period) for i in range(count)]


def delays(times, period=0.01):
    return [t[0] - i * period for i, t in enumerate(times) if t]


def test_a_perfect_link_passes_everything_at_once():
    _, times = arrivals(LinkConditions(), 100)
    assert times == [(i * 0.01,) for i in range(100)]


def test_the_same_seed_decides_the_same_and_another_one_or_the_other_direction_does_not():
    conditions = LinkConditions(delay=0.05, jitter=0.01, loss=0.1, duplicate=0.1, reorder=0.1, seed=7)
    first = arrivals(conditions, 300)[1]
    assert arrivals(conditions, 300)[1] == first
    assert arrivals(replace(conditions, seed=8), 300)[1] != first
    assert arrivals(conditions, 300, direction="down")[1] != first


def test_independent_loss_has_the_share_and_the_runs_of_independent_chances():
    model, times = arrivals(LinkConditions(loss=0.05, seed=1), 40_000)
    # Standard deviation of the share: sqrt(0.05 * 0.95 / 40000) = 0.0011.
    assert model.counters.lost / 40_000 == pytest.approx(0.05, abs=0.004)
    runs = [len(list(group)) for lost, group in groupby(not t for t in times) if lost]
    assert sum(runs) / len(runs) == pytest.approx(1 / 0.95, abs=0.05)


@pytest.mark.parametrize(("loss", "burst"), [(0.03, 4), (0.2, 8), (0.05, 1)])
def test_bursty_loss_has_the_share_and_the_mean_run_asked_for(loss, burst):
    model, times = arrivals(LinkConditions(loss=loss, burst=burst, seed=2), 100_000)
    assert model.counters.lost / 100_000 == pytest.approx(loss, rel=0.1)
    runs = [len(list(group)) for lost, group in groupby(not t for t in times) if lost]
    assert sum(runs) / len(runs) == pytest.approx(burst, rel=0.1)


def test_jitter_is_normal_around_the_delay_and_never_before_the_packet_was_sent():
    _, times = arrivals(LinkConditions(delay=0.098, jitter=0.024, seed=3))
    found = delays(times)
    mean = sum(found) / len(found)
    assert mean == pytest.approx(0.098, abs=0.001)
    assert (sum((d - mean) ** 2 for d in found) / len(found)) ** 0.5 == pytest.approx(0.024, rel=0.05)
    _, times = arrivals(LinkConditions(delay=0.01, jitter=0.05, seed=3))
    assert min(delays(times)) >= -1e-9
    assert max(delays(times)) <= 0.01 + 3 * 0.05 + 1e-9


def test_jitter_reorders_unless_told_not_to():
    conditions = LinkConditions(delay=0.05, jitter=0.014, seed=4)
    freely = [t[0] for t in arrivals(conditions)[1]]
    assert freely != sorted(freely)
    in_order = [t[0] for t in arrivals(replace(conditions, jitter_reorders=False))[1]]
    assert in_order == sorted(in_order)


def test_rate_spaces_packets_and_drops_what_finds_the_queue_full():
    size = 1000 - IP_UDP_HEADERS  # 1000 bytes on the link: 8 ms at 1 Mbit/s
    model = LinkModel(LinkConditions(rate=1e6, queue=3000, delay=0.1), "up")
    times = [model.decide(size, 0.0) for _ in range(5)]
    assert times[:3] == [(pytest.approx(0.108),), (pytest.approx(0.116),), (pytest.approx(0.124),)]
    assert times[3:] == [(), ()]
    assert model.counters.overflowed == 2
    # 8 ms later one of them has gone, so there is room for one.
    assert model.decide(size, 0.008) == (pytest.approx(0.132),)
    assert model.decide(size, 0.008) == ()


def test_an_idle_link_takes_a_packet_larger_than_its_queue():
    model = LinkModel(LinkConditions(rate=1e6, queue=0), "up")
    assert model.decide(1000 - IP_UDP_HEADERS, 1.0) == (pytest.approx(1.008),)
    assert model.decide(100, 1.0) == ()


def test_a_full_queue_empties_at_the_new_rate():
    size = 1000 - IP_UDP_HEADERS
    model = LinkModel(LinkConditions(rate=1e4, queue=10_000), "up")
    assert sum(bool(model.decide(size, 0.0)) for _ in range(20)) == 10  # 0.8 s each: 8 s of queue
    model.conditions = LinkConditions(rate=1e6, queue=10_000)
    # 0.8 s later 9000 bytes are left: 72 ms at 1 Mbit/s, and room for one packet of 8 ms.
    assert model.decide(size, 0.8) == (pytest.approx(0.88),)
    assert model.decide(size, 0.8) == ()
    model.conditions = LinkConditions()
    assert model.decide(size, 0.81) == (0.81,)
    model.conditions = LinkConditions(rate=1e6, queue=10_000)
    assert model.decide(size, 0.82) == (pytest.approx(0.828),)


def test_reordered_packets_are_held_back():
    model, times = arrivals(LinkConditions(delay=0.05, reorder=0.1, reorder_by=0.02, seed=5))
    found = Counter(round(d, 6) for d in delays(times))
    assert set(found) == {0.05, 0.07}
    assert found[0.07] == model.counters.reordered
    assert found[0.07] / 10_000 == pytest.approx(0.1, abs=0.015)


def test_duplicates_arrive_twice():
    model, times = arrivals(LinkConditions(duplicate=0.2, seed=6))
    twice = sum(len(t) == 2 for t in times)
    assert twice == model.counters.duplicated
    assert twice / 10_000 == pytest.approx(0.2, abs=0.02)


def test_a_cut_link_passes_nothing_and_changes_hold_from_the_next_packet_on():
    model = LinkModel(LinkConditions(cut=True), "up")
    assert model.decide(100, 0.0) == ()
    assert model.counters.cut == 1
    model.conditions = LinkConditions(delay=0.3)
    assert model.decide(100, 1.0) == (1.3,)


@pytest.mark.parametrize(
    ("fields", "says"),
    [
        ({"delay": -1}, "delay must be 0 to 60 s"),
        ({"loss": 1.5}, "loss must be 0 to 1"),
        ({"rate": 0}, "rate must be above 0"),
        ({"queue": -1}, "queue must be at least 0"),
        ({"burst": 0.5}, "burst must be at least 1"),
        ({"burst": float("inf")}, "burst must be at least 1 packet and finite"),
        ({"loss": 0.9, "burst": 4}, "loss must be 0 to 0.8 with bursts of 4"),
        ({"jitter": float("nan")}, "jitter must be 0 to 60 s"),
    ],
)
def test_impossible_conditions_are_refused_by_name(fields, says):
    with pytest.raises(ValueError, match=says):
        LinkConditions(**fields)


# --- the sockets: real ones ----------------------------------------------------------------------------------------


@pytest.fixture
def udp():
    """Makes UDP sockets on the loopback interface and closes them."""
    made = []

    def make():
        sock = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        sock.bind(("127.0.0.1", 0))
        sock.settimeout(2)
        made.append(sock)
        return sock

    yield make
    for sock in made:
        sock.close()


def test_datagrams_pass_both_ways_and_each_client_gets_its_own_answers(udp):
    target, one, two = udp(), udp(), udp()
    with LinkEmulator(target.getsockname()) as link:
        one.sendto(b"from one", link.address)
        data, one_seen_as = target.recvfrom(100)
        assert data == b"from one"
        two.sendto(b"from two", link.address)
        data, two_seen_as = target.recvfrom(100)
        assert data == b"from two"
        assert one_seen_as != two_seen_as
        target.sendto(b"to two", two_seen_as)
        target.sendto(b"to one", one_seen_as)
        assert two.recvfrom(100) == (b"to two", link.address)
        assert one.recvfrom(100) == (b"to one", link.address)
    counters = link.counters()
    assert (counters["up"].forwarded, counters["up"].bytes_forwarded) == (2, 16)
    assert counters["down"].forwarded == 2


def test_a_datagram_arrives_after_the_delay_and_not_much_later(udp):
    target, client = udp(), udp()
    with LinkEmulator(target.getsockname(), up=LinkConditions(delay=0.03)) as link:
        took = []
        for _ in range(10):
            start = time.monotonic()
            client.sendto(b"x", link.address)
            target.recv(10)
            took.append(time.monotonic() - start)
    assert min(took) >= 0.03
    assert sorted(took)[2] < 0.035  # a quarter of them: the machine may be busy


def test_conditions_change_live_in_one_direction(udp):
    target, client = udp(), udp()
    with LinkEmulator(target.getsockname()) as link:
        client.sendto(b"1", link.address)
        _, seen_as = target.recvfrom(10)
        link.set(down=replace(link.down, cut=True))
        target.sendto(b"lost", seen_as)
        client.sendto(b"2", link.address)
        assert target.recv(10) == b"2"
        client.settimeout(0.05)
        with pytest.raises(TimeoutError):
            client.recv(10)
        assert link.counters()["down"].cut == 1
        link.set(down=LinkConditions())
        target.sendto(b"back", seen_as)
        client.settimeout(2)
        assert client.recv(10) == b"back"


def test_a_cut_takes_what_is_under_way(udp):
    target, client = udp(), udp()
    with LinkEmulator(target.getsockname(), up=LinkConditions(delay=0.05)) as link:
        client.sendto(b"under way", link.address)
        wait_for(lambda: link.counters()["up"].received)
        link.set(up=replace(link.up, cut=True))
        wait_for(lambda: link.counters()["up"].cut)
        link.set(up=LinkConditions())
        client.sendto(b"after", link.address)
        assert target.recv(100) == b"after"


def test_the_target_can_move_and_the_clients_keep_their_address(udp):
    old, new, client = udp(), udp(), udp()
    with LinkEmulator(old.getsockname()) as link:
        client.sendto(b"1", link.address)
        _, seen_as = old.recvfrom(10)
        link.set_target(*new.getsockname())
        client.sendto(b"2", link.address)
        assert new.recvfrom(10) == (b"2", seen_as)
        new.sendto(b"hello", seen_as)
        assert client.recv(10) == b"hello"


def test_a_rebind_gives_clients_a_new_address_at_the_target(udp):
    target, client = udp(), udp()
    with LinkEmulator(target.getsockname()) as link:
        client.sendto(b"1", link.address)
        _, before = target.recvfrom(10)
        after = before
        link.rebind()

        def moved():
            nonlocal after
            client.sendto(b"2", link.address)
            _, after = target.recvfrom(10)
            return after != before

        wait_for(moved)
        target.sendto(b"hello", after)
        assert client.recv(10) == b"hello"


def test_a_target_that_is_not_there_does_not_end_it(udp):
    gone = udp()
    address = gone.getsockname()
    gone.close()
    target, client = udp(), udp()
    with LinkEmulator(address) as link:
        for _ in range(3):
            client.sendto(b"to nobody", link.address)
        wait_for(lambda: link.counters()["up"].received == 3)
        link.set_target(*target.getsockname())
        client.sendto(b"x", link.address)
        assert target.recv(10) == b"x"


def test_thousands_of_datagrams_pass_without_a_loss(udp):
    target, client = udp(), udp()
    target.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 4_000_000)
    with LinkEmulator(target.getsockname(), up=LinkConditions(delay=0.02)) as link:
        for i in range(3000):
            client.sendto(i.to_bytes(2, "big") + bytes(198), link.address)
            if i % 20 == 0:
                time.sleep(0.001)  # 20,000 a second
        assert [int.from_bytes(target.recv(300)[:2], "big") for _ in range(3000)] == list(range(3000))


def test_close_ends_the_thread_and_may_be_called_twice(udp):
    link = LinkEmulator(udp().getsockname())
    name = f"link-{link.address[1]}"
    assert name in {t.name for t in threading.enumerate()}
    link.close()
    link.close()
    assert name not in {t.name for t in threading.enumerate()}


def test_a_taken_port_is_the_callers_error(udp):
    taken = udp()
    with pytest.raises(OSError, match="in use"):
        LinkEmulator(("127.0.0.1", 9), bind=taken.getsockname())


def wait_for(condition, seconds=2):
    end = time.monotonic() + seconds
    while not condition():
        assert time.monotonic() < end, "waited in vain"
        time.sleep(0.001)
