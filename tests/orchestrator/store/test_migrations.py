"""From every schema that there was, with something in every table, to the newest: nothing is lost, all can be read."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import closing, contextmanager
from pathlib import Path
from typing import Any

import pytest
import sqlalchemy as sa
from alembic.autogenerate import compare_metadata
from alembic.migration import MigrationContext

from skytether.api.groups import Stage
from skytether.api.rest import State
from skytether.orchestrator.domain.records import Change
from skytether.orchestrator.domain.security import TokenHash
from skytether.orchestrator.store import migrations
from skytether.orchestrator.store.engine import make_engine, migrate
from skytether.orchestrator.store.models import metadata
from skytether.orchestrator.store.store import Store

pytestmark = pytest.mark.slow

NOW = 1_700_000_000.0
VERSIONS = sorted(path.stem[:4] for path in Path(migrations.__path__[0], "versions").glob("[0-9]*.py"))
TOKEN = "sky-" + "ab" * 32
KEPT = TokenHash.of(TOKEN)
MANIFEST = {
    "apiVersion": "skytether.io/v1",
    "kind": "Service",
    "metadata": {"name": "toy"},
    "spec": {"entrypoint": "skytether.testing.toy_service"},
}
INSTANCE: dict[str, Any] = {
    "id": "i1",
    "robot": "walker",
    "service": "toy",
    "session_id": "ff" * 8,
    "manifest": MANIFEST,
    "created_at": NOW,
    "lease_s": 15.0,
    "lease_expires_at": NOW + 15,
    "updated_at": NOW + 1,
    "params": {"mass": 70.5, "path": [[0, 1], None]},
    "measurements": {"lab": {"rtt_ms": 3.5}},
    "state": "running",
    "reason": "grün",
    "site": "lab",
    "refused": [{"site": "x", "reason": "cpu", "detail": "full"}],
    "host": "10.0.0.1",
    "port": 4711,
    "attempt": 2,
    "failures": 1,
    "restarts": 1,
    "start_at": NOW,
    "started_at": NOW,
    "running_at": NOW + 1,
    "stopping_at": None,
    "version": 7,
    "scores": [],
    "replaces": None,
    "pinned": None,
    "spare": False,
    "claim": None,
    "key_id": "",
    "said": 0,
    "size": None,
    "resize": None,
    "pull": None,
}
"""A value for every column that a table had at any time; what a version has not is left out."""
ROWS: dict[str, dict[str, Any]] = {
    "instances": INSTANCE,
    "robots": {
        "name": "walker",
        "services": ["*"],
        "token_prefix": KEPT.prefix,
        "token_sha256": KEPT.digest,
        "created_at": NOW,
        "last_seen_at": NOW + 2,
        "share_group": None,
    },
    "shared": {"robot": "walker", "service": "toy", "share_group": "hall", "at": NOW, "text": "a crate"},
    "orchestrators": {"address": "http://one:8600", "seen_at": NOW},
    "services": {"name": "toy", "manifest": MANIFEST},
    "stops": {"robot": "walker", "id": "s1", "at": NOW, "reason": "smoke", "by": "operator:x", "acknowledged_at": None},
    "gates": {"robot": "walker", "at": NOW, "report": {"answers": True, "troubles": 1}},
    "sites": {
        "name": "lab",
        "tier": "edge",
        "runtime": "process",
        "options": {"cpu": 2},
        "speed": 1.0,
        "cost": 0.0,
        "images": ["*"],
        "draining": False,
        "evacuating": False,
    },
    "nodes": {
        "site": "lab",
        "serial": "7f",
        "ends_at": NOW,
        "next_serial": None,
        "follow": True,
        "joined_at": NOW,
        "seen_at": NOW,
        "seen_as": "192.0.2.7",
        "machine": {"cpu": 4.0, "architecture": "arm64"},
    },
    "invitations": {
        "id": "n1",
        "prefix": KEPT.prefix,
        "sha256": KEPT.digest,
        "site": {"name": "ward", "tier": "edge", "runtime": "docker"},
        "name": "ward",
        "by": "operator",
        "created_at": NOW,
        "expires_at": NOW + 3600,
        "used_at": None,
        "used_from": None,
        "used_key": None,
    },
    "site_groups": {
        "name": "cloud",
        "asked": {"name": "cloud", "provider": "local", "max": 2},
        "owner": "00aa11bb22cc",
        "draining": False,
        "failures": 1,
        "retry_at": NOW,
        "reason": "the quota is used up",
        "told": [[NOW, "a machine was made"]],
    },
    "machines": {
        "name": "cloud-1",
        "site_group": "cloud",
        "stage": "joining",
        "since": NOW,
        "provided": "vm-1",
        "reason": "",
    },
    "events": {"instance": "i1", "at": NOW, "state": "running", "reason": "", "code": "", "pull": None},
    "idempotency": {"owner": "robot:walker", "key": "k", "body_sha256": "0" * 64, "instance": "i1", "created_at": NOW},
    "reports": {"instance": "i1", "at": NOW, "report": {"rtt_s": 0.02}},
    "facts": {"name": "secret.key", "value": "f"},
    "accounts": {
        "robot": "walker",
        "service": "toy",
        "account": {"past": [[["control_overruns"], 3]], "lives": [["robot:a", [[["control_overruns"], 4]]]]},
    },
    "tokens": {
        "id": "t1",
        "name": "walker",
        "robot": "walker",
        "scopes": [],
        "prefix": KEPT.prefix,
        "sha256": KEPT.digest,
        "created_at": NOW,
        "expires_at": None,
        "last_used_at": None,
        "family": "t1",
        "ends_at": None,
        "successor": None,
        "handle": "walker/walker",
    },
}


def fill(engine: sa.Engine) -> dict[str, int]:
    """A row in every table that there is; how many rows each has."""
    found = sa.MetaData()
    found.reflect(engine)
    counts = {}
    with engine.begin() as connection:
        for table in found.sorted_tables:
            if table.name == "leadership":
                counts[table.name] = 1  # made with its only row
            elif table.name != "alembic_version":
                names = [c.name for c in table.columns if (table.name, c.name) != ("events", "id")]
                row = {name: ROWS[table.name][name] for name in names}
                connection.execute(table.insert().values(**row))
                counts[table.name] = 1
    return counts


@contextmanager
def engine_for(url: str) -> Iterator[sa.Engine]:
    """Closed however the test ends: a connection that it leaves open fails another test, when it is collected."""
    engine = make_engine(url)
    try:
        yield engine
    finally:
        engine.dispose()


def check(url: str, version: str) -> None:
    with engine_for(url) as engine:
        migrate(engine, version)
        counts = fill(engine)
        migrate(engine)
        with engine.connect() as connection:
            assert compare_metadata(MigrationContext.configure(connection, opts={"compare_type": True}), metadata) == []
            for table, count in counts.items():
                rows = connection.scalar(sa.select(sa.func.count()).select_from(sa.table(table)))
                assert rows == count, f"from {version}: {table}"
    with closing(Store(url)) as store:
        store.migrate()
        look_through(store, counts)


def look_through(store: Store, counts: dict[str, int]) -> None:
    (record,) = store.live()
    renamed = {"spare": "standby"}  # the column has the name that it was made with
    wanted = {renamed.get(key, key): value for key, value in INSTANCE.items() if key != "claim"}
    assert {key: getattr(record, key) for key in wanted} == {**wanted, "state": State.RUNNING}
    assert [(r.name, r.services, r.last_seen_at) for r in store.robots()] == [("walker", ("*",), NOW + 2)]
    ((token, _),) = store.holders(KEPT.prefix)
    assert (token.robot, token.hash.matches(TOKEN)) == ("walker", True)
    assert store.services() == {"toy": MANIFEST}
    (site,) = store.sites()
    assert (site.name, site.options, site.speed, site.images) == ("lab", {"cpu": 2}, 1.0, ("*",))
    groups = [(row.asked.name, row.asked.max, row.failures, row.told) for row in store.site_groups()]
    assert groups == ([("cloud", 2, 1, ((NOW, "a machine was made"),))] if "site_groups" in counts else [])
    machines = [(row.name, row.stage, row.provided) for row in store.machines()]
    assert machines == ([("cloud-1", Stage.JOINING, "vm-1")] if "machines" in counts else [])
    if "nodes" in counts:
        assert store.nodes.all()["lab"].machine.architecture == "arm64"
        assert [one.site.name for one in store.nodes.invitations(KEPT.prefix)] == ["ward"]
    sums = [account.sums() for account in store.accounts().values()]
    assert sums == ([{("control_overruns",): 7}] if "accounts" in counts else [])
    assert [(e.id, e.state) for e in store.events("i1", 0)] == [(1, State.RUNNING)]
    again = store.made_with("robot:walker", "k", "0" * 64)
    assert again is not None
    assert again.id == "i1"
    # What is added later fits in beside it.
    changed = store.change(Change(record, {"state": State.STOPPING}), NOW + 3)
    assert changed is not None
    assert [e.id for e in store.events("i1", 1)] == [2]
    assert store.change(Change(changed, {"state": State.STOPPED}), NOW + 4) is not None
    store.delete_robot("walker")
    assert store.tokens() == []
    store.prune(NOW + 1000, ended_age=1, ended_count=0, events_count=0)
    assert store.all() == []


@pytest.mark.parametrize("version", VERSIONS)
def test_from_every_schema_of_sqlite(tmp_path: Path, version: str) -> None:
    check(f"sqlite:///{tmp_path}/state.db", version)


@pytest.mark.postgres
def test_from_every_schema_of_postgresql(postgres: str) -> None:
    for version in VERSIONS:
        check(postgres, version)
        with engine_for(postgres) as engine, engine.begin() as connection:
            connection.exec_driver_sql("DROP SCHEMA public CASCADE")
            connection.exec_driver_sql("CREATE SCHEMA public")
