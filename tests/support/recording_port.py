"""A graph for tests of a bridge: it keeps what it is told."""

import threading

from skytether.wire.events import Connected


class RecordingPort:
    """Keeps messages and events; `wait` returns when something has come."""

    def __init__(self):
        self.messages = []
        self.events = []
        self.changed = threading.Condition()
        self.publisher = None

    def attach(self, publisher):
        self.publisher = publisher

    def deliver(self, message):
        with self.changed:
            self.messages.append((message.topic, bytes(message.payload)))
            self.changed.notify_all()

    def notify(self, event):
        with self.changed:
            self.events.append(event)
            self.changed.notify_all()

    def wait(self, condition, seconds=5):
        """Wait until condition(self) holds; says what there was if it never does."""
        with self.changed:
            assert self.changed.wait_for(lambda: condition(self), seconds), (
                f"waited in vain; {len(self.messages)} messages, events {self.events}"
            )

    def count(self, kind):
        return sum(isinstance(e, kind) for e in self.events)

    def wait_connected(self, times=1):
        self.wait(lambda port: port.count(Connected) >= times)

    def wait_messages(self, count):
        self.wait(lambda port: len(port.messages) >= count)
