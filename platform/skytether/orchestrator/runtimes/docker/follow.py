"""What is known of an engine's containers of ours: listed once, then followed by its events.

The stream of events is read until it has been silent for a while; then everything is listed anew, which costs one call,
and finds what a stream that was cut in silence has not told.
"""

from __future__ import annotations

import logging
import threading
import time
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from dataclasses import replace
from datetime import datetime
from http import HTTPStatus
from itertools import count
from typing import Any

import requests
import urllib3
from docker import APIClient
from docker.errors import NotFound

from ..base import RuntimeFailure
from ..containers import last_line
from .engine import Engine, EngineGoneError, root_cause
from .meter import Meter
from .objects import INSTANCE, OWNER, READY
from .seen import ContainerState, Helper, carried_over, parse, parse_helper, pull_machine

log = logging.getLogger(__name__)

_QUIET_S = 10.0
"""A stream without events for so long at most is opened anew: an engine that went away in silence is noticed then."""
_AGAIN_S = 1.0
"""Between two attempts to reach an engine that does not answer."""
_SHORT_S = 0.1
"""A stream that was shorter is not opened anew at once."""
_READY_S, _READY_MOST_S, _READY_SHARE = 0.02, 0.5, 0.02
"""Between two looks for the ready file of a container that starts; each costs the engine some 3 ms. One that takes long
is looked at less often: a share of the time for which it has been waited for."""
BESIDE = 64
"""Containers that are followed each by a thread of its own, beside two for each instance that is to be there."""
MOST_LISTED = 20_000
"""Containers of a site, ended ones and those without a service included."""
_REMEMBERED = 256
"""Containers that are gone of which it is known: a look that was begun before need not find them again."""
_TAIL = 20
"""Lines of a log among which the last one that can be read is looked for."""
_TOLD = frozenset({"create", "start", "die", "pause", "unpause", "stop", "restart", "rename", "update"})
"""Events after which a container is looked at. Each check of its health brings three others, and each file that is
handed over one."""
_AT_WILL = ("oom", "health_status")
"""Events that what runs in a container can bring about as often as it likes; the second comes with a colon and more."""
AT_WILL_S = 1.0
"""Between two looks at a container because of such ones: with all of them nobody would get round to the others."""
LIST_S = 30.0
"""After which all are listed again, though events come all the time: an engine drops those that are not taken soon."""


