"""Whoever has the network, a token that was used, or another node's machine, tries what he can."""

from __future__ import annotations

import contextlib
import json
import os
import socket
import ssl
import threading
import time
from pathlib import Path
from typing import Any

import psutil
import pytest
from cryptography import x509
from cryptography.hazmat.primitives import hashes, serialization
from cryptography.hazmat.primitives.asymmetric import ec, rsa
from cryptography.hazmat.primitives.serialization import Encoding
from node_scene import NodeScene, connection, context_of, first_line, linked_by, until

from skytether.api.node import (
    ALPN,
    SERVER_NAME,
    Hello,
    Invited,
    Issued,
    Join,
    Leave,
    Link,
    Linked,
    Look,
    Machine,
    Refused,
    Renew,
    Said,
    Standing,
    Stands,
    Way,
    Welcome,
    line_of,
    read_request,
)
from skytether.node import calls, join
from skytether.node.calls import RefusedError, first_call, trusting
from skytether.node.machine import machine_id
from skytether.node.store import NodeError, new_key, request_for
from skytether.orchestrator.http import node_listener as door
from skytether.orchestrator.nodes import ways
from skytether.orchestrator.nodes.authority import Authority


def unknown_authority(folder: Path) -> ssl.SSLContext:
    """With a certificate for 'edge' by an authority of the attacker's own."""
    folder.mkdir()
    own = Authority(folder, time.time)
    key = new_key()
    certificate = own.sign(request_for(key), "edge", 30)
    (folder / "identity.pem").write_bytes(
        key.private_bytes(serialization.Encoding.PEM, serialization.PrivateFormat.PKCS8, serialization.NoEncryption())
        + certificate.public_bytes(serialization.Encoding.PEM)
    )
    context = ssl.SSLContext(ssl.PROTOCOL_TLS_CLIENT)
    context.check_hostname, context.verify_mode = False, ssl.CERT_NONE
    context.set_alpn_protocols([ALPN])
    context.load_cert_chain(folder / "identity.pem")
    return context


# In between


def test_whoever_answers_in_the_orchestrators_place_gets_no_token(nodes: NodeScene, tmp_path: Path) -> None:
    """By the network's addresses he is the orchestrator; by the token's fingerprint he is not."""
    nodes.engine()
    token = nodes.invite()
    (tmp_path / "false").mkdir()
    false = Authority(tmp_path / "false", time.time)
    nodes.core.authority, real = false, nodes.core.authority
    nodes.shut()
    nodes.open()
    with pytest.raises(NodeError, match="is not the orchestrator that made this token: its key is another one"):
        join.join(nodes.options(token))
    nodes.core.authority = real
    nodes.shut()
    nodes.open()
    assert join.join(nodes.options(token)).name == "edge"  # it was told to nobody


def test_an_authority_that_is_passed_on_by_who_has_not_its_key_is_of_no_use(nodes: NodeScene, tmp_path: Path) -> None:
    """He repeats what the real one says of itself, which is no secret, over a connection with a key of his own."""
    nodes.engine()
    token = nodes.invite()
    (tmp_path / "false").mkdir()
    false = Authority(tmp_path / "false", time.time)
    false.pem, real = nodes.core.authority.pem, nodes.core.authority
    nodes.core.authority = false
    context = false.server_context
    false.server_context = lambda: _with_own_chain(context, false)  # type: ignore[method-assign]
    nodes.shut()
    nodes.open()
    with pytest.raises(NodeError, match="is not the orchestrator that this machine joined"):
        join.join(nodes.options(token))
    nodes.core.authority = real


def _with_own_chain(make: Any, authority: Authority) -> ssl.SSLContext:
    told, authority.pem = authority.pem, authority.certificate.public_bytes(Encoding.PEM).decode()
    try:
        made: ssl.SSLContext = make()
    finally:
        authority.pem = told
    return made


def test_a_nodes_certificate_makes_nobody_an_orchestrator(nodes: NodeScene, tmp_path: Path) -> None:
    """Whoever has a node's key, and the network, is not taken for the orchestrator by other nodes."""
    nodes.join()
    store = nodes.store()
    server = ssl.SSLContext(ssl.PROTOCOL_TLS_SERVER)
    server.load_cert_chain(store.identity)
    server.set_alpn_protocols([ALPN])
    with socket.create_server(("127.0.0.1", 0)) as listener:
        url = f"https://127.0.0.1:{listener.getsockname()[1]}"

        def serve() -> None:
            taken, _ = listener.accept()
            with contextlib.suppress(OSError), taken, server.wrap_socket(taken, server_side=True) as link:
                link.recv(1000)

        thread = threading.Thread(target=serve)
        thread.start()
        with pytest.raises(NodeError, match="is not the orchestrator that this machine joined"):
            calls.call(url, context_of(store), Standing(), Stands)
        thread.join()


