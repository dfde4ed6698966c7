"""The emergency stop on disk: whatever is found there, only a whole release of this boot releases."""

import os
import time

import pytest
from hypothesis import given
from hypothesis import strategies as st

from skytether.guard.estop import SIZE, EstopFile, KeptEstop, clean, decode, encode, lasting_file
from skytether.guard.protocol import FIRST_ACT

BOOT = "7f0c"


@pytest.mark.parametrize(
    "reason", ["released", "stopped", "released\n7f0c\n", "\udcff\udc00", "x" * 9999, "a\nb", "ö" * 300]
)
def test_no_reason_looks_like_a_release(reason):
    kept = encode(reason, BOOT)
    assert len(kept) == SIZE
    assert decode(kept, BOOT) != ""
    assert clean(reason)[:5] in decode(kept, BOOT)


def test_a_release_holds_for_its_boot_only():
    assert decode(encode("", BOOT), BOOT) == ""
    assert decode(encode("", BOOT), "another") == FIRST_ACT
    assert decode(encode("", ""), "") == FIRST_ACT
    assert decode(None, BOOT) == FIRST_ACT


@given(st.integers(0, SIZE - 1))
def test_a_torn_file_is_stopped(size):
    assert decode(encode("", BOOT)[:size], BOOT) != ""


@given(st.binary(max_size=600))
def test_any_other_file_is_stopped(data):
    assert decode(data, BOOT) != ""


def test_a_reason_is_said_once_to_be_from_before():
    once = decode(encode("somebody fell", BOOT), BOOT)
    assert once == "somebody fell (before the guard was started again)"
    assert decode(encode(once, BOOT), BOOT) == once
    assert decode(encode(FIRST_ACT, BOOT), BOOT) == FIRST_ACT


@given(st.text())
def test_a_reason_is_one_line(reason):
    assert all(c.isprintable() for c in clean(reason))
    assert len(clean(reason).encode()) <= 200


def wait(condition):
    """Threads write when they may."""
    end = time.monotonic() + 30
    while not condition():
        assert time.monotonic() < end
        time.sleep(0.001)


def test_a_pipe_in_the_place_of_the_file_holds_up_nothing(tmp_path):
    path = tmp_path / "latch"
    os.mkfifo(path)
    keeper = EstopFile(str(path), BOOT, pytest.fail)
    latch = KeptEstop(keeper)
    assert "cannot be read" in latch.reason
    keeper.start()
    wait(lambda: latch.kept)
    assert not path.exists()


def test_acknowledged_is_kept(tmp_path):
    path = str(tmp_path / "latch")
    keeper = EstopFile(path, BOOT, pytest.fail)
    latch = KeptEstop(keeper)
    assert latch.reason == FIRST_ACT
    assert not latch.stop(FIRST_ACT)
    assert not latch.kept
    keeper.start()
    wait(lambda: latch.kept)
    assert not latch.reset(latch.generation - 1)  # somebody who knows another stop
    assert latch.reset(latch.generation)
    wait(lambda: latch.kept)
    assert EstopFile(path, BOOT, pytest.fail).before() == ""
    assert latch.stop("released")
    assert not latch.stop("the first reason is kept")
    wait(lambda: latch.kept)
    assert EstopFile(path, BOOT, pytest.fail).before() == "released (before the guard was started again)"


def test_what_somebody_asks_for_goes_before_the_first_act(tmp_path):
    """Who resets a machine that was just started, `robot run` say, does not reset what a person stopped it for."""
    latch = KeptEstop(EstopFile(str(tmp_path / "latch"), BOOT, pytest.fail))
    before = latch.generation
    assert latch.stop("somebody fell")
    assert latch.reason == "somebody fell"
    assert not latch.reset(before)


def test_what_cannot_be_kept_is_said(tmp_path):
    folder = tmp_path / "latch"
    folder.mkdir()
    told = []
    keeper = EstopFile(str(folder), BOOT, told.append)
    latch = KeptEstop(keeper)
    assert "cannot be read" in latch.reason
    keeper.start()
    wait(lambda: bool(told))
    assert "directory" in told[0]
    assert not latch.kept
    assert "directory" in latch.unkept


def test_what_could_not_be_kept_is_tried_again_when_somebody_asks_again(tmp_path):
    folder = tmp_path / "latch"
    folder.mkdir()
    keeper = EstopFile(str(folder), BOOT, lambda why: None)
    latch = KeptEstop(keeper)
    keeper.start()
    wait(lambda: bool(latch.unkept))
    folder.rmdir()
    assert not latch.stop("somebody fell")
    latch.renew()
    wait(lambda: latch.kept)


