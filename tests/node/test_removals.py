"""A real engine removes files of volumes when nobody runs any more who may have a folder of them."""

from __future__ import annotations

import json
import secrets
import tempfile
from http import HTTPStatus
from pathlib import Path

import pytest
from gated_engine import ENGINE, Gated, gate_at, gated

from skytether.node.machine import ask

__all__ = ["gated"]
pytestmark = [pytest.mark.docker, pytest.mark.slow]


def test_files_are_removed_when_nobody_runs_who_may_have_a_folder_of_them(gated: Gated) -> None:
    # It looks back first: what others run at this engine meets nothing that is made here.
    assert gated.ask(f"DELETE /volumes/{secrets.token_hex(32)}").status == HTTPStatus.NOT_FOUND
    gated.network()
    shared = f"{gated.name}-shared"
    assert gated.ask("POST /volumes/create", {"Name": shared, "Labels": gated.labels}).status == HTTPStatus.CREATED
    one, own = gated.make(shared)
    other, others = gated.make(shared)
    alone, apart = gated.make()
    assert gated.ask(f"DELETE /containers/{alone}?v=1&force=1").status == HTTPStatus.NO_CONTENT
    assert not gated.has(apart)
    assert gated.ask(f"DELETE /containers/{one}?v=1&force=1").status == HTTPStatus.NO_CONTENT
    assert ask(ENGINE, f"/containers/{one}/json").status == HTTPStatus.NOT_FOUND
    assert gated.has(own)
    refused = gated.ask(f"DELETE /volumes/{own}")
    assert (refused.status, b"volume is in use" in refused.content) == (HTTPStatus.CONFLICT, True)
    assert gated.has(own)
    assert gated.ask(f"POST /containers/{other}/kill?signal=KILL").status == HTTPStatus.NO_CONTENT
    assert gated.ask(f"POST /containers/{other}/wait").status == HTTPStatus.OK
    assert gated.ask(f"DELETE /volumes/{own}").status == HTTPStatus.NO_CONTENT
    assert not gated.has(own)
    assert gated.ask(f"DELETE /containers/{other}?v=1").status == HTTPStatus.NO_CONTENT
    assert not gated.has(others)


def test_whose_network_another_one_joins_goes_on_after_that(gated: Gated) -> None:
    """It is paused meanwhile."""
    gated.network()
    holds, _ = gated.make()
    joins, _ = gated.make(network=f"container:{holds}")
    states = [json.loads(gated.ask(f"GET /containers/{one}/json").content)["State"] for one in (holds, joins)]
    assert [state["Status"] for state in states] == ["running", "running"]
    assert gated.ask(f"POST /containers/{holds}/kill?signal=KILL").status == HTTPStatus.NO_CONTENT
    assert gated.ask(f"DELETE /containers/{joins}?force=1").status == HTTPStatus.NO_CONTENT


def test_who_starts_after_a_restart_of_the_node_by_what_was_asked_before_it_has_kin(gated: Gated) -> None:
    """That start waited at the engine, which said meanwhile that nothing runs; files of the machine were removed."""
    gated.network()
    shared = f"{gated.name}-shared"
    assert gated.ask("POST /volumes/create", {"Name": shared, "Labels": gated.labels}).status == HTTPStatus.CREATED
    late, own = gated.make(shared, starts=False)
    with tempfile.TemporaryDirectory(prefix="sky-") as folder, gate_at(str(Path(folder) / "gate.sock")):
        again = Gated(str(Path(folder) / "gate.sock"), gated.name)
        assert again.ask(f"DELETE /volumes/{secrets.token_hex(32)}").status == HTTPStatus.NOT_FOUND  # it looks back
        assert ask(ENGINE, f"/v1.41/containers/{late}/start", method="POST").status == HTTPStatus.NO_CONTENT
        holds, _ = again.make(shared)
        assert again.ask(f"DELETE /containers/{late}?v=1&force=1").status == HTTPStatus.NO_CONTENT
        assert again.ask(f"DELETE /volumes/{own}").status == HTTPStatus.CONFLICT
        assert again.has(own)
        assert again.ask(f"DELETE /containers/{holds}?force=1").status == HTTPStatus.NO_CONTENT
        assert again.ask(f"DELETE /volumes/{own}").status == HTTPStatus.NO_CONTENT