# Without a certificate


def test_without_a_certificate_of_ours_nothing_is_done(nodes: NodeScene, tmp_path: Path) -> None:
    nodes.join()
    store = nodes.store()
    nobody = trusting(store.authority())
    for request in (Renew(request=request_for(new_key())), Link(), Way(), Standing(), Leave(force=True)):
        with pytest.raises(RefusedError, match="takes the certificate of a node that joined"):
            calls.call(nodes.url, nobody, request, Stands)
    with connection(nodes, unknown_authority(tmp_path / "own")) as link:
        with contextlib.suppress(OSError):
            link.sendall(line_of(Standing()))
        assert first_line(link) == b""
    assert nodes.state() in ("ready", "unreachable")


def test_of_many_guesses_at_tokens_few_are_looked_at(nodes: NodeScene) -> None:
    pin = nodes.invite().partition(".")[2]
    trust = trusting(first_call(nodes.url, pin).authority)
    said = []
    for number in range(14):
        with pytest.raises(RefusedError) as error:
            calls.call(nodes.url, trust, Look(token=f"sky-{number:064x}.{pin}"), Invited)
        said.append(str(error.value))
    assert sum("is not known here" in text for text in said) <= 11
    assert said[-1].startswith("too many requests")


@pytest.mark.parametrize(
    "line",
    [
        b"",
        b"\n",
        b"GET / HTTP/1.1\r\n",
        b"{}\n",
        b'{"do": "join"}\n',
        b'{"do": "exec", "command": "sh"}\n',
        b"[" * 30_000 + b"\n",
        b"x" * 200_000,
        b'{"do": "look", "token": "' + b"a" * 60_000 + b'"}\n',
        bytes(range(256)) + b"\n",
    ],
    ids=["nothing", "empty", "http", "object", "part", "unknown", "deep", "endless", "long", "bytes"],
)
def test_what_is_no_request_is_refused_and_the_door_stays_open(nodes: NodeScene, line: bytes) -> None:
    pin = nodes.invite().partition(".")[2]
    trust = trusting(first_call(nodes.url, pin).authority)
    with connection(nodes, trust) as link, contextlib.suppress(OSError):
        link.sendall(line)
        link.settimeout(0.3)
        answer = link.recv(4096)
        assert not answer or Refused.model_validate_json(answer).error
    assert calls.call(nodes.url, trust, Hello(), Welcome).authority


def test_no_bytes_make_more_of_a_request_than_it_is() -> None:
    for line in (b"", b"{", b"[" * 100_000, b"\xff\xfe", b"null", b'{"do": 1}'):
        with pytest.raises(ValueError, match="no request"):
            read_request(line)


def test_connections_that_say_nothing_keep_no_node_out(nodes: NodeScene, monkeypatch: pytest.MonkeyPatch) -> None:
    """As many as may be, and twice that: the oldest of them give way."""
    nodes.join()
    with contextlib.ExitStack() as stack:
        for _ in range(2 * door.STRANGERS):
            stack.enter_context(socket.create_connection(("127.0.0.1", nodes.port), timeout=10))
        with nodes.running() as linked:
            until(lambda: linked and nodes.state() == "ready")


def test_who_is_slow_is_cut_off(nodes: NodeScene, monkeypatch: pytest.MonkeyPatch) -> None:
    nodes.join()
    monkeypatch.setattr(door, "ANSWER_S", 0.3)
    trust = context_of(nodes.store())
    with socket.create_connection(("127.0.0.1", nodes.port), timeout=10) as silent:
        assert silent.recv(10) == b""  # no handshake
    with connection(nodes, trust) as half:
        half.sendall(b'{"do": ')
        assert first_line(half) == b""  # no end of the line


# With another node's certificate


def test_a_node_has_ways_to_no_engine_but_its_own_and_only_when_it_is_asked(nodes: NodeScene) -> None:
    nodes.join("edge")
    nodes.join("other")
    sites = nodes.core.settings.state_dir / "sites"
    with nodes.running("edge") as linked:
        until(lambda: linked and (sites / "edge/engine.sock").exists())
        # The other one has no link, so it has no ways; and there is no field in which it could name another.
        with pytest.raises(RefusedError, match="while its link stands"):
            calls.call(nodes.url, context_of(nodes.store("other")), Way(), Stands)
        assert read_request(b'{"do": "way", "name": "edge"}') == Way()
        # Linked, it gets no way that it was not asked for.
        hostile = context_of(nodes.store("other"))
        with connection(nodes, hostile) as link, contextlib.ExitStack() as stack:
            secret, opened = linked_by(link), []
            link.sendall(line_of(Said(engine="")))
            for _ in range(ways.SPARE + 3):  # some may be wanted just now
                way = stack.enter_context(connection(nodes, hostile))
                way.sendall(line_of(Way(link=secret)))
                way.settimeout(0.05)
                opened.append(way)
            until(lambda: any(b"nobody asked for this way" in first_line(way) for way in opened))
        assert nodes.state("edge") == "ready"


