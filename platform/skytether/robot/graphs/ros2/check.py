"""What ``--check`` and the doctor look at in a robot's ROS 2 graph: is everything there that a run will need?"""

from __future__ import annotations

import time
from collections.abc import Mapping, Sequence
from pathlib import Path

from skytether.api.manifest import ANY_TOPIC, Manifest, TopicSpec
from skytether.messages import hash_of
from skytether.ros.names import Names, resolve
from skytether.ros.ros2.config import join_graph
from skytether.ros.ros2.dialect import Endpoint, Kind
from skytether.ros.ros2.graph import mismatches
from skytether.ros.ros2.lifecycle import ACTIVE, states
from skytether.ros.ros2.native.node import NOBODY, RclpyNode, clashes
from skytether.ros.ros2.qos import Qos, history_missed
from skytether.ros.ros2.seam import GraphNode

from ...session.topic_table import spoken
from ..finding import Finding, forbidden, other_publishers, unknown
from ..graph_config import RobotGraphConfig
from .join import robot_config
from .robot import Ros2RobotConfig
from .sections import Ros2Config

_JOIN_S = 10.0
"""For the node to come up, or the router to answer and to tell of the graph."""
_LIFECYCLE_S = 3.0
"""For lifecycle nodes to tell their states."""
_FIRST_S = 15.0
"""For the first node on DDS to be discovered."""
_NEXT_S = 5.0
"""For the next: nobody says when all of them are."""
_TODO = "start the robot's nodes, or correct ros2 in robot.yaml"


def check_graph(
    ros2: Ros2Config, shared: RobotGraphConfig, folder: Path, manifest: Manifest | None, command_topic: str
) -> list[Finding]:
    """Everything that a run will need of the graph, one by one.

    Raises:
        ConfigError: ROS 2 or the extra is missing, or Zenoh does not take a setting.
    """
    config = robot_config(ros2, shared)
    with join_graph(ros2, folder, config.home) as node:
        joined = node.wait_until_joined(_JOIN_S)
        findings = [_graph(ros2, node) if isinstance(node, RclpyNode) else _router(ros2, node, joined)]
        if manifest is not None and joined:
            specs = spoken(manifest.spec.robot_topics, "ros2_action")
            names = config.names(specs)
            findings += [unknown(name) for name in names.unused((*config.readings, ros2.cmd_vel))]
            parts = [part for spec in specs for part in spec.parts()]
            rows = [part for part in parts if part.name != ANY_TOPIC]
            wanted = [resolve(name, config.home) for name in config.topics] if len(rows) < len(parts) else []
            # What a publisher keeps for newcomers they get, without a word of any manifest.
            kept = {"direction": "in", "reliable": True, "latched": True}
            readings = [TopicSpec.model_validate({"name": n, "type": t, **kept}) for n, t in config.readings.items()]
            if isinstance(node, RclpyNode):
                awaited = [
                    (Kind.PUBLISHER, names.of(r.name)) for r in rows if r.kind == "topic" and r.direction == "in"
                ]
                awaited += [(Kind.PUBLISHER, name) for name in wanted]
                awaited += [(Kind.PUBLISHER, config.names(()).own(name)) for name in config.readings]
                if config.cmd_vel is not None:
                    awaited.append((Kind.SUBSCRIPTION, config.names(()).own(config.cmd_vel)))
                _wait(node, awaited)
                findings[0] = _graph(ros2, node)
            idle = {name: label for name, label in states(node, _LIFECYCLE_S).items() if label != ACTIVE}
            findings += [_row(command_topic, part, names, node, idle) for part in rows]
            findings += [_any(name, node) for name in wanted if name not in {names.of(row.name) for row in rows}]
            findings += [_row("", row, config.names(()), node, idle) for row in readings]
            findings += forbidden(config.permissions(), specs, names, command_topic)
            if config.cmd_vel is not None:
                findings.append(_wheels(config, config.cmd_vel, node))
            found = [endpoint.node for endpoint in node.endpoints(config.wheels, Kind.PUBLISHER)]
            findings += other_publishers(config.wheels, found, config.drivers)
    return findings


def _router(ros2: Ros2Config, node: GraphNode, joined: bool) -> Finding:
    router = ros2.router or "as configured"
    if not joined:
        todo = "start the graph's Zenoh router, or correct ros2.router in robot.yaml"
        says = "does not answer; is it running? (ros2 run rmw_zenoh_cpp rmw_zenohd)"
        return Finding("ROS 2 router", router, "", says, good=False, todo=todo)
    says = f"answers; {len(node.endpoints())} publishers, subscriptions, services and clients"
    return Finding("ROS 2 router", router, "", says)


def _graph(ros2: Ros2Config, node: RclpyNode) -> Finding:
    """The node that we are, and whether anybody else is seen."""
    if not node.middleware:
        says = "; ".join(node.troubles) or f"our node was not there within {_JOIN_S:g} s"
        return Finding("ROS 2 graph", ros2.node, "", says, good=False, todo=_TODO)
    where = f"{node.middleware}, domain {node.domain}"
    if not node.nodes:
        return Finding("ROS 2 graph", where, "", NOBODY, good=False, todo=_TODO)
    if node.troubles:
        return Finding("ROS 2 graph", where, "", "; ".join(node.troubles), good=False, todo=_TODO)
    return Finding("ROS 2 graph", where, "", f"{node.nodes} other nodes are seen")


