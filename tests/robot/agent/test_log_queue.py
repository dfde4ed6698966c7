import logging
import threading

import pytest

from skytether.robot.agent.log_queue import LogQueue

LOG = logging.getLogger("skytether.robot.test")


class Reader(logging.Handler):
    """Reads only while it is let."""

    def __init__(self):
        super().__init__()
        self.lines = []
        self.reads = threading.Event()

    def emit(self, record):
        self.reads.wait(30)
        self.lines.append(record.getMessage())


@pytest.fixture
def reader():
    reader = Reader()
    root = logging.getLogger()
    root.addHandler(reader)
    yield reader
    reader.reads.set()
    root.removeHandler(reader)


def test_lines_are_not_waited_for_and_come_in_order(reader):
    lines = LogQueue(10)
    lines.use()
    for i in range(30):
        LOG.warning("line %d", i)
    assert reader.lines == []
    assert lines.dropped >= 19, "one may be in the reader's hands"
    reader.reads.set()
    lines.done()
    *kept, note = reader.lines
    numbers = [int(line.removeprefix("line ")) for line in kept]
    assert numbers[:10] == list(range(10)), "what found room at once"
    assert numbers == sorted(set(numbers))
    assert len(numbers) == 30 - lines.dropped
    assert note == f"{lines.dropped} lines of the log were dropped: nobody read them"


def test_at_the_end_all_is_as_it_was(reader):
    reader.reads.set()
    logger = logging.getLogger("skytether")
    own = Reader()
    own.reads.set()
    logger.addHandler(own)
    before = (logger.handlers[:], logger.propagate)
    lines = LogQueue()
    lines.use()
    lines.use()
    LOG.warning("one")
    lines.done()
    LOG.warning("two")
    lines.done()
    assert (logger.handlers, logger.propagate) == before
    LOG.warning("three")
    assert own.lines == reader.lines == ["one", "two", "three"]
    logger.removeHandler(own)


def test_a_handler_that_fails_does_not_end_the_log(reader, monkeypatch):
    reader.reads.set()
    monkeypatch.setattr(reader, "handle", lambda record: 1 / 0)
    lines = LogQueue()
    lines.use()
    LOG.warning("one")
    lines.done()
    monkeypatch.undo()
    lines.use()
    LOG.warning("two")
    lines.done()
    assert reader.lines == ["two"]


def test_who_never_reads_is_left_behind(reader):
    before = threading.enumerate()
    lines = LogQueue(2, drain_s=0.1)
    lines.use()
    for _ in range(10):
        LOG.warning("unread")
    (thread,) = (thread for thread in threading.enumerate() if thread.name == "log" and thread not in before)
    lines.done()
    assert reader.lines == []
    reader.reads.set()
    thread.join(30)
    assert reader.lines == ["unread"], "the one that it had in its hands"
