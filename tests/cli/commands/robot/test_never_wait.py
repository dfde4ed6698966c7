"""What a command prints waits for nobody; real processes and pipes."""

import subprocess
import sys

import pytest

pytestmark = pytest.mark.slow

PROGRAM = """
from skytether.cli.commands.robot.never_wait import never_wait
import sys
never_wait()
for i in range(300):
    print("line", i)
print("last", file=sys.stderr)
"""
FLOOD = (
    PROGRAM
    + """
for i in range(100):
    sys.stdout.write("x" * 100_000)
"""
)


def test_all_that_is_printed_is_there_at_the_end():
    done = subprocess.run([sys.executable, "-c", PROGRAM], capture_output=True, text=True, timeout=60, check=True)
    assert done.stdout.splitlines() == [f"line {i}" for i in range(300)]
    assert done.stderr == "last\n"


@pytest.mark.parametrize("program", [PROGRAM, FLOOD])
def test_a_program_whose_output_is_full_ends(full_pipe, program):
    with subprocess.Popen([sys.executable, "-c", program], stdout=full_pipe, stderr=full_pipe) as process:
        assert process.wait(60) == 0


def test_a_program_whose_reader_is_gone_ends():
    with subprocess.Popen([sys.executable, "-c", FLOOD], stdout=subprocess.PIPE, stderr=subprocess.STDOUT) as process:
        process.stdout.close()
        assert process.wait(60) == 0
