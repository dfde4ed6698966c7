"""What a pair of sessions over a link model has told and sent."""

from skytether.wire import Role
from skytether.wire.codec import packet


def events(link, role, kind):
    """Of one end, those of a kind, each with its time [s]."""
    return [(t, e) for t, e in link.events[role] if isinstance(e, kind)]


def rejected(link, role):
    """Packets that one end threw away, by reason."""
    return link.sessions[role].stats(link.time_of(role)).rejected


def hellos(link):
    """Questions of handshakes; of a link that records what is sent."""
    return [p for _, p in link.sent[Role.ROBOT] if p[0] == packet.HELLO]


def welcomes(link):
    """Answers to handshakes; of a link that records what is sent."""
    return [p for _, p in link.sent[Role.SERVICE] if p[0] == packet.WELCOME]
