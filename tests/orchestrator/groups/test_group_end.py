"""``skytether orchestrator dismantle``: of groups whose orchestrators are gone for good no machine is left."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import pytest
from node_scene import until
from typer.testing import CliRunner

from skytether.api.groups import GroupCreate, Stage
from skytether.api.manifest import Strict
from skytether.cli.app import app
from skytether.orchestrator.config.settings import Settings
from skytether.orchestrator.core import Orchestrator
from skytether.orchestrator.groups.group_end import end_groups
from skytether.orchestrator.providers.base import Found, Order, Provider
from skytether.orchestrator.runtimes.base import RuntimeFailure
from skytether.orchestrator.store.group_store import GroupRow, MachineRow
from skytether.orchestrator.store.store import Store
from skytether.testing.providers import FakeCloud, FakeProvider

FILE = "cloud: {provider: local, min: 2, max: 3}\n"
OWNER = "0123456789ab"


def dismantle(folder: Path, *words: str) -> Any:
    (folder / "sites.yaml").write_text(FILE)
    return CliRunner().invoke(app, ["orchestrator", "dismantle", str(folder / "sites.yaml"), *words])


@pytest.mark.slow
def test_machines_of_a_group_are_gone_and_while_an_orchestrator_leads_nothing_is_touched(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    state = tmp_path / "state"
    core = Orchestrator(Settings(state_dir=state, local_site=False))
    core.start()
    try:
        core.groups.add(GroupCreate(name="cloud", provider="local", min=2, max=3))
        until(lambda: [machine.stage for machine in core.store.machines()] == [Stage.READY] * 2)
        there = sorted(note.name for note in (state / "groups/cloud/machines").iterdir())
        refused = dismantle(tmp_path, "--state-dir", str(state))
        assert (refused.exit_code, "an orchestrator leads over this database" in refused.output) == (1, True)
        assert len(core.store.machines()) == 2
    finally:
        core.stop()
    assert sorted(note.name for note in (state / "groups/cloud/machines").iterdir()) == there
    done = dismantle(tmp_path, "--state-dir", str(state))
    assert done.exit_code == 0, done.output
    assert "2 machines of cloud are destroyed" in done.output
    assert list((state / "groups/cloud/machines").iterdir()) == []
    store = Store(f"sqlite:///{state / 'state.db'}")
    assert (store.site_groups(), store.machines(), store.sites()) == ([], [], [])
    store.close()
    again = dismantle(tmp_path, "--state-dir", str(state))
    assert (again.exit_code, "0 machines of cloud are destroyed" in again.output) == (0, True)
    assert "this database knows no group 'cloud'" in caplog.text


def test_without_the_database_that_knows_them_it_refuses_or_says_that_they_stay(tmp_path: Path) -> None:
    refused = dismantle(tmp_path, "--state-dir", str(tmp_path / "none"))
    assert refused.exit_code == 1
    assert "known to the orchestrators' database only: name it (--database)" in " ".join(refused.output.split())
    forced = dismantle(tmp_path, "--state-dir", str(tmp_path / "none"), "--force")
    assert (forced.exit_code, "database only, and stay" in " ".join(forced.output.split())) == (0, True)


@pytest.fixture
def store(tmp_path: Path) -> Iterator[Store]:
    made = Store(f"sqlite:///{tmp_path / 'state.db'}")
    made.migrate()
    made.add_site_group(GroupRow(GroupCreate(name="cloud", provider="fake", max=3), OWNER))
    yield made
    made.close()


def provider_of(cloud: FakeCloud) -> Any:
    class Of(FakeProvider):
        settle_s = 1.0

        def __init__(self, group: str, owner: str, folder: Path, options: Strict) -> None:
            super().__init__(group, owner, folder, options, cloud)

        def machines(self) -> Sequence[Found]:
            found = super().machines()
            cloud.lists_late = False  # by the next look
            return found

    def find(_: str) -> type[Provider]:
        return Of

    return find


def test_a_cloud_that_does_not_answer_leaves_group_and_machines_in_the_database(store: Store, tmp_path: Path) -> None:
    cloud = FakeCloud()
    provider = FakeProvider("cloud", OWNER, tmp_path, FakeProvider.Options(), cloud)
    id_ = provider.make(Order("cloud-1"))
    store.add_machine(MachineRow("cloud-1", "cloud", Stage.READY, 0.0, id_))
    cloud.silent = True
    with pytest.raises(RuntimeFailure, match=r"group cloud: .*; machines may be left"):
        end_groups(store, ["cloud"], tmp_path, provider_of(cloud))
    assert [machine.name for machine in store.machines()] == ["cloud-1"]
    cloud.silent = False
    assert end_groups(store, ["cloud", "unknown"], tmp_path, provider_of(cloud)) == ["cloud-1"]
    assert (cloud.names(), store.machines(), store.site_groups()) == ([], [], [])


def test_one_whose_order_got_no_answer_is_waited_for(store: Store, tmp_path: Path) -> None:
    cloud = FakeCloud()
    provider = FakeProvider("cloud", OWNER, tmp_path, FakeProvider.Options(), cloud)
    provider.make(Order("cloud-1"))
    store.add_machine(MachineRow("cloud-1", "cloud", Stage.MAKING, 0.0))
    cloud.lists_late = True
    assert end_groups(store, ["cloud"], tmp_path, provider_of(cloud)) == ["cloud-1"]
    assert cloud.destroyed == ["vm-1"]