def test_where_nothing_can_be_written_a_release_is_taken_away(tmp_path, monkeypatch):
    path = tmp_path / "latch"
    path.write_bytes(encode("", BOOT))
    keeper = EstopFile(str(path), BOOT, lambda why: 1 / 0)  # nothing ends the thread
    latch = KeptEstop(keeper)
    assert latch.reason == ""

    def full(*_):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(os, "pwrite", full)
    keeper.start()
    latch.stop("somebody fell")
    wait(lambda: latch.kept)
    assert EstopFile(str(path), BOOT, pytest.fail).before() == FIRST_ACT


def test_a_stop_of_a_robot_that_is_stopped_outlives_a_reset_that_was_asked_for_before(tmp_path):
    keeper = EstopFile(str(tmp_path / "latch"), BOOT, pytest.fail)
    latch = KeptEstop(keeper)
    keeper.start()
    latch.stop("somebody fell")
    wait(lambda: latch.kept)
    known = latch.generation
    assert not latch.stop("and another one")
    latch.renew()
    assert latch.kept  # the same is on disk
    assert not latch.reset(known)
    assert latch.reset(latch.generation)


@pytest.mark.skipif(os.geteuid() != 0, reason="needs root, to be another user too")
def test_what_another_user_has_put_there_releases_nothing_and_keeps_nothing(tmp_path):
    """A group may make files in a folder with the sticky bit."""
    path = tmp_path / "latch"
    path.write_bytes(encode("", BOOT))
    os.chown(path, 54_321, -1)
    keeper = EstopFile(str(path), BOOT, pytest.fail)
    assert "no file of this user" in keeper.before()
    keeper.start()
    keeper.keep(1, "somebody fell")
    wait(lambda: keeper.kept.done == 1)
    assert not path.exists()  # root may remove it; a file that is not there is a stop


def test_a_stop_outlives_a_reboot_that_empties_the_folder(tmp_path):
    path, lasting = tmp_path / "run" / "latch", lasting_file(str(tmp_path / "run"), str(tmp_path / "lib" / "record"))
    path.parent.mkdir()

    keepers = {}

    def boot(name):
        keepers[name] = EstopFile(str(path), name, pytest.fail, lasting)
        return KeptEstop(keepers[name])

    def say(name, latch, act):
        keepers[name].start()
        act(latch)
        wait(lambda: latch.kept)
        path.unlink()

    first = boot("first")
    assert first.reason == FIRST_ACT
    say("first", first, lambda latch: latch.stop("somebody fell"))
    second = boot("second")
    assert second.reason == "somebody fell (before the guard was started again)"
    say("second", second, lambda latch: latch.reset(latch.generation))
    assert boot("third").reason == FIRST_ACT, "a machine that was started is reset by a person"


def test_the_second_file_is_beside_the_record_and_stops_only(tmp_path):
    assert lasting_file("/run/skytether", "/run/skytether/record") == ""
    lasting = lasting_file("/run/skytether", "/var/lib/skytether/safety-record")
    assert lasting == "/var/lib/skytether/safety-record-latch"
    first, second = tmp_path / "latch", tmp_path / "record-latch"
    for one, other, reason in [
        (encode("", BOOT), None, ""),
        (encode("", BOOT), encode(FIRST_ACT, "another"), ""),
        (encode("", BOOT), encode("it fell", "another"), "it fell"),
        (encode("it fell", BOOT), encode("", BOOT), "it fell"),
        (None, encode("", BOOT), FIRST_ACT),
        (None, b"nonsense", "cannot be read"),
    ]:
        for path, data in ((first, one), (second, other)):
            path.unlink(missing_ok=True)
            if data is not None:
                path.write_bytes(data)
        found = EstopFile(str(first), BOOT, pytest.fail, str(second)).before()
        assert reason in found
        assert bool(reason) is bool(found)


def test_a_stop_that_would_not_outlive_a_reboot_is_not_kept(tmp_path):
    (tmp_path / "file").touch()
    told = []
    keeper = EstopFile(str(tmp_path / "latch"), BOOT, told.append, str(tmp_path / "file" / "record-latch"))
    keeper.start()
    keeper.keep(1, "somebody fell")
    wait(lambda: keeper.kept.done == 1)
    assert "record-latch" in keeper.kept.error
    wait(lambda: bool(told))
    assert decode((tmp_path / "latch").read_bytes(), BOOT).startswith("somebody fell")


def test_a_link_is_not_followed(tmp_path):
    path, other = tmp_path / "latch", tmp_path / "other"
    other.write_bytes(encode("", BOOT))
    path.symlink_to(other)
    keeper = EstopFile(str(path), BOOT, pytest.fail)
    assert keeper.before() != ""
    keeper.start()
    keeper.keep(1, "somebody fell")
    wait(lambda: keeper.kept.done == 1)
    assert other.read_bytes() == encode("", BOOT)
