"""The bridge's benchmark for real, for a second: processes, emulators, every transport that is installed."""

from __future__ import annotations

import json
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import pytest

from skytether.emulator.link_model import LinkConditions
from skytether.lab.bench import conditions
from skytether.lab.bench.pair import BenchError, Pair
from skytether.lab.bench.traffic import COMMANDS, TABLE2, fig26
from skytether.lab.bench.transports import NAMES, load
from skytether.lab.bench.transports.base import TransportError

pytestmark = pytest.mark.slow

BASE = ("skytether", "udp")


def _skip_missing(name: str) -> None:
    try:
        load(name)
    except TransportError as error:
        pytest.skip(str(error))


@pytest.mark.parametrize("name", BASE)
def test_user_space_emulator_delays_and_counts(name: str) -> None:
    link = LinkConditions(delay=0.02)
    with Pair(name, COMMANDS, condition="20ms", link=link, emulator="user", congestion="reno") as pair:
        rows = pair.measure(0.5, warm_up=0.2)
    for row in rows:
        assert 20 <= row.sent <= 25
        assert row.delivered == row.sent
        assert row.delay_p50_ms is not None
        assert row.delay_p50_ms >= 20
        assert row.overhead is not None
        # Headers of IP and UDP at least; a message at an end of the interval may enter the link just outside of it.
        assert row.overhead >= 28 / 80 - 2 * (108 / 80) / 40
        assert (row.emulator, row.congestion) == ("user", None)


@pytest.mark.parametrize("name", [n for n in NAMES if not n.startswith(("ros2", "cyclone"))])
def test_every_transport_carries_the_traffic_between_namespaces(name: str, netns: None) -> None:
    _skip_missing(name)
    ideal = conditions.find(["ideal"])[0]
    with Pair(name, TABLE2, condition="ideal", link=ideal.link, emulator="tun", congestion="reno") as pair:
        for _ in range(5):
            rows = pair.measure(1.0, warm_up=0.3)
            if all(row.delivered for row in rows):  # on a busy machine some leave a second to what ranks higher
                break
    assert [row.topic for row in rows] == [flow.name for flow in TABLE2]
    for row in rows:
        assert row.sent > 0
        assert row.delivered > 0  # how many is what the benchmark measures
    assert rows[0].overhead is not None
    sent, delivered = sum(row.sent * row.size for row in rows), sum(row.delivered * row.size for row in rows)
    assert (1 + rows[0].overhead) * sent > delivered  # what was dropped before it got to the link was not carried
    assert rows[0].congestion == ("reno" if load(name).TCP else None)


@pytest.mark.parametrize("name", ["skytether", "tcp", "zenoh-tcp"])
def test_traffic_of_one_direction_connects_too(name: str) -> None:
    _skip_missing(name)
    with Pair(name, fig26(2, 1.0, 100.0), condition="loopback", link=None, emulator="user", congestion="reno") as pair:
        rows = pair.measure(0.3, warm_up=0.1)
    assert all(row.delivered == row.sent > 0 for row in rows)


def test_the_same_ends_measure_other_traffic() -> None:
    with Pair("udp", COMMANDS, condition="loopback", link=None, emulator="user", congestion="reno") as pair:
        first = pair.measure(0.3, warm_up=0.1)
        second = pair.measure(
            0.3, flows=tuple(replace(flow, size=500) for flow in COMMANDS), condition="again", warm_up=0.1
        )
    assert {row.condition for row in first} == {"loopback"}
    assert {row.condition for row in second} == {"again"}
    assert all(row.delivered == row.sent > 0 for row in (*first, *second))
    assert ({row.size for row in first}, {row.size for row in second}) == ({80}, {500})
    assert {row.emulator for row in first} == {"none"}


def test_what_the_emulator_s_process_cannot_do_is_a_sentence(netns: None) -> None:
    with pytest.raises(BenchError, match=r"udp, here: sysctl net\.ipv4\.tcp_congestion_control=fast failed"):
        Pair("udp", COMMANDS, condition="here", link=LinkConditions(), emulator="tun", congestion="fast")


def test_what_an_end_cannot_do_is_a_sentence() -> None:
    with pytest.raises(BenchError, match=r"skytether, loopback: .*'no_such_setting'"):
        Pair(
            "skytether",
            COMMANDS,
            condition="loopback",
            link=None,
            emulator="user",
            congestion="reno",
            options={"no_such_setting": 1},
        )


def test_command_prints_rows_and_writes_a_report(tmp_path: Path) -> None:
    command = "lab bench bridge --transport udp --condition ideal --seconds 0.5 --emulator user --json --output"
    done = subprocess.run(
        [sys.executable, "-m", "skytether.cli", *command.split(), str(tmp_path)],
        capture_output=True,
        text=True,
        check=True,
        timeout=60,
    )
    rows = json.loads(done.stdout)
    assert [row["topic"] for row in rows] == [flow.name for flow in TABLE2]
    assert rows == json.loads((tmp_path / "rows.json").read_text())
    report = (tmp_path / "report.md").read_text()
    assert "| ideal | udp | /cmd_vel |" in report
    assert "![ideal](ideal.png)" in report
    assert (tmp_path / "ideal.png").read_bytes().startswith(b"\x89PNG")
