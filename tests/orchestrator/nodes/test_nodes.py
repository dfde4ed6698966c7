"""Machines that join: what comes of it, and of joins that fail; made-up engines, real TLS on loopback."""

from __future__ import annotations

import contextlib
import dataclasses
import socket
import threading
from collections.abc import Callable
from typing import Any

import pytest
from node_scene import NodeScene, ReachedRuntime, program, until

from skytether.api.client import ApiError, Client
from skytether.api.node import Issued, Join, Leave, Link, Linked, Stands
from skytether.api.rest import InstanceCreate, Invite, SiteCreate, State, TokenCreate
from skytether.node import calls, checks, join, unit
from skytether.node.calls import RefusedError, first_call, trusting
from skytether.node.join import ChecksError, leave
from skytether.node.store import NodeError, NodeStore, new_key, request_for
from skytether.orchestrator.http import node_echo

DAY = 86_400.0


def said(action: Callable[[], Any]) -> str:
    with pytest.raises(NodeError) as error:
        action()
    return str(error.value)


def nothing_is_left(nodes: NodeScene, name: str = "edge") -> bool:
    return not nodes.store(name).folder.exists() and not nodes.core.nodes.all() and not nodes.operator.sites()


def test_a_machine_that_joins_is_a_site_and_starts_what_it_is_told(nodes: NodeScene) -> None:
    joined = nodes.join()
    assert (joined.name, joined.stands.state, joined.stands.cpu) == ("edge", "ready", 8)
    with nodes.running() as linked:
        until(lambda: linked)
        until(lambda: nodes.state() == "ready")
        site = nodes.operator.get_site("edge")
        assert (site.cpu, site.memory_mb, site.tier) == (8, 16384, "edge")
        assert site.node is not None
        assert (site.node.engine, site.node.seen_as, site.node.cpu) == ("29.1", "127.0.0.1", 8)
        made = nodes.operator.create_instance(InstanceCreate(robot="walker", service="toy"))
        assert nodes.operator.wait_running(made.id).placement.site == "edge"


def test_its_key_is_its_own_and_readable_by_nobody_else(nodes: NodeScene) -> None:
    nodes.join()
    folder = nodes.store().folder
    assert folder.stat().st_mode & 0o777 == 0o700
    assert {path.name: path.stat().st_mode & 0o777 for path in folder.iterdir()} == {
        "node.json": 0o600,
        "authority.pem": 0o600,
        "identity.pem": 0o600,
    }
    assert "PRIVATE KEY" in nodes.store().identity.read_text()
    assert (nodes.core.settings.state_dir / "nodes.key").stat().st_mode & 0o777 == 0o600
    database = (nodes.core.settings.state_dir / "state.db").read_bytes()
    assert b"PRIVATE KEY" not in database


def test_no_token_is_in_the_database_and_whoever_may_change_sites_may_make_one(nodes: NodeScene) -> None:
    token = nodes.invite()
    wal = nodes.core.settings.state_dir / "state.db-wal"
    stored = (nodes.core.settings.state_dir / "state.db").read_bytes() + (wal.read_bytes() if wal.exists() else b"")
    assert token.partition(".")[0].encode() not in stored
    made = nodes.operator.create_token(TokenCreate(name="terraform", scopes=("sites", "read")))
    reader = nodes.operator.create_token(TokenCreate(name="reader", scopes=("read",)))
    with Client(nodes.api, made.token) as client:
        assert client.invite(Invite(name="other")).name == "other"
        with pytest.raises(ApiError, match="network"):  # opens the network: the state folder's operator alone
            client.invite(Invite(name="other", options={"network": "mine"}))
    with Client(nodes.api, reader.token) as client, pytest.raises(ApiError, match="scope 'sites'"):
        client.invite(Invite(name="other"))


def test_wrong_options_are_refused_when_the_token_is_made(nodes: NodeScene) -> None:
    with pytest.raises(ApiError, match=r"options\.prots.*ports"):
        nodes.invite(options={"prots": [1, 2]})


