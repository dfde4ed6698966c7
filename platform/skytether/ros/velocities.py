"""Velocities that came late: worse than none, for whoever has them drives on."""

from __future__ import annotations

from skytether.messages import Twist, TwistStamped
from skytether.wire.events import MessageReceived
from skytether.wire.topic import Topic

VELOCITIES = frozenset({Twist.TYPE, TwistStamped.TYPE})


def too_late(row: Topic, message: MessageReceived) -> str:
    """Why what came from the peer is not to be published, in a sentence; empty if it is.

    This process may have stood still, or the network held it back, and nobody may say anything after it.
    """
    age = message.received_at - message.sent_at
    if row.type not in VELOCITIES or not age - message.sent_at_error > row.lifespan:
        return ""
    return (
        f"{row.name}: velocities that come more than {row.lifespan:g} s after they were sent (lifespan_ms) are not "
        "published: the network, or one of the two ends, held them back"
    )
