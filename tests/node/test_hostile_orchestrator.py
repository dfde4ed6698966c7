"""Whoever has taken an orchestrator over, and has its keys, takes no node's memory, files or identity."""

from __future__ import annotations

import asyncio
import base64
import contextlib
import resource
import socket
import ssl
import threading
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import Any

import pytest
from cryptography import x509
from cryptography.hazmat.primitives import hashes
from cryptography.hazmat.primitives.asymmetric import ec
from cryptography.hazmat.primitives.serialization import load_pem_private_key
from cryptography.x509.oid import ExtendedKeyUsageOID, NameOID
from node_scene import first_line, program, until

from skytether.api.node import Issued, Link, Linked, Renew, line_of, read_request
from skytether.node import calls, run
from skytether.node.store import NodeConfig, NodeError, NodeStore, new_key, request_for
from skytether.orchestrator.nodes.authority import KEY, Authority, pem_of

Answers = Callable[[ssl.SSLSocket], object]
_ROOM = 1 << 14
"""Bytes that a kernel keeps of what nobody takes: few, so that it is seen soon."""


@dataclass
class Hostile:
    """Answers in an orchestrator's place, with its keys."""

    authority: Authority
    store: NodeStore
    url: str
    answers: dict[type, Answers] = field(default_factory=dict)
    """By what was asked."""

    def issue(self, key: Any, authority: Authority | None = None) -> str:
        return pem_of((authority or self.authority).sign(request_for(key), "edge", 30))

    def linked(self, **changes: Any) -> bytes:
        now = time.time()
        return line_of(Linked(**{"time": now, "begins": now, "ends": now + 1e6, **changes}))

    def stay(self, link: ssl.SSLSocket, **changes: Any) -> None:
        """Be linked until the node ends."""
        link.sendall(self.linked(**changes))
        while link.recv(1 << 16):
            pass


@pytest.fixture
def hostile(tmp_path: Path) -> Iterator[Hostile]:
    (tmp_path / "keys").mkdir()
    authority = Authority(tmp_path / "keys", time.time)
    context = authority.server_context()
    with socket.socket() as listener:
        for option in (socket.SO_RCVBUF, socket.SO_SNDBUF):
            listener.setsockopt(socket.SOL_SOCKET, option, _ROOM)
        listener.bind(("127.0.0.1", 0))
        listener.listen()
        url = f"https://127.0.0.1:{listener.getsockname()[1]}"
        made = Hostile(authority, NodeStore(tmp_path / "node"), url)

        def serve(taken: socket.socket) -> None:
            with contextlib.suppress(OSError), taken, context.wrap_socket(taken, server_side=True) as link:
                asked = type(read_request(first_line(link)))
                made.answers.get(asked, lambda _: None)(link)

        def listen() -> None:
            with contextlib.suppress(OSError):
                while True:
                    threading.Thread(target=serve, args=(listener.accept()[0],), daemon=True).start()

        threading.Thread(target=listen, daemon=True).start()
        key = new_key()
        config = NodeConfig(name="edge", urls=(url,), engine=str(tmp_path / "engine.sock"), address="127.0.0.1")
        made.store.join(config, authority.pem, key, made.issue(key))
        yield made
        listener.shutdown(socket.SHUT_RDWR)


def test_who_asks_all_the_time_and_takes_no_answer_is_not_heard_on(hostile: Hostile) -> None:
    """Else the answers would wait in the node's memory, of which a machine at the edge has little."""
    waits, over = threading.Event(), threading.Event()

    def ask(link: ssl.SSLSocket) -> None:
        link.sendall(hostile.linked())
        link.settimeout(2)
        try:
            for _ in range(4000):
                link.sendall(b'{"ping": 123456789012345678}\n' * 100)
        except TimeoutError:
            waits.set()
        over.set()

    hostile.answers[Link] = ask
    with program(hostile.store):
        assert over.wait(60)
    assert waits.is_set()


