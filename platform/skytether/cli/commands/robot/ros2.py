"""``skytether robot run`` for a robot that is a ROS 2 graph: how it is joined, and what ``--check`` looks at."""

from __future__ import annotations

import time
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path

from skytether.api.manifest import ANY_TOPIC, TopicSpec
from skytether.messages import hash_of
from skytether.robot.agent.diagnostics import TOPIC as DIAGNOSTICS
from skytether.robot.agent.diagnostics import Ros2Diagnostics
from skytether.robot.config.robot_config import RobotConfig, Ros2Config
from skytether.robot.graphs.ros2 import Ros2Robot, Ros2RobotConfig
from skytether.robot.session.topic_table import spoken
from skytether.ros.names import Names, resolve
from skytether.ros.ros2.config import join_graph
from skytether.ros.ros2.dialect import Endpoint, Kind
from skytether.ros.ros2.graph import mismatches
from skytether.ros.ros2.lifecycle import ACTIVE, states
from skytether.ros.ros2.native.node import NOBODY, RclpyNode, clashes
from skytether.ros.ros2.qos import Qos, history_missed, row_settings
from skytether.ros.ros2.seam import GraphNode

from .check import (
    Finding,
    forbidden,
    look_at_gate,
    look_at_orchestrator,
    look_at_record,
    other_publishers,
    plausible,
    show,
    unknown,
)

_JOIN_S = 10.0
"""For the node to come up, or the router to answer and to tell of the graph."""
_LIFECYCLE_S = 3.0
"""For lifecycle nodes to tell their states."""
_LOOK_S = 5.0
"""For nodes on DDS to be discovered: nobody says when all of them are."""


def ros2_config(settings: RobotConfig, ros2: Ros2Config) -> Ros2RobotConfig:
    """What the graph needs of the configuration."""
    return Ros2RobotConfig(
        robot=settings.robot,
        service=settings.service,
        namespace=ros2.namespace,
        remap=ros2.remap,
        cmd_vel=ros2.cmd_vel if settings.safety is None else None,
        cmd_vel_type=ros2.cmd_vel_type,
        frame=ros2.frame,
        idle_s=ros2.idle_s,
        readings=ros2.readings,
        topics=ros2.topics,
        allowed=settings.allowed,
        protected=settings.protected,
        wheels=settings.wheels,
        drivers=settings.drivers,
    )


@contextmanager
def join_ros2(settings: RobotConfig, ros2: Ros2Config, folder: Path) -> Iterator[tuple[Ros2Robot, Ros2Diagnostics]]:
    """The robot as a graph, and its diagnostics there, for as long as the context lasts.

    Raises:
        ConfigError: ROS 2 or the extra is missing, or Zenoh does not take a setting.
    """
    config = ros2_config(settings, ros2)
    with join_graph(ros2, folder, config.home) as node:
        robot = Ros2Robot(config, node)
        name = resolve(ros2.node, config.home)
        topic = config.names(()).own(DIAGNOSTICS)
        try:
            yield robot, Ros2Diagnostics(settings.robot, settings.service, name, node, topic)
        finally:
            robot.close()


def check_ros2(settings: RobotConfig, ros2: Ros2Config, folder: Path, token: str) -> bool:
    """Look whether everything is there that a run will need, and print a table. True if nothing is wrong.

    Raises:
        ConfigError: ROS 2 or the extra is missing, or Zenoh does not take a setting.
    """
    return show(look_ros2(settings, ros2, folder, token))


def look_ros2(settings: RobotConfig, ros2: Ros2Config, folder: Path, token: str) -> list[Finding]:
    """Everything that a run will need, one by one.

    Raises:
        ConfigError: ROS 2 or the extra is missing, or Zenoh does not take a setting.
    """
    config = ros2_config(settings, ros2)
    manifest, findings = look_at_orchestrator(settings, token)
    with join_graph(ros2, folder, config.home) as node:
        joined = node.wait_until_joined(_JOIN_S)
        graph = len(findings)
        findings.append(_graph(ros2, node) if isinstance(node, RclpyNode) else _router(ros2, node, joined))
        if manifest is not None and joined:
            specs = spoken(manifest.spec.robot_topics, "ros2_action")
            names = config.names(specs)
            findings += [unknown(name) for name in names.unused((*config.readings, ros2.cmd_vel))]
            rows = [part for spec in specs for part in spec.parts() if part.name != ANY_TOPIC]
            if isinstance(node, RclpyNode):
                awaited = [
                    (Kind.PUBLISHER, names.of(r.name)) for r in rows if r.kind == "topic" and r.direction == "in"
                ]
                if config.cmd_vel is not None:
                    awaited.append((Kind.SUBSCRIPTION, config.names(()).own(config.cmd_vel)))
                _wait(node, awaited)
                findings[graph] = _graph(ros2, node)
            idle = {name: label for name, label in states(node, _LIFECYCLE_S).items() if label != ACTIVE}
            findings += [_row(settings, part, names, node, idle) for part in rows]
            findings += forbidden(config.permissions(), specs, names, settings.command_topic)
            if config.cmd_vel is not None:
                findings.append(_wheels(config, config.cmd_vel, node))
            found = [endpoint.node for endpoint in node.endpoints(config.wheels, Kind.PUBLISHER)]
            findings += other_publishers(config.wheels, found, config.drivers)
    return [*findings, *plausible(settings), look_at_gate(settings), *look_at_record(settings)]


