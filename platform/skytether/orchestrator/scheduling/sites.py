"""The sites: each has a runtime and a thread of its own, so that a slow or silent one holds up no other."""

from __future__ import annotations

import logging
import threading
import time
from collections.abc import Callable, Collection, Iterable, Mapping
from pathlib import Path
from typing import Any

from skytether.api.rest import SiteCreate
from skytether.api.validation_errors import known

from ..config.settings import Timing
from ..config.sites_file import stored_as
from ..domain.errors import ConflictError, Fault, ForbiddenError, InvalidError, NotFoundError
from ..domain.validation import parse
from ..runtimes.base import OvertakenError, Runtime, RuntimeFailure
from ..store.engine import GONE
from ..store.leader import LeadLostError, fence, fenced
from ..store.store import Store
from .runtime_entry_points import Unusable, load_runtime
from .site import Site, Step

log = logging.getLogger(__name__)

DEFAULT_SITE = SiteCreate(name="local", tier="edge", runtime="process")
"""Made when there is no site at all. Tier ``edge``: the orchestrator's machine is near the robot, not on it."""
NODE = "node://"
"""How the engine of a machine that joined begins."""
_FIRST_LOOK = 1.0
"""Seconds a new site gets to answer before it is listed all the same."""
_CLOSE_TIMEOUT = 5.0
"""Seconds that a call into a hanging runtime gets at the end."""


