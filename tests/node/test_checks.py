"""What is looked at before a machine joins, and the sentence that is said of each."""

from __future__ import annotations

import os
import socket
import tempfile
from pathlib import Path

import pytest
from node_scene import MadeUpEngine

from skytether.node import checks
from skytether.node.calls import address_of
from skytether.node.checks import Finding, judge_address, judge_clock, judge_disk, judge_engine, judge_memory
from skytether.node.join import engine_path
from skytether.node.machine import EngineInfo, address_towards, ask_engine, describe
from skytether.node.store import NodeError, NodeStore
from skytether.node.unit import unit

ROOT = Path(__file__).parents[2]
ENGINE = EngineInfo("29.1", "1.52", "amd64", 8.0, 16_384, "/var/lib/docker")


def changed(**changes: object) -> EngineInfo:
    return EngineInfo(**{**ENGINE.__dict__, **changes})  # type: ignore[arg-type]


@pytest.mark.parametrize(
    ("finding", "words"),
    [
        (
            judge_engine(changed(version="19.03", api_version="1.40"), "amd64"),
            "the Docker engine here is too old: 19.03",
        ),
        (judge_engine(changed(api_version="old"), "amd64"), "the Docker engine here is too old"),
        (judge_engine(changed(architecture="arm64"), "amd64"), "the engine runs on arm64, this machine is amd64"),
        (judge_memory(511), "this machine has 511 MiB of memory: a site needs 512 at least"),
        (judge_disk(100, "/var/lib/docker"), "the disk of /var/lib/docker has 100 MiB left, and images need 2048"),
        (judge_clock(3600), "this machine's clock is 60 minutes behind the orchestrator's"),
        (judge_clock(-90), "this machine's clock is 90 s ahead of the orchestrator's"),
        (judge_address("0.0.0.0", named=True, orchestrator="cloud"), "robots cannot connect to 0.0.0.0"),
        (judge_address("127.0.0.1", named=False, orchestrator="cloud"), "robots elsewhere cannot connect to 127.0.0.1"),
    ],
)
def test_what_keeps_a_machine_from_joining_is_told(finding: Finding, words: str) -> None:
    assert not finding.good
    assert finding.says.startswith(words)


def test_what_is_good_enough_is() -> None:
    address = judge_address("127.0.0.1", named=True, orchestrator="127.0.0.1")
    for finding in (
        judge_engine(changed(version="20.10.24", api_version="1.41"), "amd64"),
        judge_memory(512),
        judge_disk(2048, "/"),
        judge_clock(59),
        judge_clock(-59),
        address,
    ):
        assert finding.good
        assert not finding.warning


def test_an_address_of_a_nat_is_told_of_and_taken() -> None:
    finding = judge_address("192.0.2.7", named=True, orchestrator="cloud")
    assert finding.good
    assert finding.warning
    assert "none of this machine's own" in finding.says


def test_a_disk_that_is_not_seen_is_told_of() -> None:
    assert judge_disk(None, "/far").warning


def test_an_engine_that_is_missing_or_is_none_is_told(tmp_path: Path) -> None:
    missing, found = checks.check_engine(str(tmp_path / "none.sock"))
    assert found is None
    assert missing.says.startswith(f"there is no Docker engine at {tmp_path}/none.sock: install one")
    path = Path(os.path.relpath(tmp_path / "e.sock"))  # a short one
    with socket.socket(socket.AF_UNIX) as nobody:
        nobody.bind(str(path))
    refused, _ = checks.check_engine(str(path))
    assert "does not answer (Connection refused): `systemctl status docker` says more" in refused.says
    engine = MadeUpEngine(path)
    try:
        good, found = checks.check_engine(str(path))
        assert good.good
        assert found == ask_engine(str(path))
        del engine.info["NCPU"]
        strange, _ = checks.check_engine(str(path))
        assert "is no Docker engine: its answer has no 'NCPU'" in strange.says
    finally:
        engine.stop()