@pytest.mark.slow
def test_a_thousand_connections_of_one_node_take_nothing_from_another(nodes: NodeScene) -> None:
    nodes.join("edge")
    nodes.join("other")
    hostile = context_of(nodes.store("other"))
    with contextlib.ExitStack() as stack, nodes.running("edge") as linked:
        until(lambda: linked and nodes.state("edge") == "ready")
        for number in range(1000):
            plain = stack.enter_context(socket.create_connection(("127.0.0.1", nodes.port), timeout=10))
            if number % 25 == 0:  # a handshake of each would take the test a while
                with contextlib.suppress(OSError):
                    link = stack.enter_context(hostile.wrap_socket(plain, server_hostname=SERVER_NAME))
                    link.sendall(line_of(Way() if number % 50 else Link(machine=Machine(id="x"))))
        assert nodes.state("edge") == "ready"
        engine = nodes.core.sites.get("edge").runtime.engine  # type: ignore[attr-defined]
        engine.drop()
        assert engine.api().info()["NCPU"] == 8
    assert len(linked) == 1


def test_a_node_that_links_again_and_again_is_told_to_wait(nodes: NodeScene) -> None:
    """With another address each time: its site would be opened anew with each."""
    nodes.join(advertise=None)
    trust, said = context_of(nodes.store()), []
    for number in range(5 * door.LINKS):  # more are let in as time goes by, and a slow machine takes its time
        with connection(nodes, trust) as link:
            link.sendall(line_of(Link(address=f"192.0.2.{number}")))
            said.append(first_line(link))
        if b"too many requests" in said[-1]:
            break
    assert b"too many requests" in said[-1]
    assert b"too many requests" not in said[0]
    assert len(said) >= door.LINKS  # the join took one
    address = nodes.operator.get_site("edge").options["advertise_host"]
    assert int(address.rpartition(".")[2]) < 10  # the first few


def test_a_copy_of_a_machine_does_not_take_its_place(nodes: NodeScene) -> None:
    """A disk that was cloned: the same key on another machine, while the first one is there."""
    nodes.join()
    trust = context_of(nodes.store())
    with nodes.running() as linked:
        until(lambda: linked and nodes.state() == "ready")
        with pytest.raises(RefusedError, match="another machine is linked as 'edge'"):
            calls.call(nodes.url, trust, Link(machine=Machine(id="another")), Linked)
        with pytest.raises(RefusedError, match="this machine, or one that says so, is linked as 'edge'"):
            calls.call(nodes.url, trust, Link(machine=Machine(id=machine_id())), Linked)
        assert nodes.state() == "ready"
    assert len(linked) == 1