class Sites:
    """All sites, in memory and in the store."""

    _step: Step
    """What each site's thread does again and again; from `start` on."""

    def __init__(
        self, folder: Path, store: Store, timing: Timing, find_runtime: Callable[[str], type[Runtime]]
    ) -> None:
        """There are none before `start`; ``find_runtime`` gives a runtime by its name."""
        self._find_runtime = find_runtime
        self._folder = folder
        self._store = store
        self._timing = timing
        self._lock = threading.Lock()
        self._sites: dict[str, Site] = {}
        self._deletion_listeners: list[Callable[[str], object]] = []

    def start(self, step: Step, local: bool = True, declared: Iterable[SiteCreate] = ()) -> None:
        """Open every site of the store, and give them a moment to answer.

        Args:
            step: What each site's thread does again and again, from now on.
            local: Make one, if there is none.
            declared: Sites that are to be there, and as these.

        Raises:
            InvalidError: A declared one cannot be.
        """
        self._step = step
        for asked in declared:
            self._declare(asked)
        if local and not self._store.sites():
            self._store.add_site(DEFAULT_SITE)
        self.refresh()
        deadline = time.monotonic() + _FIRST_LOOK
        for site in self.all():
            site.loop.wait_first(max(0.0, deadline - time.monotonic()))

    def _declare(self, asked: SiteCreate) -> None:
        kind = self._find_runtime(asked.runtime)
        there = next((site for site in self._store.sites() if site.name == asked.name), None)
        wanted = stored_as(asked, there, kind)
        if there is None:
            self._store.add_site(wanted)  # or another orchestrator over this database has just done it
        elif wanted != there:
            self._store.change_site(wanted)
            log.info("site %s is changed to what the sites file says", asked.name)

    def stored(self) -> dict[str, Mapping[str, int]]:
        """By site, bytes that services have written there by robot, as far as that is known."""
        return {site.name: site.runtime.stored() for site in self.all()}

    def hosted(self, name: str) -> frozenset[str] | None:
        """Of a site that is a machine that joined, the robots that had an instance there; None: of no such site."""
        site = self.find(name)
        if site is None or not str(site.asked.options.get("engine", "")).startswith(NODE):
            return None
        return site.hosted or frozenset()

    def refresh(self) -> None:
        """Open and close what another orchestrator over the same database added and deleted."""
        with self._lock:
            wanted, draining = {site.name: site for site in self._store.sites()}, self._store.draining_sites()
            evacuating = self._store.evacuating_sites()
            gone = [site for name, site in self._sites.items() if wanted.get(name) != site.asked]
            for site in gone:
                del self._sites[site.name]
            for one in wanted.values():
                if one.name not in self._sites:
                    self._open(one, self._make_usable(one))
                self._sites[one.name].draining = one.name in draining
                self._sites[one.name].evacuating = one.name in evacuating
        for site in gone:
            self._close(site)

    def stop(self) -> None:
        """Let go of all sites; what runs there runs on."""
        all_ = self.all()
        _end(all_)
        for site in all_:
            site.runtime.close()

    def add(self, asked: SiteCreate, *, by_owner: bool = True, put: Callable[[SiteCreate], bool] | None = None) -> Site:
        """A new site.

        Args:
            asked: As it was described.
            by_owner: By the operator of the state folder, who may make one that runs as the orchestrator's user.
            put: Stores it, and says whether it could, in the place of what does that otherwise.

        Raises:
            ForbiddenError: Somebody else wants one that does.
            InvalidError: Runtime or options are wrong.
            ConflictError: There is one of that name.
        """
        with self._lock:
            kind = self._check(asked, by_owner=by_owner)
            asked = asked.model_copy(update={"options": kind.completed(asked.options)})
            self._must_be_unique(asked, kind.unique)
            runtime = self._make_runtime(asked)
            if not (put or self._store.add_site)(asked):  # by way of another orchestrator
                runtime.close()
                raise ConflictError(
                    f"there is a site '{asked.name}' already: choose another name, or delete that first"
                )
            site = self._open(asked, runtime)
        site.loop.wait_first(_FIRST_LOOK)
        return site

    def check(self, asked: SiteCreate, *, by_owner: bool) -> None:
        """Whether such a site could be added now; raises as ``add``."""
        with self._lock:
            kind = self._check(asked, by_owner=by_owner)
        parse(kind.Options, asked.options, prefix=("options",))

    def _check(self, asked: SiteCreate, *, by_owner: bool) -> type[Runtime]:
        if asked.name in self._sites:
            raise ConflictError(f"there is a site '{asked.name}' already: choose another name, or delete that first")
        kind = self._find_runtime(asked.runtime)
        if kind.runs_as_us and not by_owner:
            raise ForbiddenError(
                f"instances at a site of the runtime '{asked.runtime}' are processes of the orchestrator's own "
                "user: only the token in its state folder (operator.token) may make one"
            )
        given = sorted(kind.owner_options & asked.options.keys())
        if given and not by_owner:
            raise ForbiddenError(
                f"the options {', '.join(given)} may open up the whole machine of the site, or tell its engine "
                "passwords: only the token in the orchestrator's state folder (operator.token) may give them"
            )
        return kind

    def change_options(self, name: str, changes: Mapping[str, Any]) -> None:
        """Have some options of a site be others, from now on; what runs there runs on.

        Raises:
            NotFoundError: There is none of that name.
            InvalidError: They are wrong.
        """
        with self._lock:
            asked = self.get(name).asked
            changed = asked.model_copy(update={"options": {**asked.options, **changes}})
            parse(self._find_runtime(asked.runtime).Options, changed.options, prefix=("options",))
            self._store.change_site(changed)
        self.refresh()

    def _must_be_unique(self, asked: SiteCreate, key: str) -> None:
        value = asked.options.get(key)
        for other in self._sites.values() if value is not None else ():
            if other.asked.runtime == asked.runtime and other.asked.options.get(key) == value:
                raise ConflictError(
                    f"site '{other.name}' has the same option '{key}': each would end the other's instances; "
                    "give another, or leave it out"
                )

    def delete(self, name: str, *, force: bool = False) -> None:
        """Forget a site, with what ended instances left there.

        Args:
            name: Its name.
            force: With instances there, too: they count as failed, and their robots ask again.

        Raises:
            NotFoundError: There is none of that name.
            ConflictError: Instances are there.
        """
        with self._lock:
            site = self.get(name)
            held = [record.id for record in self._store.live_at(name)]
            if held and not force:
                raise ConflictError(
                    f"site '{name}' has {len(held)} instances: delete them first ({', '.join(held[:3])}), or drain it: "
                    "it takes no more, and is deleted with its last one"
                )
            self._store.delete_site(name)
            del self._sites[name]
        site.loop.stop(timeout=_CLOSE_TIMEOUT)
        try:
            try:
                _empty(site.runtime)
            except OvertakenError:  # it led here once; a site is deleted by whoever was asked to
                site.runtime.close()
                site.runtime = self._make_usable(site.asked)
                _empty(site.runtime)
        except RuntimeFailure as error:
            log.warning("site %s was deleted, but what it left there stays: %s", name, error)
        site.runtime.close()
        for notify in self._deletion_listeners:
            notify(name)

    def subscribe_deletions(self, notify: Callable[[str], object]) -> None:
        """Have ``notify`` called with the name of each site of which nothing is left here."""
        self._deletion_listeners.append(notify)

    def drain(self, name: str) -> bool:
        """Let a site take no more instances, and delete it as soon as none is there; whether it is gone by now.

        Raises:
            NotFoundError: There is none of that name.
        """
        with self._lock:
            site = self.get(name)
            self._store.drain_site(name)
            site.draining = True
        if self._store.live_at(name):
            return False
        self.delete(name)
        return True

    def evacuate(self, name: str, evacuating: bool = True) -> None:
        """Let a site take no more instances, and have those that are there moved elsewhere; or not any more.

        Raises:
            NotFoundError: There is none of that name.
            ConflictError: It is to be deleted with its last instance, which cannot be taken back.
        """
        with self._lock:
            site = self.get(name)
            if site.draining and not evacuating:
                raise ConflictError(f"site '{name}' is to be deleted with its last instance: that cannot be taken back")
            self._store.evacuate_site(name, evacuating)
            site.evacuating = evacuating
        site.wake()

    def end_drained(self, held: Collection[str | None], forget: Callable[[str], object]) -> None:
        """Delete what was drained; in threads of their own, for a site that does not answer takes its time.

        Args:
            held: Where instances are.
            forget: Called with the name of each that is gone.
        """
        for site in self.all():
            if site.draining and site.name not in held and (site.ender is None or not site.ender.is_alive()):
                site.ender = threading.Thread(
                    target=self._end_drained,
                    args=(site.name, forget, fence()),
                    name=f"drained-{site.name}",
                    daemon=True,
                )
                site.ender.start()

    def _end_drained(self, name: str, forget: Callable[[str], object], epoch: int) -> None:
        try:
            with fenced(epoch):
                self.delete(name)
        # By somebody else meanwhile; or the next pass tries.
        except (NotFoundError, ConflictError, LeadLostError, *GONE) as error:
            log.info("site %s is not deleted yet: %s", name, error)
            return
        log.info("site %s held no more instances, and was deleted", name)
        forget(name)

    def get(self, name: str) -> Site:
        """One site.

        Raises:
            NotFoundError: There is none of that name; the text names those there are.
        """
        site = self.find(name)
        if site is None:
            raise NotFoundError(f"there is no site '{name}'; {known(self._sites, name)}")
        return site

    def find(self, name: str | None) -> Site | None:
        return self._sites.get(name) if name else None

    def find_anew(self, name: str | None) -> Site | None:
        """The same; one that is not known may have been added at another orchestrator a moment ago."""
        if name and name not in self._sites:
            self.refresh()
        return self.find(name)

    def all(self) -> list[Site]:
        return sorted(self._sites.values(), key=lambda site: site.name)

    def _make_runtime(self, asked: SiteCreate) -> Runtime:
        kind = self._find_runtime(asked.runtime)
        options = parse(kind.Options, asked.options, prefix=("options",))
        folder = self._folder / asked.name
        folder.mkdir(mode=0o700, parents=True, exist_ok=True)
        try:
            return kind(asked.name, folder, options)
        except RuntimeFailure as error:
            raise InvalidError([Fault("runtime", str(error))]) from error

    def _make_usable(self, asked: SiteCreate) -> Runtime:
        try:
            return self._make_runtime(asked)
        except InvalidError as error:
            log.error("site %s cannot be used: %s", asked.name, error)
            return Unusable(str(error))

    def _open(self, asked: SiteCreate, runtime: Runtime) -> Site:
        site = Site(asked, runtime, self._step, self._timing)
        self._sites[asked.name] = site
        site.loop.start()
        return site

    def _close(self, site: Site) -> None:
        site.loop.stop(timeout=_CLOSE_TIMEOUT)
        site.runtime.close()