def test_of_addresses_that_an_orchestrator_tells_few_are_kept_and_no_odd_one(
    hostile: Hostile, caplog: pytest.LogCaptureFixture
) -> None:
    odd = ("https://a\nfalse line", "ftp://a", "https://a:99999", "https://\x1b[31m", "https://" + "a" * 300)
    many = (*odd, *(f"https://127.0.0.1:{port}" for port in range(1, 1000)))
    told = threading.Event()

    def tell(link: ssl.SSLSocket) -> None:
        link.sendall(hostile.linked(urls=many))
        told.wait(30)

    hostile.answers[Link] = tell
    with program(hostile.store) as linked:
        until(lambda: linked)
        kept = until(lambda: len(urls := hostile.store.config().urls) > 1 and urls)
        told.set()
    assert len(kept) == 16
    assert not set(kept) & set(odd)
    assert not any("\n" in line or "\x1b" in line for line in caplog.messages)


def test_an_orchestrator_that_is_new_takes_the_place_of_one_that_is_not_told_of_any_more(hostile: Hostile) -> None:
    """One that was taken over filled all places with what is nowhere, for good."""
    made_up = [f"https://127.0.0.1:{port}" for port in range(1, 20)]
    told, over = [(hostile.url, *made_up), (hostile.url, "https://127.0.0.1:5000")], threading.Event()

    def tell(link: ssl.SSLSocket) -> None:
        if told:
            link.sendall(hostile.linked(urls=told.pop(0)))
        over.wait(0.5 if told else 30)

    hostile.answers[Link] = tell
    with program(hostile.store):
        until(lambda: "https://127.0.0.1:5000" in hostile.store.config().urls)
        over.set()
    kept = hostile.store.config().urls
    assert kept[0] == hostile.url
    assert len(kept) == 16


def odd_certificate(keys: Path, key: ec.EllipticCurvePrivateKey, odd: str) -> str:
    """What whoever has the authority's key can sign, and no program can use."""
    authority, signer = Authority(keys, time.time), load_pem_private_key((keys / KEY).read_bytes(), None)
    assert isinstance(signer, ec.EllipticCurvePrivateKey)
    names = {"of another name": ["other"], "of two names": ["edge", "edge"]}.get(odd, ["edge"])
    purpose = ExtendedKeyUsageOID.SERVER_AUTH if odd == "for servers" else ExtendedKeyUsageOID.CLIENT_AUTH
    ends = datetime.now(UTC) + timedelta(days=-10 if odd == "over long ago" else 30)
    builder = (
        x509.CertificateBuilder(public_key=key.public_key(), serial_number=x509.random_serial_number())
        .issuer_name(authority.certificate.subject)
        .subject_name(x509.Name([x509.NameAttribute(NameOID.COMMON_NAME, name) for name in names]))
        .add_extension(x509.ExtendedKeyUsage([purpose]), critical=True)
        .not_valid_before(ends - timedelta(days=30))
        .not_valid_after(ends)
    )
    if odd == "with what nobody knows":
        unknown = x509.UnrecognizedExtension(x509.ObjectIdentifier("1.3.6.1.4.1.99999.1"), b"\5\0")
        builder = builder.add_extension(unknown, critical=True)
    made = builder.sign(signer, hashes.SHA3_256() if odd == "signed oddly" else hashes.SHA256())
    if odd != "of no version":
        return pem_of(made)
    tbs = made.tbs_certificate_bytes.replace(b"\xa0\3\2\1\2", b"\xa0\3\2\1\x22", 1)
    signed = b"\0" + signer.sign(tbs, ec.ECDSA(hashes.SHA256()))
    kind = bytes.fromhex("300a06082a8648ce3d040302")  # ecdsa-with-SHA256
    inner = tbs + kind + bytes([3, len(signed)]) + signed
    whole = b"\x30\x82" + len(inner).to_bytes(2, "big") + inner
    return f"-----BEGIN CERTIFICATE-----\n{base64.encodebytes(whole).decode()}-----END CERTIFICATE-----\n"


