"""A group of sites on the command line, against a real orchestrator that is killed in between."""

from __future__ import annotations

import json
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest
import yaml
from typer.testing import CliRunner, Result

from skytether.cli.app import app
from skytether.lab.embedded import EmbeddedOrchestrator

pytestmark = pytest.mark.slow

MANIFEST = {
    "apiVersion": "skytether.io/v1",
    "kind": "Service",
    "metadata": {"name": "toy"},
    "spec": {"entrypoint": "skytether.testing.toy_service", "needs": {"cpu": 1, "tiers": ["cloud"]}},
}
Run = Callable[..., Result]
ADD = ("group", "add", "cloud", "--provider", "local", "--grow-after-s", "0", "--idle-s", "1", "--json")


@pytest.fixture(scope="module")
def orchestrator() -> Iterator[EmbeddedOrchestrator]:
    with EmbeddedOrchestrator() as orchestrator:
        yield orchestrator


@pytest.fixture
def run(orchestrator: EmbeddedOrchestrator, monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> Run:
    monkeypatch.setenv("SKYTETHER_URL", orchestrator.url)
    monkeypatch.setenv("SKYTETHER_TOKEN", orchestrator.operator_token)
    monkeypatch.setenv("HOME", str(tmp_path))
    return lambda *arguments: CliRunner().invoke(app, list(arguments), catch_exceptions=False)


def good(result: Result) -> Any:
    assert result.exit_code == 0, result.output
    return json.loads(result.stdout) if result.stdout else None


def bad(result: Result, status: int = 1) -> str:
    assert result.exit_code == status, result.output
    (line,) = result.stderr.splitlines()
    return line.removeprefix("error: ")


def until(seen: Callable[[], Any], patience: float = 60.0) -> Any:
    deadline = time.monotonic() + patience
    while not (found := seen()):
        assert time.monotonic() < deadline
        time.sleep(0.1)
    return found


def machines(run: Run) -> dict[str, str]:
    return {one["name"]: one["stage"] for one in good(run("group", "show", "cloud", "--json"))["machines"]}


def states(run: Run) -> list[str]:
    return sorted(one["state"] for one in good(run("instance", "list", "--json")) if one["state"] != "stopped")


def test_a_queue_makes_it_grow_and_an_empty_one_shrink_whoever_is_killed(
    run: Run, orchestrator: EmbeddedOrchestrator, tmp_path: Path
) -> None:
    (tmp_path / "toy.yaml").write_text(yaml.safe_dump(MANIFEST))
    good(run("apply", "-f", str(tmp_path / "toy.yaml"), "--json"))
    added = good(run(*ADD, "--max", "2", "--cost", "3"))
    assert (added["cpu"], added["machines"], added["max"]) == (1.0, [], 2)
    assert "0 to 2" in run("group", "list").stdout
    ids = []
    for n in range(3):
        ids.append(good(run("instance", "create", "toy", "--robot", f"w{n}", "--no-wait", "--json"))["id"])
        if n == 1:
            orchestrator.kill()
            orchestrator.start()
    until(lambda: states(run) == ["pending", "running", "running"])
    there = machines(run)
    assert list(there.values()) == ["ready", "ready"]
    sites = {site["name"]: site for site in good(run("site", "list", "--json"))}
    assert [sites[name]["cost"] for name in there] == [3.0, 3.0]
    pending = next(i for i in good(run("instance", "list", "--json")) if i["state"] == "pending")
    assert "0 of 1 are free" in pending["reason"]

    first = next(i for i in ids if i != pending["id"])
    run("instance", "delete", first)
    until(lambda: states(run) == ["running", "running"])
    orchestrator.kill()
    orchestrator.start()
    assert machines(run) == there
    assert "has 2 machines" in bad(run("group", "delete", "cloud"))
    for id_ in ids:
        run("instance", "delete", id_)
    until(lambda: "draining" in machines(run).values() or len(machines(run)) < 2)
    orchestrator.kill()
    orchestrator.start()
    until(lambda: machines(run) == {})
    assert [site["name"] for site in good(run("site", "list", "--json"))] == ["local"]
    folder = orchestrator.state_dir / "groups" / "cloud"
    assert [path.name for path in folder.iterdir()] == ["machines"]
    assert list((folder / "machines").iterdir()) == []
    told = "\n".join(event["text"] for event in good(run("group", "show", "cloud", "--json"))["events"])
    assert "is given back: it was idle for" in told
    assert run("group", "delete", "cloud").exit_code == 0
    assert good(run("group", "list", "--json")) == []


def test_a_drained_group_goes_with_its_last_machine(run: Run) -> None:
    good(run(*ADD, "--max", "2", "--min", "1"))
    until(lambda: "ready" in machines(run).values())
    assert "makes no more machines" in run("group", "delete", "cloud", "--drain").stderr
    until(lambda: good(run("group", "list", "--json")) == [])
    assert [site["name"] for site in good(run("site", "list", "--json"))] == ["local"]


@pytest.mark.parametrize(
    ("given", "status", "sentence"),
    [
        (("--max", "1", "--min", "2"), 2, "min is 2 and max 1: min must not be above max"),
        (("--max", "1", "--option", "cpu"), 2, "--option cpu: write KEY=VALUE"),
        (("--max", "1", "--option", "cpus=1"), 1, "options.cpus: unknown key, did you mean 'cpu'?"),
        (("--max", "1", "--option", "runtime=podman"), 1, "options.runtime: input should be 'process' or 'docker'"),
        (("--max", "1", "--option", "options={networks: 1}"), 1, "options.networks: unknown key"),
        (("--max", "1", "--option", "options={cpu: 1}"), 1, "options.cpu is made for each machine: leave it out"),
        (("--max", "1", "--provider", "cloudy"), 1, "there is no provider 'cloudy'; installed are: local, openstack"),
        (("--max", "1", "--tier", "fog"), 2, "tier: "),
    ],
)
def test_a_bad_group_is_refused_in_a_sentence_and_nothing_is_made(
    run: Run, given: tuple[str, ...], status: int, sentence: str
) -> None:
    assert sentence in bad(run(*ADD, *given), status)
    assert good(run("group", "list", "--json")) == []
    assert "there is no group 'cloud'" in bad(run("group", "show", "cloud"))


def test_two_of_one_name_and_names_that_are_none(run: Run) -> None:
    good(run(*ADD, "--max", "1"))
    assert "there is a group 'cloud' already" in bad(run(*ADD, "--max", "1"))
    assert "name: " in bad(run("group", "add", "Cloud!", "--provider", "local", "--max", "1"), 2)
    assert run("group", "delete", "cloud").exit_code == 0


def test_one_operator_of_sites_may_not_make_machines(run: Run, monkeypatch: pytest.MonkeyPatch) -> None:
    token = good(run("token", "create", "ops", "--scope", "sites", "--scope", "read", "--json"))["token"]
    monkeypatch.setenv("SKYTETHER_TOKEN", token)
    assert "operator.token" in bad(run(*ADD, "--max", "1"))
    assert good(run("group", "list", "--json")) == []
