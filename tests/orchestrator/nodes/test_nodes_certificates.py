"""Certificates of machines that joined: renewed by themselves, after a long time away, worth nothing once replaced."""

from __future__ import annotations

import socket
from pathlib import Path
from typing import Any

import pytest
from cryptography import x509
from node_scene import NodeScene, program, until

from skytether.api.node import SERVER_NAME, Issued, Link, Linked, Renew, Standing, Stands
from skytether.api.rest import InstanceCreate, State
from skytether.node import calls
from skytether.node.calls import RefusedError, trusting
from skytether.node.run import NodeProgram
from skytether.node.store import NodeError, NodeStore, new_key, renew_due, request_for
from skytether.orchestrator.nodes.authority import Authority, serial_of

DAY = 86_400.0


def serial(store: NodeStore) -> str:
    return serial_of(x509.load_pem_x509_certificate(store.identity.read_bytes()))


def ask(nodes: NodeScene, trust: Any) -> Stands:
    return calls.call(nodes.url, trust, Standing(), Stands)


def test_a_certificate_is_due_after_two_thirds_of_its_life() -> None:
    assert not renew_due(0.0, 30 * DAY, 20 * DAY - 1)
    assert renew_due(0.0, 30 * DAY, 20 * DAY)


@pytest.mark.parametrize("days", [0.01, 0.5, 1.0, 30.0])
def test_no_certificate_is_due_as_it_is_made(tmp_path: Path, days: float) -> None:
    """It begins earlier, for clocks that are behind; a machine that renews while it joins has joined by another one."""
    now = 1000 * DAY
    made = Authority(tmp_path, lambda: now).sign(request_for(new_key()), "edge", days)
    begins, ends = made.not_valid_before_utc.timestamp(), made.not_valid_after_utc.timestamp()
    assert begins < now < ends
    assert not renew_due(begins, ends, now + days * DAY / 4)
    assert renew_due(begins, ends, now + days * DAY * 2 / 3)


def test_a_node_renews_in_time_and_the_certificate_before_is_worth_nothing_once_the_new_one_was_shown(
    nodes: NodeScene, later: Any
) -> None:
    nodes.join()
    store, old = nodes.store(), serial(nodes.store())
    before = trusting(store.authority(), store.identity)
    key = store.identity.read_text()
    later.by = 21 * DAY
    with nodes.running() as linked:
        until(lambda: linked and serial(store) != old)
    with nodes.running() as linked:
        until(lambda: linked)
    assert store.identity.read_text().split("-----")[2] != key.split("-----")[2]
    with pytest.raises(RefusedError, match="another certificate was made for 'edge' and is in use"):
        ask(nodes, before)
    assert ask(nodes, trusting(store.authority(), store.identity)).state != "gone"


def test_a_node_that_was_away_for_longer_than_its_certificate_is_good_comes_back(nodes: NodeScene, later: Any) -> None:
    nodes.join()
    old = serial(nodes.store())
    later.by = 45 * DAY  # it ended 15 days ago
    store = nodes.store()
    trust = trusting(store.authority(), store.identity)
    with pytest.raises(RefusedError) as error:
        calls.call(nodes.url, trust, Link(), Linked)
    assert error.value.over  # it may be renewed, and is good for nothing else
    with pytest.raises(RefusedError):
        ask(nodes, trust)
    with nodes.running() as linked:
        until(lambda: linked)
        until(lambda: nodes.state() == "ready")
    assert serial(store) != old


def test_a_node_that_was_away_for_too_long_is_told_what_to_do(nodes: NodeScene, later: Any) -> None:
    nodes.join()
    later.by = 61 * DAY
    store = nodes.store()
    request = Renew(request=request_for(new_key()))
    with pytest.raises(RefusedError, match=r"could be renewed until .*: remove the site .*--force"):
        calls.call(nodes.url, trusting(store.authority(), store.identity), request, Issued)


