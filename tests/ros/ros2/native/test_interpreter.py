"""Which Python has ROS 2."""

import pytest

from skytether.ros.ros2.native.interpreter import NAMED, find_python
from skytether.ros.ros2.seam import Ros2Error


@pytest.fixture
def python(tmp_path):
    """Makes a program that says what a Python would."""

    def make(name, says="", code=0):
        path = tmp_path / name
        path.write_text(f"#!/bin/sh\necho '{says}' >&2\nexit {code}\n")
        path.chmod(0o755)
        return str(path)

    return make


def test_the_first_that_has_rclpy(python, monkeypatch, tmp_path):
    monkeypatch.delenv(NAMED, raising=False)
    monkeypatch.setenv("PATH", f"{tmp_path}:/bin")
    found = python("python3")
    assert find_python() == found


def test_a_named_one_or_none(python, monkeypatch):
    good, bad = python("good"), python("bad", "ModuleNotFoundError: No module named rclpy", 1)
    monkeypatch.setenv(NAMED, bad)
    assert find_python(good) == good
    with pytest.raises(Ros2Error) as caught:
        find_python()
    sentence = str(caught.value)
    assert sentence.startswith(f"no Python with ROS 2 is here ({bad}: ModuleNotFoundError: No module named rclpy): ")
    assert "source ROS 2 before (. /opt/ros/" in sentence
    assert "or name its Python as ros2.python" in sentence


def test_an_old_one_is_named(python):
    with pytest.raises(Ros2Error, match=r"older than Python 3\.10"):
        find_python(python("python3", "", 1))


def test_one_that_a_signal_ends_is_named(python, tmp_path):
    """With a /dev/shm of 4 KiB it was called too old."""
    dies = python("dies")
    (tmp_path / "dies").write_text("#!/bin/sh\nkill -BUS $$\n")
    with pytest.raises(Ros2Error, match="ends by SIGBUS"):
        find_python(dies)


@pytest.mark.slow
@pytest.mark.ros2
def test_real_ones(ros2):
    assert find_python(ros2) == ros2
