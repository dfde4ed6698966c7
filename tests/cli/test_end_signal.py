"""Commands that run until they are interrupted or terminated."""

import subprocess
import sys

EACH_MOMENT = """
import signal, sys
from skytether.cli.end_signal import EndSignal

def wait(moment):
    passed = 0
    def look(frame, event, argument):
        nonlocal passed
        if passed == moment:
            signal.raise_signal(signal.SIGTERM)
        passed += 1
        return look
    end = EndSignal()
    sys.settrace(look)
    end.wait(0.01)
    sys.settrace(None)
    return end, passed

end, moments = wait(-1)
assert not end.came
assert not end.wait(0)
for moment in range(moments):
    end, _ = wait(moment)
    assert end.wait(0), moment
    assert end.came
    assert end.wait()
print(moments)
"""


def test_a_signal_in_whatever_moment_of_the_wait_ends_it():
    """A handler that takes a lock which the waiting thread holds would wait for ever."""
    done = subprocess.run([sys.executable, "-c", EACH_MOMENT], capture_output=True, text=True, timeout=30)
    assert done.stderr == ""
    assert int(done.stdout) > 3