def _wait(node: RclpyNode, awaited: list[tuple[Kind, str]]) -> None:
    """Until all of these are seen, or nothing more has come for a while."""
    most, since = 0, time.monotonic()
    while not node.nodes or not all(node.endpoints(name, kind) for kind, name in awaited):
        seen = node.nodes + len(node.endpoints())
        if seen > most:
            most, since = seen, time.monotonic()
        if time.monotonic() - since > (_NEXT_S if node.nodes else _FIRST_S):
            return
        time.sleep(0.05)


def _row(command_topic: str, row: TopicSpec, names: Names, node: GraphNode, idle: Mapping[str, str]) -> Finding:
    """One row of the service's topics; ``idle`` are the lifecycle nodes that are not active, with their states."""
    if row.kind == "topic" and row.direction == "out" and row.name == command_topic:
        return Finding(row.name, "", row.type, "drives, past the supervisor")
    ours, says, waits = _expected(row, names)
    others = node.endpoints(ours.name, ours.kind.answers)
    wrong = [mismatch.reason for mismatch in mismatches(ours, others)]
    if ours.kind is Kind.PUBLISHER and isinstance(node, RclpyNode):
        wrong += clashes(ours, others)
    if wrong:
        return Finding(row.name, ours.name, row.type, wrong[0], good=False)
    if not waits:
        return Finding(row.name, ours.name, row.type, says)
    if not others:
        asleep = ", ".join(f"{who} ({label})" for who, label in sorted(idle.items()))
        hint = f"; lifecycle nodes that are not active: {asleep}" if asleep else ""
        return Finding(row.name, ours.name, row.type, f"nobody {waits} it yet; it is waited for{hint}", missing=True)
    who = ", ".join(sorted({o.node for o in others if o.node}))
    says = f"{says} {who}".strip() + _idle_hint(others, idle)
    if ours.kind is Kind.SUBSCRIPTION:
        says += _durability_hints(row, others, node)
    return Finding(row.name, ours.name, row.type, says, missing=all(o.node in idle for o in others))


def _expected(row: TopicSpec, names: Names) -> tuple[Endpoint, str, str]:
    """Our side of a row, what is said of it, and what the others' side does that is waited for; empty: nothing."""
    if row.kind == "call":
        name = names.of(f"{row.name}/request").removesuffix("/request")
        served = Kind.SERVER, "will be offered", ""
        kind, says, waits = served if row.direction == "in" else (Kind.CLIENT, "is offered", "offers")
    else:
        name = names.of(row.name)
        published = Kind.PUBLISHER, "will be published", ""
        kind, says, waits = (Kind.SUBSCRIPTION, "from", "publishes") if row.direction == "in" else published
    qos = Qos(reliable=True, transient_local=row.latched)
    return Endpoint(kind, name, row.type, hash_of(row.type, "cdr"), qos), says, waits


def _idle_hint(others: Sequence[Endpoint], idle: Mapping[str, str]) -> str:
    still = sorted({o.node for o in others if o.node in idle})
    if not still:
        return ""
    sleeping = ", ".join(f"{name} is a lifecycle node and {idle[name]}" for name in still)
    return f"; {sleeping}: it does nothing until it is activated (ros2 lifecycle set {still[0]} activate)"


def _durability_hints(row: TopicSpec, others: Sequence[Endpoint], node: GraphNode) -> str:
    """What others keep for newcomers, and we do not get."""
    hints = ""
    if not row.latched and any(o.qos.reliable and o.qos.transient_local for o in others):
        hints += "; it is transient local: reliable: true, latched: true in the manifest would keep it for newcomers"
    if isinstance(node, RclpyNode) and history_missed([o.qos for o in others]):
        kept = ", ".join(sorted({o.node for o in others if o.qos.transient_local}))
        lost = ", ".join(sorted({o.node for o in others if not o.qos.transient_local}))
        hints += f"; what {kept} keeps for newcomers (transient local) is missed, because {lost} offers volatile"
    return hints


def _any(name: str, node: GraphNode) -> Finding:
    """A topic for a service that takes any."""
    others = node.endpoints(name, Kind.PUBLISHER)
    if not others:
        return Finding(name, name, "any", "nobody publishes it yet; it is followed as it comes", missing=True)
    who = ", ".join(sorted({other.node for other in others if other.node}))
    return Finding(name, name, others[0].type, f"from {who}".strip())


def _wheels(config: Ros2RobotConfig, cmd_vel: str, node: GraphNode) -> Finding:
    name = config.names(()).own(cmd_vel)
    ours = Endpoint(Kind.PUBLISHER, name, config.cmd_vel_type, hash_of(config.cmd_vel_type, "cdr"))
    others = node.endpoints(name, Kind.SUBSCRIPTION)
    wrong = mismatches(ours, others)
    if wrong:
        hint = "" if wrong[0].endpoint.type == ours.type else "; set ros2.cmd_vel_type"
        return Finding("wheels", name, ours.type, wrong[0].reason + hint, good=False)
    if isinstance(node, RclpyNode) and (unheard := clashes(ours, others)):
        return Finding("wheels", name, ours.type, unheard[0], good=False)
    says = "is listened to" if others else "nobody listens to it yet; is cmd_vel right?"
    return Finding("wheels", name, ours.type, says)
