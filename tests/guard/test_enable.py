"""The enable signal: changes while all is well, and never for longer than braking takes when it is not."""

import os
import socket
import struct

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from skytether.guard.enable import Enable, GpioLine, Power, WriterLine, open_line
from skytether.guard.protocol import pack_enable, unpack_beat, unpack_enable
from skytether.guard.wheels import WriterWheels

TURN, BRAKING, AFTER = 0.02, 0.4, 0.3


class Pin:
    """Remembers its levels; fails while it is told to."""

    def __init__(self) -> None:
        self.levels: list[bool] = []
        self.error: OSError | None = None

    def write(self, high: bool) -> None:
        if self.error is not None:
            raise self.error
        self.levels.append(high)

    def close(self) -> None:
        """Nothing is open."""


turns = st.lists(
    st.tuples(
        st.booleans(), st.booleans(), st.booleans(), st.integers(1, 60), st.sampled_from([TURN, TURN, 0.5, -1.0])
    ),
    max_size=20,
)


@settings(max_examples=100, deadline=None)
@given(turns)
def test_it_changes_only_while_all_is_well_or_the_robot_brakes(sequence):
    power, now, wrong_at, cut = Power(BRAKING, AFTER), 10.0, None, True
    for well, told, stands, count, dt in sequence:
        for _ in range(count):
            now += dt
            on = power.update(now, well=well, told=told, stands=stands)
            if well and told:
                wrong_at, cut = None, False
                assert on
                continue
            wrong_at = now if wrong_at is None else wrong_at
            assert not (on and not told)  # wheels that hear nothing cannot brake
            assert not (on and cut)  # what was cut stays so until all is well
            assert not (on and now - wrong_at > BRAKING + AFTER)
            cut = not on


def test_a_stop_brakes_with_power_and_then_takes_it_away():
    power = Power(BRAKING, AFTER)
    assert power.update(1.0, well=True, told=True, stands=False)
    assert power.update(1.1, well=False, told=True, stands=False)  # it brakes
    assert power.update(1.3, well=False, told=True, stands=True)  # it is told to stand
    assert power.update(1.59, well=False, told=True, stands=True)
    assert not power.update(1.61, well=False, told=True, stands=True)  # 0.3 s later
    assert power.update(1.7, well=True, told=True, stands=True)  # a reset: all is well


def test_what_does_not_come_to_a_standstill_in_time_is_cut():
    power = Power(BRAKING, AFTER)
    power.update(1.0, well=True, told=True, stands=False)
    assert power.update(1.01, well=False, told=True, stands=False)
    assert power.update(1.7, well=False, told=True, stands=False)
    assert not power.update(1.72, well=False, told=True, stands=False)


def test_it_never_was_well_so_it_never_changes():
    power = Power(BRAKING, AFTER)
    assert not power.update(1.0, well=False, told=True, stands=True)
    assert not power.update(1.0, well=True, told=False, stands=True)


def test_every_turn_is_an_edge_and_it_ends_low():
    pin = Pin()
    enable = Enable(lambda: pin, Power(BRAKING, 0.0))
    for k in range(5):
        enable.turn(1.0 + k * TURN, well=True, told=True, stands=True)
    assert (pin.levels, enable.on) == ([True, False, True, False, True], True)
    for k in range(20):
        enable.turn(1.1 + k * TURN, well=False, told=True, stands=True)
    assert (pin.levels[5:], enable.on) == ([False], False)


def test_a_line_that_is_not_there_is_tried_again_and_named():
    pin, tried = Pin(), []

    def opened() -> Pin:
        tried.append(1)
        if len(tried) < 3:
            raise FileNotFoundError(2, "No such file or directory")
        return pin

    enable = Enable(opened, Power(BRAKING, AFTER))
    for k in range(120):
        enable.turn(1.0 + k * TURN, well=True, told=True, stands=True)
        if k == 50:
            assert "cannot be had: No such file" in enable.trouble
            assert not enable.on
    assert len(tried) == 3
    assert (enable.on, enable.trouble) == (True, "")
    pin.error = OSError(19, "No such device")
    enable.turn(9.0, well=True, told=True, stands=True)
    assert not enable.on
    assert "cannot be set: No such device" in enable.trouble


