"""One start: earlier runs ended, network and image there, the container made, its grant put in, begun."""

from __future__ import annotations

import logging
import threading
import time
from collections.abc import Iterable, Iterator, Mapping
from contextlib import contextmanager, suppress
from http import HTTPStatus
from typing import Protocol

from docker.errors import APIError, NotFound

from skytether.api.manifest import Opening
from skytether.api.pull_progress import PullProgress

from ..base import Launch, OvertakenError, RuntimeFailure
from ..egress import resolve
from .engine import Engine, EngineGoneError, explain
from .fence import Fence
from .follow import Follower
from .images import ensure_image
from .namespaces import Namespaces
from .network import close_off, guard_image, is_ours
from .objects import OWNER, Namespace, advised, archives, container, declared, free_gpus, free_port, name_of
from .options import DockerOptions
from .seen import ContainerState, parse

log = logging.getLogger(__name__)

_KEPT = 2
"""Earlier runs whose containers stay, for their logs."""
_END_S = 10.0
"""Seconds that a killed container gets to be gone."""
START_S = 30.0
"""For an engine to start one: a node whose program was just started holds some starts for up to 15 s."""
_AGAIN_S = 0.05
"""Between two attempts to have a name that a container which is just removed still has."""
_TAKEN = ("port is already allocated", "address already in use")
"""What an engine says when a port is."""
_CHOOSING = threading.Lock()
"""Never held while anybody is waited for: it is of all sites."""
_CHOSEN: set[tuple[str, str, int]] = set()
"""Engine, kind and number of the ports and GPUs of starts under way, which their containers are not seen to have yet:
two starts must not choose the same."""


Openings = Mapping[Opening, Iterable[str]]
"""What it may connect to, with the addresses of each."""


class Prepare(Protocol):
    """Has the network ready, or raises; with ``anew`` also where it was once."""

    def __call__(self, *, anew: bool = False) -> None: ...


class StoppedError(RuntimeFailure):
    """It was asked to end before it ran."""


