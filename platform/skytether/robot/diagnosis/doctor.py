"""The usual failures, and what to do about each: judged here from what was seen. Pure; `examine` is what looks."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from datetime import UTC, datetime
from email.utils import parsedate_to_datetime
from itertools import pairwise
from typing import Literal

CLOCK_S = 2.0
"""Clocks that differ by less are well enough: the bridge finds the rest by itself."""
GOOD_DATAGRAM = 1200
"""Bytes of the bridge's datagrams where nothing says otherwise."""
LEAST_DATAGRAM = 512
"""Smallest that the bridge can do with."""
IP_UDP = 28
"""Bytes of the headers of IPv4 and UDP."""

EXTRAS: Mapping[str, tuple[str, ...]] = {
    "orchestrator": ("fastapi", "uvicorn", "sqlalchemy", "alembic", "jsonschema"),
    "docker": ("docker",),
    "postgres": ("psycopg",),
    "recorder": ("mcap",),
    "ros2": ("zenoh",),
    "lab": ("matplotlib",),
}
"""What each extra brings."""


@dataclass(frozen=True, slots=True)
class Finding:
    """One check.

    Attributes:
        check: What was looked at.
        state: ``ok``; ``trouble``: it will not work, or not well; ``skipped``: it could not be looked at.
        says: What was found.
        todo: What to do; empty unless there is trouble, or a reason to look at it in another way.
    """

    check: str
    state: Literal["ok", "trouble", "skipped"]
    says: str
    todo: str = ""

    def document(self) -> dict[str, str]:
        """For ``--json``."""
        return asdict(self)


def judge_certificate(url: str, error: str) -> Finding:
    """Why TLS did not come about; ``error`` is what the library said, empty if it did."""
    if not error:
        return Finding("certificate", "ok", "is trusted")
    text = error.lower()
    if "self-signed" in text or "self signed" in text or "unable to get local issuer" in text:
        says = "is by an authority that this machine does not know"
        todo = "give the authority's PEM file with --ca-file or SKYTETHER_CA_FILE, on robots with ca_file"
    elif "expired" in text or "not yet valid" in text:
        says = f"is not valid now ({'expired' if 'expired' in text else 'not yet valid'})"
        todo = "renew it at the orchestrator; if it is valid, this machine's clock is wrong"
    elif "mismatch" in text or "not valid for" in text or "match" in text:
        says = "is for another name"
        todo = f"use the name that it is for instead of {url}, or make one for that name"
    else:
        says, todo = f"is refused: {error}", "look at the orchestrator's tls.certificate and tls.key"
    return Finding("certificate", "trouble", says, todo)


def judge_clock(date: str | None, before: float, after: float) -> Finding:
    """This machine's clock beside the orchestrator's.

    Args:
        date: The ``Date`` header of an answer: whole seconds.
        before: This machine's Unix time when the request was sent [s].
        after: And when the answer was there [s].
    """
    try:
        told = parsedate_to_datetime(date or "")
    except ValueError:
        return Finding("clock", "skipped", "the orchestrator's answer holds no date")
    theirs = (told if told.tzinfo else told.replace(tzinfo=UTC)).timestamp()
    # The header's second may have just begun or be nearly over, and it was written at some time of the round trip.
    least, most = before - theirs - 1, after - theirs
    if least <= CLOCK_S and most >= -CLOCK_S:
        return Finding("clock", "ok", "agrees with the orchestrator's")
    ahead = least if least > 0 else most
    way = "ahead of" if ahead > 0 else "behind"
    here = datetime.fromtimestamp(after, UTC).isoformat(timespec="seconds")
    return Finding(
        "clock",
        "trouble",
        f"is {abs(ahead):.0f} s {way} the orchestrator's ({here} here)",
        "set both by NTP: timedatectl set-ntp true; certificates, tokens and logs need the right time",
    )


def judge_udp(where: str, asked: int, answered: int) -> Finding:
    """Whether UDP gets through."""
    if answered == 0:
        return Finding(
            "udp",
            "trouble",
            f"nothing comes back from UDP {where} ({asked} asked)",
            "let UDP out to the sites (firewall here, at the router, at the site), or run `skytether echo` there if "
            "none runs; where UDP is forbidden, a `skytether relay` on a port that is not",
        )
    if answered < asked / 2:
        return Finding(
            "udp",
            "trouble",
            f"UDP {where}: {asked - answered} of {asked} are lost",
            "use a better network: the bridge bears a third of losses, not more than half",
        )
    return Finding("udp", "ok", f"UDP {where}: {answered} of {asked} came back")


def judge_mtu(largest: int | None) -> Finding:
    """What size of datagrams gets through, in bytes of UDP payload; None: not even the smallest."""
    if largest is None:
        return Finding("mtu", "skipped", "no datagram came back")
    says = f"datagrams of {largest} bytes get through (an MTU of {largest + IP_UDP} or more)"
    if largest >= GOOD_DATAGRAM:
        return Finding("mtu", "ok", says)
    works = "the bridge uses smaller ones, at a cost" if largest >= LEAST_DATAGRAM else "too small for the bridge"
    return Finding(
        "mtu",
        "trouble",
        f"{says}; larger ones vanish: {works}",
        f"raise the MTU of the VPN, tunnel or radio on the way to {GOOD_DATAGRAM + IP_UDP} or more",
    )


def judge_nat(seen: Sequence[tuple[str, int]]) -> Finding:
    """How this machine was seen, by one socket's questions in order."""
    if len(seen) < 2:
        return Finding("nat", "skipped", "too few datagrams came back")
    changes = sum(a != b for a, b in pairwise(seen))
    host, port = seen[-1]
    if changes == 0:
        return Finding("nat", "ok", f"is seen as {host}:{port} all the time")
    return Finding(
        "nat",
        "trouble",
        f"is seen as {len(set(seen))} addresses in turn, {changes} changes in {len(seen)} datagrams "
        f"(now {host}:{port})",
        "the bridge follows each change, at a round trip each: look for a router that rebinds, or for two uplinks that "
        "share packets; bind the robot to one of them (paths in robot.yaml)",
    )


def judge_extras(missing: Mapping[str, Sequence[str]], needed: Sequence[str]) -> Finding:
    """Which extras are not installed, and which of them are needed.

    Args:
        missing: Modules that cannot be found, by extra.
        needed: Extras that the configuration needs.
    """
    lacking = [extra for extra in needed if missing.get(extra)]
    if lacking:
        modules = ", ".join(module for extra in lacking for module in missing[extra])
        return Finding(
            "extras", "trouble", f"not installed: {modules}", f"pip install 'skytether[{','.join(lacking)}]'"
        )
    absent = ", ".join(extra for extra in missing if missing[extra])
    rest = f"; not installed, not needed: {absent}" if absent else ""
    return Finding("extras", "ok", f"what is needed is there{rest}")
