"""The class that a service author writes a subclass of."""

from __future__ import annotations

import logging
from abc import ABC, abstractmethod
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any, ClassVar, Generic, TypeVar, get_args, get_origin

from skytether.messages import Message, ServiceType

from .actions import Handler, Inbox, join
from .calls import Caller
from .goals import ActionServer
from .mailbox import Mailbox, RawQueue, Sender
from .params import NoParams, schema_of
from .reports import Reports
from .topics import Action, Answer, AnyInput, Call, Declared, Input, Output

P = TypeVar("P")


@dataclass(frozen=True, slots=True)
class Context:
    """For whom a service runs, and where it may write."""

    robot: str = ""
    instance: str = ""
    data_dir: Path = Path()
    """For what it produces (recordings); nothing else on the file system is its own."""
    epoch: float = 0.0
    """Unix time at which the monotonic clock stood at 0; with ``now`` added it is a date."""


class Service(ABC, Generic[P]):
    """One robot's service: topics in, topics out, parameters, and a step between them.

    A subclass names its parameter dataclass, ``class Guide(Service[GuideParams])`` (`NoParams` for none), declares its
    topics, and sets either ``rate_hz`` or ``trigger``. All its methods are called from one thread, in which the bridge
    has no part. An exception ends the process with a traceback; the orchestrator starts it again, so a service keeps
    no state that a crash could not lose.
    """

    rate_hz: float | None = None
    """Steps per second, at absolute times. `start` may set it, from a parameter."""
    trigger: ClassVar[str | None] = None
    """The topic of an `Input`, instead of a rate; one step for its newest message, whenever there is a new one."""

    params_type: ClassVar[type[Any]] = NoParams
    declared: ClassVar[tuple[Declared, ...]] = ()

    def __init_subclass__(cls, **kwargs: Any) -> None:
        """Collect the declared topics and the parameter type.

        Raises:
            TypeError: Two topics have one name, or the trigger is no input.
        """
        super().__init_subclass__(**kwargs)
        for base in getattr(cls, "__orig_bases__", ()):
            if get_origin(base) is Service and not isinstance(get_args(base)[0], TypeVar):
                cls.params_type = get_args(base)[0]
        found = {d.attribute: d for c in reversed(cls.__mro__) for d in vars(c).values() if isinstance(d, Declared)}
        cls.declared = tuple(found.values())
        topics = [d.topic for d in cls.declared]
        for topic in topics:
            if topics.count(topic) > 1:
                raise TypeError(f"{cls.__name__}: topic '{topic}' is declared twice")
        triggers = [d.topic for d in cls.declared if isinstance(d, Input)]
        if cls.trigger is not None and cls.trigger not in triggers:
            raise TypeError(f"{cls.__name__}: trigger '{cls.trigger}' is no Input; there are {', '.join(triggers)}")

    def __init__(self, params: P, context: Context | None = None) -> None:
        self.params = params
        self.context = context or Context()
        self.log = logging.getLogger(type(self).__name__)
        self.reports = Reports()
        self.mailboxes: dict[str, Mailbox[Any]] = {}
        self.senders: dict[str, Sender[Any]] = {}
        self.anything: RawQueue | None = None
        self.callers: dict[str, Caller[Any, Any]] = {}
        self.answers: dict[str, tuple[ServiceType[Any, Any], Callable[[Any], Any]]] = {}
        self.actions: list[ActionServer[Any, Any, Any]] = []
        self.asked_for: dict[str, tuple[type[Message], Handler]] = {}
        """Topics of actions, each message of which counts; by `inbox`."""
        self.inbox = Inbox(self.log)
        for declared in self.declared:
            self.__dict__[declared.attribute] = self._open(declared)

    def start(self) -> None:
        """Called once before the first step, parameters read and no robot connected yet.

        Raises:
            ServiceError: The service cannot work; its sentence is all that is printed.
        """

    @abstractmethod
    def step(self, now: float) -> None:
        """Look at the inputs, publish outputs. ``now``: seconds of the monotonic clock."""

    def stop(self) -> None:
        """Called once after the last step, also after one that raised: close what is open."""

    def report(self, code: str, message: str) -> None:
        """Tell people something: it becomes an event of the instance, and a line of its log.

        Of many in a short time the orchestrator takes the newest: it is for what somebody should know, not for
        measurements.

        Args:
            code: For programs: small letters, digits and underscores.
            message: A sentence; 300 characters of it are kept.

        Raises:
            ValueError: The code is none.
        """
        self.reports.add(code, message)
        self.log.info("%s: %s", code, message)

    def _open(self, declared: Declared) -> object:
        """Make what stands behind one declaration."""
        match declared:
            case Input():
                self.mailboxes[declared.topic] = Mailbox(declared.topic, declared.cls, self.log, declared.max_bytes)
                return self.mailboxes[declared.topic]
            case Output():
                self.senders[declared.topic] = Sender(declared.topic, declared.cls)
                return self.senders[declared.topic]
            case AnyInput():
                self.anything = RawQueue(declared.max_messages, declared.max_bytes)
                return self.anything
            case Call():
                self.callers[declared.topic] = Caller(declared.topic, declared.srv)
                return self.callers[declared.topic]
            case Answer():
                handler = partial(declared.method, self)
                self.answers[declared.topic] = declared.srv, handler
                return handler
            case Action():
                return self._serve(declared)
        raise TypeError(f"{type(declared).__name__} is no Input, AnyInput, Output, Call, Action or answer")

    def _serve(self, declared: Action[Any, Any, Any]) -> ActionServer[Any, Any, Any]:
        joined = join(declared.action, declared.topic, self.context.epoch)
        own = {name: Sender(name, cls) for name, cls in joined.outputs.items()}
        by_part = {name.rpartition("/")[2]: sender for name, sender in own.items()}
        joined.server.send = lambda part, message: by_part[part].publish(message)
        self.senders.update(own)
        self.answers.update(joined.calls)
        self.asked_for.update(joined.inputs)
        self.actions.append(joined.server)
        return joined.server


def params_schema(cls: type[Service[Any]]) -> dict[str, Any]:
    """JSON schema of a service's parameters: what ``spec.params`` of its manifest has to hold."""
    return schema_of(cls.params_type)