def _router(ros2: Ros2Config, node: GraphNode, joined: bool) -> Finding:
    router = ros2.router or "as configured"
    if not joined:
        says = "does not answer; is it running? (ros2 run rmw_zenoh_cpp rmw_zenohd)"
        return Finding("ROS 2 router", router, "", says, good=False)
    says = f"answers; {len(node.endpoints())} publishers, subscriptions, services and clients"
    return Finding("ROS 2 router", router, "", says)


def _graph(ros2: Ros2Config, node: RclpyNode) -> Finding:
    """The node that we are, and whether anybody else is seen."""
    if not node.middleware:
        says = "; ".join(node.troubles) or f"our node was not there within {_JOIN_S:g} s"
        return Finding("ROS 2 graph", ros2.node, "", says, good=False)
    where = f"{node.middleware}, domain {node.domain}"
    if not node.nodes:
        return Finding("ROS 2 graph", where, "", NOBODY, good=False)
    if node.troubles:
        return Finding("ROS 2 graph", where, "", "; ".join(node.troubles), good=False)
    return Finding("ROS 2 graph", where, "", f"{node.nodes} other nodes are seen")


def _wait(node: RclpyNode, awaited: list[tuple[Kind, str]]) -> None:
    """Until all of these are seen, for a while."""
    deadline = time.monotonic() + _LOOK_S
    while time.monotonic() < deadline and not all(node.endpoints(name, kind) for kind, name in awaited):
        time.sleep(0.05)


def _row(settings: RobotConfig, row: TopicSpec, names: Names, node: GraphNode, idle: Mapping[str, str]) -> Finding:
    """One row of the service's topics; ``idle`` are the lifecycle nodes that are not active, with their states."""
    if row.kind == "topic" and row.direction == "out" and row.name == settings.command_topic:
        return Finding(row.name, "", row.type, "drives, past the supervisor")
    if row.kind == "call":
        name = names.of(f"{row.name}/request").removesuffix("/request")
        kind, verb, waits = (
            (Kind.SERVER, "will be offered", "") if row.direction == "in" else (Kind.CLIENT, "is offered", "offers")
        )
    else:
        name = names.of(row.name)
        kind, verb, waits = (
            (Kind.SUBSCRIPTION, "from", "publishes")
            if row.direction == "in"
            else (Kind.PUBLISHER, "will be published", "")
        )
    qos = Qos(reliable=True, transient_local=row.latched)
    ours = Endpoint(kind, name, row.type, hash_of(row.type, "cdr"), qos)
    others = node.endpoints(name, kind.answers)
    wrong = [mismatch.reason for mismatch in mismatches(ours, others)]
    if kind is Kind.PUBLISHER and isinstance(node, RclpyNode):
        wrong += clashes(ours, others)
    if wrong:
        return Finding(row.name, name, row.type, wrong[0], good=False)
    if waits and not others:
        asleep = ", ".join(f"{who} ({label})" for who, label in sorted(idle.items()))
        hint = f"; lifecycle nodes that are not active: {asleep}" if asleep else ""
        return Finding(row.name, name, row.type, f"nobody {waits} it yet; it is waited for{hint}", missing=True)
    who = ", ".join(sorted({o.node for o in others if o.node}))
    says = f"{verb} {who}".strip() if waits else verb
    still = sorted({o.node for o in others if o.node in idle}) if waits else []
    if still:
        sleeping = ", ".join(f"{node_name} is a lifecycle node and {idle[node_name]}" for node_name in still)
        says += f"; {sleeping}: it does nothing until it is activated (ros2 lifecycle set {still[0]} activate)"
    if kind is Kind.SUBSCRIPTION and not row.latched and any(row_settings(o.qos)["latched"] for o in others):
        says += "; it is transient local: reliable: true, latched: true in the manifest would keep it for newcomers"
    if kind is Kind.SUBSCRIPTION and isinstance(node, RclpyNode) and history_missed([o.qos for o in others]):
        kept = ", ".join(sorted({o.node for o in others if o.qos.transient_local}))
        lost = ", ".join(sorted({o.node for o in others if not o.qos.transient_local}))
        says += f"; what {kept} keeps for newcomers (transient local) is missed, because {lost} offers volatile"
    return Finding(row.name, name, row.type, says, missing=bool(still) and all(o.node in idle for o in others))


def _wheels(config: Ros2RobotConfig, cmd_vel: str, node: GraphNode) -> Finding:
    name = config.names(()).own(cmd_vel)
    ours = Endpoint(Kind.PUBLISHER, name, config.cmd_vel_type, hash_of(config.cmd_vel_type, "cdr"))
    others = node.endpoints(name, Kind.SUBSCRIPTION)
    wrong = mismatches(ours, others)
    if wrong:
        hint = "" if wrong[0].endpoint.type == ours.type else "; set ros2.cmd_vel_type"
        return Finding("wheels", name, ours.type, wrong[0].reason + hint, good=False)
    says = "is listened to" if others else "nobody listens to it yet; is cmd_vel right?"
    return Finding("wheels", name, ours.type, says)
