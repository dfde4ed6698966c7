"""Secrets that change while sessions run."""

from __future__ import annotations

import os
import stat
import time
from pathlib import Path
from typing import Any

import pytest
from typer.testing import CliRunner

from skytether.api.client import ApiError
from skytether.api.rest import InstanceCreate, RobotCreate, State
from skytether.cli.app import app
from skytether.orchestrator.access.rotation import Rotation, rotate_key, rotate_operator
from skytether.orchestrator.backup import backup, restore
from skytether.orchestrator.domain.records import Change
from skytether.orchestrator.domain.security import SecretFileError, Secrets, fingerprint_of

ID = "0011223344556677"
CLAIM = "c" * 43


def test_sessions_keep_their_key_and_new_ones_have_another(tmp_path: Path) -> None:
    secrets = Secrets(tmp_path)
    before, first = secrets.fingerprint(), secrets.session_key(ID)
    assert not secrets.reload()
    kept = rotate_key(tmp_path)
    assert kept.stat().st_mode & 0o777 == 0o600
    assert secrets.reload()
    assert secrets.fingerprint() != before
    assert secrets.old_fingerprints() == (before,)
    assert secrets.session_key(ID, before) == first
    assert secrets.session_key(ID) == first, "one from before fingerprints were noted"
    assert secrets.session_key(ID, secrets.fingerprint()) != first
    second = secrets.fingerprint()
    rotate_key(tmp_path)
    assert Secrets(tmp_path).old_fingerprints() == (before, second)
    with pytest.raises(SecretFileError, match="is not in"):
        secrets.session_key(ID, "00" * 16)


def test_a_session_of_a_key_that_another_orchestrator_saw_first(tmp_path: Path) -> None:
    slow, quick = Secrets(tmp_path), Secrets(tmp_path)
    rotate_key(tmp_path)
    quick.reload()
    assert slow.session_key(ID, quick.fingerprint()) == quick.session_key(ID, quick.fingerprint())


def test_what_cannot_be_used_changes_nothing(tmp_path: Path, caplog: pytest.LogCaptureFixture, store: Any) -> None:
    secrets = Secrets(tmp_path)
    rotation = Rotation(tmp_path, secrets, store, time.time)
    before = secrets.fingerprint()
    (tmp_path / "secret.key").rename(tmp_path / "away")
    for _ in range(3):
        rotation.refresh()
    assert secrets.fingerprint() == before
    assert not (tmp_path / "secret.key").exists(), "no other one is made while sessions run"
    assert caplog.text.count("secret.key is gone: put it back") == 1
    with pytest.raises(SecretFileError, match=r"cannot change .*secret\.key"):
        rotate_key(tmp_path)
    assert [path.name for path in tmp_path.iterdir() if "old" in path.name or "draft" in path.name] == []


def test_a_key_that_could_not_be_used_is_once_it_is_mended(
    tmp_path: Path, caplog: pytest.LogCaptureFixture, store: Any
) -> None:
    """Somebody copies a key from another orchestrator, and chmods it only when told so."""
    secrets = Secrets(tmp_path)
    rotation = Rotation(tmp_path, secrets, store, time.time)
    before = secrets.fingerprint()
    (tmp_path / "copy").write_bytes(b"k" * 32)
    (tmp_path / "copy").chmod(0o644)
    (tmp_path / "copy").replace(tmp_path / "secret.key")
    for _ in range(3):
        rotation.refresh()
    assert secrets.fingerprint() == before
    assert caplog.text.count("can be read by others: chmod 600") == 1
    (tmp_path / "secret.key").chmod(0o600)
    assert secrets.reload()
    assert secrets.fingerprint() == fingerprint_of(b"k" * 32)


