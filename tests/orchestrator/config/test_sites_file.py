"""Sites that a file declares, and the token that lies beside the secret key."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from pathlib import Path

import pytest
from typer.testing import CliRunner

from skytether.api.rest import SiteCreate
from skytether.cli.app import app
from skytether.orchestrator.access.access import Principal
from skytether.orchestrator.config.settings import Settings
from skytether.orchestrator.config.sites_file import read_sites
from skytether.orchestrator.core import Orchestrator
from skytether.orchestrator.domain.errors import ForbiddenError, InvalidError, UnauthenticatedError
from skytether.orchestrator.domain.security import new_token
from skytether.orchestrator.runtimes.base import Observation, Phase
from skytether.orchestrator.runtimes.docker import DockerRuntime
from skytether.orchestrator.scheduling.sites import dismantle
from skytether.orchestrator.store.store import Store
from skytether.testing.runtimes import FakeRuntime

Start = Callable[[str], Orchestrator]
EDGE = "edge: {tier: edge, runtime: fake, cost: 1}"


@pytest.fixture
def start(tmp_path: Path) -> Iterator[Start]:
    started: list[Orchestrator] = []

    def make(text: str) -> Orchestrator:
        for one in started:
            one.stop()
        (tmp_path / "sites.yaml").write_text(text)
        settings = Settings(state_dir=tmp_path / "state", sites_file=tmp_path / "sites.yaml", local_site=False)
        started.append(Orchestrator(settings, find_runtime=lambda _: FakeRuntime))
        started[-1].start()
        return started[-1]

    yield make
    for one in started:
        one.stop()


def test_a_declared_site_is_made_changed_and_otherwise_left(start: Start) -> None:
    assert start(EDGE).sites.get("edge").asked.cost == 1
    assert start("").sites.get("edge").asked.cost == 1, "what the file does not name stays"
    assert start(f"{EDGE.replace('1', '2')}\ncloud: {{tier: cloud, runtime: fake}}").sites.get("edge").asked.cost == 2
    assert [site.name for site in start(EDGE).sites.all()] == ["cloud", "edge"]


def test_what_was_made_up_once_stays(tmp_path: Path) -> None:
    """The name by which a Docker site finds its containers again."""
    from skytether.orchestrator.config.sites_file import stored_as

    asked = SiteCreate(name="edge", tier="edge", runtime="docker", options={"pull": "never"})
    first = stored_as(asked, None, DockerRuntime)
    assert first.options["owner"]
    again = stored_as(asked.model_copy(update={"options": {"pull": "missing"}}), first, DockerRuntime)
    assert again.options == {"owner": first.options["owner"], "pull": "missing"}
    other = asked.model_copy(update={"options": {"owner": "another"}})
    with pytest.raises(
        InvalidError, match=rf"edge.options.owner: is '{first.options['owner']}' since the site was made"
    ):
        stored_as(other, first, DockerRuntime)
    with pytest.raises(InvalidError, match=r"edge\.runtime: the site runs on 'docker'"):
        stored_as(SiteCreate(name="edge", tier="edge", runtime="fake"), first, FakeRuntime)


@pytest.mark.parametrize(
    ("text", "says"),
    [
        ("edge: {teir: edge, runtime: fake}", r"edge.teir: unknown key, did you mean 'tier'\?"),
        ("edge: 1", "edge: must be what is known of the site"),
        ("- edge", "must hold one document"),
        ("edge: {tier: edge, runtime: fake, options: {cpus: 1}}", "edge.options.cpus: unknown key"),
        ("Edge: {tier: edge, runtime: fake}", "Edge.name"),
        ("{", "line 1"),
    ],
)
def test_a_wrong_file_is_refused_by_its_key(start: Start, text: str, says: str) -> None:
    with pytest.raises(InvalidError, match=says):
        start(text)


def test_when_the_orchestrators_are_gone_for_good_nothing_is_left(tmp_path: Path) -> None:
    left = {"a": Observation(1, Phase.RUNNING), "b": Observation(1, Phase.EXITED)}
    undone = []

    class Held(FakeRuntime):
        def observe(self) -> dict[str, Observation]:
            return left

        def remove(self, instance: str) -> None:
            undone.append(instance)

        def dismantle(self) -> None:
            undone.append("the rest")

        def close(self) -> None:
            undone.append("closed")

    (tmp_path / "sites.yaml").write_text(EDGE)
    dismantle(read_sites(tmp_path / "sites.yaml"), tmp_path, lambda _: Held)
    assert undone == ["a", "b", "the rest", "closed"]


def test_the_command_names_what_is_wrong_in_the_file(tmp_path: Path) -> None:
    (tmp_path / "sites.yaml").write_text("edge: {tier: edge, runtime: nothing}")
    done = CliRunner().invoke(app, ["orchestrator", "dismantle", str(tmp_path / "sites.yaml")])
    assert done.exit_code == 2
    assert "there is no runtime 'nothing'" in done.output


def test_a_token_beside_the_secret_key_may_measure_and_nothing_else(tmp_path: Path) -> None:
    token, folder = new_token(), tmp_path / "state"
    folder.mkdir(mode=0o700)
    (folder / "metrics.token").touch(mode=0o600)
    (folder / "metrics.token").write_text(f"{token}\n")
    core = Orchestrator(Settings(state_dir=folder))
    core.store.migrate()
    caller = core.access.verify(token)
    caller.require_scope("metrics")
    assert not caller.owns_state
    with pytest.raises(ForbiddenError, match="it needs the scope 'sites'; its scopes are: metrics"):
        caller.require_scope("sites")
    core.store.close()


def test_without_that_file_nobody_has_such_a_token(tmp_path: Path) -> None:
    store = Store(f"sqlite:///{tmp_path}/state.db")
    store.close()
    core = Orchestrator(Settings(state_dir=tmp_path / "state"))
    core.store.migrate()
    with pytest.raises(UnauthenticatedError):
        core.access.verify("")
    assert core.access.verify((tmp_path / "state" / "operator.token").read_text().strip()).owns_state
    assert Principal(None).owns_state
    core.store.close()


GROUP = "cloud: {provider: local, max: 2, cost: 3, options: {cpu: 2}}"


def test_a_declared_group_is_made_changed_and_otherwise_left(start: Start) -> None:
    core = start(f"{EDGE}\n{GROUP}")
    assert [site.name for site in core.sites.all()] == ["edge"]
    row = core.groups.row("cloud")
    assert (row.asked.max, row.asked.cost, row.asked.options) == (2, 3, {"cpu": 2})
    assert "cloud" in [one.name for one in start("").groups.all()], "what the file does not name stays"
    core = start(GROUP.replace("max: 2", "max: 5"))
    assert core.groups.row("cloud").asked.max == 5
    assert core.groups.row("cloud").owner == row.owner, "by it its machines are found again"


@pytest.mark.parametrize(
    ("text", "why"),
    [
        ("cloud: {provider: local, max: 1, min: 2}", "cloud: min is 2 and max 1: min must not be above max"),
        ("cloud: {provider: local, max: 1, maximum: 2}", "cloud.maximum: unknown key, did you mean 'max'?"),
        ("cloud: {provider: local, max: 1, runtime: docker}", "a site has a runtime, a group of sites a provider"),
        ("cloud: {provider: lokal, max: 1}", "there is no provider 'lokal'; installed are: local, openstack"),
        ("cloud: {provider: local, max: 1, options: {cpus: 1}}", "options.cpus: unknown key, did you mean 'cpu'?"),
        ("cloud: {provider: local}", "cloud.max: is missing"),
    ],
)
def test_a_declared_group_that_is_none_is_refused_in_a_sentence(start: Start, text: str, why: str) -> None:
    with pytest.raises(InvalidError) as caught:
        start(text)
    assert why in str(caught.value)


def test_a_group_does_not_change_its_provider(start: Start) -> None:
    start(GROUP)
    with pytest.raises(InvalidError, match="its machines are made by 'local': delete the group first"):
        start(GROUP.replace("local", "openstack"))
