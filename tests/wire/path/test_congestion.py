"""The rate of a path: as arithmetic, and of whole sessions on bottlenecks that others use too."""

import heapq
import math

import pytest

from skytether.emulator.link_model import LinkConditions, LinkModel
from skytether.wire import Direction, Role, Topic
from skytether.wire.codec.frames import Feedback
from skytether.wire.path.congestion import LOWEST, MARGIN, PATIENCE, TARGET, RateControl

ROBOT, SERVICE = Role.ROBOT, Role.SERVICE
CLEAR = Feedback(math.inf, 0.0, 5e6, 0, 0, 0, 0.0, 0.0)


class Told:
    """A rate control that is told the same every 100 ms, after two seconds in which all of the rate was used."""

    def __init__(self, ceiling=50e6):
        self.control = RateControl(ceiling, 0.0)
        self.now = 0.0
        self.run(2)

    def run(self, seconds, *, settled=70, lost=0, used=None, waited=True, **fields):
        for _ in range(round(seconds / 0.1)):
            self.now += 0.1
            rate = self.control.rate if used is None else used
            feedback = CLEAR._replace(**{"rate": rate, **fields})
            self.control.update(feedback, settled, lost, rate, waited, 0.05, self.now)
        return self.control.rate


def test_without_a_sign_of_a_limit_the_ceiling_is_used_whatever_is_lost():
    told = Told()
    for share in (0, 5, 21):
        assert told.run(10, lost=share) == 50e6
    assert not told.control.competing


def test_a_capacity_takes_effect_at_once_and_the_rate_comes_back():
    told = Told()
    assert told.run(2, capacity=10e6, used=6e6, rate=6e6) == pytest.approx(12e6)  # bursts of twice the mean
    assert told.run(1, capacity=10e6, queue=0.03) < MARGIN * 10e6
    low = told.control.rate
    assert low < told.run(0.3) < told.run(0.5) < told.run(1)
    assert told.run(30) == 50e6


def test_a_rate_that_is_not_used_does_not_grow():
    told = Told()
    low = told.run(0.1, capacity=2e6, queue=0.02)
    told.run(0.1)
    assert told.run(5, waited=False) <= max(low, told.control.rate)
    assert told.control.rate < 2.1e6


def test_a_queue_is_drained_and_the_rate_after_it_is_lower_than_before():
    told = Told(10e6)
    drained = told.run(0.1, queue=0.05)
    after = told.run(0.1)
    assert drained < after < 10e6
    assert told.run(0.1, queue=TARGET / 2) >= after


def test_a_queue_that_does_not_shrink_is_somebody_elses_and_losses_in_it_count():
    told = Told(10e6)
    told.run(5, lost=2)  # what the path loses without a queue
    told.run(PATIENCE + 0.2, queue=0.05)
    assert told.control.competing
    assert told.run(1, queue=0.05, lost=2) == 10e6
    assert told.run(0.1, queue=0.05, lost=20) == pytest.approx(5e6)
    assert told.run(3, queue=0.05, lost=2) > 5e6
    told.run(PATIENCE + 0.2)
    assert not told.control.competing


def test_it_never_stops():
    told = Told()
    assert told.run(PATIENCE, capacity=1e5, queue=0.5, rate=0.0) == LOWEST


def test_a_queue_of_ours_that_takes_long_to_drain_brings_no_rate_back_that_the_path_never_had():
    told = Told()
    told.run(0.1, capacity=5e6, queue=0.8, rate=5e6)
    assert told.run(6, capacity=5e6, queue=0.8, rate=5e6, waited=False) <= 6e6


# --- whole sessions in made-up time


TOPICS = (
    Topic("tf", "t", Direction.IN, priority=120, lifespan=0.1, delivery=0.999, depth=4),
    Topic("camera", "t", Direction.IN, priority=10, lifespan=0.15, delivery=0.995, depth=2),
)


class Tcp:
    """A download with Reno's window (RFC 5681) and selective acknowledgements, which come back after ``delay``."""

    def __init__(self, model, delay, now):
        self.model, self.delay, self.now = model, delay, now
        self.window, self.threshold = 10.0, math.inf
        self.next, self.recover, self.received = 0, -1, 0
        self.under_way, self.arrivals = set(), []

    def run_until(self, end):
        while True:
            while len(self.under_way) < int(self.window):
                self.under_way.add(self.next)
                for arrival in self.model.decide(1448, self.now):
                    heapq.heappush(self.arrivals, (arrival + self.delay, self.next))
                self.next += 1
            if not self.arrivals or self.arrivals[0][0] > end:
                break
            self.now, number = heapq.heappop(self.arrivals)
            if number not in self.under_way:
                continue
            self.under_way.discard(number)
            self.received += 1448
            lost = {n for n in self.under_way if n < number - 3}
            self.under_way -= lost
            if lost and number > self.recover:
                self.window = self.threshold = max(2.0, self.window / 2)
                self.recover = self.next
            else:
                self.window += 1.0 if self.window < self.threshold else 1 / self.window
        if not self.arrivals:  # all lost: a time-out
            self.under_way.clear()
            self.window = 2.0
        self.now = end


class Bottleneck:
    """Sessions and downloads through one queue, in steps of a millisecond."""

    def __init__(self, world, **conditions):
        self.world = world
        self.model = LinkModel(LinkConditions(**conditions), "up")
        self.delay = conditions["delay"]
        self.now = 0.0
        self.users = []

    def session(self, frame):
        ends = {"topics": TOPICS}
        link = self.world.link(
            connect=False, robot=ends | {"now": self.now}, service=ends, down=LinkConditions(delay=self.delay),
            start=self.now, seed=len(self.users),
        )  # fmt: skip
        link.models[ROBOT] = self.model
        link.every(1 / 15, self.now + 300, lambda: link.publish(ROBOT, "camera", bytes(frame)))
        link.every(0.01, self.now + 300, lambda: link.publish(ROBOT, "tf", bytes(180)))
        self.users.append(link)
        return link

    def download(self):
        self.users.append(Tcp(self.model, self.delay, self.now))
        return self.users[-1]

    def run(self, seconds):
        """Returns bits per second that each user got."""
        before = [self.got(user) for user in self.users]
        for _ in range(round(seconds * 1000)):
            self.now += 0.001
            for user in self.users:
                user.run_until(self.now)
        return [(self.got(u) - b) * 8 / seconds for u, b in zip(self.users, before, strict=True)]

    @staticmethod
    def got(user):
        if isinstance(user, Tcp):
            return user.received
        return user.sessions[SERVICE].stats(user.now).paths[0].bytes_received


@pytest.mark.slow
def test_two_sessions_on_one_bottleneck_share_it(world):
    link = Bottleneck(world, delay=0.03, rate=5e6)
    link.session(100_000)
    link.run(2)
    link.session(100_000)
    link.run(15)
    first, second = link.run(10)
    assert 0.5 < first / second < 2
    assert first + second > 0.75 * 5e6


@pytest.mark.slow
def test_a_download_and_a_session_leave_each_other_their_share(world):
    link = Bottleneck(world, delay=0.03, rate=10e6)
    link.session(200_000)
    link.run(3)
    link.download()
    link.run(12)
    session, download = link.run(30)
    assert session > 0.25 * 10e6
    assert download > 0.2 * 10e6


@pytest.mark.slow
def test_a_download_beside_ordinary_traffic_does_not_starve_it(world):
    link = Bottleneck(world, delay=0.03, rate=20e6)
    link.session(47_611)
    link.run(3)
    link.download()
    link.run(5)
    session, download = link.run(20)
    assert session > 2.5e6
    assert download > 5e6