def test_an_old_key_is_on_the_disk_before_another_takes_its_place(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Not only what is in the files: their names too, or a power cut takes the only key that sessions have."""
    kept: list[dict[str, bytes]] = []

    def note(file: int) -> None:
        if stat.S_ISDIR(os.fstat(file).st_mode):
            kept.append({path.name: path.read_bytes() for path in tmp_path.iterdir()})

    monkeypatch.setattr(os, "fsync", note)
    Secrets(tmp_path)
    old = (tmp_path / "secret.key").read_bytes()
    assert kept.pop()["secret.key"] == old, "a new one is there for good too"
    kept.clear()
    name = rotate_key(tmp_path).name
    assert [(names["secret.key"] == old, names[name] == old) for names in kept] == [(True, True), (False, True)]


def test_an_old_key_is_forgotten_when_no_session_has_it(
    tmp_path: Path, store: Any, new_record: Any, caplog: pytest.LogCaptureFixture
) -> None:
    caplog.set_level("INFO")
    (tmp_path / "secrets").mkdir()
    folder = tmp_path / "secrets"
    secrets, ahead = Secrets(folder), [0.0]
    rotation = Rotation(folder, secrets, store, lambda: time.time() + ahead[0])
    store.key_id = lambda: secrets.fingerprint()
    assert rotation.agree()
    record = store.add(new_record(), "operator", None, "")
    first = secrets.fingerprint()
    assert record.key_id == first
    old = rotate_key(folder)
    ahead[0] = 120.0
    rotation.refresh()
    assert old.exists(), "an instance has it"
    assert Rotation(folder, Secrets(folder), store, time.time).agree(), "and so does an orchestrator that starts now"
    stranger = tmp_path / "stranger"
    stranger.mkdir()
    assert not Rotation(stranger, Secrets(stranger), store, time.time).agree()
    assert store.change(Change(record, {"state": State.STOPPED}), 1_700_000_001.0)
    ahead[0] = 0.0
    rotation.refresh()
    assert old.exists(), "another orchestrator may not have seen the rotation"
    ahead[0] = 120.0
    rotation.refresh()
    assert not old.exists()
    rotation.refresh()
    assert secrets.old_fingerprints() == ()
    assert caplog.text.count("were changed") == 1, "at the rotation, and not where a key was forgotten"


def test_nothing_ends_where_secrets_are_rotated(served: Any, tmp_path: Path) -> None:
    served.site()
    robot = served.client(served.operator.create_robot(RobotCreate(name="walker")).token)
    old = robot.wait_running(robot.create_instance(InstanceCreate(service="toy", robot="walker")).id, timeout=10)
    key = robot.claim_session(old.id, CLAIM)
    runs = CliRunner()
    for what in ("secret-key", "operator-token"):
        assert runs.invoke(app, ["orchestrator", "rotate", what, "--state-dir", str(tmp_path)]).exit_code == 0
    served.core.rotation.refresh()
    with pytest.raises(ApiError, match="not known here"):
        served.operator.sites()
    served.token = (tmp_path / "operator.token").read_text().strip()
    assert served.operator.sites()
    assert robot.claim_session(old.id, CLAIM) == key
    assert robot.renew_instance(old.id).state == "running"
    new = robot.wait_running(robot.create_instance(InstanceCreate(service="toy", robot="walker")).id, timeout=10)
    records = {record.id: record for record in served.core.store.live()}
    assert records[old.id].key_id != records[new.id].key_id
    assert records[new.id].key_id == Secrets(tmp_path).fingerprint()


def test_a_session_whose_key_is_gone_is_told_so(served: Any, tmp_path: Path) -> None:
    served.site()
    asks = served.operator
    one = asks.wait_running(asks.create_instance(InstanceCreate(service="toy", robot="walker")).id, timeout=10)
    rotate_key(tmp_path).unlink()
    served.core.rotation.refresh()
    with pytest.raises(ApiError, match="put it back, or delete instance") as told:
        asks.claim_session(one.id, CLAIM)
    assert told.value.problem.status == 409


def test_a_copy_holds_the_keys_of_sessions_that_run(tmp_path: Path) -> None:
    state = tmp_path / "state"
    state.mkdir()
    secrets = Secrets(state)
    first = secrets.session_key(ID, secrets.fingerprint())
    before = secrets.fingerprint()
    rotate_key(state)
    rotate_operator(state)
    backup(state, tmp_path / "copy")
    restore(tmp_path / "copy", tmp_path / "again")
    assert Secrets(tmp_path / "again").session_key(ID, before) == first
