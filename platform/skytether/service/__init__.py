"""What a service author needs: one class with typed topics, parameters and a step, and `run`.

Everything that knows of sockets, sessions or the orchestrator is behind it; a service imports this package and
`skytether.messages`, nothing else of Skytether. Its tests use `skytether.testing.service.Harness`.
"""

from .calls import Caller
from .delay import MeanDelay
from .errors import CallError, ConfigError, ServiceError
from .goals import ActionServer, Goal, GoalError
from .mailbox import RawReceived, Received
from .main import run
from .params import NoParams, param
from .rate import Lasting, Rate
from .service import Context, Service, params_schema
from .topics import Action, AnyInput, Call, Input, Output, answers

__all__ = [
    "Action",
    "ActionServer",
    "AnyInput",
    "Call",
    "CallError",
    "Caller",
    "ConfigError",
    "Context",
    "Goal",
    "GoalError",
    "Input",
    "Lasting",
    "MeanDelay",
    "NoParams",
    "Output",
    "Rate",
    "RawReceived",
    "Received",
    "Service",
    "ServiceError",
    "answers",
    "param",
    "params_schema",
    "run",
]
