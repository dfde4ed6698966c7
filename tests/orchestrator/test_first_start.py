"""In the orchestrator's image: its health check; passwords and token of compose.yaml, made once and kept."""

from __future__ import annotations

import importlib.util
import stat
from pathlib import Path
from typing import Any

import pytest

FOLDER = Path(__file__).parents[2] / "images" / "orchestrator"


def loaded(name: str) -> Any:
    spec = importlib.util.spec_from_file_location(name, FOLDER / f"{name}.py")
    assert spec
    assert spec.loader
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


@pytest.fixture
def first_start() -> Any:
    return loaded("first_start")


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    for name in ("database", "grafana", "prometheus"):
        (tmp_path / name).mkdir()
    return tmp_path


def test_passwords_are_made_once_and_differ(first_start: Any, folder: Path) -> None:
    first_start.passwords(folder)
    made = {path: path.read_text() for path in folder.rglob("*") if path.is_file()}
    database, grafana = made[folder / "database/password"], made[folder / "grafana/admin_password"]
    assert len({database, grafana}) == 2
    assert min(len(database), len(grafana)) >= 48
    pgpass = folder / "database" / "pgpass"
    assert made.pop(pgpass) == f"*:*:*:*:{database}\n"
    assert stat.S_IMODE(pgpass.stat().st_mode) == 0o600
    pgpass.unlink()  # a start that was cut short
    (folder / "database" / "pgpass.new").write_text("half")
    first_start.passwords(folder)
    assert pgpass.read_text() == f"*:*:*:*:{database}\n"
    assert {path: path.read_text() for path in made} == made


def test_the_token_is_kept_while_it_is_good(first_start: Any, folder: Path, served: Any, capsys: Any) -> None:
    operator = folder / "operator.token"
    operator.write_text(f"{served.token}\n")
    path = folder / "prometheus" / "token"
    first_start.token(served.url, folder, operator)
    token = path.read_text()
    assert served.client(token).metrics()
    first_start.token(served.url, folder, operator)
    assert path.read_text() == token
    (known,) = served.operator.tokens()
    assert known.scopes == ("metrics",)
    served.operator.delete_token(known.id)
    first_start.token(served.url, folder, operator)
    assert path.read_text() != token
    assert "made anew" in capsys.readouterr().out
    assert served.client(path.read_text()).metrics()


def test_an_orchestrator_that_is_not_there_is_one_sentence(first_start: Any, capsys: Any) -> None:
    assert first_start.main(["token", "http://127.0.0.1:1"]) == 1
    assert capsys.readouterr().err.startswith("error: ")
    assert first_start.main([]) == 2


@pytest.mark.parametrize(
    ("written", "asked"),
    [
        ("http://0.0.0.0:8600\n", "http://127.0.0.1:8600/healthz"),
        ("https://0.0.0.0:443\n", "https://127.0.0.1:443/healthz"),
        ("https://[::]:8600\n", "https://[::1]:8600/healthz"),
        ("http://192.0.2.7:80\n", "http://192.0.2.7:80/healthz"),
        ("http://[fd00::1]:80\n", "http://[fd00::1]:80/healthz"),
    ],
)
def test_health_is_asked_for_where_the_orchestrator_listens(written: str, asked: str) -> None:
    assert loaded("healthy").url(written) == asked


def test_an_orchestrator_that_answers_is_healthy(served: Any, tmp_path: Path, capsys: Any) -> None:
    healthy = loaded("healthy")
    healthy.ADDRESS = tmp_path / "address"
    assert healthy.main() == 1
    healthy.ADDRESS.write_text(f"{served.url}\n")
    assert healthy.main() == 0
    healthy.ADDRESS.write_text("http://127.0.0.1:1\n")
    assert healthy.main() == 1
    assert capsys.readouterr().err.count("error: ") == 2
