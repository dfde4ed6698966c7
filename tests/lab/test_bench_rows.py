"""Pure parts of the bridge's benchmark: rows, conditions, traffic, plans, schedules, queues."""

from __future__ import annotations

import dataclasses
import time

import pytest
from typer.testing import CliRunner

from skytether.cli.commands.lab.app import app as cli
from skytether.lab.bench import conditions, traffic
from skytether.lab.bench.bridge import BenchError, make_plan
from skytether.lab.bench.report import cells, markdown_table
from skytether.lab.bench.ros2_program.schedule import Order, publish
from skytether.lab.bench.rows import Carried, Notes, Row, Run, arrival_rate, make_rows, percentiles_ms
from skytether.lab.bench.suites import SUITES
from skytether.lab.bench.traffic import Flow
from skytether.lab.bench.transports import NAMES
from skytether.lab.bench.transports.queue import LatestQueue
from skytether.wire.topic import Direction

FLOWS = (Flow("up", 100, 10.0), Flow("down", 50, 10.0, Direction.OUT))


def _run(carried: Carried | None = None) -> Run:
    return Run("udp", "here", None, "tun", start=10.0, seconds=2.0, carried=carried, emulator_late_ms=0.1)


def test_messages_of_the_window_count_once_and_in_whatever_order() -> None:
    robot = Notes({0: [9.9, 10.0, 10.5, 11.9, 12.0]}, {1: [(0, 10.1, 10.3)]}, cpu_s=0.5)
    service = Notes(
        {1: [10.1, 10.2]},
        {0: [(0, 9.9, 10.0), (2, 10.5, 10.6), (1, 10.0, 10.7), (2, 10.5, 10.8), (4, 12.0, 12.1)]},
        cpu_s=0.25,
    )
    up, down = make_rows(_run(), FLOWS, robot, service)
    assert (up.sent, up.delivered) == (3, 2)  # sent at 10.0, 10.5, 11.9; the first arrival of number 2 counts
    assert (up.delay_p50_ms, up.delay_max_ms) == (100.0, 700.0)
    assert up.lost == pytest.approx(1 / 3)
    assert (down.sent, down.delivered, down.delay_p99_ms) == (2, 1, 200.0)
    assert (up.cpu_s, up.cpu_robot_s, up.cpu_service_s) == (0.75, 0.5, 0.25)


def test_overhead_is_what_the_link_carried_beyond_payload() -> None:
    robot, service = Notes({0: [10.0, 11.0]}, {1: []}, 0.0), Notes({1: [10.0]}, {0: []}, 0.0)
    rows = make_rows(_run(Carried(10.0, 12.0, bytes=300)), FLOWS, robot, service)
    assert [row.overhead for row in rows] == [0.2, 0.2]  # 300 over 2 x 100 + 50
    late = Carried(10.5, 12.5, bytes=130)  # counted on a busy machine: two messages were on the link by then
    assert make_rows(_run(late), FLOWS, robot, service)[0].overhead == 0.3
    assert make_rows(_run(), FLOWS, robot, service)[0].overhead is None


def test_nothing_delivered_has_no_delays() -> None:
    row = make_rows(_run(), FLOWS[:1], Notes({0: [10.0]}, {}, 0.0), Notes({}, {0: []}, 0.0))[0]
    assert (row.delivered, row.delay_p50_ms, row.delay_max_ms) == (0, None, None)
    assert row.lost == 1.0
    assert cells(row)[4:9] == ("100.00", "", "", "", "")


def test_nothing_sent_is_not_lost() -> None:
    row = make_rows(_run(Carried(10.0, 12.0, bytes=10)), FLOWS[:1], Notes({0: []}, {}, 0.0), Notes({}, {0: []}, 0.0))[0]
    assert (row.sent, row.lost, row.overhead) == (0, 0.0, None)


def test_percentiles_are_measured_values() -> None:
    assert percentiles_ms(i / 1000 for i in range(1, 101)) == (50.0, 95.0, 99.0, 100.0)
    assert percentiles_ms([0.002, 0.001]) == (1.0, 2.0, 2.0, 2.0)


def test_json_has_the_columns_that_are_promised() -> None:
    row = make_rows(_run(), FLOWS[:1], Notes({0: [10.0]}, {}, 0.0), Notes({}, {0: [(0, 10.0, 10.1)]}, 0.0))[0]
    promised = "transport condition topic sent delivered delay_p50_ms delay_p95_ms delay_p99_ms delay_max_ms overhead"
    assert list(row.document())[:11] == [*promised.split(), "cpu_s"]


def test_markdown_has_a_line_for_each_row() -> None:
    row = Row("tcp", "50ms-1%", "/tf", 10, 9, 1, 2, 3, 4, 0.5, 0.2, 0.1, 0.1, "bbr", "tun", 0.1, 180, 2.0)
    assert markdown_table([row]).splitlines()[2] == (
        "| 50ms-1% | tcp (bbr) | /tf | 10 | 10.00 | 1.0 | 2.0 | 3.0 | 4.0 | 50.0 | 5.0/5.0 |"
    )


def test_the_rate_of_arrival_counts_the_time_of_the_last() -> None:
    row = Row("tcp", "x", "s", 100, 90, 1, 2, 3, 1000.0, None, 0.2, 0.1, 0.1, "bbr", "none", None, 180, 2.0)
    assert arrival_rate(row) == 30.0