def test_a_port_that_is_taken_is_named_with_what_shows_by_whom() -> None:
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as other:
        other.bind(("0.0.0.0", 0))
        port = other.getsockname()[1]
        taken = checks.check_ports((port,), None)
        assert taken.says.startswith(
            f"UDP port {port} is taken by another program: `ss -lunp 'sport = :{port}'` names it"
        )
        assert "--echo-port" in checks.check_ports((), port).says
    assert checks.check_ports((port,), None).good


def test_a_unit_wants_root_and_a_folder_that_may_be_written(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    assert checks.check_rights(tmp_path / "a" / "b", unit=False).good
    monkeypatch.setattr(os, "geteuid", lambda: 1000)
    assert "needs root: run this with sudo, or give --no-unit" in checks.check_rights(tmp_path, unit=True).says


@pytest.mark.parametrize(
    "url",
    [
        "http://cloud:8603",
        "cloud",
        "https://",
        "https://u:p@cloud",
        "https://cloud/x",
        "https://cloud:99999",
        "https://a..b",  # a resolver raises on this, and on the next one
        f"https://{64 * 'a'}.b",
        "https://ward one",
        "https://ward\x00",
    ],
)
def test_what_is_no_address_for_nodes_is_refused(url: str) -> None:
    with pytest.raises(NodeError, match="write https://HOST or https://HOST:PORT"):
        address_of(url)


def test_the_port_is_the_usual_one_unless_another_is_named() -> None:
    assert address_of("https://cloud") == ("cloud", 8603)
    assert address_of("https://[2001:db8::1]:1234/") == ("2001:db8::1", 1234)


def test_an_engine_of_another_machine_joins_there() -> None:
    assert engine_path("unix:///run/docker.sock") == "/run/docker.sock"
    with pytest.raises(NodeError, match="the engine of another machine joins there"):
        engine_path("tcp://192.0.2.7:2376")


def test_a_machine_without_an_engine_is_described_all_the_same() -> None:
    machine = describe(None, 8600)
    assert machine.cpu >= 1
    assert machine.memory_mb > 0
    assert machine.engine == ""
    assert address_towards("https://127.0.0.1") == "127.0.0.1"


def test_the_unit_of_the_documentation_is_the_one_that_is_written() -> None:
    assert (ROOT / "docs/examples/node/skytether-node.service").read_text() == unit("/opt/skytether/bin/skytether")


def test_a_unit_hides_no_home_that_it_needs() -> None:
    assert "ProtectHome=yes" in unit("/opt/skytether/bin/skytether")
    assert "ProtectHome=read-only" in unit("/home/me/.venv/bin/skytether")
    assert "ProtectHome=no" in unit("/opt/skytether/bin/skytether", engine="/run/user/1000/docker.sock")


def test_a_folder_into_which_others_may_put_another_authority_is_refused(tmp_path: Path) -> None:
    """Whoever does that is the node's orchestrator, and has its engine."""
    tmp_path.chmod(0o755)
    open_to_all = tmp_path / "open"
    open_to_all.mkdir()
    open_to_all.chmod(0o777)
    found = checks.check_rights(open_to_all / "node", unit=False)
    assert not found.good
    assert f"others may write to {open_to_all}" in found.says
    (open_to_all / "node").mkdir(mode=0o700)
    with pytest.raises(NodeError, match="is not trusted: others may replace"):
        NodeStore(open_to_all / "node").config()
    open_to_all.chmod(0o755)
    assert checks.check_rights(open_to_all / "other", unit=False).good
    with pytest.raises(NodeError, match="this machine has not joined"):
        NodeStore(open_to_all / "node").config()


@pytest.mark.skipif(os.geteuid() != 0, reason="makes a folder another user's")
def test_a_folder_that_somebody_made_where_all_may_is_not_the_nodes() -> None:
    with tempfile.TemporaryDirectory() as place:
        os.chmod(place, 0o1777)
        theirs = Path(place) / "node"
        theirs.mkdir()
        os.chown(theirs, 65_534, 65_534)
        assert "belongs to the user 65534" in checks.check_rights(theirs, unit=False).says