def test_what_whoever_invited_said_goes_before_what_the_machine_says(nodes: NodeScene) -> None:
    nodes.engine()
    token = nodes.invite(options={"ports": [20_000, 20_009], "advertise_host": "192.0.2.7"}, tier="cloud", cost=2)
    join.join(nodes.options(token, ports=(30_000, 30_001), advertise="127.0.0.1"))
    site = nodes.operator.get_site("edge")
    assert (site.tier, site.cost) == ("cloud", 2)
    assert site.options["ports"] == [20_000, 20_009]
    assert site.options["advertise_host"] == "192.0.2.7"
    assert site.options["engine"] == "node://edge"


# Tokens


def test_a_token_is_good_once(nodes: NodeScene) -> None:
    nodes.engine()
    nodes.engine("other")
    token = nodes.invite()
    join.join(nodes.options(token))
    why = said(lambda: join.join(nodes.options(token, "other")))
    assert why.startswith("this join token was used at ")
    assert why.endswith(
        "from 127.0.0.1: each is good for one machine; make another token with `skytether site invite edge`"
    )
    assert not nodes.store("other").folder.exists()


def test_a_token_that_is_too_old_says_until_when_it_was_good(nodes: NodeScene, later: Any) -> None:
    nodes.engine()
    token = nodes.invite(ttl_s=50)
    later.by = 51  # within what clocks may differ
    assert said(lambda: join.join(nodes.options(token))).startswith("this join token was good until ")
    assert nothing_is_left(nodes)


def test_of_two_tokens_for_a_name_the_later_one_is_good(nodes: NodeScene) -> None:
    nodes.engine()
    first, second = nodes.invite(), nodes.invite()
    assert "another one was made for the same name since" in said(lambda: join.join(nodes.options(first)))
    assert join.join(nodes.options(second)).name == "edge"


def test_what_is_no_token_is_told_before_anybody_is_asked(nodes: NodeScene) -> None:
    assert said(lambda: join.join(nodes.options("sky-123"))).startswith("this is no join token: it is one word")


def test_an_operators_token_is_no_join_token(nodes: NodeScene) -> None:
    nodes.engine()
    operators = (nodes.core.settings.state_dir / "operator.token").read_text().strip()
    assert "is not known here" in said(lambda: join.join(nodes.options(f"{operators}.{nodes.core.authority.pin}")))
    assert nothing_is_left(nodes)


def test_a_join_token_is_no_operators_token(nodes: NodeScene) -> None:
    token = nodes.invite()
    for given in (token, token.partition(".")[0]):
        with Client(nodes.api, given) as client, pytest.raises(ApiError, match="is not known here"):
            client.sites()


# Two of a name


def test_a_name_that_a_site_has_is_not_given_twice(nodes: NodeScene) -> None:
    nodes.join()
    with pytest.raises(ApiError, match="there is a site 'edge' already"):
        nodes.invite()


def test_a_site_that_came_to_be_after_the_token_keeps_its_name_and_the_token_stays_good(nodes: NodeScene) -> None:
    nodes.engine()
    token = nodes.invite()
    nodes.operator.create_site(SiteCreate(name="edge", tier="edge", runtime="fake"))
    why = said(lambda: join.join(nodes.options(token)))
    assert why.startswith("there is a site 'edge' already")
    assert why.endswith("the token is still good")
    assert not nodes.store().folder.exists()
    nodes.operator.delete_site("edge")
    assert join.join(nodes.options(token)).name == "edge"


def test_a_machine_joins_once(nodes: NodeScene) -> None:
    nodes.join()
    token = nodes.invite("other")
    assert said(lambda: join.join(nodes.options(token, "edge"))).startswith("this machine is the site 'edge' already")
    assert join.join(dataclasses.replace(nodes.options(token, "edge"), folder=nodes.store("other").folder))


# Checks


@pytest.mark.parametrize(
    ("hours", "words"), [(1, "60 minutes behind the orchestrator's"), (-1, "60 minutes ahead of the orchestrator's")]
)
def test_a_clock_that_is_an_hour_wrong_is_told_and_the_token_stays_good(
    nodes: NodeScene, later: Any, hours: int, words: str
) -> None:
    nodes.engine()
    later.by = hours * 3600
    token = nodes.invite(ttl_s=DAY)
    why = said(lambda: join.join(nodes.options(token)))
    assert why.startswith(f"this machine's clock is {words}: set it (timedatectl set-ntp true")
    assert nothing_is_left(nodes)
    later.by = 0
    assert join.join(nodes.options(token)).name == "edge"


