"""The bridge protocol, sans-IO: bytes and time stamps in; bytes, events and the next timer out.

Nothing here opens a socket, reads a clock, starts a thread or draws a random number; `skytether.bridge` does.
`Session` is one end of one session. The other files are its parts, each usable and tested alone.
"""

from .config import Config
from .events import Connected, Disconnected, Event, MessageReceived, PathSwitched, PeerMoved, Refused
from .packet import peek_id
from .path import Transmit
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
