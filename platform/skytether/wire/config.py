"""Settings of one end of a session. The defaults suit a robot on a mobile network and a service in a data centre."""

from __future__ import annotations

import math
from dataclasses import dataclass

MIN_MTU = 512
"""Smaller than any path in use; bounds the number of shards that a message may claim to have."""
MAX_MTU = 65_507
"""Largest UDP payload over IPv4."""
MAX_COPIES = 100
MAX_REKEY_BYTES = 2**36
"""64 GiB are 2**32 blocks of AES under one key: they can be told from random ones with a chance of 2**-65 (of n blocks
n**2 / 2**129). No packet has less than 60 bytes, so they are fewer than 2**31, and numbers of 32 bits do not repeat."""
_POSITIVE = (
    "rate_bps", "keepalive", "report_interval", "probe_after", "probe_interval", "silence", "hello_retry",
    "hello_retry_max", "rekey_after",
)  # fmt: skip
_NOT_NEGATIVE = "max_parity", "copy_spacing", "old_keys", "path_stable", "path_overlap"


@dataclass(frozen=True, slots=True)
class Config:
    """Sizes in bytes, times in seconds. Both ends may differ: nothing here has to match the peer's."""

    mtu: int = 1200
    """Largest UDP payload sent until probes show what passes a path. 1,200 passes nearly every path in use (QUIC relies
    on it too), and IP never fragments: where it does not pass, a probe finds out (`mtu`)."""
    max_mtu: int = 1400
    """Largest UDP payload that is tried; not above ``mtu``: none larger."""
    rate_bps: float = 100e6
    """Most that a path is used with, bits per second of UDP payload; less where delays show a queue (rule 6)."""
    burst: int = 19_200
    """Most that one call of ``transmit`` returns: 16 packets. A higher priority waits for no more than this."""
    max_message: int = 16 * 2**20
    """Largest payload published or accepted."""
    reassembly_limit: int = 32 * 2**20
    """Most memory for messages that arrived in part; must hold one of the largest."""
    queue_limit: int = 64 * 2**20
    """Most memory for messages that wait to be sent; the lowest priorities give way first."""
    keepalive: float = 0.1
    """Time between pings: keeps NAT bindings open, measures round trip and clock offset, tells what arrives."""
    report_interval: float = 0.5
    """Time between reports of counters to the peer."""
    probe_after: float = 0.15
    """The robot's end asks whether the service still knows the session after this much silence. One lost ping is
    enough for that, and costs one packet; a restarted service is found within one more ``probe_interval``."""
    probe_interval: float = 0.1
    """Time between attempts to reach a silent peer at first; 2 % of the silence later, at most ``hello_retry_max``."""
    path_stable: float = 2.0
    """A cheaper or better path is switched to once it has been so for this long."""
    path_overlap: float = 0.3
    """Time for which traffic goes over both paths when it is switched from one to the other."""
    silence: float = 1.0
    """A peer not heard for this long is reported as disconnected; its keys stay valid."""
    hello_retry: float = 0.05
    """Time between handshakes at first; 5 % of that since the first one later, at most ``hello_retry_max``."""
    hello_retry_max: float = 1.0
    old_keys: float = 2.0
    """How long the keys before a new handshake still open packets that were on their way, after the last of them."""
    rekey_after: float = 3600.0
    """The robot's end makes new keys after this time: who gets hold of some reads an hour, and an id lasts as long."""
    rekey_bytes: int = MAX_REKEY_BYTES
    """The same after so many bytes in either direction."""
    assumed_loss: float = 0.05
    """Share of packets taken to be lost on a path before anything is known of it (rule 5)."""
    max_copies: int = 12
    """Most packets that carry the same one-shard message."""
    max_parity: float = 1.0
    """Most parity shards per data shard; messages of few shards may have ``max_copies - 1`` in any case."""
    copy_spacing: float = 0.002
    """Least time between copies of a one-shard message; more where losses come in bursts."""

    def __post_init__(self) -> None:
        """Refuse what cannot work.

        Raises:
            ValueError: The text names the setting and its range.
        """
        if not MIN_MTU <= self.mtu <= MAX_MTU:
            raise ValueError(f"mtu must be {MIN_MTU} to {MAX_MTU} bytes, not {self.mtu}")
        if not MIN_MTU <= self.max_mtu <= MAX_MTU:
            raise ValueError(f"max_mtu must be {MIN_MTU} to {MAX_MTU} bytes, not {self.max_mtu}")
        largest = max(self.mtu, self.max_mtu)
        if not largest <= self.burst < math.inf:
            raise ValueError(f"burst must be at least mtu and max_mtu ({largest} bytes), not {self.burst}")
        if not 0 < self.max_message <= 2**30:
            raise ValueError(f"max_message must be 1 to {2**30} bytes, not {self.max_message}")
        if not self.max_message <= self.queue_limit < math.inf:
            raise ValueError(f"queue_limit must be at least max_message ({self.max_message} bytes)")
        needed = self.max_message * 3 // 2 + 4096  # with the book-keeping of its shards, however small they are
        if not needed <= self.reassembly_limit < math.inf:
            raise ValueError(f"reassembly_limit must be at least 1.5 times max_message plus 4 KiB ({needed} bytes)")
        for name in _POSITIVE:
            if not 0 < getattr(self, name) < math.inf:
                raise ValueError(f"{name} must be above 0 and finite, not {getattr(self, name)}")
        for name in _NOT_NEGATIVE:
            if not 0 <= getattr(self, name) < math.inf:
                raise ValueError(f"{name} must be 0 or more and finite, not {getattr(self, name)}")
        if not 0 < self.rekey_bytes <= MAX_REKEY_BYTES:
            raise ValueError(f"rekey_bytes must be 1 to {MAX_REKEY_BYTES}, not {self.rekey_bytes}")
        if not 0 <= self.assumed_loss < 0.9:
            raise ValueError(f"assumed_loss must be 0 to below 0.9, not {self.assumed_loss}")
        if not 1 <= self.max_copies <= MAX_COPIES:
            raise ValueError(f"max_copies must be 1 to {MAX_COPIES}, not {self.max_copies}")