def test_a_port_that_is_closed_is_named_with_the_check_that_shows_it(nodes: NodeScene) -> None:
    nodes.engine()
    token = nodes.invite()
    nodes.shut()
    why = said(lambda: join.join(nodes.options(token)))
    assert why.startswith(f"TCP port {nodes.port} of 127.0.0.1 cannot be reached (nobody listens there)")
    assert why.endswith(f"`nc -vz 127.0.0.1 {nodes.port}` shows it")
    nodes.open()
    assert join.join(nodes.options(token)).name == "edge"


def test_the_apis_port_is_not_where_nodes_connect(nodes: NodeScene) -> None:
    nodes.engine()
    api = nodes.api.replace("http://", "https://")
    why = said(lambda: join.join(nodes.options(nodes.invite(), urls=(api,))))
    assert "is the port the orchestrator's nodes.port (8603)?" in why
    assert "write https://HOST or https://HOST:PORT" in said(
        lambda: join.join(nodes.options(nodes.invite(), urls=("http://127.0.0.1",)))
    )


def test_all_that_is_wrong_is_told_at_once_and_the_token_stays_good(nodes: NodeScene) -> None:
    token = nodes.invite()
    nodes.engine(MemTotal=256 << 20)
    with pytest.raises(ChecksError) as error:
        join.join(nodes.options(token, advertise="0.0.0.0"))
    found = {finding.check: finding.says for finding in error.value.findings}
    assert found["memory"] == "this machine has 256 MiB of memory: a site needs 512 at least"
    assert found["address"].startswith("robots cannot connect to 0.0.0.0: give the address")
    assert nothing_is_left(nodes)
    nodes.engine()
    assert join.join(nodes.options(token)).name == "edge"


# Half-made


def test_an_answer_that_was_lost_is_given_again_to_the_same_key_and_to_no_other(nodes: NodeScene) -> None:
    token = nodes.invite()
    seen = first_call(nodes.url, token.partition(".")[2])
    trust, key = trusting(seen.authority), new_key()
    asked = Join(token=token, request=request_for(key), address="127.0.0.1")
    first = calls.call(nodes.url, trust, asked, Issued)
    again = calls.call(nodes.url, trust, asked, Issued)
    assert again.name == first.name
    assert again.certificate != first.certificate
    with pytest.raises(RefusedError, match="was used at"):
        calls.call(nodes.url, trust, asked.model_copy(update={"request": request_for(new_key())}), Issued)


def test_a_join_that_fails_late_leaves_nothing_on_either_side(
    nodes: NodeScene, monkeypatch: pytest.MonkeyPatch
) -> None:
    nodes.engine()

    def fail(*_: Any, **__: Any) -> Stands:
        raise NodeError("the site did not answer")

    with monkeypatch.context() as patch:
        patch.setattr(join, "_until_there", fail)
        assert said(lambda: join.join(nodes.options(nodes.invite()))) == "the site did not answer"
    assert nothing_is_left(nodes)
    assert join.join(nodes.options(nodes.invite())).name == "edge"  # the name is free


def test_a_folder_that_cannot_be_written_after_all_takes_everything_back(
    nodes: NodeScene, monkeypatch: pytest.MonkeyPatch
) -> None:
    nodes.engine()

    def full(*_: Any) -> None:
        raise OSError(28, "No space left on device")

    with monkeypatch.context() as patch:
        patch.setattr(NodeStore, "save", full)
        assert "No space left on device; nothing is left of the join" in said(
            lambda: join.join(nodes.options(nodes.invite()))
        )
    assert nothing_is_left(nodes)


# Leaving


def test_a_machine_that_leaves_is_no_site_and_has_no_key(nodes: NodeScene) -> None:
    nodes.join()
    with nodes.running() as linked:
        until(lambda: linked)
        assert leave(nodes.store(), force=False, timeout_s=5) is None
    assert nothing_is_left(nodes)


