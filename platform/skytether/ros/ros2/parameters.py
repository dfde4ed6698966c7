"""Parameters for nodes of a ROS 2 graph, which each node keeps itself: set by its service, whenever it is there."""

from __future__ import annotations

import threading
from collections.abc import Mapping
from types import TracebackType
from typing import Any

from skytether.bridge.calls import CallError
from skytether.messages import DecodeError, decode_plain, encode_plain, hash_of

from .dialect import Endpoint, Kind
from .names import full_name
from .seam import Client, GraphNode

SERVICE = "rcl_interfaces/srv/SetParameters"
TIMEOUT_S = 10.0
"""For a node to answer."""
_LOOK_S = 0.5

_KINDS: tuple[tuple[type, int, str], ...] = (  # rcl_interfaces/msg/ParameterType; bool before int, which it is too
    (bool, 1, "bool"),
    (int, 2, "integer"),
    (float, 3, "double"),
    (str, 4, "string"),
)
_ARRAYS = 5
"""Added to the kind of a value: that of an array of them (6 to 9)."""


def set_request(values: Mapping[str, Any]) -> bytes:
    """The request that sets these parameters, in CDR.

    Raises:
        ValueError: A value can be no parameter; the text names it.
    """
    parameters = [{"name": name, "value": _value(name, value)} for name, value in values.items()]
    return encode_plain(f"{SERVICE}_Request", {"parameters": parameters})


def refusals(response: bytes, names: list[str]) -> list[str]:
    """What a node refused, a sentence each.

    Raises:
        DecodeError: This is no response.
    """
    results = decode_plain(f"{SERVICE}_Response", response).results
    return [
        f"parameter {name} was refused: {result.reason or 'no reason is given'}"
        for name, result in zip(names, results, strict=False)
        if not result.successful
    ]


class Parameters:
    """Sets parameters of nodes, each time that a node shows up in the graph.

    Args:
        node: Ours.
        wanted: Values by the other node's full name (``/bot/controller``) and the parameter's name.

    Raises:
        ValueError: A name or a value can be none; the text names it.
    """

    def __init__(self, node: GraphNode, wanted: Mapping[str, Mapping[str, Any]]) -> None:
        self._node = node
        self._wanted = {full_name(name): dict(values) for name, values in wanted.items()}
        self._requests = {name: set_request(values) for name, values in self._wanted.items()}
        self._ended = threading.Event()
        self._thread = threading.Thread(target=self._run, name="ros2-parameters", daemon=True)

    def __enter__(self) -> Parameters:
        if self._wanted:
            self._thread.start()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._ended.set()
        if self._wanted:
            self._thread.join()

    def _run(self) -> None:
        endpoints = {
            name: Endpoint(Kind.CLIENT, f"{name}/set_parameters", SERVICE, hash_of(SERVICE, "cdr"))
            for name in self._wanted
        }
        clients = {name: self._node.client(endpoint) for name, endpoint in endpoints.items()}
        done: set[str] = set()
        while not self._ended.wait(_LOOK_S):
            lives = {name: self._node.lives(e.name, Kind.SERVER) for name, e in endpoints.items()}
            done &= set().union(*lives.values())
            for name, there in lives.items():
                if there - done and self._set(name, clients[name]):
                    done |= there
        for client in clients.values():
            client.close()

    def _set(self, name: str, client: Client) -> bool:
        """Whether the node has answered, whatever it said."""
        try:
            refused = refusals(client.call(self._requests[name], TIMEOUT_S), list(self._wanted[name]))
        except (CallError, DecodeError) as error:
            self._node.report(f"parameters {name}", f"parameters of {name} could not be set: {error}; trying on")
            return False
        self._node.settle(f"parameters {name}")
        for sentence in refused:
            self._node.report(f"parameters {name} {sentence}", f"{name}: {sentence}")
        return True


def _value(name: str, value: Any) -> dict[str, Any]:
    is_list = isinstance(value, list | tuple)
    items = list(value) if is_list else [value]
    for kind, number, field in _KINDS:
        if items and all(type(item) is kind for item in items):
            return (
                {"type": number + _ARRAYS, f"{field}_array_value": items}
                if is_list
                else {
                    "type": number,
                    f"{field}_value": value,
                }
            )
    raise ValueError(f"parameter {name}: must be true or false, a number or a text, or a list of one of them")