def dismantle(
    declared: Iterable[SiteCreate],
    folder: Path,
    find_runtime: Callable[[str], type[Runtime]] = load_runtime,
    *,
    erase: bool = False,
) -> None:
    """End and remove all that is at declared sites, whose orchestrators are gone for good.

    Args:
        declared: As `sites_file.read_sites` gives them.
        folder: Where the runtimes keep what they note.
        find_runtime: Gives a runtime by its name.
        erase: And what services wrote there.

    Raises:
        InvalidError: Runtime or options are wrong.
        RuntimeFailure: A site does not answer, or refuses.
    """
    for asked in declared:
        kind = find_runtime(asked.runtime)
        options = parse(kind.Options, asked.options, prefix=(asked.name, "options"))
        (folder / asked.name).mkdir(mode=0o700, parents=True, exist_ok=True)
        runtime = kind(asked.name, folder / asked.name, options)
        try:
            _empty(runtime)
            if erase:
                runtime.erase()
        finally:
            runtime.close()


def _empty(runtime: Runtime) -> None:
    """Leave nothing at a site that is no more."""
    for instance in runtime.observe():
        runtime.remove(instance)
    runtime.dismantle()


def _end(sites: Collection[Site]) -> None:
    """End their threads; several that hang take no longer than one."""
    for site in sites:
        site.loop.stop(timeout=0)
    deadline = time.monotonic() + _CLOSE_TIMEOUT
    for site in sites:
        site.loop.stop(max(0.0, deadline - time.monotonic()))
