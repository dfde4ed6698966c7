"""Network namespaces that are closed off before anybody asks, so that a start waits for no guard.

Each is held by a container of the guard's image that sleeps, without any right. It is closed off as an instance's own
network is: made without a network, filtered by a guard, connected then. A service joins it as it is, so this is for
those alone that open nothing of the network. It goes when the service in it has ended: nobody ever gets a used one.

What is there is told by labels, not by what this orchestrator remembers: what one left behind that was killed, the
next one removes.
"""

from __future__ import annotations

import logging
import secrets
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress

from docker.errors import APIError

from ..base import RuntimeFailure
from .engine import Engine
from .follow import Follower
from .network import close_off, guard_image, is_ours
from .objects import Namespace, holder
from .options import DockerOptions
from .seen import published_port

log = logging.getLogger(__name__)

_AGAIN_S = 10.0
"""Seconds until another try to make one that could not be made."""


class Namespaces:
    """Those of one site. Safe from any thread."""

    def __init__(
        self,
        engine: Engine,
        options: DockerOptions,
        owner: str,
        follower: Follower,
        prepare: Callable[[], None],
        must_lead: Callable[[], None],
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        """``prepare`` has the network ready, or raises; so does ``must_lead``, if another orchestrator leads by now."""
        self._engine = engine
        self._options = options
        self._owner = owner
        self._follower = follower
        self._prepare = prepare
        self._must_lead = must_lead
        self._clock = clock
        self._lock = threading.Lock()
        self._ready: list[Namespace] = []
        self._mine: set[str] = set()
        """Names of those that are made, ready, or handed to a start that has not shown yet whether it uses them."""
        self._given: set[str] = set()
        """Ids of those that were handed out."""
        self._removing = threading.Lock()
        self._thread: threading.Thread | None = None
        self._failed_at = -_AGAIN_S
        self._closing = threading.Event()

    @property
    def ready(self) -> tuple[Namespace, ...]:
        """Those that the next starts get."""
        with self._lock:
            return tuple(self._ready)

    @property
    def busy(self) -> bool:
        """One is made, or something that nobody needs is there still."""
        return (self._thread is not None and self._thread.is_alive()) or bool(self._left())

    @contextmanager
    def taken(self) -> Iterator[Namespace | None]:
        """One for a start, which nobody else gets; None: there is none. The start is over with the block."""
        self._let_go_of_ended()
        with self._lock:
            one = self._ready.pop(0) if self._ready else None
            if one is not None:
                self._given.add(one.id)
        try:
            yield one
        finally:
            if one is not None:
                with self._lock:
                    self._mine.discard(one.name)

    def begin(self, *, resting: bool) -> None:
        """Remove what is of no use any more, and, while the site is ``resting``, make what lacks. Does not wait."""
        if self._thread is not None and self._thread.is_alive():
            return
        self._let_go_of_ended()
        lacks = resting and len(self._ready) < self._options.prepared and self._clock() - self._failed_at >= _AGAIN_S
        left = self._left()
        if lacks or left:
            self._thread = threading.Thread(
                target=self._tend, args=(left, lacks), name="docker-namespaces", daemon=True
            )
            self._thread.start()

    def _let_go_of_ended(self) -> None:
        helpers = self._follower.helpers()
        with self._lock:
            ended = [one for one in self._ready if one.id not in helpers or not helpers[one.id].runs]
            self._ready = [one for one in self._ready if one not in ended]
            self._mine -= {one.name for one in ended}

    def _tend(self, left: list[str], lacks: bool) -> None:
        try:
            self._must_lead()  # after the look at what is left: nothing of it is a later leader's
            for container in left:
                self.remove(container)
            if lacks and not self._closing.is_set():
                self._make()
        except RuntimeFailure as error:
            log.info("no network could be prepared: %s", error)  # each start makes its own then, or says why not

    def _left(self) -> list[str]:
        """What nobody needs: a namespace without its service, a guard without its target."""
        helpers = self._follower.helpers()
        with self._lock:
            mine = set(self._mine)
        # Asked after the names: a start that has let go of its namespace is seen in it.
        seen = self._follower.seen(self._options.timeout_s)
        used = {one.namespace for one in seen if not one.ended}
        there = {one.id for one in seen if not one.ended} | helpers.keys()
        return [
            container
            for container, helper in helpers.items()
            if (helper.target not in there if helper.target else helper.name not in mine and container not in used)
        ]

    def _make(self) -> None:
        name = f"skytether-{self._owner}-namespace-{secrets.token_hex(4)}"
        with self._lock:
            self._mine.add(name)
        made = None
        try:
            made = self._made(name)
        finally:
            with self._lock:
                if made is None:
                    self._mine.discard(name)
                    self._failed_at = self._clock()
                else:
                    self._ready.append(made)

    def _made(self, name: str) -> Namespace | None:
        """None: instances at this site are not closed off."""
        self._prepare()
        if not is_ours(self._engine, self._options.network):
            return None
        image = guard_image(self._engine, self._options)
        with self._engine.asked():
            api = self._engine.api()
            made = str(api.create_container_from_config(holder(self._options, self._owner, image), name)["Id"])
            try:
                api.disconnect_container_from_network(made, self._options.network)
                api.start(made)
                self._follower.inspect(made)
                close_off(self._engine, self._options, self._owner, image, made, {})
                api.connect_container_to_network(made, self._options.network)
                port = published_port(api.inspect_container(made))
                if port is None:
                    raise RuntimeFailure(f"the engine has published no port of {name}")
            except BaseException:
                with suppress(RuntimeFailure):  # it is found again
                    self.remove(made)
                raise
        return Namespace(made, name, port)

    def remove(self, container: str) -> None:
        """Remove one, with what is published there; returns when it is gone.

        Raises:
            RuntimeFailure: The engine does not answer, or refuses.
        """
        # Who comes second waits until the first has done it.
        with self._removing, self._engine.asked():
            try:
                self._engine.api().remove_container(container, force=True)
            except APIError as error:
                if error.status_code not in (404, 409):  # gone, or another orchestrator is at it
                    raise
        self._follower.forget(container)
        with self._lock:
            self._given.discard(container)

    def clear(self) -> None:
        """Remove all that nobody needs, and wait for it.

        Raises:
            RuntimeFailure: The engine does not answer, or refuses.
        """
        self._forget()
        for container in self._left():
            self.remove(container)

    def close(self) -> None:
        """Leave none of its own behind; where several orchestrators share a site, the others have theirs."""
        self._closing.set()
        deadline = self._clock() + self._options.timeout_s
        own = self._forget()  # but what a start has that is not over: its container may just be begun in there
        with suppress(RuntimeFailure):  # whoever is next removes it
            if own:
                self._follower.catch_up(self._options.timeout_s)  # who is in there need not have been told of yet
            left = self._left() if own else []
            if left:
                self._must_lead()  # after the look, as ever
            for container in left:
                if container in own and self._clock() < deadline:
                    self.remove(container)

    def _forget(self) -> set[str]:
        """Let whatever is made be finished, and none of it be kept; returns those that were handed out or might be.

        What a start under way was given stays its own.
        """
        if self._thread is not None:
            self._thread.join(self._options.timeout_s)
        with self._lock:
            own = {one.id for one in self._ready} | self._given
            self._mine -= {one.name for one in self._ready}
            self._ready.clear()
        return own