@pytest.mark.parametrize(
    ("odd", "why"),
    [
        ("nothing", "Unable to load PEM"),
        ("garbage", "error parsing asn1"),
        ("of another key", "it is for another key"),
        ("by another authority", "InvalidSignature"),
        ("signed oddly", "[SSL"),
        ("for servers", "unsuitable certificate purpose"),
        ("of no version", "is not a valid X509 version"),
        ("of another name", "it is for another name"),
        ("of two names", "it is for another name"),
        ("over long ago", "it is over already"),
        ("with what nobody knows", "unhandled critical extension"),
    ],
)
def test_what_is_no_certificate_of_the_node_takes_its_own_from_nobody(
    hostile: Hostile, odd: str, why: str, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    """It would be no site any more, also where the orchestrator is the operator's again."""
    (tmp_path / "false").mkdir()
    false = Authority(tmp_path / "false", time.time)
    key, before = new_key(), hostile.store.identity.read_bytes()
    given = {
        "nothing": " ",
        "garbage": "-----BEGIN CERTIFICATE-----\nAAAA\n-----END CERTIFICATE-----\n",
        "of another key": hostile.issue(new_key()),
        "by another authority": hostile.issue(key, false),
    }.get(odd) or odd_certificate(tmp_path / "keys", key, odd)
    with pytest.raises(NodeError, match="is not kept") as refused:
        hostile.store.renew(key, given)
    assert why in str(refused.value)
    hostile.answers[Renew] = lambda link: link.sendall(line_of(Issued(name="edge", certificate=given)))
    hostile.answers[Link] = lambda link: hostile.stay(link, time=time.time() + 1e8)
    with program(hostile.store):
        until(lambda: any("is not kept" in line for line in caplog.messages))
    assert hostile.store.identity.read_bytes() == before
    run.NodeProgram(hostile.store)  # which it could not be any more
    hostile.store.renew(key, hostile.issue(key))
    assert hostile.store.identity.read_bytes() != before


def test_what_nobody_expects_of_one_link_ends_no_other(hostile: Hostile, monkeypatch: pytest.MonkeyPatch) -> None:
    """By one answer of a replica that was taken over the node's program ended, and again after each start."""
    links = iter(range(100))

    def read(*_: Any) -> Any:
        if next(links) == 0:
            raise ArithmeticError
        raise NodeError("no")

    monkeypatch.setattr(run, "read_answer", read)
    monkeypatch.setattr(run, "_AGAIN_MOST_S", 0.05)
    hostile.answers[Link] = lambda link: link.sendall(hostile.linked())
    with program(hostile.store):
        until(lambda: next(links) > 2)


@pytest.mark.parametrize("left", ["left", "left, and joined another"])
def test_who_has_left_is_linked_no_more_whatever_an_orchestrator_says(
    hostile: Hostile, left: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Also where no unit runs the node's program, and nobody ended that."""
    monkeypatch.setattr(run, "LOOK_S", 0.05)
    linked, ended = threading.Event(), threading.Event()

    def stay(link: ssl.SSLSocket) -> None:
        linked.set()
        hostile.stay(link)
        ended.set()

    hostile.answers[Link] = stay
    node = threading.Thread(target=lambda: asyncio.run(run.NodeProgram(hostile.store).run()), daemon=True)
    node.start()
    assert linked.wait(30)
    config = hostile.store.config()
    hostile.store.clear()
    if left != "left":
        (tmp_path / "other").mkdir()
        other, key = Authority(tmp_path / "other", time.time), new_key()
        hostile.store.join(config, other.pem, key, hostile.issue(key, other))
    assert ended.wait(30)
    node.join(30)
    assert not node.is_alive()


def test_an_answer_in_drops_takes_no_longer_than_another(hostile: Hostile, monkeypatch: pytest.MonkeyPatch) -> None:
    """A node renews with one orchestrator at a time: the others would wait until its certificate is over."""
    monkeypatch.setattr(calls, "ANSWER_S", 0.2)

    def drip(link: ssl.SSLSocket) -> None:
        for _ in range(400):
            link.sendall(b" ")
            time.sleep(0.05)

    hostile.answers[Renew] = drip
    trust = calls.trusting(hostile.store.authority(), hostile.store.identity)
    began = time.monotonic()
    with pytest.raises(calls.UnreachableError):
        calls.call(hostile.url, trust, Renew(request=request_for(new_key())), Issued)
    assert time.monotonic() - began < 10


def test_a_node_has_as_many_files_as_its_ways_take(hostile: Hostile) -> None:
    """The thousand that most programs begin with are used up by one orchestrator's ways, and no other is linked."""
    hostile.answers[Link] = hostile.stay
    soft, hard = resource.getrlimit(resource.RLIMIT_NOFILE)
    resource.setrlimit(resource.RLIMIT_NOFILE, (min(1024, hard), hard))
    try:
        with program(hostile.store) as linked:
            until(lambda: linked)
            assert resource.getrlimit(resource.RLIMIT_NOFILE)[0] >= min(hard, 65_536)
    finally:
        resource.setrlimit(resource.RLIMIT_NOFILE, (soft, hard))