def test_conditions_by_name_each_once() -> None:
    found = conditions.find(["burst", "sweep", "burst", "loss-5%"])
    assert [c.name for c in found] == ["burst", *(f"loss-{p}%" for p in conditions.SWEEP)]
    assert found[0].link.burst == 4
    assert conditions.find(["private"])[0].link.jitter_reorders
    ordered = conditions.find(["private-ordered"])[0].link
    assert (ordered.jitter_reorders, ordered.jitter) == (False, 0.024)


def test_an_unknown_name_lists_the_known() -> None:
    with pytest.raises(ValueError, match=r"condition 'nice' is not known; choose from ideal, 50ms-1%.*, sweep"):
        conditions.find(["nice"])
    with pytest.raises(ValueError, match="suite 'all' is not known; choose from table2, fig26"):
        make_plan("all")
    with pytest.raises(ValueError, match="transport 'tpc' is not known; choose from skytether, udp, tcp"):
        make_plan("table2", transport=["udp", "tpc"])
    with pytest.raises(ValueError, match="emulator 'netem' is not known; choose from auto, tun, user"):
        make_plan("table2", emulator="netem")
    with pytest.raises(ValueError, match="suite 'saturated' has its own link"):
        make_plan("saturated", condition=["burst"])


def test_help_names_everything_that_may_be_chosen_and_every_field() -> None:
    shown = CliRunner().invoke(cli, ["bench", "bridge", "--help"], env={"COLUMNS": "200"}).output
    words = set(shown.replace(",", " ").replace(".", " ").replace(":", " ").replace(";", " ").replace(")", " ").split())
    sweep = [c.name for c in conditions.find(["sweep"])]
    fields = [field.name for field in dataclasses.fields(Row)]
    assert words >= {*SUITES, *NAMES, *conditions.NAMES, *sweep, *fields}


def test_tcp_is_left_out_in_user_space_and_said_so() -> None:
    plan = make_plan("table2", transport=["skytether", "tcp"], emulator="user")
    assert plan.setup.transports == ("skytether",)
    assert any(note.startswith("tcp is left out: it is carried by TCP") for note in plan.notes)


def test_a_suite_on_loopback_takes_tcp_and_has_no_link() -> None:
    plan = make_plan("latency", transport=["tcp"], emulator="user")
    assert (plan.setup.transports, plan.setup.emulator, plan.setup.conditions) == (("tcp",), "none", ())


def test_congestion_control_of_loopback_is_the_machine_s() -> None:
    assert make_plan("latency", transport=["tcp"]).setup.congestion
    with pytest.raises(BenchError, match="congestion control 'fast' needs the TUN emulator"):
        make_plan("latency", transport=["tcp"], congestion="fast")


def test_all_transports_are_compared_by_default() -> None:
    assert SUITES["table2"].transports == NAMES


def test_table2_is_the_thesis_s() -> None:
    rows = {f.name: (f.size, round(1000 / f.hz), f.rank) for f in traffic.TABLE2}
    assert rows["camera"] == (47_611, 66, 2)
    assert rows["/RosAria/laserscan"] == (2_284, 120, 5)
    # camera 5.771, /scan 0.178, front scan 0.152, /tf 0.144, pose 0.060, sonar 0.022, commands 0.006 Mbit/s
    assert sum(f.size * f.hz * 8 for f in traffic.TABLE2) / 1e6 == pytest.approx(6.333, abs=0.001)
    assert [f.rank for f in traffic.camera_last(traffic.TABLE2)] == [1, 7, 3, 4, 5, 6, 1]


def test_figure_26_divides_the_rate_among_topics() -> None:
    assert (traffic.SIZES_KB[0], traffic.SIZES_KB[5], traffic.SIZES_KB[-1]) == (1.0, 13.5, 16.0)
    assert (len(traffic.RATES_HZ), traffic.RATES_HZ[-1]) == (7, 200.0)
    flows = traffic.fig26(5, 16.0, 200.0)
    assert [(f.size, f.hz) for f in flows] == [(16_384, 40.0)] * 5


def test_a_message_without_room_for_its_time_is_refused() -> None:
    with pytest.raises(ValueError, match="x: a message needs at least 16 bytes, not 8"):
        Flow("x", 8, 1.0)


def test_publisher_keeps_the_schedule_and_the_end() -> None:
    begin = time.monotonic()
    order = Order((Flow("a", 100, 200.0), Flow("b", 50, 100.0)), begin, begin + 0.05, begin + 0.2)
    messages: list[tuple[int, bytes]] = []
    started: list[float] = []
    sent = publish(
        order, (0, 1), lambda index, data: messages.append((index, data)), lambda: started.append(time.monotonic())
    )
    assert len(started) == 1
    assert started[0] >= order.start
    # 0 and 5 ms apart from the beginning on; a machine that stalls may leave out what would come after the end
    assert 20 <= len(sent[0]) <= 40
    assert 10 <= len(sent[1]) <= 20
    assert all(sent[0][i] >= begin + i / 200 for i in range(len(sent[0])))
    assert len(messages) == len(sent[0]) + len(sent[1])
    assert {len(data) for index, data in messages if index == 1} == {50}


def test_queue_drops_the_oldest_and_serves_the_most_important() -> None:
    queue = LatestQueue({3: (2, 2), 8: (1, 1)})
    for payload in (b"a", b"b", b"c"):
        queue.put(3, payload)
    queue.put(8, b"x")
    assert [queue.get() for _ in range(3)] == [(8, b"x"), (3, b"b"), (3, b"c")]
    queue.put(3, b"late")
    queue.close()
    assert queue.get() is None
