"""A program that is started in real time starts without it, and has it when its node is there."""

import os
import subprocess
import sys

import pytest

CODE = """
import os, threading, time
from skytether.ros.ros2.native.side import real_time
os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(7))
before = real_time.leave()
ended = threading.Event()
threading.Thread(target=ended.wait).start()
def seen():
    tasks = map(int, os.listdir("/proc/self/task"))
    return {(os.sched_getscheduler(task), os.sched_getparam(task).sched_priority) for task in tasks}
print(seen() == {(os.SCHED_OTHER, 0)})
real_time.resume(before)
print(seen() == {(os.SCHED_FIFO, 7)})
ended.set()
"""


@pytest.mark.skipif(os.geteuid() != 0, reason="only root may be sure to get real time")
def test_a_program_has_real_time_when_its_node_is_there():
    assert subprocess.check_output([sys.executable, "-c", CODE], text=True).split() == ["True", "True"]


def test_where_it_was_not_started_so_nothing_changes():
    code = CODE.replace("os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(7))\n", "", 1)
    assert subprocess.check_output([sys.executable, "-c", code], text=True).split() == ["True", "False"]