class Job:
    """A start under way, in a thread of its own."""

    def __init__(
        self,
        launch: Launch,
        engine: Engine,
        options: DockerOptions,
        owner: str,
        follower: Follower,
        prepare: Prepare,
        namespaces: Namespaces,
        fence: Fence,
        before: Job | None,
    ) -> None:
        """``before`` is an earlier start of the instance."""
        self.launch = launch
        self.failure = ""
        """Why nothing runs, when it has ended that way."""
        self.unanswered = False
        """It came to nothing, or nobody knows to what: the engine did not answer, or another orchestrator led. To be
        started again, by who leads."""
        self.unstarted = False
        """It came to nothing, and nothing of earlier runs is left either."""
        self.pull: PullProgress | None = None
        """How far the pull is that it waits for."""
        self.given_up: set[str] = before.given_up if before is not None else set()
        """Containers that this start or one before has ended, or tried to: the engine may do either much later."""
        self._engine = engine
        self._options = options
        self._owner = owner
        self._follower = follower
        self._prepare = prepare
        self._namespaces = namespaces
        self._fence = fence
        self._epoch = fence.epoch
        self._before = before
        self._cancelled = threading.Event()
        self._leaving = threading.Event()
        self._thread = threading.Thread(target=self._run, name="docker-start", daemon=True)

    @property
    def attempt(self) -> int:
        return self.launch.attempt

    @property
    def ended(self) -> bool:
        return not self._thread.is_alive()

    def start(self) -> None:
        self._thread.start()

    def cancel(self) -> None:
        """Let it come to nothing, wherever it is."""
        self._cancelled.set()

    def leave(self) -> None:
        """Begin nothing any more. What is begun by now runs on: it is the next leader's, who may have adopted it."""
        self._leaving.set()

    def join(self, timeout_s: float) -> None:
        self._thread.join(timeout_s)

    def _run(self) -> None:
        cleared = False
        try:
            if self._before is not None:
                self._before.cancel()
                self._before.join(_END_S + START_S + self._options.timeout_s)
                self._before = None
            begun = self._clear()
            cleared = True
            if not begun:
                self._launch()
        except OvertakenError as error:
            log.info("start of %s: %s", self.launch.instance, error)
            self.unanswered = True
        except StoppedError:
            if self._cancelled.is_set():
                self.failure = "was stopped before it ran"
            else:
                self.unanswered = True
        except EngineGoneError as error:
            log.warning("start of %s: %s", self.launch.instance, error)
            self._follower.doubt(error)
            self.unanswered = True
        except RuntimeFailure as error:
            if self._is_overtaken():  # and has removed what was just made: that says nothing of the service
                log.info("start of %s: another orchestrator leads: %s", self.launch.instance, error)
                self.unanswered = True
                return
            self.unstarted = cleared  # first: whoever sees the failure reads this next
            self.failure = f"could not be started: {advised(str(error))}"
        except Exception as error:
            log.exception("start of %s failed", self.launch.instance)
            self.failure = f"could not be started: {error}"

    def _is_overtaken(self) -> bool:
        try:
            self._fence.must_lead(self._epoch)
        except OvertakenError:
            return True
        except RuntimeFailure:
            pass  # the engine does not answer: nobody can tell
        return False

    def _go_on(self) -> None:
        if self._cancelled.is_set() or self._leaving.is_set():
            raise StoppedError

    def _note_pull(self, pull: PullProgress) -> None:
        self._go_on()
        self.pull = pull

    def _launch(self) -> None:
        self._go_on()
        image = ensure_image(self._engine, self._options, str(self.launch.spec.image), self._note_pull)
        self.pull = None
        self._go_on()
        self._prepare()
        openings = resolve(self.launch.spec.needs.openings)
        self._go_on()
        try:
            made = self._create(image, openings)
        except _NetworkGoneError:
            self._prepare(anew=True)
            made = self._create(image, openings)
        if self._cancelled.is_set():
            self._must_lead()  # whoever asked for its end may have been followed: it is the later leader's then
            with suppress(RuntimeFailure):
                kill(self._engine, made.id, "KILL")
            self._follower.inspect(made.id)

    def _clear(self) -> bool:
        """End what is left of earlier runs; of most, forget it too. Whether this very run was begun meanwhile."""
        there = self._follower.of(self.launch.instance)
        self._must_lead()  # after the look: nothing of it was begun by a later leader
        for seen in there:
            if seen.runs and seen.attempt > self.attempt:
                raise OvertakenError(later_runs(seen))
            if self._is_this(seen):
                return True
        for seen in there:
            if seen.runs:
                kill(self._engine, seen.id, "KILL")
                self._wait_for_end(seen)
            if seen.namespace in self._follower.helpers():
                self._namespaces.remove(seen.namespace)  # its port is the next run's
            if seen.attempt < self.attempt - _KEPT or seen.attempt >= self.attempt or not (seen.runs or seen.ended):
                remove(self._engine, self._follower, seen.id)
        return False

    def _must_lead(self) -> None:
        self._fence.must_lead(self._epoch)

    def _is_this(self, seen: ContainerState) -> bool:
        """Whether a container is this very run, and was begun."""
        begun = seen.runs or seen.status == "exited"
        return begun and seen.attempt == self.attempt and seen.id not in self.given_up

    def _wait_for_end(self, seen: ContainerState) -> None:
        deadline = time.monotonic() + _END_S
        while (now := self._follower.inspect(seen.id)) is not None and now.runs:
            if time.monotonic() > deadline:
                raise RuntimeFailure("what is left of the run before cannot be ended: see the engine's log")
            time.sleep(0.02)

    def _create(self, image: str, openings: Openings) -> ContainerState:
        refused: set[int] = set()
        deadline = time.monotonic() + _END_S
        while True:
            with self._chosen(refused) as (port, gpus):
                try:
                    return self._begin(image, port, gpus, openings)
                except _PortTakenError as error:
                    if port is None:
                        raise RuntimeFailure(str(error)) from error
                    log.warning("UDP port %d of the engine's machine is taken by another program", port)
                    refused.add(port)
                except _NameTakenError as error:
                    begun = self._begun_by_another()
                    if begun is not None:
                        return begun
                    if time.monotonic() > deadline:
                        raise RuntimeFailure(str(error)) from error
                    time.sleep(_AGAIN_S)

    def _begun_by_another(self) -> ContainerState | None:
        """This run as another orchestrator has begun it, by its container's name; None: there is none any more.

        One that was made only is removed: if whoever made it is still at it, it finds nothing to begin.
        """
        name = name_of(self._owner, self.launch.instance, self.attempt)
        with self._engine.asked():
            try:
                inspected = self._engine.api().inspect_container(name)
            except NotFound:
                return None
        seen = parse(inspected)
        if seen is None or inspected["Config"]["Labels"].get(OWNER) != self._owner:
            raise RuntimeFailure(f"there is a container {name} that is not of this site: remove it")
        self._must_lead()
        if self._is_this(seen):
            return self._follower.inspect(seen.id)
        remove(self._engine, self._follower, seen.id)
        return None

    @contextmanager
    def _chosen(self, refused: Iterable[int]) -> Iterator[tuple[int | None, tuple[int, ...]]]:
        """A port, none of ``refused``, and GPUs that no other start chooses meanwhile; None: the engine's choice."""
        engine = self._options.engine
        with _CHOOSING:
            port, gpus = self._choose(engine, refused)
            mine = {(engine, "gpu", number) for number in gpus}
            if port is not None:
                mine.add((engine, "port", port))
            _CHOSEN.update(mine)
        try:
            yield port, gpus
        finally:
            with _CHOOSING:
                _CHOSEN.difference_update(mine)

    def _choose(self, engine: str, refused: Iterable[int]) -> tuple[int | None, tuple[int, ...]]:
        others = [s for s in self._follower.seen(self._options.timeout_s) if s.runs]
        taken_gpus = {gpu for s in others for gpu in s.gpus} | {
            n for e, kind, n in _CHOSEN if (e, kind) == (engine, "gpu")
        }
        gpus = free_gpus(self.launch.spec.needs.gpu, self._options.gpu, taken_gpus)
        if gpus is None:
            raise RuntimeFailure("every GPU of the site is taken")
        taken = {s.host_port for s in others if s.host_port is not None} | set(refused)
        taken |= {n for e, kind, n in _CHOSEN if (e, kind) == (engine, "port")}
        before = self._follower.of(self.launch.instance)
        try:
            return free_port(self._options.ports, before[-1].host_port if before else None, taken), gpus
        except StopIteration:
            first, last = self._options.ports or (0, 0)
            raise RuntimeFailure(f"every UDP port from {first} to {last} is taken (option 'ports')") from None

    def _begin(self, image: str, port: int | None, gpus: tuple[int, ...], openings: Openings) -> ContainerState:
        """In a network that is prepared, if any may do: what opens something, or has to have a port, needs its own."""
        guard = guard_image(self._engine, self._options) if is_ours(self._engine, self._options.network) else None
        if guard is not None and port is None and not openings:
            with self._namespaces.taken() as namespace:
                if namespace is not None:
                    try:
                        return self._run_in(image, port, gpus, openings, None, namespace)
                    except (EngineGoneError, OvertakenError, StoppedError):
                        raise
                    except RuntimeFailure as error:  # whoever removed that network, or whatever else it is
                        log.info("start of %s in a prepared network: %s", self.launch.instance, error)
        return self._run_in(image, port, gpus, openings, guard)

    def _run_in(
        self,
        image: str,
        port: int | None,
        gpus: tuple[int, ...],
        openings: Openings,
        guard: str | None,
        namespace: Namespace | None = None,
    ) -> ContainerState:
        """``guard`` is the image that closes the network off; None: it is closed off already, or is not to be."""
        network = self._options.network
        info = self._follower.info(self._options.timeout_s)
        hosts = {to.host: found for to, found in openings.items() if not any("/" in address for address in found)}
        name = name_of(self._owner, self.launch.instance, self.attempt)
        with self._engine.asked():
            api = self._engine.api()
            told = declared(image, api.inspect_image(image))
            asked = self.launch, self._options, self._owner, told, port, gpus, info, hosts, namespace
            body = container(*asked, epoch=self._epoch)
            try:
                made = str(api.create_container_from_config(body, name)["Id"])
            except APIError as error:
                if error.status_code == HTTPStatus.CONFLICT:
                    raise _NameTakenError(explain(error)) from error
                raise
            begun = False
            try:
                for folder, archive in archives(self.launch):
                    api.put_archive(made, folder, archive)
                if guard is not None:
                    api.disconnect_container_from_network(made, network)
                self._go_on()
                self._must_lead()  # now that it is there for a later leader to see
                begun = True  # or will be, whatever comes of the call
                self._engine.api(max(START_S, self._options.timeout_s)).start(made)
                seen = self._follower.inspect(made)
                if guard is not None:
                    self._connect(guard, made, openings)
                    seen = self._follower.inspect(made)
            except BaseException as error:
                self._give_up(made, begun=begun)
                remove(self._engine, self._follower, made)
                said = explain(error) if isinstance(error, APIError) else ""
                if any(words in said for words in _TAKEN):
                    raise _PortTakenError(said) from error
                if said == f"network {network} not found":
                    raise _NetworkGoneError(said) from error
                raise
        if seen is None:
            raise RuntimeFailure("its container was removed by somebody else")
        return seen

    def _give_up(self, made: str, *, begun: bool) -> None:
        """Before it is removed; raises where that is another one's to decide: a later leader may have adopted it."""
        self.given_up.add(made)
        try:
            if begun:
                self._must_lead()
        except OvertakenError:
            self.given_up.discard(made)
            raise

    def _connect(self, guard: str, made: str, openings: Openings) -> None:
        """Let it have the network, closed off; one that has ended meanwhile needs none."""
        try:
            close_off(self._engine, self._options, self._owner, guard, made, openings)
            self._engine.api().connect_container_to_network(made, self._options.network)
        except (APIError, RuntimeFailure):
            seen = self._follower.inspect(made)
            if seen is None or not seen.ended:
                raise


