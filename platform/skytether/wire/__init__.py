"""The bridge protocol, sans-IO: bytes and time stamps in; bytes, events and the next timer out.

Nothing here opens a socket, reads a clock, starts a thread or draws a random number; `skytether.bridge` does.
`Session` is one end of one session; beside it is what its users see: settings, topics, events, statistics. Its parts
are in rooms, each usable and tested alone. Imports go down only (contract "Rooms of the wire protocol")::

    session                       puts the parts together
    receive                       packets -> messages
    connect                       handshakes, several paths
    send                          messages -> packets
    path | state                  one path | epoch, counters, reliable topics
    reliable                      selective repeat
    fec                           shards and parity
    codec                         bytes, keys
    measure                       clocks, counters
    events | config | stats | topic
"""

from .codec.packet import peek_id
from .config import Config
from .events import Connected, Disconnected, Event, MessageReceived, PathSwitched, PeerMoved, Refused
from .path.path import Transmit
from .session import Session
from .stats import PathStats, SessionStats, TopicStats
from .topic import Direction, PathUse, Role, Topic

__all__ = [
    "Config",
    "Connected",
    "Direction",
    "Disconnected",
    "Event",
    "MessageReceived",
    "PathStats",
    "PathSwitched",
    "PathUse",
    "PeerMoved",
    "Refused",
    "Role",
    "Session",
    "SessionStats",
    "Topic",
    "TopicStats",
    "Transmit",
    "peek_id",
]
