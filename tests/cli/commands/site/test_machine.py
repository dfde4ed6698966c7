"""``skytether site invite, join, run, leave, drain, resume, remove``: real programs over a made-up engine."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import tempfile
from collections.abc import Iterator
from pathlib import Path

import pytest
from node_scene import MadeUpEngine, until
from orchestrator_program import Program
from typer.testing import CliRunner

from skytether.cli.app import app

pytestmark = pytest.mark.slow
ANSWERS = ("ready", "blocked")
"""What is made up runs no containers, as the runtime finds out a moment later."""
SKYTETHER = [sys.executable, "-m", "skytether.cli"]


@pytest.fixture
def orchestrator(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Program]:
    (tmp_path / "one").mkdir()
    program = Program(tmp_path / "one" / "state")
    program.environment = {"SKYTETHER_NODES_PORT": "0", "SKYTETHER_LOCAL_SITE": "false"}
    with program.start():
        monkeypatch.setenv("SKYTETHER_URL", (program.folder / "address").read_text().strip())
    monkeypatch.setenv("SKYTETHER_TOKEN_FILE", str(program.folder / "operator.token"))
    yield program
    program.clean_up()


def run(*words: str, given: str = "") -> subprocess.CompletedProcess[str]:
    return subprocess.run([*SKYTETHER, *words], input=given, capture_output=True, text=True, timeout=120)


def test_a_machine_joins_runs_leaves_and_joins_again(orchestrator: Program, tmp_path: Path) -> None:
    url = (orchestrator.folder / "nodes.address").read_text().strip()
    invited = run("site", "invite", "ward", "--valid", "10m", "--tier", "cloud")
    assert invited.returncode == 0, invited.stderr
    token = invited.stdout.strip()
    assert f"skytether site join https://ORCHESTRATOR:{url.rpartition(':')[2]} --token-file -" in invited.stderr
    assert token.startswith("sky-")
    assert token not in invited.stderr
    with tempfile.TemporaryDirectory(prefix="sky-") as short:
        engine = MadeUpEngine(Path(short) / "e.sock", Architecture=os.uname().machine)
        folder = tmp_path / "node"
        common = [url, "--token-file", "-", "--engine", f"unix://{engine.path}", "--folder", str(folder), "--no-unit"]
        try:
            joined = run("site", "join", *common, "--advertise", "127.0.0.1", "--echo-port", "0", "--json", given=token)
            assert joined.returncode == 0, joined.stderr
            document = json.loads(joined.stdout)
            assert document["name"] == "ward"
            assert document["state"] in ANSWERS
            node = subprocess.Popen([*SKYTETHER, "site", "run", "--folder", str(folder)], stderr=subprocess.PIPE)
            try:
                shown = json.loads(run("site", "show", "ward", "--json").stdout)
                assert (shown["tier"], shown["node"]["engine"]) == ("cloud", "29.1")
                until(lambda: json.loads(run("site", "show", "ward", "--json").stdout)["state"] in ANSWERS)
                again = run("site", "join", *common, given=token)
                assert (again.returncode, "is the site 'ward' already" in again.stderr) == (1, True)
                assert run("site", "drain", "ward").returncode == 0
                assert "takes instances again" in run("site", "resume", "ward", "--no-wait").stderr
                left = run("site", "leave", "--folder", str(folder))
                assert (left.returncode, left.stderr) == (0, "this machine is no site any more\n")
            finally:
                node.send_signal(signal.SIGTERM)
                assert node.wait(60) == 130
                assert node.stderr is not None
                said = node.stderr.read().decode()
                node.stderr.close()
            assert "linked with https://127.0.0.1" in said
            assert "Traceback" not in said
        finally:
            engine.stop()
    assert not folder.exists()
    assert json.loads(run("site", "list", "--json").stdout) == []
    # And from the other side.
    removed = run("site", "remove", "ward")
    assert (removed.returncode, "there is no site 'ward'" in removed.stderr) == (1, True)


def test_two_orchestrators_with_different_keys_of_nodes_do_not_both_start(
    orchestrator: Program, tmp_path: Path
) -> None:
    """Over one database; here one that comes back without its key."""
    orchestrator.end()
    (orchestrator.folder / "nodes.key").unlink()
    (orchestrator.folder.parent / "log").write_text("")
    status, line = orchestrator.fails()
    assert status == 1
    assert "belongs to orchestrators with another nodes.key" in line


@pytest.mark.parametrize(
    ("words", "says"),
    [
        (["site", "invite", "ward", "--valid", "2d"], "write 90s, 30m or 1h; 24h at most"),
        (["site", "invite", "ward", "--tier", "moon"], "tier"),
        (["site", "join", "https://cloud"], "give the join token with --token-file"),
        (
            ["site", "join", "https://cloud", "--token", "x", "--token-file", "y"],
            "give the join token with --token-file",
        ),
        (["site", "join", "https://cloud", "--token-file", "/none"], "cannot read the token file /none"),
        (["site", "join", "https://cloud", "--token", "x", "--ports", "5-1"], "write FIRST-LAST"),
        (["site", "join", "https://cloud", "--token", "x", "--device", "/etc"], "write the path of a device"),
        (["site", "join", "https://cloud", "--token", "x", "--registry", "a/b"], "write HOST or HOST:PORT"),
    ],
)
def test_wrong_usage_is_told(words: list[str], says: str) -> None:
    done = CliRunner().invoke(app, words)
    assert done.exit_code == 2
    assert says in done.output


def test_what_is_no_token_and_no_folder_is_told(tmp_path: Path) -> None:
    joined = CliRunner().invoke(app, ["site", "join", "https://cloud", "--token", "x", "--folder", str(tmp_path / "n")])
    assert joined.exit_code == 1
    assert "all users of this machine could read the token" in joined.output
    assert "this is no join token" in joined.output
    for words in (["site", "run"], ["site", "leave"]):
        done = CliRunner().invoke(app, [*words, "--folder", str(tmp_path / "n")])
        assert done.exit_code == 1
        assert "this machine has not joined" in done.output