def test_who_leaves_waits_until_what_runs_there_was_moved(nodes: NodeScene) -> None:
    nodes.join()
    with nodes.running() as linked:
        until(lambda: linked and nodes.state() == "ready")
        made = nodes.operator.create_instance(InstanceCreate(robot="walker", service="toy", lease_s=1000))
        nodes.operator.wait_running(made.id)
        why = said(lambda: leave(nodes.store(), force=False, timeout_s=0))
        assert why.startswith("1 instances are here still")
        nodes.operator.create_site(SiteCreate(name="elsewhere", tier="edge", runtime="fake"))
        # Moved, its robot is told of the other one; that it lets the first one go is the robot's part.
        successor = until(lambda: nodes.operator.renew_instance(made.id).successor)
        assert nodes.operator.wait_running(successor).placement.site == "elsewhere"
        assert nodes.operator.get_instance(made.id).state is State.RUNNING
        nodes.operator.delete_instance(made.id)
        assert leave(nodes.store(), force=False, timeout_s=10) is None
    assert [site.name for site in nodes.operator.sites()] == ["elsewhere"]


def test_who_is_forced_to_leave_leaves_without_an_orchestrator(nodes: NodeScene) -> None:
    nodes.join()
    nodes.shut()
    why = said(lambda: leave(nodes.store(), force=False, timeout_s=0))
    assert "with --force this machine leaves without a word" in why
    assert nodes.store().exists()
    told: list[str] = []
    left = leave(nodes.store(), force=True, timeout_s=0, on_progress=told.append)
    assert left is not None
    assert told == []
    assert not nodes.store().folder.exists()


@pytest.mark.parametrize("there", [True, False])
def test_who_leaves_is_told_of_containers_that_are_here_still(nodes: NodeScene, there: bool) -> None:
    """An orchestrator that somebody has taken says that it has ended them."""
    engine = nodes.engine()
    join.join(nodes.options(nodes.invite()))
    nodes.shut()
    engine.containers = [{"Id": "a"}, {"Id": "b"}]
    if not there:
        engine.stop()
    told: list[str] = []
    leave(nodes.store(), force=True, timeout_s=0, on_progress=told.append)
    (text,) = told
    assert text.startswith("2 containers" if there else "containers that orchestrators made may be here still")
    assert f"`docker -H unix://{engine.path} rm -fv $(docker -H" in text
    assert nodes.operator.delete_site("edge", force=True)


def test_a_site_that_was_removed_has_no_certificate_any_more(nodes: NodeScene) -> None:
    nodes.join()
    with nodes.running() as linked:
        until(lambda: linked)
        nodes.operator.delete_site("edge")
        until(lambda: not (nodes.core.settings.state_dir / "sites/edge/engine.sock").exists())
    store = nodes.store()
    trust = trusting(store.authority(), store.identity)
    assert calls.call(nodes.url, trust, Leave(), Stands).state == "gone"
    with pytest.raises(RefusedError, match="there is no site 'edge' any more: it was removed"):
        calls.call(nodes.url, trust, Link(), Linked)


# The engine


def test_an_engine_that_goes_away_makes_the_site_unreachable_and_says_why(nodes: NodeScene) -> None:
    nodes.join()
    engine = nodes.engine("edge")
    with program(nodes.store()) as linked:
        until(lambda: linked and nodes.state() == "ready")
        engine.stop()
        until(lambda: "the engine there cannot be reached" in nodes.operator.get_site("edge").reason)
        engine.start()
        until(lambda: nodes.state() == "ready")


def test_a_node_that_comes_back_under_another_address_is_found_there_and_what_runs_runs_on(nodes: NodeScene) -> None:
    nodes.join(advertise=None)
    trust = trusting(nodes.store().authority(), nodes.store().identity)
    with program(nodes.store()) as linked:
        until(lambda: linked and nodes.state() == "ready")
        made = nodes.operator.create_instance(InstanceCreate(robot="walker", service="toy", lease_s=1000))
        nodes.operator.wait_running(made.id)
    calls.call(nodes.url, trust, Link(address="192.0.2.9"), Linked)
    assert nodes.operator.get_site("edge").options["advertise_host"] == "192.0.2.9"
    with program(nodes.store()) as linked:  # and this machine's own again
        until(lambda: linked and nodes.state() == "ready")
        assert nodes.operator.get_site("edge").options["advertise_host"] == "127.0.0.1"
        after = nodes.operator.get_instance(made.id)
        assert (after.state, after.restarts) == (State.RUNNING, 0)