def test_a_link_that_is_half_open_gives_way_to_the_machine_when_it_comes_back(
    nodes: NodeScene, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A router forgot it: the orchestrator has the old connection still, and nobody is at its other end."""
    nodes.join()
    with connection(nodes, context_of(nodes.store())) as silent:
        silent.sendall(line_of(Link(machine=Machine(id="before"))))
        Linked.model_validate_json(first_line(silent).splitlines()[0])
        with nodes.running() as linked:
            until(lambda: linked and nodes.state() == "ready")


def test_a_node_that_says_nothing_is_not_linked(nodes: NodeScene, monkeypatch: pytest.MonkeyPatch) -> None:
    nodes.join()
    monkeypatch.setattr(ways, "SILENT_S", 0.3)
    with connection(nodes, context_of(nodes.store())) as link:
        link.sendall(line_of(Link()) + line_of(Said(engine="")))
        until(lambda: "it said nothing for" in nodes.operator.get_site("edge").reason)


def test_a_node_that_opens_none_of_its_ways_keeps_nobody_waiting_for_long(
    nodes: NodeScene, monkeypatch: pytest.MonkeyPatch
) -> None:
    nodes.join()
    monkeypatch.setattr(ways, "ANSWER_S", 0.2)
    path = nodes.core.settings.state_dir / "sites/edge/engine.sock"
    with connection(nodes, context_of(nodes.store())) as link:
        link.sendall(line_of(Link()) + line_of(Said(engine="")))
        until(path.exists)
        began = time.monotonic()
        with socket.socket(socket.AF_UNIX) as asks:
            asks.settimeout(10)
            file = os.open(path.parent, os.O_PATH)
            try:
                asks.connect(f"/proc/self/fd/{file}/engine.sock")
            finally:
                os.close(file)
            asks.sendall(b"GET /info HTTP/1.1\r\n\r\n")
            with contextlib.suppress(ConnectionResetError):
                assert asks.recv(100) == b""
        assert time.monotonic() - began < 8


def test_ways_that_wait_are_not_forgotten_by_a_nat(nodes: NodeScene) -> None:
    """Both ends have the kernel say something while nobody else does."""

    def kept() -> list[bool]:
        """For each end; one that was opened just now has it in a moment."""
        here = [one for one in psutil.Process().net_connections("tcp") if one.status == "ESTABLISHED"]
        found = []
        for end in (one for one in here if nodes.port in (one.laddr.port, one.raddr.port)):
            with contextlib.suppress(OSError), socket.socket(fileno=os.dup(end.fd)) as one:
                if one.family == end.family:  # else it has ended just now, and another has its number
                    said = one.getsockopt(socket.SOL_SOCKET, socket.SO_KEEPALIVE) == 1
                    found.append(said and one.getsockopt(socket.IPPROTO_TCP, socket.TCP_KEEPIDLE) <= 60)
        return found

    nodes.join()
    with nodes.running() as linked:
        until(lambda: linked and nodes.state() == "ready")
        until(lambda: len(found := kept()) >= 2 * ways.SPARE and all(found))


def test_the_socket_of_an_engine_is_nobody_elses(nodes: NodeScene) -> None:
    nodes.join()
    with nodes.running() as linked:
        until(lambda: linked and nodes.state() == "ready")
        path = nodes.core.settings.state_dir / "sites/edge/engine.sock"
        assert path.stat().st_mode & 0o777 == 0o600
        assert path.parent.stat().st_mode & 0o777 == 0o700
    until(lambda: not path.exists())


def test_a_certificate_is_for_the_key_that_was_asked_for_whatever_the_request_says(nodes: NodeScene) -> None:
    """It says that it is for an authority, for another name, for the orchestrator."""
    token = nodes.invite()
    trust = trusting(first_call(nodes.url, token.partition(".")[2]).authority)
    key = ec.generate_private_key(ec.SECP256R1())
    asked = (
        x509.CertificateSigningRequestBuilder(x509.Name([x509.NameAttribute(x509.NameOID.COMMON_NAME, "other")]))
        .add_extension(x509.BasicConstraints(ca=True, path_length=None), critical=True)
        .add_extension(x509.SubjectAlternativeName([x509.DNSName(SERVER_NAME)]), critical=False)
        .sign(key, hashes.SHA256())
    )
    other = x509.CertificateSigningRequestBuilder(x509.Name([])).sign(
        rsa.generate_private_key(65537, 2048), hashes.SHA256()
    )

    def ask(request: str) -> Issued:
        return calls.call(nodes.url, trust, Join(token=token, request=request, address="127.0.0.1"), Issued)

    for wrong in (other.public_bytes(Encoding.PEM).decode(), "nothing", ""):
        with pytest.raises(RefusedError, match=r"P-256|no request for a certificate"):
            ask(wrong)
    made = x509.load_pem_x509_certificate(ask(asked.public_bytes(Encoding.PEM).decode()).certificate.encode())
    assert made.subject.rfc4514_string() == "CN=edge"
    assert not made.extensions.get_extension_for_class(x509.BasicConstraints).value.ca
    usage = made.extensions.get_extension_for_class(x509.ExtendedKeyUsage).value
    assert list(usage) == [x509.ExtendedKeyUsageOID.CLIENT_AUTH]
    with pytest.raises(x509.ExtensionNotFound):
        made.extensions.get_extension_for_class(x509.SubjectAlternativeName)


def test_what_a_node_says_of_itself_is_bounded(nodes: NodeScene) -> None:
    for wrong in ({"hostname": "x" * 10_000}, {"cpu": -1}, {"cpu": float("inf")}):
        line = json.dumps(Link().model_dump() | {"machine": wrong}).encode()
        with pytest.raises(ValueError, match="no request"):
            read_request(line)
    more = json.dumps(Link().model_dump() | {"machine": {"secret": 1}}).encode()
    assert read_request(more) == Link(machine=Machine()), "what nobody asked for is not kept"