def test_two_certificates_of_a_node_are_good_at_most(nodes: NodeScene) -> None:
    nodes.join()
    store = nodes.store()
    trust = trusting(store.authority(), store.identity)
    copies = []
    for number in range(3):
        key, copy = new_key(), NodeStore(nodes.folder / f"copy-{number}")
        issued = calls.call(nodes.url, trust, Renew(request=request_for(key)), Issued)
        copy.join(store.config(), store.authority(), key, issued.certificate)
        copies.append(trusting(copy.authority(), copy.identity))
    for refused in copies[:2]:
        with pytest.raises(RefusedError, match="another certificate was made"):
            ask(nodes, refused)
    assert ask(nodes, copies[2]).state != "gone"
    with pytest.raises(RefusedError, match="another certificate was made"):
        ask(nodes, trust)  # the one before is over, now that the new one was shown


def test_the_orchestrators_own_certificate_is_another_one_after_a_month_and_nodes_stay_linked(
    nodes: NodeScene, later: Any
) -> None:
    nodes.join()
    with nodes.running() as linked:
        until(lambda: linked and nodes.state() == "ready")
        shown = _shown(nodes)
        later.by = 31 * DAY
        assert _shown(nodes) != shown
        # Ways are opened anew all the time, each with a handshake.
        asked = nodes.operator.create_instance(InstanceCreate(robot="walker", service="toy"))
        nodes.operator.wait_running(asked.id)
        assert nodes.state() == "ready"
        assert len(linked) <= 2


def _shown(nodes: NodeScene) -> bytes:
    store = nodes.store()
    context = trusting(store.authority(), store.identity)
    with (
        socket.create_connection(("127.0.0.1", nodes.port), timeout=10) as plain,
        context.wrap_socket(plain, server_hostname=SERVER_NAME) as link,
    ):
        shown = link.getpeercert(True)
    assert shown is not None
    return shown


def test_an_orchestrator_that_is_restarted_finds_its_nodes_again(nodes: NodeScene) -> None:
    nodes.join()
    with nodes.running() as linked:
        until(lambda: linked and nodes.state() == "ready")
        nodes.shut()
        until(lambda: nodes.state() == "unreachable")
        assert "is not linked (since 20" in nodes.operator.get_site("edge").reason
        nodes.open()
        until(lambda: nodes.state() == "ready")


def test_after_a_day_without_an_orchestrator_all_that_ran_runs_on_and_keys_are_renewed(
    nodes: NodeScene, later: Any
) -> None:
    nodes.join()
    store, old = nodes.store(), serial(nodes.store())
    with nodes.running() as linked:
        until(lambda: linked and nodes.state() == "ready")
        made = nodes.operator.create_instance(InstanceCreate(robot="walker", service="toy", lease_s=15))
        before = nodes.operator.wait_running(made.id)
        nodes.shut()  # the cable is pulled; robot and node are driven on
        until(lambda: nodes.state() == "unreachable")
        later.by = 21 * DAY
        nodes.open()
        until(lambda: nodes.state() == "ready")
        after = nodes.operator.renew_instance(made.id)
        assert (after.state, after.restarts) == (State.RUNNING, 0)
        assert (after.session, after.placement) == (before.session, before.placement)
        until(lambda: serial(store) != old)
        assert nodes.operator.get_instance(made.id).restarts == 0


def test_a_node_with_several_orchestrators_is_linked_with_all_of_them(nodes: NodeScene) -> None:
    nodes.join()
    store = nodes.store()
    config = store.config()
    closed = "https://127.0.0.1:1"
    store.save(config.model_copy(update={"urls": (closed, *config.urls)}))
    with program(store) as linked:
        until(lambda: nodes.url in linked)
        until(lambda: nodes.state() == "ready")


def test_a_node_learns_where_the_other_orchestrators_are(nodes: NodeScene) -> None:
    nodes.core.nodes.urls = (nodes.url, "https://127.0.0.1:2")
    nodes.join()
    assert nodes.store().config().urls == (nodes.url, "https://127.0.0.1:2")
    nodes.core.nodes.urls = (*nodes.core.nodes.urls, "https://127.0.0.1:3")
    with nodes.running() as linked:
        until(lambda: linked)
        until(lambda: "https://127.0.0.1:3" in nodes.store().config().urls)


def test_who_has_not_joined_runs_nothing(tmp_path: Any) -> None:
    with pytest.raises(NodeError, match="this machine has not joined"):
        NodeProgram(NodeStore(tmp_path))
