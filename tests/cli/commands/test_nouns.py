"""The small verbs, against a real orchestrator."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest
import yaml
from typer.testing import CliRunner, Result

from skytether.cli.app import app
from skytether.lab.embedded import EmbeddedOrchestrator

MANIFEST: dict[str, Any] = {
    "apiVersion": "skytether.io/v1",
    "kind": "Service",
    "metadata": {"name": "toy"},
    "spec": {
        "entrypoint": "skytether.testing.toy_service",
        "params": {"properties": {"say": {"type": "string"}, "exit_status": {"type": "integer"}}},
    },
}
Run = Callable[..., Result]


@pytest.fixture(scope="module")
def orchestrator() -> Iterator[EmbeddedOrchestrator]:
    with EmbeddedOrchestrator() as orchestrator:
        yield orchestrator


@pytest.fixture
def run(orchestrator: EmbeddedOrchestrator, monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> Run:
    """Run a command line against it, as an operator whose environment names it."""
    monkeypatch.setenv("SKYTETHER_URL", orchestrator.url)
    monkeypatch.setenv("SKYTETHER_TOKEN", orchestrator.operator_token)
    monkeypatch.setenv("HOME", str(tmp_path))
    return lambda *arguments, stdin="": CliRunner().invoke(app, list(arguments), input=stdin, catch_exceptions=False)


def good(result: Result) -> Any:
    assert result.exit_code == 0, result.output
    return json.loads(result.stdout)


def bad(result: Result, status: int = 1) -> str:
    """The one sentence of a command that failed."""
    assert result.exit_code == status, result.output
    assert result.stdout == ""
    lines = result.stderr.splitlines()
    assert len(lines) == 1, result.stderr
    assert lines[0].startswith("error: ")
    return lines[0].removeprefix("error: ")


@pytest.mark.slow
def test_a_service_from_file_to_log(run: Run, tmp_path: Path) -> None:
    (tmp_path / "toy.yaml").write_text(yaml.safe_dump(MANIFEST))
    assert good(run("apply", "-f", str(tmp_path / "toy.yaml"), "--json"))[0]["metadata"]["name"] == "toy"
    assert "toy" in [m["metadata"]["name"] for m in good(run("service", "list", "--json"))]
    assert "toy" in run("service", "list").stdout
    assert [site["name"] for site in good(run("site", "list", "--json"))] == ["local"]
    assert "local" in run("site", "list").stdout

    made = good(run("instance", "create", "toy", "--robot", "walker", "--params", '{"say": "hello [there]"}', "--json"))
    assert made["state"] == "running"
    assert "key" not in made["session"]
    assert good(run("instance", "show", made["id"], "--json"))["id"] == made["id"]
    shown = run("instance", "show", made["id"]).stdout
    assert yaml.safe_load(shown)["service"] == "toy"
    assert "key" not in yaml.safe_load(shown)["session"]
    assert made["id"] in [i["id"] for i in good(run("instance", "list", "--json"))]
    header, row, *_ = run("instance", "list").stdout.splitlines()
    columns = ("instance", "robot", "service", "state", "site", "restarts")
    cells = [row[header.index(column) :].split()[0] for column in columns]
    assert cells == [made["id"], "walker", "toy", "running", "local", "0"]
    assert run("instance", "logs", made["id"]).stdout == "hello [there]\n"
    assert good(run("instance", "logs", made["id"], "--json"))["lines"] == ["hello [there]"]
    resized = good(run("instance", "resize", made["id"], "--cpu", "0.5", "--memory", "200", "--json"))
    assert (resized["id"], resized["size"], resized["resize"]) == (made["id"], {"cpu": 0.5, "memory_mb": 200}, None)
    events = run("instance", "events", made["id"]).stdout
    assert "has 0.5 cores and 200 MiB instead of 0.1 cores and 128 MiB: operator asked for it" in events
    assert "say what it is to have" in bad(run("instance", "resize", made["id"]), 2)
    assert "would have 5000 cores, and may have 16" in bad(run("instance", "resize", made["id"], "--cpu", "5000"))
    assert run("instance", "delete", made["id"]).exit_code == 0
    assert run("instance", "delete", made["id"]).exit_code == 0
    assert run("service", "delete", "toy").exit_code == 0
    assert "there is no service 'toy'" in bad(run("instance", "create", "toy", "--robot", "walker"))


def written(path: Path, *documents: Any) -> str:
    path.write_text(yaml.safe_dump_all(documents))
    return str(path)


def named(name: str, **spec: Any) -> dict[str, Any]:
    return {**MANIFEST, "metadata": {"name": name}, "spec": {**MANIFEST["spec"], **spec}}


@pytest.mark.slow
def test_files_are_applied_all_or_none_and_as_often_as_one_likes(run: Run, tmp_path: Path) -> None:
    def results(*arguments: str, stdin: str = "") -> dict[str, str]:
        rows = good(run("apply", *arguments, "--json", stdin=stdin))
        return {row["metadata"]["name"]: row["result"] for row in rows}

    folder = tmp_path / "services"
    folder.mkdir()
    written(folder / "one.yaml", named("a1"), named("a2"))
    written(folder / "two.yml", named("a3"))
    (folder / "notes.txt").write_text("no manifest")
    new = dict.fromkeys(["a1", "a2", "a3"], "created")
    assert results("-f", str(folder), "--dry-run") == new
    assert results("-f", str(folder)) == new
    assert results("-f", str(folder)) == dict.fromkeys(new, "unchanged")
    changed = yaml.safe_dump_all([named("a3", needs={"cpu": 0.5}), named("a4")])
    assert results("-f", "-", "-f", str(folder / "one.yaml"), stdin=changed) == {
        "a3": "changed",
        "a4": "created",
        "a1": "unchanged",
        "a2": "unchanged",
    }
    shown = run("apply", "-f", str(folder / "one.yaml"))
    assert (shown.stdout, shown.stderr.split()[:3]) == ("", ["unchanged", "service", "a1,"])

    wrong = written(tmp_path / "wrong.yaml", named("b1"), named("b2", entrpoint="x"), named("b3", params={"type": 3}))
    refused = run("apply", "-f", wrong)
    assert refused.exit_code == 1
    first, second = refused.stderr.splitlines()
    assert first == f"error: {wrong}, document 2: spec.entrpoint: unknown key, did you mean 'entrypoint'?"
    assert second.startswith(f"error: {wrong}, document 3: spec.params.type: ")
    assert "there is no service 'b1'" in bad(run("service", "show", "b1"))
    twice = written(tmp_path / "twice.yaml", named("a1"))
    assert f"service 'a1' is in {twice} already" in bad(run("apply", "-f", twice, "-f", twice), 2)
    assert "'A/1' is not a valid name" in bad(run("apply", "-f", written(tmp_path / "name.yaml", named("A/1"))), 2)
    (tmp_path / "empty").mkdir()
    assert "holds no *.yaml" in bad(run("apply", "-f", str(tmp_path / "empty")), 2)
    assert bad(run("apply", "-f", "-", stdin=": ["), 2).startswith("standard input: is no YAML")
    assert yaml.safe_load(run("service", "show", "a3").stdout)["spec"]["needs"]["cpu"] == 0.5
    for name in ("a1", "a2", "a3", "a4"):
        assert run("service", "delete", name).exit_code == 0


@pytest.mark.slow
def test_a_table_in_a_pipe_has_one_line_for_each_row(run: Run, tmp_path: Path) -> None:
    topics = [{"name": f"topic_{i:02}", "type": "std_msgs/msg/String", "direction": "in"} for i in range(30)]
    run("apply", "-f", written(tmp_path / "x.yaml", named("wide", topics=topics)))
    (row,) = [line for line in run("service", "list").stdout.splitlines() if line.startswith("wide")]
    assert "topic_29" in row
    assert run("service", "delete", "wide").exit_code == 0


@pytest.mark.slow
def test_a_robot_gets_its_token_on_standard_output_alone(run: Run, tmp_path: Path) -> None:
    added = run("robot", "add", "newcomer", "--service", "toy")
    token = added.stdout.strip()
    assert token.startswith("sky-")
    assert token not in added.stderr
    assert good(run("robot", "list", "--json"))[0]["services"] == ["toy"]
    assert "newcomer" in run("robot", "list").stdout
    assert "there is a robot 'newcomer' already" in bad(run("robot", "add", "newcomer"))
    (tmp_path / "token").write_text(f"{token}\n")
    assert good(run("instance", "list", "--token-file", str(tmp_path / "token"), "--json")) == []
    assert "it needs an operator's token" in bad(run("robot", "list", "--token-file", str(tmp_path / "token")))
    assert run("robot", "delete", "newcomer").exit_code == 0
    assert "this token is not known here" in bad(run("site", "list", "--token-file", str(tmp_path / "token")))


@pytest.mark.slow
def test_a_service_that_ends_at_once_is_told(run: Run, tmp_path: Path) -> None:
    (tmp_path / "toy.yaml").write_text(yaml.safe_dump(MANIFEST))
    run("apply", "-f", str(tmp_path / "toy.yaml"))
    result = run("instance", "create", "toy", "--robot", "r", "--params", '{"exit_status": 2, "say": "no mass"}')
    assert (result.exit_code, result.stdout) == (1, "")
    *steps, sentence = result.stderr.splitlines()
    assert 'is failed: the service ended with exit status 2; its last line: "no mass"' in sentence
    assert [step.split(": ")[1] for step in steps] == ["pending", "placing", "starting", "failed"]


@pytest.mark.slow
@pytest.mark.parametrize(
    ("text", "status", "sentence"),
    [
        (yaml.safe_dump({**MANIFEST, "spce": 1}), 1, "spce: unknown key, did you mean 'spec'?"),
        ("a: [", 2, "is no YAML"),
        ("", 2, "holds no manifest"),
        ("- 1", 2, "metadata.name: is missing"),
        (None, 2, "No such file"),
    ],
)
def test_a_wrong_file_is_one_sentence(run: Run, tmp_path: Path, text: str | None, status: int, sentence: str) -> None:
    if text is not None:
        (tmp_path / "x.yaml").write_text(text)
    assert sentence in bad(run("apply", "-f", str(tmp_path / "x.yaml")), status)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("arguments", "status", "sentence"),
    [
        (["instance", "show", "x"], 1, "there is no instance 'x'"),
        (["service", "show", "recoder"], 1, "there is no service 'recoder'"),
        (["service", "delete", "recoder"], 1, "did you mean 'recorder'?"),
        (["site", "delete", "locl"], 1, "there is no site 'locl'; known are: local; did you mean 'local'?"),
        (["robot", "delete", "nobody"], 1, "there is no robot 'nobody'; known are: "),
        (["token", "delete", "0"], 1, "there is no token '0'; known are: "),
        (["instance", "create", "toy", "--robot", "R!"], 2, "robot: string should match pattern"),
        (["token", "create", "R!", "--scope", "read"], 2, "name: string should match pattern"),
        (["instance", "create", "toy", "--robot", "r", "--params", "{"], 2, "--params is no JSON"),
        (["instance", "create", "toy", "--robot", "r", "--params", "[]"], 2, "params: must be a mapping"),
        (["robot", "add", "R!"], 2, "'R!' is not a valid name"),
        (["site", "list", "--token-file", "/nowhere"], 2, "there is no token file /nowhere"),
        (
            ["site", "list", "--url", "http://127.0.0.1:1"],
            1,
            "no orchestrator answers at http://127.0.0.1:1: start one",
        ),
    ],
)
def test_wrong_use_is_one_sentence(run: Run, arguments: list[str], status: int, sentence: str) -> None:
    assert sentence in bad(run(*arguments), status)


def test_without_any_orchestrator_it_says_how_to_start_one(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    for name in ("SKYTETHER_URL", "SKYTETHER_TOKEN", "SKYTETHER_TOKEN_FILE"):
        monkeypatch.delenv(name, raising=False)
    monkeypatch.setenv("HOME", str(tmp_path))
    state = tmp_path / ".local/state/skytether"
    state.mkdir(parents=True)
    (state / "address").write_text("http://127.0.0.1:1\n")
    assert "start one with `skytether orchestrator run`" in bad(CliRunner().invoke(app, ["site", "list"]))


@pytest.mark.slow
def test_tokens_from_made_to_revoked(run: Run, monkeypatch: pytest.MonkeyPatch) -> None:
    made = good(run("token", "create", "prometheus", "--scope", "metrics", "--scope", "read", "--days", "1", "--json"))
    assert made["scopes"] == ["metrics", "read"]
    listed = good(run("token", "list", "--json"))
    assert [t["name"] for t in listed if t["id"] == made["id"]] == ["prometheus"]
    assert made["token"] not in run("token", "list").output
    fresh = run("token", "rotate", made["id"], "--grace-s", "0")
    assert fresh.exit_code == 0
    monkeypatch.setenv("SKYTETHER_TOKEN", made["token"])
    assert "expired at" in bad(run("site", "list"))
    monkeypatch.setenv("SKYTETHER_TOKEN", fresh.stdout.strip())
    assert run("site", "list").exit_code == 0
    assert "needs the scope 'tokens'" in bad(run("token", "delete", made["id"]))
    assert "expected" not in bad(run("token", "create", "Bad Name", "--scope", "read"), 2)
    assert "scopes" in bad(run("token", "create", "a", "--scope", "everything"), 2)


@pytest.mark.slow
def test_sites_from_added_to_deleted_and_what_happened_to_an_instance(run: Run, tmp_path: Path) -> None:
    added = good(run("site", "add", "more", "--runtime", "process", "--option", "cpu=2", "--cost", "3", "--json"))
    assert (added["cpu"], added["cost"], added["options"]) == (2, 3, {"cpu": 2})
    assert good(run("site", "show", "more", "--json"))["state"] == "ready"
    assert "unknown key" in bad(run("site", "add", "bad", "--runtime", "process", "--option", "cup=2"))
    assert "KEY=VALUE" in bad(run("site", "add", "bad", "--runtime", "process", "--option", "cup"), 2)
    file = tmp_path / "toy.yaml"
    file.write_text(yaml.safe_dump(MANIFEST))
    assert run("apply", "-f", str(file)).exit_code == 0
    made = good(run("instance", "create", "toy", "--robot", "walker", "--json"))
    assert {score["site"] for score in made["placement"]["scores"]} == {"local", "more"}
    assert run("instance", "delete", made["id"]).exit_code == 0
    told = run("instance", "events", made["id"], "--follow", "--json")
    states = [json.loads(line)["state"] for line in told.stdout.splitlines()]
    assert states == ["pending", "placing", "starting", "running", "stopping", "stopped"]
    assert run("site", "delete", "more").exit_code == 0
    assert "there is no site 'more'" in bad(run("site", "show", "more"))
