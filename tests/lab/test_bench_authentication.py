"""What authentic packets cost, with a made-up clock: what is timed, and that it is the session's own work."""

from __future__ import annotations

import json
from itertools import count

import pytest
from typer.testing import CliRunner

from skytether.cli.commands.lab.app import app as cli
from skytether.lab.bench.authentication import bench_authentication
from skytether.lab.bench.pair import BenchError
from skytether.wire.codec.tags import Tags


def test_each_size_is_timed_and_its_tags_are_a_part(monkeypatch: pytest.MonkeyPatch) -> None:
    ticks = count()
    checked: list[tuple[int, ...]] = []
    check = Tags.check
    monkeypatch.setattr(Tags, "check", lambda self, rows: (checked.append(rows.shape), check(self, rows))[1])
    small, large = bench_authentication(2, (100, 47_611), lambda: float(next(ticks)))
    assert (small.size, small.packets, small.n) == (100, 1, 2)
    assert small.sender_tags_us == small.receiver_tags_us == 1e6  # one reading of the clock before, one after
    assert small.sender_us > small.sender_tags_us
    assert large.packets > 47_611 // 1_472
    # The session checks each packet of a large message once, and the bench as many again by themselves.
    of_large = [shape for shape in checked if shape[1] > 1_000]
    assert sum(packets for packets, _ in of_large) == pytest.approx(2 * 2 * large.packets, abs=8)


def test_a_message_that_does_not_arrive_is_told() -> None:
    with pytest.raises(BenchError, match="message 0 of 1000000 bytes did not arrive"):
        bench_authentication(1, (1_000_000,), patience_s=0.0)


def test_the_command_prints_rows() -> None:
    done = CliRunner().invoke(cli, ["bench", "authentication", "-n", "3", "--json"])
    rows = json.loads(done.output)
    assert [row["size"] for row in rows] == [100, 47_611, 1_000_000]
    assert all(0 < row["sender_tags_us"] < row["sender_us"] for row in rows)
    assert all(0 < row["receiver_tags_us"] < row["receiver_us"] for row in rows)