def test_a_file_and_a_pipe_take_digits(tmp_path):
    value, pipe = tmp_path / "value", tmp_path / "pipe"
    value.touch()
    with pytest.raises(OSError, match="is a regular file"):  # a disk may hold up who writes to it
        open_line(["file", str(value)])
    line = open_line(["file-on-disk", str(value)])
    line.write(True)
    assert value.read_text() == "1\n"
    line.write(False)
    assert value.read_text() == "0\n"
    line.close()
    os.mkfifo(pipe)
    with pytest.raises(OSError, match="No such device"):
        open_line(["file", str(pipe)])  # nobody reads
    reader = os.open(pipe, os.O_RDONLY | os.O_NONBLOCK)
    line = open_line(["file", str(pipe)])
    for high in (True, False, True):
        line.write(high)
    assert os.read(reader, 64) == b"1\n0\n1\n"
    enable = Enable(lambda: line, Power(BRAKING, AFTER))
    for k in range(100_000):  # nobody takes it any more: it never waits
        enable.turn(1.0 + k * TURN, well=True, told=True, stands=True)
        if enable.trouble:
            break
    assert "nobody takes it" in enable.trouble
    os.close(reader)
    line.close()


def test_a_topic_without_a_writer_is_no_line_and_raises_nothing_in_the_loop():
    enable = Enable(lambda: open_line(["topic"]), Power(BRAKING, AFTER))
    enable.turn(1.0, well=True, told=True, stands=True)
    assert (enable.on, enable.trouble) == (False, "the enable signal's line cannot be had: there is no line 'topic'")


def test_a_datagram_is_a_bool(tmp_path):
    path = str(tmp_path / "power.sock")
    line = open_line(["unix", path])
    with pytest.raises(OSError, match="No such file"):
        line.write(True)
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as power:
        power.bind(path)
        line.write(True)
        line.write(False)
        assert [power.recv(64), power.recv(64)] == [b"\0\1\0\0\1", b"\0\1\0\0\0"]
    line.close()


def test_a_gpio_line_is_asked_for_as_output_and_set(tmp_path):
    """The layout is that of linux/gpio.h, version 2: 64 offsets, 32 bytes of name, 272 of configuration."""
    asked = []

    def ioctl(file: int, request: int, data: bytearray) -> int:
        asked.append((file, request, bytes(data)))
        if request == 0xC250B407:
            data[588:592] = struct.pack("=i", 77)
        return 0

    chip = tmp_path / "gpiochip0"
    chip.touch()
    line = GpioLine(str(chip), 17, ioctl)
    line.write(True)
    line.write(False)
    _, _, request = asked[0]
    assert len(request) == 592
    assert struct.unpack_from("=I", request, 0) == (17,)
    assert request[256:272] == b"skytether enable"
    assert struct.unpack_from("=QI", request, 288) == (1 << 3, 0)  # an output, no attributes
    assert struct.unpack_from("=I", request, 560) == (1,)  # one line
    assert asked[1:] == [(77, 0xC010B40F, struct.pack("=QQ", 1, 1)), (77, 0xC010B40F, struct.pack("=QQ", 0, 1))]


def test_the_writer_is_told_each_change():
    ours, theirs = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
    with ours, theirs:
        WriterLine(WriterWheels(ours)).write(True)
        data = theirs.recv(64)
    assert unpack_enable(data) is True
    assert unpack_enable(pack_enable(high=False)) is False
    assert unpack_beat(data) is None
    assert unpack_enable(b"") is None
    with pytest.raises(OSError, match="writer is not there"):
        WriterLine(WriterWheels()).write(True)
