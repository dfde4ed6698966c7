"""Quality of service: that of ROS 2 from a row of the bridge's table and back, and its forms in liveliness tokens."""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import dataclass

from skytether.wire.topic import Topic

DEFAULT_DEPTH = 42
"""What ``rmw_zenoh_cpp`` takes for granted, and leaves out of its tokens."""
MAX_DEPTH = 10_000
"""Of a topic of the bridge."""


@dataclass(frozen=True, slots=True)
class Qos:
    """What ROS 2 knows of an endpoint that matters here.

    Attributes:
        reliable: Else best effort.
        transient_local: A newcomer gets the newest ``depth`` messages; else volatile.
        depth: Messages kept; of a history that keeps all, as many as a topic of the bridge may. 0: nobody told.
        deadline_s: At most so long between two messages; None: nobody asks for that.
        manual: Liveliness is told by hand, topic by topic.
        lease_s: At most so long between two signs of life; None: nobody asks for that.
    """

    reliable: bool = True
    transient_local: bool = False
    depth: int = DEFAULT_DEPTH
    deadline_s: float | None = None
    manual: bool = False
    lease_s: float | None = None


_ACTION_STATUS = "/_action/status"
SERVICE = Qos(depth=10)
"""ROS 2's profile for services."""


def qos_of(row: Topic, *, publishes: bool) -> Qos:
    """What we are on the graph for a row of the bridge's table.

    In ROS 2 an endpoint that offers more matches one that asks for less. So we always publish reliably (either kind of
    subscription matches) and subscribe reliably only where the row is reliable (a best-effort subscription matches
    either kind of publisher). A latched row is transient local with a depth of 1: the bridge keeps its newest message;
    so is the status of an action where we publish it, for clients of actions ask for that (rcl_action).
    """
    if row.latched or (publishes and row.name.endswith(_ACTION_STATUS)):
        return Qos(reliable=True, transient_local=True, depth=1)
    return Qos(reliable=publishes or row.reliable, depth=row.depth)


# --- DDS: what is offered must be at least what is asked for, or nothing is delivered -------------------------------

MIN_FOLLOWED, MAX_FOLLOWED = 10, 1000
"""Messages that a subscription keeps, whatever is offered; most kinds of DDS do not tell a publisher's depth."""


def follow(row: Qos, offers: Collection[Qos], *, kept_too: bool = True) -> Qos:
    """What to ask for where publishers offer these: all that each of them offers, so that each is heard.

    Args:
        row: What the bridge's table asks for; of it the depth counts.
        offers: Of the publishers there are, one at least.
        kept_too: Take also what they keep for newcomers; else only if the table asks for it.
    """
    depth = max(row.depth, sum(offer.depth or MIN_FOLLOWED for offer in offers))
    return Qos(
        reliable=all(offer.reliable for offer in offers),
        transient_local=all(offer.transient_local for offer in offers) and (kept_too or row.transient_local),
        depth=min(max(depth, MIN_FOLLOWED), MAX_FOLLOWED),
    )


def clash(offered: Qos, asked: Qos) -> str:
    """Why a subscription that asks for the one is not served by a publisher that offers the other; empty if it is."""
    found = []
    if asked.reliable and not offered.reliable:
        found.append(("reliable", "best effort"))
    if asked.transient_local and not offered.transient_local:
        found.append(("transient local", "volatile"))
    for what, want, have in (
        ("deadline", asked.deadline_s, offered.deadline_s),
        ("lease of liveliness", asked.lease_s, offered.lease_s),
    ):
        if want is not None and (have is None or have > want):
            found.append((f"a {what} of {want:g} s", "none" if have is None else f"{have:g} s"))
    if asked.manual and not offered.manual:
        found.append(("liveliness by hand", "automatic liveliness"))
    return ", ".join(f"{want} is asked for, {have} is offered" for want, have in found)


def describe(qos: Qos) -> str:
    """In words, as ROS 2's own tools say it."""
    reliability = "reliable" if qos.reliable else "best effort"
    return f"{reliability}, transient local" if qos.transient_local else reliability


def history_missed(offers: Collection[Qos]) -> bool:
    """Whether a newcomer misses what some of these publishers keep for it, because others of them keep nothing."""
    return len({offer.transient_local for offer in offers}) > 1


# --- rmw_zenoh: rmw_zenoh_cpp/src/detail/liveliness_utils.cpp, qos_to_keyexpr and keyexpr_to_qos ----------------------
# <reliability>:<durability>:<history>,<depth>:<deadline>:<lifespan>:<liveliness>, numbers of rmw/types.h; a default
# (reliable, volatile, keep last, 42, no deadline, no lifespan, automatic liveliness) is left out.


def push_rmw(qos: Qos) -> str:
    """Quality of service in a token of ``rmw_zenoh``."""
    reliability = "" if qos.reliable else "2"
    durability = "1" if qos.transient_local else ""
    depth = "" if qos.depth == DEFAULT_DEPTH else str(qos.depth)
    return f"{reliability}:{durability}:,{depth}:,:,:,,"


def pull_rmw(text: str) -> Qos | None:
    """Inverse of `push_rmw`; None for what is no quality of service."""
    parts = text.split(":")
    history, comma, depth = parts[2].partition(",") if len(parts) >= 6 else ("", "", "")
    if not comma or not _numbers(parts[0], parts[1], history, depth):
        return None
    kept = MAX_DEPTH if history == "2" else int(depth or DEFAULT_DEPTH)
    return Qos(reliable=parts[0] != "2", transient_local=parts[1] == "1", depth=kept)


# --- zenoh-plugin-ros2dds: src/liveliness_mgt.rs, qos_to_key_expr and key_expr_to_qos ---------------------------------
# <K if keyed>:<reliability>:<durability>:<history>,<depth>[:<user data>], numbers of DDS; what is not set is empty. The
# user data of a ROS 2 endpoint holds "typehash=RIHS01_...;".


def push_dds(qos: Qos, type_hash: str) -> str:
    """Quality of service in a token of ``zenoh-bridge-ros2dds``, with the type's hash if it is known."""
    text = f":{int(qos.reliable)}:{int(qos.transient_local)}:0,{qos.depth}"
    return f"{text}:typehash={type_hash};" if type_hash else text


def pull_dds(text: str) -> tuple[Qos, str] | None:
    """Inverse of `push_dds`; None for what is no quality of service."""
    parts = text.split(":", 4)
    history, _, depth = parts[3].partition(",") if len(parts) > 3 else ("", "", "")
    if len(parts) < 4 or not _numbers(parts[1], parts[2], history, depth):
        return None
    kept = MAX_DEPTH if history == "1" else int(depth or 1)
    data = parts[4] if len(parts) > 4 else ""
    hashes = [item.strip().removeprefix("typehash=") for item in data.split(";") if "typehash=" in item]
    # An absent reliability is DDS's default of readers, best effort; ROS 2 sets it always.
    return Qos(parts[1] == "1", parts[2] == "1", kept), hashes[0] if hashes else ""


def _numbers(*texts: str) -> bool:
    return all(not t or (t.isascii() and t.isdigit() and len(t) < 10) for t in texts)
