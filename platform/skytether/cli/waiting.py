"""Waiting for an instance to run: a progress bar on a terminal, elsewhere a line for each step. On standard error."""

from __future__ import annotations

import time
from typing import TYPE_CHECKING, Protocol

from .output import console

if TYPE_CHECKING:
    from skytether.api.client import Client
    from skytether.api.rest import Instance, InstanceEvent


_LOOK_S = 0.1


def until_running(client: Client, instance: str, timeout_s: float) -> Instance:
    """Wait until it runs, and show how far it is.

    Raises:
        NotRunning: It ended, or it took too long.
        ApiError: As of every request.
        Unreachable: As of every request.
    """
    if not console.is_terminal:
        return client.wait_running(instance, timeout_s, Lines().show)
    with _Bar(instance) as bar:
        return client.wait_running(instance, timeout_s, bar.show)


def until_resized(client: Client, instance: str, timeout_s: float) -> Instance:
    """Wait until an instance has what it is to have, or another one runs in its place that has it.

    Returns:
        Whichever of the two its robot ends up with, as it is now.

    Raises:
        NotRunning: It took too long.
        ApiError: As of every request.
        Unreachable: As of every request.
    """
    from skytether.api.client import NotRunning

    until = time.monotonic() + timeout_s
    while True:
        found = client.get_instance(instance)
        if found.successor is not None:
            console.print(f"{instance}: its robot is handed over to {found.successor}", markup=False)
            return until_running(client, found.successor, max(0.1, until - time.monotonic()))
        if found.resize is None:
            return found
        if time.monotonic() >= until:
            raise NotRunning(f"instance {instance} has {found.size} after {timeout_s:g} s, not {found.resize} yet")
        time.sleep(_LOOK_S)


class Display(Protocol):
    """Shows what happens to an instance."""

    def show(self, event: InstanceEvent) -> None:
        """One more change."""
        ...


class Lines:
    """One line for each state and reason; of a pull one for each tenth."""

    def __init__(self) -> None:
        self._last = ""
        self._tenth = -1

    def show(self, event: InstanceEvent) -> None:
        """Print it, unless it says nothing new."""
        line = self.line(event)
        if line:
            console.print(line, markup=False, soft_wrap=True)

    def line(self, event: InstanceEvent) -> str:
        """What to print; empty: nothing."""
        line = f"{event.instance}: {event.state}" + (f": {event.reason}" if event.reason else "")
        pull = event.pull
        if pull is not None and pull.total_bytes:
            tenth = 10 * pull.done_bytes // pull.total_bytes + 11 * pull.unpacking
            if tenth == self._tenth:
                return ""
            self._tenth = tenth
        if line == self._last:
            return ""
        self._last = line
        return line


class _Bar:
    """One line of a terminal, overwritten, and gone at the end."""

    def __init__(self, instance: str) -> None:
        from rich.progress import BarColumn, Progress, SpinnerColumn, TextColumn, TimeElapsedColumn
        from rich.table import Column

        text = TextColumn("{task.description}", markup=False, table_column=Column(no_wrap=True, overflow="ellipsis"))
        columns = (SpinnerColumn(), text, BarColumn(20), TextColumn("{task.fields[amount]}"), TimeElapsedColumn())
        self._progress = Progress(*columns, console=console, transient=True)
        self._task = self._progress.add_task(f"{instance}", total=None, amount="")

    def __enter__(self) -> _Bar:
        self._progress.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._progress.stop()

    def show(self, event: InstanceEvent) -> None:
        """Overwrite what was shown."""
        pull = event.pull
        text = f"{event.state}: {event.reason}" if event.reason else str(event.state)
        amount, done, total = "", 0, None
        if pull is not None and pull.total_bytes:
            done, total = pull.done_bytes, pull.total_bytes
            amount = f"{done / 1e6:.0f} of {total / 1e6:.0f} MB, {done / total:.0%}"
            text = f"{event.state}: {'unpacking' if pull.unpacking else 'pulling'} {pull.image}"
        self._progress.update(self._task, description=text, completed=done, total=total, amount=amount)
