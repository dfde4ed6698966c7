"""Backup of a running orchestrator, and restore into a new one: the real program."""

from __future__ import annotations

import shutil
import sqlite3
import stat
from collections.abc import Callable, Iterator
from contextlib import closing
from pathlib import Path
from typing import Any

import pytest
from orchestrator_program import Program, until, with_toy

from skytether.api.client import Client
from skytether.api.rest import InstanceCreate, RobotCreate, State
from skytether.orchestrator.backup import BackupError, backup, restore


@pytest.fixture
def programs(tmp_path: Path) -> Iterator[Callable[[str], Program]]:
    made: list[Program] = []

    def make(name: str) -> Program:
        (tmp_path / name).mkdir()
        made.append(Program(tmp_path / name / "state"))
        return made[-1]

    yield make
    for program in made:
        program.clean_up()


@pytest.mark.slow
def test_what_was_backed_up_in_mid_work_goes_on_elsewhere(
    programs: Callable[[str], Program], manifest: Any, tmp_path: Path
) -> None:
    first = programs("one")
    with first.start() as client:
        with_toy(client, manifest)
        token = client.create_robot(RobotCreate(name="walker")).token
        made = client.create_instance(InstanceCreate(robot="walker", service="toy", lease_s=1000))
        running = client.wait_running(made.id)
        key = client.claim_session(made.id, "c" * 16)
        assert backup(first.folder, tmp_path / "copy") == ["state.db", "secret.key", "operator.token"]
        client.create_robot(RobotCreate(name="later"))
    first.clean_up()
    shutil.rmtree(first.folder)

    second = programs("two")
    assert restore(tmp_path / "copy", second.folder) == ["state.db", "secret.key", "operator.token"]
    with second.start() as client:
        assert [robot.name for robot in client.robots()] == ["walker"]
        url = (second.folder / "address").read_text().strip()
        with Client(url, token) as robot:
            until(lambda: robot.get_instance(made.id).state is State.RUNNING, second)  # started anew
            again = robot.get_instance(made.id)
            assert robot.claim_session(made.id, "d" * 16) == key
        assert running.session is not None
        assert again.session is not None
        assert again.session.id == running.session.id


def test_a_copy_is_its_owners_whoever_may_enter_its_folder(tmp_path: Path) -> None:
    state = tmp_path / "state"
    state.mkdir()
    with closing(sqlite3.connect(state / "state.db")) as database:
        database.execute("CREATE TABLE tokens (id)")
    for name in ("secret.key", "operator.token"):
        (state / name).write_text("x")
    copied = backup(state, tmp_path / "copy")
    assert {path.name: stat.S_IMODE(path.stat().st_mode) for path in (tmp_path / "copy").iterdir()} == dict.fromkeys(
        copied, 0o600
    )


def test_what_cannot_be_is_one_sentence_and_leaves_nothing(tmp_path: Path) -> None:
    with pytest.raises(BackupError, match="is no state folder"):
        backup(tmp_path, tmp_path / "copy")
    assert not (tmp_path / "copy").exists()
    with pytest.raises(BackupError, match="is no backup"):
        restore(tmp_path, tmp_path / "state")
    (tmp_path / "state").mkdir()
    for name in ("secret.key", "operator.token"):
        (tmp_path / "state" / name).write_text("x")
    (tmp_path / "there").mkdir()
    with pytest.raises(BackupError, match="is there already"):
        backup(tmp_path / "state", tmp_path / "there")
    (tmp_path / "state" / "state.db").write_text("this is no database, and long enough to be one " * 9)
    with pytest.raises(BackupError, match="nothing of it is left"):
        backup(tmp_path / "state", tmp_path / "copy")
    assert not (tmp_path / "copy").exists()
    (tmp_path / "state" / "state.db").unlink()
    assert backup(tmp_path / "state", tmp_path / "copy") == ["secret.key", "operator.token"]
    with pytest.raises(BackupError, match=r"holds secret.key, operator.token: move that away first"):
        restore(tmp_path / "copy", tmp_path / "state")
