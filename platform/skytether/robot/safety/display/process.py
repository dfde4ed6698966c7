"""The display as a process: ``python -m skytether.robot.safety.display.process FD CONFIG``, started by the guard.

It draws what the gate sends, and says so while the gate sends nothing. It has the lowest priority of all; nothing waits
for it, and if it ends or hangs the guard starts it anew.
"""

from __future__ import annotations

import logging
import os
import select
import signal
import socket
import sys
from collections.abc import Callable
from contextlib import suppress
from math import inf

from skytether.guard.clock import now as boottime
from skytether.guard.folder import Known
from skytether.guard.mailbox import bind
from skytether.guard.settings import thaw
from skytether.messages import MarkerArray, Message, warm
from skytether.robot.log_throttle import LogThrottle
from skytether.robot.safety.config.display_config import DisplayConfig
from skytether.robot.safety.config.safety_config import SafetyConfig
from skytether.robot.safety.io.hardware import receive_known
from skytether.robot.safety.io.io_factory import open_display
from skytether.robot.safety.io.process_setup import log_without_waiting
from skytether.robot.safety.protocol import DISPLAY_SOCKET
from skytether.robot.safety.rules.modes import Envelope, Modes
from skytether.robot.safety.rules.places import Places

from .markers import markers, silence
from .picture import picture
from .snapshot import LARGEST, unpack

_log = logging.getLogger("skytether.display")
_NICE = 10
_WAITING = 64
"""More than the kernel keeps; the newest counts."""
_SILENCE_S = 1.0
"""Without a word of the gate."""
_LASTS = 3.0
"""Periods that markers stay without being published again."""


class Display:
    """The loop.

    Args:
        config: The section of robot.yaml.
        guard: The socket to the guard; its end is the end of this.
        publish: A message on the graph; returns at once.
        clock: [s]

    Raises:
        OSError: The socket cannot be had.
    """

    def __init__(
        self,
        config: SafetyConfig,
        guard: socket.socket,
        publish: Callable[[Message], object],
        clock: Callable[[], float] = boottime,
    ) -> None:
        display = config.display or DisplayConfig()
        rules = config.rules()
        modes = Modes(rules.modes, Envelope(rules.limits, rules.zones, rules.footprint))
        self._places = Places(modes, rules.stages, rules.unseen)
        self._known = frozenset(rules.modes.envelopes)
        self._frame = display.frame
        self._lasts = max(_LASTS / display.rate_hz, _SILENCE_S)
        self._guard = guard
        self._publish = publish
        self._clock = clock
        self._log_throttle = LogThrottle(_log)
        self._feed = bind(str(config.place() / DISPLAY_SOCKET), 0o600)
        self._senders = Known.of(self._feed)
        self._heard_at = clock()
        self._lived_at = -inf

    def run(self) -> None:
        """Draw until the guard is gone."""
        while True:
            ready, _, _ = select.select([self._feed, self._guard], [], [], _SILENCE_S / 2)
            if self._guard in ready and self._gone():
                return
            self.turn()

    def turn(self) -> None:
        """Draw the newest of what came."""
        now = self._clock()
        came, _ = receive_known(self._feed, self._senders, LARGEST, _WAITING)
        if came:
            self._heard_at = now
            self._draw(came[-1][0], now)
        elif now - self._heard_at > _SILENCE_S:
            self._publish(silence(self._frame, self._lasts))
        if now - self._lived_at > _SILENCE_S / 2:
            self._lived_at = now
            with suppress(BlockingIOError):
                self._guard.send(b".")

    def close(self) -> None:
        """Close the socket."""
        self._feed.close()

    def _gone(self) -> bool:
        try:
            return not self._guard.recv(1)
        except OSError:  # it ended without having read the last signs of life
            return True

    def _draw(self, data: bytes, now: float) -> None:
        seen = unpack(data)
        if seen is None:
            self._log_throttle.warn("bytes", "something that is no snapshot comes to the display's socket", now)
            return
        try:
            drawn = picture(self._places.of(seen.modes & self._known), seen.asked, seen.told)
            self._publish(markers(seen, drawn, self._frame, self._lasts))
        except Exception as error:  # the next one may be drawn
            self._log_throttle.warn("draw", f"cannot draw what the gate says: {type(error).__name__}: {error}", now)


def main() -> None:
    """Run as the guard's child."""
    for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP):
        signal.signal(number, signal.SIG_IGN)  # it ends when the guard does
    os.nice(_NICE)
    config = SafetyConfig.model_validate_json(thaw(int(sys.argv[2])))
    logging.basicConfig(format="%(levelname)s display: %(message)s", level=logging.INFO)
    log_without_waiting()
    guard = socket.socket(fileno=int(sys.argv[1]))
    guard.setblocking(False)
    warm([MarkerArray], config.encoding)
    graph = open_display(config)
    try:
        Display(config, guard, graph.publish).run()
    finally:
        graph.close()


if __name__ == "__main__":
    main()