class _NetworkGoneError(RuntimeFailure):
    """Somebody removed the network while no container was in it: ``docker system prune`` does."""


class _NameTakenError(Exception):
    """There is a container for this run."""


class _PortTakenError(Exception):
    """Another program on the engine's machine has the port."""


def later_runs(seen: ContainerState) -> str:
    """Why an earlier attempt is not begun."""
    return f"attempt {seen.attempt} of {seen.instance} runs: an earlier one is not begun any more"


def kill(engine: Engine, container_id: str, signal: str) -> None:
    """Send a signal; one that has ended or is gone stays so.

    Raises:
        RuntimeFailure: The engine does not answer.
    """
    with engine.asked():
        try:
            engine.api().kill(container_id, signal)
        except APIError as error:
            if error.status_code not in (404, 409):
                raise


def remove(engine: Engine, follower: Follower, container_id: str) -> None:
    """Remove a container, whatever it does, with the volume that holds its grant.

    An engine that was built with an older Go (before 1.25) follows a folder of a volume that becomes a link while it
    removes that, and then removes files of the machine. In a volume of data that both have, another container may have
    been handed a folder of this one's: as long as it may run, the volumes stay, for `remove_left`.

    Raises:
        RuntimeFailure: The engine does not answer.
    """
    with engine.asked():
        try:
            engine.api().remove_container(container_id, v=not follower.shares(container_id), force=True)
        except NotFound:
            pass
        except APIError as error:
            if error.status_code != 409:  # somebody else is at it
                raise
    follower.forget(container_id)
