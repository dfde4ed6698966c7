"""When the robot's end speaks first: to find the service, to find it again, to find it elsewhere (rule 1)."""

from __future__ import annotations

import math
from collections.abc import Hashable, Sequence

from ..codec.ciphers import Ciphers
from ..config import Config
from ..topic import Topic
from .handshake import LIFE_SIZE, NO_KEYS, Entropy, Hello

HELLO_LIFE = 5.0
"""Seconds before an unanswered HELLO is replaced by a new one: less than the service remembers it."""
HELLO_SHARE = 0.05
"""Time between HELLOs as a share of that since the first: no back-off in the first second, in which a lost packet is
more likely than an absent service."""
PROBE_SHARE = 0.02
"""Time between probes as a share of the silence: who was away for 5 s is found within 0.1 s."""


def patience(config: Config, silence: float) -> float:
    """Time between attempts to reach a peer that was last heard ``silence`` seconds ago."""
    return min(max(config.probe_interval, PROBE_SHARE * silence), config.hello_retry_max)


class Reconnector:
    """Makes HELLO when it is time. The service's end has one that never does."""

    def __init__(self, session_id: int, key: bytes, topics: Sequence[Topic], config: Config, entropy: Entropy) -> None:
        self._session_id = session_id
        self._key = key
        self._topics = topics
        self._config = config
        self._entropy = entropy
        self._life = entropy(LIFE_SIZE)
        self._began = math.inf
        """When the first HELLO was sent since the service was last heard or looked for elsewhere."""
        self._proposal = entropy(1)[0]
        self.peers: set[Hashable] = set()
        """Where the service should be, seen from all paths."""
        self.hello: Hello | None = None
        """The one that is to be answered."""
        self.due = math.inf
        """When to call `next_hello`."""
        self._elsewhere = False
        """Told to look in another place, from which no answer came yet."""
        self.rekeying = False
        """New keys are wanted although those in use work."""

    def set_peers(self, peers: set[Hashable], connected: bool) -> None:
        """Look there at once, even if somebody is heard from another place."""
        self.peers = peers
        self.hello = None
        self.due = 0.0
        self._began = math.inf
        self._elsewhere = connected

    def counts(self, address: Hashable) -> bool:
        """Whether a message from there tells that the service is found."""
        return not self._elsewhere or address in self.peers

    def found(self, now: float, epoch: int) -> None:
        """The service is heard; ``epoch`` is the one in use, so that the next HELLO proposes another."""
        self.hello = None
        self.rekeying = False
        self._elsewhere = False
        self._began = math.inf
        self._proposal = epoch
        self.due = now + self._config.probe_after if self.peers else math.inf

    def rekey(self, now: float) -> None:
        """Ask for new keys, until there are some."""
        if not self.rekeying:
            self.rekeying = True
            self.hello = None
            self.due = now

    def pause(self, until: float) -> None:
        """Ask again, anew, at that time."""
        self.hello = None
        self.due = until

    def refused(self, now: float) -> None:
        """The service has other topics: ask again, rarely."""
        self.pause(now + self._config.hello_retry_max)

    def next_hello(self, held: Ciphers | None, last_heard: float, now: float) -> Hello | None:
        """What to send now.

        Args:
            held: Keys in use, if any.
            last_heard: When the service was heard.
            now: Time.

        Returns:
            None if the service was heard lately.
        """
        config = self._config
        idle = self.hello is None and not self._elsewhere and not self.rekeying
        if held is not None and idle and last_heard + config.probe_after > now:
            self.due = last_heard + config.probe_after
            return None
        if self.hello is None or self.hello.made_at + HELLO_LIFE < now:
            self._proposal = (self._proposal + 1) % 256
            name = NO_KEYS if held is None or self.rekeying else held.resume
            self.hello = Hello(
                self._session_id, self._key, self._topics, self._proposal, name, self._life, self._entropy, now
            )
        self.hello.sent += 1
        if held is None or self.rekeying:
            self._began = min(self._began, now)
            wait = max(config.hello_retry, HELLO_SHARE * (now - self._began))
            self.due = now + min(wait, config.hello_retry_max)
        else:
            self.due = now + patience(config, now - last_heard)
        return self.hello
