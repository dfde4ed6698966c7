"""How a service's author declares typed topics in the class body."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, ClassVar, Generic, Literal, Self, TypeVar, overload

from skytether.messages import ActionType, Message, ServiceType
from skytether.wire.topic import Direction

from .calls import Caller
from .goals import ActionServer, F, G, R
from .mailbox import Mailbox, RawQueue, Sender

ANY = "*"
M = TypeVar("M", bound=Message)
Q = TypeVar("Q", bound=Message)
A = TypeVar("A", bound=Message)


class Declared:
    """Base of the declarations in a service's class body. The topic's name is the attribute's unless given."""

    direction: ClassVar[Direction]
    kind: Literal["topic", "call", "action", "ros2_action"] = "topic"

    def __init__(self, type_name: str, topic: str | None) -> None:
        self.type_name = type_name
        self.topic = topic or ""
        self.attribute = ""

    def __set_name__(self, owner: type[Any], name: str) -> None:
        self.attribute = name
        self.topic = self.topic or name


class Typed(Declared, Generic[M]):
    """A declaration with a message class."""

    def __init__(self, cls: type[M], topic: str | None = None) -> None:
        super().__init__(cls.TYPE, topic)
        self.cls = cls


class Input(Typed[M]):
    """A topic from the robot, of which the newest message matters: ``force = Input(WrenchStamped)``.

    Args:
        cls: Of its messages.
        topic: Its name; the attribute's unless given.
        max_bytes: Larger messages are counted as undecodable, and not looked at: a list of a hundred thousand
            transforms would hold up a step by seconds. None: as large as the bridge lets through.
    """

    direction = Direction.IN

    def __init__(self, cls: type[M], topic: str | None = None, *, max_bytes: int | None = None) -> None:
        super().__init__(cls, topic)
        self.max_bytes = max_bytes

    @overload
    def __get__(self, service: None, owner: type[Any]) -> Self: ...
    @overload
    def __get__(self, service: object, owner: type[Any]) -> Mailbox[M]: ...
    def __get__(self, service: object, owner: type[Any]) -> Self | Mailbox[M]:
        return self  # an instance has its mailbox under the same name


class AnyInput(Declared):
    """Every topic from the robot that no other input takes, as bytes in the order of arrival, none left out.

    Args:
        max_messages: Unread messages that may wait; beyond it the oldest are dropped and counted.
        max_bytes: The same for their bytes.
    """

    direction = Direction.IN

    def __init__(self, max_messages: int = 100_000, max_bytes: int = 64 * 2**20) -> None:
        super().__init__(ANY, ANY)
        self.max_messages = max_messages
        self.max_bytes = max_bytes

    @overload
    def __get__(self, service: None, owner: type[Any]) -> Self: ...
    @overload
    def __get__(self, service: object, owner: type[Any]) -> RawQueue: ...
    def __get__(self, service: object, owner: type[Any]) -> Self | RawQueue:
        return self


class Output(Typed[M]):
    """A topic to the robot: ``cmd_vel = Output(Twist)``."""

    direction = Direction.OUT

    @overload
    def __get__(self, service: None, owner: type[Any]) -> Self: ...
    @overload
    def __get__(self, service: object, owner: type[Any]) -> Sender[M]: ...
    def __get__(self, service: object, owner: type[Any]) -> Self | Sender[M]:
        return self


class Call(Declared, Generic[Q, A]):
    """A call that the service makes and the robot answers: ``get_map = Call(GetMap)``."""

    direction = Direction.OUT
    kind = "call"

    def __init__(self, srv: ServiceType[Q, A], name: str | None = None) -> None:
        super().__init__(srv.name, name)
        self.srv = srv

    @overload
    def __get__(self, service: None, owner: type[Any]) -> Self: ...
    @overload
    def __get__(self, service: object, owner: type[Any]) -> Caller[Q, A]: ...
    def __get__(self, service: object, owner: type[Any]) -> Self | Caller[Q, A]:
        return self


class Action(Declared, Generic[G, R, F]):
    """An action that the service serves and the robot's clients ask for: ``move_base = Action(MoveBase)``."""

    direction = Direction.IN

    def __init__(self, action: ActionType[G, R, F], name: str | None = None) -> None:
        super().__init__(action.name, name)
        self.action = action
        self.kind = action.kind

    @overload
    def __get__(self, service: None, owner: type[Any]) -> Self: ...
    @overload
    def __get__(self, service: object, owner: type[Any]) -> ActionServer[G, R, F]: ...
    def __get__(self, service: object, owner: type[Any]) -> Self | ActionServer[G, R, F]:
        return self


class Answer(Declared, Generic[Q, A]):
    """A method that answers a call of the robot; made by `answers`."""

    direction = Direction.IN
    kind = "call"

    def __init__(self, srv: ServiceType[Q, A], name: str | None, method: Callable[[Any, Q], A]) -> None:
        super().__init__(srv.name, name)
        self.srv = srv
        self.method = method
        self.__doc__ = method.__doc__

    @overload
    def __get__(self, service: None, owner: type[Any]) -> Self: ...
    @overload
    def __get__(self, service: object, owner: type[Any]) -> Callable[[Q], A]: ...
    def __get__(self, service: object, owner: type[Any]) -> Self | Callable[[Q], A]:
        return self


def answers(srv: ServiceType[Q, A], name: str | None = None) -> Callable[[Callable[[Any, Q], A]], Answer[Q, A]]:
    """Have a method answer a call of the robot: ``@answers(SetBool)`` above ``def pause(self, request): ...``.

    It runs in the thread of the steps, between two of them, and may raise `CallError` to tell the robot why not.

    Args:
        srv: What is asked and answered.
        name: Of the call; the method's unless given.
    """
    return lambda method: Answer(srv, name, method)
