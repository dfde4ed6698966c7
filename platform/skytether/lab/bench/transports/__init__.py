"""The transports that can be measured, by name. Each is loaded when it is asked for."""

from __future__ import annotations

from importlib import import_module

from .base import EndSpec, Program, Transport, TransportError

_WHERE = {
    "skytether": "skytether:SkytetherTransport",
    "udp": "udp:UdpTransport",
    "tcp": "tcp:TcpTransport",
    "websocket-cbor": "websocket:WebsocketTransport",
    "zenoh-tcp": "zenoh:ZenohTcp",
    "zenoh-2tcp": "zenoh:ZenohTwoTcp",
    "zenoh-quic": "zenoh:ZenohQuic",
    "zenoh-udp": "zenoh:ZenohUdp",
    "zenoh-mixed": "zenoh:ZenohMixed",
    "ros2-best-effort": "ros2:BestEffort",
    "ros2-reliable": "ros2:Reliable",
    "ros2-tuned-best-effort": "ros2:TunedBestEffort",
    "ros2-tuned-reliable": "ros2:TunedReliable",
    "cyclone-best-effort": "ros2:CycloneBestEffort",
    "cyclone-reliable": "ros2:CycloneReliable",
}
NAMES = tuple(_WHERE)


def load(name: str) -> type[Transport] | type[Program]:
    """The class of a transport.

    Raises:
        ValueError: The name is not known; the text lists those that are.
        TransportError: It needs a library that is not installed.
    """
    if name not in _WHERE:
        raise ValueError(f"transport '{name}' is not known; choose from {', '.join(NAMES)}")
    module, _, attribute = _WHERE[name].partition(":")
    try:
        found: type[Transport] | type[Program] = getattr(import_module(f".{module}", __name__), attribute)
    except ModuleNotFoundError as error:
        raise TransportError(f"{name}: needs {error.name}: pip install 'skytether[peers]'") from error
    return found


__all__ = ["NAMES", "EndSpec", "Program", "Transport", "TransportError", "load"]
