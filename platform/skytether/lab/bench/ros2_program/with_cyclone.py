"""Cyclone DDS with its own Python, on the topics and with the messages of ROS 2."""

# The type's fields are read from its annotations, so these may not be turned into text.
from dataclasses import dataclass
from typing import Any

from cyclonedds.core import Listener, Policy, Qos
from cyclonedds.domain import DomainParticipant
from cyclonedds.idl import IdlStruct
from cyclonedds.idl.types import sequence, uint8, uint32
from cyclonedds.pub import DataWriter
from cyclonedds.sub import DataReader
from cyclonedds.topic import Topic
from cyclonedds.util import duration

from .graph import HEAD_BYTES, Deliver, Graph, Wanted, serialise

_BLOCK_S = 0.1
"""As rmw_cyclonedds: how long a reliable writer may wait for room in its queue."""
_TAKE = 64


@dataclass
class _Dimension(IdlStruct, typename="std_msgs.msg.dds_.MultiArrayDimension_"):  # type: ignore[call-arg, misc]
    label: str
    size: uint32
    stride: uint32


@dataclass
class _Layout(IdlStruct, typename="std_msgs.msg.dds_.MultiArrayLayout_"):  # type: ignore[call-arg, misc]
    dim: sequence[_Dimension]
    data_offset: uint32


@dataclass
class _UInt8MultiArray(IdlStruct, typename="std_msgs.msg.dds_.UInt8MultiArray_"):  # type: ignore[call-arg, misc]
    layout: _Layout
    data: sequence[uint8]

    # Serialised messages pass as they are, as in rclpy with raw=True: encoding in Python would be what is measured.
    def serialize(self, *_: Any, **__: Any) -> bytes:
        return serialise(self.data)

    @classmethod
    def deserialize(cls, data: bytes, *_: Any, **__: Any) -> "_UInt8MultiArray":
        return cls(_Layout([], 0), data)


class CycloneGraph(Graph):
    """One participant; messages are taken in Cyclone's own thread, as they come."""

    def __init__(self, wanted: Wanted, deliver: Deliver) -> None:
        """Join the graph."""
        self._participant = DomainParticipant(wanted.domain)
        self._readers, self._writers = {}, {}
        for i in (*wanted.receives, *wanted.sends):
            flow = wanted.flows[i]
            kind = Policy.Reliability
            quality = Qos(
                kind.Reliable(duration(seconds=_BLOCK_S)) if wanted.reliable else kind.BestEffort,
                Policy.Durability.Volatile,
                Policy.History.KeepLast(flow.depth),
            )
            topic = Topic(self._participant, f"rt{flow.topic}", _UInt8MultiArray)
            if i in wanted.sends:
                self._writers[i] = DataWriter(self._participant, topic, qos=quality)
            else:
                listener = _Listener(i, deliver)
                self._readers[i] = DataReader(self._participant, topic, qos=quality, listener=listener)

    def connected(self) -> bool:
        return all(w.get_matched_subscriptions() for w in self._writers.values()) and all(
            r.get_matched_publications() for r in self._readers.values()
        )

    def publish(self, index: int, payload: bytes) -> None:
        self._writers[index].write(_UInt8MultiArray(_Layout([], 0), payload))

    def close(self) -> None:
        for reader in self._readers.values():
            reader.set_listener(Listener())


class _Listener(Listener):  # type: ignore[misc]
    def __init__(self, index: int, deliver: Deliver) -> None:
        super().__init__()
        self._index = index
        self._deliver = deliver

    def on_data_available(self, reader: "DataReader[_UInt8MultiArray]") -> None:
        for sample in reader.take(_TAKE):
            if isinstance(sample, _UInt8MultiArray):
                self._deliver(self._index, sample.data, HEAD_BYTES)