class Follower:
    """Keeps up with one engine, in a thread of its own."""

    def __init__(self, engine: Engine, owner: str, on_connect: Callable[[], None], timeout_s: float) -> None:
        """``on_connect`` is called with each new connection; it must not wait. ``timeout_s``: the engine's patience."""
        self._engine = engine
        self._quiet_s = min(_QUIET_S, 5 * timeout_s)  # not oftener than a busy engine can bear
        self._mine = {"label": [f"{OWNER}={owner}"]}
        self._on_connect = on_connect
        self._lock = threading.Lock()
        self._seen: dict[str, ContainerState] = {}
        self._helpers: dict[str, Helper] = {}
        self._most = BESIDE
        self._awaited: set[str] = set()
        self._at_will: dict[str, bool] = {}
        """Containers that were looked at a moment ago because of `_AT_WILL`, and whether there was more of it since."""
        self._turns = count()
        self._shown: dict[str, int] = {}
        """By container, the turn of the look that is shown: one that was begun before that is late."""
        self._gone: dict[str, int] = {}
        """The same of those that were forgotten last."""
        self._failure: RuntimeFailure | None = None
        self._connected = False
        self.looked = threading.Event()
        """Set when the engine was looked at, or did not answer."""
        self._closing = threading.Event()
        self._stream: Any = None
        self._info: Mapping[str, Any] = {}
        self.meter = Meter(engine)
        self._thread = threading.Thread(target=self._run, name="docker-events", daemon=True)

    def start(self) -> None:
        self._thread.start()

    def close(self) -> None:
        """Stop following; returns when nothing is read any more."""
        self._closing.set()
        self._end_stream()
        self.meter.close()
        if self._thread.is_alive():
            self._thread.join(_QUIET_S)

    def seen(self, timeout_s: float) -> list[ContainerState]:
        """All containers of ours; waits for the first look only, ``timeout_s`` [s] at most.

        Raises:
            EngineGoneError: The engine does not answer.
            RuntimeFailure: What it answers is not understood.
        """
        self._must_answer(timeout_s)
        with self._lock:
            return list(self._seen.values())

    def info(self, timeout_s: float) -> Mapping[str, Any]:
        """What the engine says of itself; raises as ``seen``."""
        self._must_answer(timeout_s)
        return self._info

    def _must_answer(self, timeout_s: float) -> None:
        if not self.looked.wait(timeout_s):
            raise EngineGoneError("the Docker engine has not answered yet")
        failure = self._failure
        if failure is not None:
            raise type(failure)(str(failure))

    def expect(self, instances: int) -> None:
        """So many instances are to be there; of containers that an engine makes up beyond, none costs a thread."""
        before, self._most = self._most, 2 * instances + BESIDE
        if self._most > before:
            with self._lock:
                run = [seen for seen in self._seen.values() if seen.runs]
            for seen in run:
                self._follow_closely(seen)

    def _follow_closely(self, seen: ContainerState) -> None:
        if not self._closing.is_set():
            self.meter.follow(seen.id, self._most)
        if not seen.ready:
            self._await_ready(seen.id)

    def doubt(self, error: EngineGoneError) -> None:
        """A call got no answer: believe that the engine is away until it has been looked at anew, at once."""
        self._failure = error
        self._end_stream()

    def of(self, instance: str) -> list[ContainerState]:
        """The containers of one instance as last seen, the earliest run first."""
        with self._lock:
            return sorted((s for s in self._seen.values() if s.instance == instance), key=lambda seen: seen.attempt)

    def shares(self, container: str) -> bool:
        """Whether another container that may run has its volume of data, too; of one that was not seen it may be so."""
        with self._lock:
            mine, others = self._seen.get(container), [s for s in self._seen.values() if s.id != container]
        return mine is None or any(other.volume == mine.volume and not other.ended for other in others)

    def helpers(self) -> dict[str, Helper]:
        """Those of our containers that are no services, by id."""
        with self._lock:
            return dict(self._helpers)

    def forget(self, container: str) -> None:
        """It is gone."""
        self.meter.forget(container)
        with self._lock:
            self._shown.pop(container, None)
            self._gone[container] = next(self._turns)
            if len(self._gone) > _REMEMBERED:
                del self._gone[next(iter(self._gone))]
            self._seen.pop(container, None)
            self._helpers.pop(container, None)

    def catch_up(self, timeout_s: float) -> None:
        """List anew, now: what is seen after this is no older than the call.

        Events are told one after the other, and each is looked at: on a busy engine that can be half a minute behind.

        Raises:
            EngineGoneError: The engine does not answer, or has not been looked at once within ``timeout_s`` [s].
            RuntimeFailure: What it answers is not understood.
        """
        self._must_answer(timeout_s)
        try:
            with self._engine.asked():
                before, rows = self._list(self._engine.api())
            self._apply_list(before, rows, anew=False)
        except RuntimeFailure:
            raise
        except Exception as error:  # as in the thread: an engine may be anybody's
            raise _not_understood(error) from error

    def inspect(self, container: str) -> ContainerState | None:
        """Look at one container now; None: it is not there, or not ours.

        Raises:
            RuntimeFailure: The engine does not answer.
        """
        with self._lock:
            turn = next(self._turns)
        with self._engine.asked():
            try:
                inspected = self._engine.api().inspect_container(container)
                seen, helper = parse(inspected), parse_helper(inspected)
            except NotFound:
                seen = helper = None
        with self._lock:
            old = self._seen.get(container)
        if seen is not None:
            seen = carried_over(seen, old)
            if seen.ended and (old is None or not old.ended):
                seen = replace(seen, last_line=self._last_line(container))
        if seen is None and helper is None:
            self.forget(container)
            return None
        with self._lock:
            if max(self._shown.get(container, turn), self._gone.get(container, turn)) > turn:
                return self._seen.get(container)
            self._shown[container] = turn
            if seen is not None:
                self._seen[container] = seen
            if helper is not None:
                self._helpers[container] = helper
        if seen is None or not seen.runs:
            self.meter.forget(container)
            return seen
        self._follow_closely(seen)
        return seen

    def _last_line(self, container: str) -> str:
        with suppress(RuntimeFailure), self._engine.asked():  # it may be gone by now
            return last_line(self._engine.api().logs(container, tail=_TAIL).decode(errors="replace"))
        return ""

    # The thread

    def _run(self) -> None:
        while not self._closing.is_set():
            begun = time.monotonic()
            try:
                self.follow()
                if time.monotonic() < begun + _SHORT_S:  # an engine that ends each stream at once
                    self._closing.wait(_SHORT_S)
            except RuntimeFailure as error:
                self._lost(error)
            except Exception as error:
                # Whatever it is, the next look sees everything anew; a dead thread would see nothing ever.
                failure = _not_understood(error)
                if str(failure) != str(self._failure):  # once, though it is asked every second
                    log.exception("following the engine failed")
                self._lost(failure)

    def _lost(self, error: RuntimeFailure) -> None:
        self._failure, self._connected = error, False
        self.looked.set()
        self._engine.drop()
        self._closing.wait(_AGAIN_S)

    def follow(self) -> None:
        """List what is there; if that was known already, hear of changes until the engine ends its stream of events.

        Raises:
            RuntimeFailure: The engine does not answer, or what it answers is not understood.
        """
        with self._engine.asked():
            api = self._engine.api()
            self._info = pull_machine(api.info())
            # By the engine's clock: events from before the list are looked at again, and none is missed.
            since = int(datetime.fromisoformat(_seconds(self._info["SystemTime"])).timestamp())
            quiet = self._engine.api(self._quiet_s)
            before, rows = self._list(api)
        self._apply_list(before, rows, anew=not self._connected)
        self._failure = None
        self.looked.set()
        if not self._connected:
            self._connected = True
            self._on_connect()
            self._await_all()
            return  # a look at all takes its time, and an engine keeps its last 256 events only: the next list is short
        try:
            # Podman answers with the first event only, so that silence until then says nothing of the engine.
            with self._engine.asked(), suppress(requests.ReadTimeout):
                self._stream = quiet.events(since=since, filters={**self._mine, "type": ["container"]}, decode=True)
            self._read_events()
        finally:
            self._end_stream()

    def _list(self, api: APIClient) -> tuple[set[str], list[dict[str, Any]]]:
        """Those that were seen before, and those that there are now."""
        with self._lock:
            before = self._seen.keys() | self._helpers.keys()
        rows = api.containers(all=True, filters=self._mine)
        if len(rows) > MOST_LISTED:
            raise RuntimeFailure(f"the engine lists {len(rows)} containers of this site: that cannot be")
        return before, rows

    def _apply_list(self, before: set[str], rows: Sequence[Mapping[str, Any]], *, anew: bool) -> None:
        """Look at what has changed by a list, or at all of it ``anew``."""
        # What holds a network comes before who is in there, whose network would seem to be gone.
        there = [row["Id"] for row in sorted(rows, key=lambda row: INSTANCE in (row["Labels"] or ()))]
        for container in before - set(there):  # and not what a start has made and looked at since
            self.forget(container)
        for container in there if anew else self._changed(rows, there):
            seen = self.inspect(container)
            if anew and seen is not None and seen.runs and not seen.ready:
                self._check_ready(container)  # or an adopted one would seem to start

    def _changed(self, rows: Sequence[Mapping[str, Any]], there: Sequence[str]) -> list[str]:
        """Those of a list that are not as they were seen last: events say the rest."""
        listed = {row["Id"]: (row.get("State"), "unhealthy" in str(row.get("Status"))) for row in rows}
        with self._lock:
            # That it was connected to its network, and has a port since, no event tells.
            known = [one for one in self._seen.values() if not one.runs or one.host_port is not None]
            seen = {one.id: (one.status, bool(one.ill)) for one in known}
            run = [one.id for one in self._seen.values() if one.runs]
        for container in run:
            self.meter.follow(container, self._most)
        return [container for container in there if listed[container] != seen.get(container)]

    def _read_events(self) -> None:
        until = time.monotonic() + LIST_S
        with suppress(urllib3.exceptions.HTTPError, OSError, ValueError, AttributeError):  # ended, or silent too long
            for event in self._stream or ():
                if self._closing.is_set() or time.monotonic() > until:
                    return
                action, container = str(event.get("Action", "")), event.get("Actor", {}).get("ID", "")
                if action == "destroy":
                    self.forget(container)
                elif action in _TOLD:
                    self.inspect(container)
                elif action.startswith(_AT_WILL):
                    self._inspect_now_and_then(container)

    def _inspect_now_and_then(self, container: str) -> None:
        """At once, unless that was done a moment ago: then in a moment, once, however many events come till then."""
        with self._lock:
            if container in self._at_will:
                self._at_will[container] = True
                return
            self._at_will[container] = False
        again = threading.Timer(AT_WILL_S, self._inspect_again, (container,))
        again.daemon = True
        again.start()
        self.inspect(container)

    def _inspect_again(self, container: str) -> None:
        with self._lock:
            more = self._at_will.pop(container, False)
        if more and not self._closing.is_set():
            with suppress(RuntimeFailure):  # the next list says so, too
                self._inspect_now_and_then(container)

    def _end_stream(self) -> None:
        stream, self._stream = self._stream, None
        if stream is not None:
            with suppress(Exception):  # of a connection that is half gone, anything
                stream.close()

    # Readiness

    def _await_all(self) -> None:
        """What was seen before this connection and starts yet: the engine need not have anything more to tell of it."""
        with self._lock:
            starting = [seen.id for seen in self._seen.values() if seen.runs and not seen.ready]
        for container in starting:
            self._await_ready(container)

    def _await_ready(self, container: str) -> None:
        with self._lock:
            if container in self._awaited or not self._connected or len(self._awaited) >= self._most:
                return
            self._awaited.add(container)
        threading.Thread(target=self._watch_ready, args=(container,), name="docker-ready", daemon=True).start()

    def _watch_ready(self, container: str) -> None:
        began = time.monotonic()
        while True:
            with self._lock:
                seen = self._seen.get(container)
                if self._closing.is_set() or seen is None or not seen.runs or seen.ready:
                    self._awaited.discard(container)  # at once: whoever sees it run again has it watched again
                    return
            with suppress(RuntimeFailure):
                self._check_ready(container)
            waited = time.monotonic() - began
            self._closing.wait(min(_READY_MOST_S, max(_READY_S, _READY_SHARE * waited)))

    def _check_ready(self, container: str) -> None:
        with self._engine.asked():
            api = self._engine.api()
            # The SDK only knows how to fetch the file, which takes the engine 50 to 100 ms. It is put there in one
            # piece, and the port in it is always the same.
            url = f"{api.base_url}/v{api.api_version}/containers/{container}/archive"
            there = api.head(url, params={"path": READY}, timeout=api.timeout).status_code == HTTPStatus.OK
        if there:
            with self._lock:
                if container in self._seen:
                    self._seen[container] = replace(self._seen[container], ready=True)


def _not_understood(error: Exception) -> RuntimeFailure:
    return RuntimeFailure(f"the Docker engine's answer is not understood: {root_cause(error)}")


def _seconds(moment: str) -> str:
    """An engine's time without its nanoseconds, which are more digits than Python reads."""
    return moment[:19] + "+00:00" if moment.endswith("Z") else moment[:19] + moment[-6:]
