"""Two ends, any applications, any network, anybody listening in: what holds whatever they do, in any order."""

from random import Random

import pytest
from hypothesis import settings
from hypothesis import strategies as st
from hypothesis.stateful import RuleBasedStateMachine, invariant, rule

from skytether.emulator.link_model import LinkConditions
from skytether.testing.link import LossyLink
from skytether.wire import Config, Direction, Role, Session, Topic
from skytether.wire.connect.handshake import MAX_HANDSHAKE
from skytether.wire.events import Connected

ROBOT, SERVICE = Role.ROBOT, Role.SERVICE
CONFIG = Config(max_message=30_000, reassembly_limit=60_000, queue_limit=60_000)
TOPICS = (
    Topic("newest", "t/msg/N", Direction.IN, priority=100, lifespan=0.2),
    Topic("every", "t/msg/E", Direction.IN, priority=10, lifespan=1.0, depth=100),
    Topic("cmd", "t/msg/C", Direction.OUT, priority=127, lifespan=0.2),
    Topic("map", "t/msg/M", Direction.OUT, priority=1, lifespan=5.0, depth=3),
)
NEWEST_ONLY = {"newest", "cmd"}
CONDITIONS = st.builds(
    LinkConditions,
    delay=st.floats(0, 0.3),
    jitter=st.floats(0, 0.1),
    loss=st.sampled_from([0.0, 0.05, 0.3, 1.0]),
    duplicate=st.sampled_from([0.0, 0.2]),
    reorder=st.sampled_from([0.0, 0.2]),
    rate=st.sampled_from([None, 1e6]),
    seed=st.integers(0, 100),
)


class TwoEnds(RuleBasedStateMachine):
    """Each message is numbered and published once, so each may arrive once at most, and as it was."""

    def __init__(self):
        super().__init__()
        self.random = Random(5)
        self.link = LossyLink(
            self.end(ROBOT, 0.0), self.end(SERVICE, 70.0), service_clock=(70.0, 3e-5), corrupt=0.02, record=True
        )
        self.published = {}
        self.checked = dict.fromkeys(Role, 0)
        self.arrived = set()
        self.newest = {}
        self.lives = 0

    def end(self, role, now):
        return Session(role, 9, bytes(32), TOPICS, config=CONFIG, entropy=self.random.randbytes, now=now)

    @rule(topic=st.sampled_from(TOPICS), size=st.sampled_from([4, 100, 1200, 5000, 30_000]), count=st.integers(1, 5))
    def publish(self, topic, size, count):
        for _ in range(count):
            number = len(self.published)
            payload = number.to_bytes(4, "big").ljust(size, bytes([number % 251]))
            self.published[number] = topic.name, payload
            self.link.publish(topic.direction.sender, topic.name, payload)

    @rule(seconds=st.sampled_from([0.001, 0.02, 0.2, 1.5]))
    def time_passes(self, seconds):
        self.link.run(seconds)

    @rule(role=st.sampled_from(Role), conditions=CONDITIONS)
    def the_network_changes(self, role, conditions):
        self.link.models[role].conditions = conditions

    @rule(role=st.sampled_from(Role))
    def an_end_restarts(self, role):
        self.lives += 1
        self.link.replace(role, self.end(role, self.link.time_of(role)))

    @rule()
    def the_robot_moves(self):
        self.link.addresses[ROBOT] = f"robot {self.random.random()}"

    @rule(role=st.sampled_from(Role), count=st.integers(1, 50), damaged=st.booleans())
    def somebody_repeats_what_was_sent(self, role, count, damaged):
        heard = self.link.sent[ROBOT if role is SERVICE else SERVICE]
        for _ in range(min(count, len(heard))):
            data = bytearray(self.random.choice(heard)[1])
            if damaged:
                data[self.random.randrange(len(data))] ^= 1 << self.random.randrange(8)
            self.link.inject(role, bytes(data))

    @invariant()
    def nothing_arrives_twice_or_altered_or_out_of_turn(self):
        for role in Role:
            for _, message in self.link.messages[role][self.checked[role] :]:
                number = int.from_bytes(message.payload[:4], "big")
                assert self.published[number] == (message.topic, bytes(message.payload))
                assert number not in self.arrived
                self.arrived.add(number)
                if message.topic in NEWEST_ONLY:
                    assert number > self.newest.get(message.topic, -1)
                    self.newest[message.topic] = number
            self.checked[role] = len(self.link.messages[role])

    @invariant()
    def memory_is_bounded(self):
        for role, session in self.link.sessions.items():
            used = session.stats(self.link.time_of(role)).reassembly_bytes
            assert used <= CONFIG.reassembly_limit + 2 * MAX_HANDSHAKE

    def teardown(self):
        """On a network that works again, so does the session."""
        for role in Role:
            self.link.models[role].conditions = LinkConditions()
        self.link.corrupt = 0.0
        self.link.run(12.0)
        for role, topic in ((ROBOT, "every"), (SERVICE, "map")):
            payload = len(self.published).to_bytes(4, "big")
            self.published[len(self.published)] = topic, payload
            assert self.link.publish(role, topic, payload)
        self.link.run(1.0)
        self.nothing_arrives_twice_or_altered_or_out_of_turn()
        assert {len(self.published) - 1, len(self.published) - 2} <= self.arrived
        for role in Role:
            assert any(isinstance(event, Connected) for _, event in self.link.events[role])


TwoEnds.TestCase.settings = settings(max_examples=12, stateful_step_count=15, deadline=None)
test_two_ends = pytest.mark.slow(TwoEnds.TestCase)
