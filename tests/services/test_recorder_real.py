"""The recorder on a real recording: what goes in comes out, byte for byte."""

from __future__ import annotations

from pathlib import Path

import pytest
from mcap.reader import make_reader
from rosbags.rosbag1 import Reader

from skytether.messages import LaserScan, decode
from skytether.testing.service import Harness
from skytether.wire.topic import Direction, Topic
from skytether_services.recorder.service import Recorder


@pytest.mark.data
def test_every_recorded_scan_comes_out_identical(data_dir: Path, tmp_path: Path) -> None:
    with Reader(data_dir / "legs" / "stationary_simple.bag") as bag:
        scans = [bytes(data) for _, _, data in bag.messages()]
    assert len(scans) == 1265

    harness = Harness(Recorder, data_dir=tmp_path)
    harness.connect(Topic("/scan", LaserScan.TYPE, Direction.IN, encoding="ros1"))
    for number, scan in enumerate(scans):
        harness.send("/scan", scan)
        if number % 10 == 0:
            harness.step()
    harness.step()
    harness.stop()

    (path,) = tmp_path.iterdir()
    with path.open("rb") as stream:
        messages = [message for _, _, message in make_reader(stream, validate_crcs=True).iter_messages()]
    assert [message.data for message in messages] == scans
    assert decode(LaserScan, messages[-1].data, "ros1").header.seq == 11565
