"""Settings of Fast DDS and Cyclone DDS, as text for their own files."""

from __future__ import annotations

from collections.abc import Iterable

MTU = 1400
"""Bytes of a datagram, so that IP makes no fragments of it, through a VPN neither."""
HEARTBEAT_MS = 100
"""Between a reliable writer's heartbeats; Fast DDS's default is 3 s. Each is answered by a request for what is missing:
at less than a round trip, the same is repeated several times (at 20 ms the small topics starved)."""
_PERIOD_MS = 10
_BYTES = 20_000
"""The flow controller's limit in each period, 16 Mbit/s: under the 20 Mbit/s that the slowest links have."""
_BUFFER = 4 * 1024 * 1024


def fastdds_profile(topics: Iterable[tuple[str, int]]) -> str:
    """A profile for lossy networks after Fast DDS's documentation ("Large Data Rates"), for Fast DDS 3.

    Args:
        topics: Names and ranks, 1 the highest.
    """
    writers = "".join(_writer(name, rank) for name, rank in topics)
    return f"""<?xml version="1.0" encoding="UTF-8" ?>
<dds xmlns="http://www.eprosima.com"><profiles>
  <transport_descriptors><transport_descriptor>
    <transport_id>lossy</transport_id>
    <type>UDPv4</type>
    <sendBufferSize>{_BUFFER}</sendBufferSize>
    <receiveBufferSize>{_BUFFER}</receiveBufferSize>
    <maxMessageSize>{MTU}</maxMessageSize>
  </transport_descriptor></transport_descriptors>
  <participant profile_name="lossy" is_default_profile="true"><rtps>
    <flow_controller_descriptor_list><flow_controller_descriptor>
      <name>link</name>
      <scheduler>HIGH_PRIORITY</scheduler>
      <max_bytes_per_period>{_BYTES}</max_bytes_per_period>
      <period_ms>{_PERIOD_MS}</period_ms>
    </flow_controller_descriptor></flow_controller_descriptor_list>
    <userTransports><transport_id>lossy</transport_id></userTransports>
    <useBuiltinTransports>false</useBuiltinTransports>
  </rtps></participant>
{writers}</profiles></dds>
"""


def _writer(topic: str, rank: int) -> str:
    """A data writer's profile, which rmw_fastrtps finds by the topic's name."""
    priority = min(rank - 11, 10)  # from -10, the highest
    return f"""  <data_writer profile_name="{topic}">
    <times><heartbeat_period><sec>0</sec><nanosec>{HEARTBEAT_MS * 1_000_000}</nanosec></heartbeat_period></times>
    <qos><publishMode><kind>ASYNCHRONOUS</kind><flow_controller_name>link</flow_controller_name></publishMode></qos>
    <propertiesPolicy><properties><property>
      <name>fastdds.sfc.priority</name><value>{priority}</value>
    </property></properties></propertiesPolicy>
  </data_writer>
"""


def cyclone_settings(peer: str) -> str:
    """What rmw_cyclonedds sets for the other end's address: no multicast, the peer named. All else is as it comes."""
    return (
        '<CycloneDDS><Domain id="any"><General><AllowMulticast>false</AllowMulticast></General>'
        "<Discovery><ParticipantIndex>auto</ParticipantIndex><MaxAutoParticipantIndex>32</MaxAutoParticipantIndex>"
        f'<Peers><Peer address="{peer}"/></Peers></Discovery></Domain></CycloneDDS>'
    )