def test_an_address_that_somebody_named_stays(nodes: NodeScene) -> None:
    nodes.join(advertise="127.0.0.1")
    trust = trusting(nodes.store().authority(), nodes.store().identity)
    calls.call(nodes.url, trust, Link(address="192.0.2.9"), Linked)
    assert nodes.operator.get_site("edge").options["advertise_host"] == "127.0.0.1"


def test_the_echo_of_a_machine_that_joins_answers_the_orchestrator_or_it_is_told(
    nodes: NodeScene, monkeypatch: pytest.MonkeyPatch
) -> None:
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as free:
        free.bind(("0.0.0.0", 0))
        port = free.getsockname()[1]
    assert nodes.join(echo=port).stands.echo is True
    nodes.engine("other")
    monkeypatch.setattr(node_echo, "ASK_S", 0.05)  # nobody is there who could answer
    # Robots would be told an address at which nobody passes on what comes for this machine.
    assert (
        join.join(nodes.options(nodes.invite("other"), "other", echo=port, advertise="192.0.2.1")).stands.echo is False
    )


def test_who_leaves_waits_until_nothing_of_the_site_is_left(nodes: NodeScene, monkeypatch: pytest.MonkeyPatch) -> None:
    nodes.join()
    emptied, told = threading.Event(), []
    monkeypatch.setattr(ReachedRuntime, "dismantle", lambda _: emptied.wait(30))
    with nodes.running() as linked:
        until(lambda: linked and nodes.state() == "ready")
        thread = threading.Thread(target=nodes.core.sites.delete, args=("edge",))
        thread.start()
        until(lambda: not nodes.core.nodes.all())

        def tell(text: str) -> None:
            told.append(text)
            emptied.set()

        assert leave(nodes.store(), force=False, timeout_s=20, on_progress=tell) is None
        thread.join()
    assert told == ["what is left here is being removed"]


class MadeUpSystemd:
    """Runs the node of a unit as systemd would, or says that it does not come up."""

    def __init__(self, nodes: NodeScene, monkeypatch: pytest.MonkeyPatch) -> None:
        self.stack = contextlib.ExitStack()
        self.texts: list[str] = []
        self.trouble = ""
        self._nodes = nodes
        monkeypatch.setattr(checks, "check_rights", lambda *_, **__: checks.Finding("rights", "made up"))
        monkeypatch.setattr(unit, "install", self.install)
        monkeypatch.setattr(unit, "remove", self.stack.close)
        monkeypatch.setattr(unit, "trouble", lambda: self.trouble)
        monkeypatch.setattr(join, "LOOK_S", 0.05)

    def install(self, text: str) -> None:
        self.texts.append(text)
        if not self.trouble:
            self.stack.enter_context(program(self._nodes.store()))


def test_a_unit_runs_the_node_and_is_gone_when_the_machine_leaves(
    nodes: NodeScene, monkeypatch: pytest.MonkeyPatch
) -> None:
    nodes.engine()
    systemd = MadeUpSystemd(nodes, monkeypatch)
    joined = join.join(nodes.options(nodes.invite(), unit=True, program="/opt/skytether/bin/skytether"))
    assert joined.stands.state == "ready"
    (text,) = systemd.texts
    assert f"ExecStart=/opt/skytether/bin/skytether site run --folder {nodes.store().folder}\n" in text
    assert f"ReadWritePaths={nodes.store().folder}\n" in text
    assert leave(nodes.store(), force=False, timeout_s=10) is None
    assert nothing_is_left(nodes)


def test_a_unit_that_does_not_come_up_is_told_of_before_long_and_nothing_is_left(
    nodes: NodeScene, monkeypatch: pytest.MonkeyPatch
) -> None:
    nodes.engine()
    systemd = MadeUpSystemd(nodes, monkeypatch)
    systemd.trouble = "skytether-node.service ended 3 times; its log ends with: no module named x"
    why = said(lambda: join.join(nodes.options(nodes.invite(), unit=True)))
    assert "ended 3 times; its log ends with: no module named x); nothing is left of the join" in why
    assert nothing_is_left(nodes)
