"""What waits for the socket: a queue for each channel, each with its own bounds.

The channel with the highest priority goes first. A queue that is full loses its oldest message, never another
channel's, and counts that.
"""

from __future__ import annotations

import socket
import threading
from collections import deque

from .frames import Frame, push_head

FIRST = 1_000
"""Priority of control: above that of any topic."""
UNBOUNDED = 1_000_000
MAX_BYTES = 64 * 1024 * 1024
"""That wait in one channel; its newest message is kept, whatever its size."""
_JOINED = 64 * 1024
"""Bodies up to this size are copied behind their heads, which is quicker than two buffers."""


class _Queue:
    def __init__(self, priority: int, depth: int) -> None:
        self.priority = priority
        self.depth = depth
        self.frames: deque[Frame] = deque()
        self.size = 0
        self.dropped = 0


class Outbox:
    """Queues of frames; not safe for several threads."""

    def __init__(self) -> None:
        self._queues: dict[int, _Queue] = {}
        self._order: list[tuple[int, int]] = []
        self.set(0, FIRST, UNBOUNDED)

    def set(self, channel: int, priority: int, depth: int) -> None:
        """Open a channel, or give it other bounds."""
        queue = self._queues.setdefault(channel, _Queue(priority, depth))
        queue.priority, queue.depth = priority, depth
        self._order = sorted((-q.priority, n) for n, q in self._queues.items())

    def remove(self, channel: int) -> None:
        """Close a channel; what waits in it is gone."""
        self._queues.pop(channel, None)
        self._order = [(rank, n) for rank, n in self._order if n != channel]

    def put(self, channel: int, frame: Frame) -> int:
        """Have a frame wait. Returns how many messages were dropped for it; of a closed channel this one."""
        queue = self._queues.get(channel)
        if queue is None:
            return 1
        queue.frames.append(frame)
        queue.size += len(frame.body)
        dropped = 0
        while len(queue.frames) > queue.depth or (queue.size > MAX_BYTES and len(queue.frames) > 1):
            queue.size -= len(queue.frames.popleft().body)
            dropped += 1
        queue.dropped += dropped
        return dropped

    def pop(self) -> Frame | None:
        """The next frame; None if nothing waits. Channels of the same priority take turns."""
        for i, (rank, channel) in enumerate(self._order):
            queue = self._queues[channel]
            if not queue.frames:
                continue
            frame = queue.frames.popleft()
            queue.size -= len(frame.body)
            if i + 1 < len(self._order) and self._order[i + 1][0] == rank:
                self._give_turn(i, rank)
            return frame
        return None

    def dropped(self) -> dict[int, int]:
        """Messages dropped so far, by channel, where there are any."""
        return {n: q.dropped for n, q in self._queues.items() if q.dropped}

    def _give_turn(self, i: int, rank: int) -> None:
        last = i
        while last + 1 < len(self._order) and self._order[last + 1][0] == rank:
            last += 1
        self._order.insert(last, self._order.pop(i))


class Sender:
    """Sends what waits, in a thread of its own; every method may be called from any thread, and returns at once.

    Args:
        link: Connected; it stays the caller's.
    """

    def __init__(self, link: socket.socket) -> None:
        self._link = link
        self._outbox = Outbox()
        self._changed = threading.Condition()
        self._ended = False
        self._thread = threading.Thread(target=self._run, name="ros2-sender", daemon=True)
        self._thread.start()

    def set(self, channel: int, priority: int, depth: int) -> None:
        """See `Outbox.set`."""
        with self._changed:
            self._outbox.set(channel, priority, depth)

    def remove(self, channel: int) -> None:
        """See `Outbox.remove`."""
        with self._changed:
            self._outbox.remove(channel)

    def put(self, frame: Frame, channel: int | None = None) -> int:
        """Have a frame wait, in its own channel if no other is named; see `Outbox.put`."""
        with self._changed:
            if self._ended:
                return 1
            dropped = self._outbox.put(frame.channel if channel is None else channel, frame)
            self._changed.notify()
            return dropped

    def dropped(self) -> dict[int, int]:
        """See `Outbox.dropped`."""
        with self._changed:
            return self._outbox.dropped()

    def close(self) -> None:
        """Stop; what waits is gone."""
        with self._changed:
            self._ended = True
            self._changed.notify()

    def _run(self) -> None:
        while True:
            with self._changed:
                frame = self._outbox.pop()
                while frame is None and not self._ended:
                    self._changed.wait()
                    frame = self._outbox.pop()
                if self._ended:
                    return
            try:
                self._send(frame)
            except OSError:
                self.close()
                return

    def _send(self, frame: Frame | None) -> None:
        if frame is None:
            return
        if len(frame.body) <= _JOINED:
            self._link.sendall(push_head(frame) + frame.body)
        else:
            self._link.sendall(push_head(frame))
            self._link.sendall(frame.body)
