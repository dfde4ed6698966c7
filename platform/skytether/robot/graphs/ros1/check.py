"""What ``--check`` and the doctor look at in a robot's ROS 1 graph: is everything there that a run will need?"""

from __future__ import annotations

import time
from collections.abc import Collection, Sequence

from skytether.api.manifest import ANY_TOPIC, Manifest, TopicSpec
from skytether.messages import hash_of
from skytether.ros.names import Names, resolve
from skytether.ros.ros1.master import MasterError
from skytether.ros.ros1.node import Node
from skytether.ros.ros1.services import CallRefusedError
from skytether.ros.ros1.subscription import Listener

from ...session.topic_table import spoken
from ..finding import Finding, forbidden, other_publishers, unknown
from ..graph_config import RobotGraphConfig
from .join import joined_node, node_name, robot_config
from .robot import Ros1RobotConfig
from .sections import Ros1Config

_LOOK_S = 3.0
"""For publishers to say what they publish."""
_DOCTORS = "ros master"
_TODO = "start roscore, or correct ros1.master in robot.yaml (ROS_MASTER_URI); both machines must know each other"


def check_graph(
    section: Ros1Config, shared: RobotGraphConfig, manifest: Manifest | None, command_topic: str, role: str
) -> list[Finding]:
    """Everything that a run will need of the graph, one by one.

    Raises:
        ConfigError: Our node cannot be.
    """
    graph = robot_config(section, shared)
    # With the agent's own name the master would end the agent that runs.
    with joined_node(section, node_name(section, graph.home, role), lambda _: None) as node:
        return _check_joined(graph, node, manifest, command_topic, graph.drivers or [node_name(section, graph.home)])


def _check_joined(
    graph: Ros1RobotConfig, node: Node, manifest: Manifest | None, command_topic: str, own: Collection[str]
) -> list[Finding]:
    findings = [_master(node)]
    if manifest is not None and findings[-1].good:
        specs = spoken(manifest.spec.robot_topics, "action")
        names = graph.names(specs)
        findings += _topics(graph, command_topic, names, node, specs)
        if any(row.name == ANY_TOPIC for spec in specs for row in spec.rows()):
            findings += _any(graph, node)
        findings += forbidden(graph.permissions(), specs, names, command_topic)
        if graph.cmd_vel is not None:
            findings.append(_wheels(graph.cmd_vel, graph, node))
        if graph.wheels is not None:
            findings += other_publishers(graph.wheels, node.master.publishers(graph.wheels), own)
    return findings


def _master(node: Node) -> Finding:
    try:
        topics = len(node.master.published())
    except MasterError as error:
        says = f"{error}; is roscore running?"
        return Finding("ROS master", node.master_uri, "", says, good=False, check=_DOCTORS, todo=_TODO)
    says = f"answers; {topics} topics are published"
    return Finding("ROS master", node.master_uri, "", says, check=_DOCTORS)


def _topics(
    graph: Ros1RobotConfig, command_topic: str, names: Names, node: Node, specs: Sequence[TopicSpec]
) -> list[Finding]:
    rows = [row for spec in specs if spec.kind != "call" for row in spec.rows() if row.name != ANY_TOPIC]
    own = graph.names(())
    readings = [(TopicSpec(name=n, type=kind, direction="in"), own.own(n)) for n, kind in graph.readings.items()]
    taken = [(row, names.of(row.name)) for row in rows if row.direction == "in"] + readings
    for row, name in taken:
        node.subscribe(name, row.type, hash_of(row.type, "ros1"), Listener(lambda *_: None))
    found = [unknown(name) for name in names.unused(graph.readings)]
    published = node.master.published()
    deadline = time.monotonic() + _LOOK_S
    awaited = {name for _, name in taken} & set(published)
    while time.monotonic() < deadline and any(not any(node.publishers_by_topic()[name]) for name in awaited):
        time.sleep(0.05)
    for row in rows:
        name = names.of(row.name)
        if row.direction == "in":
            found.append(_incoming(row, name, node, name in published))
        elif row.name == command_topic:
            found.append(Finding(row.name, "", row.type, "drives, past the supervisor"))
        else:
            found.append(Finding(row.name, name, row.type, "will be published"))
    found += [_call(spec, names.of(spec.name), node) for spec in specs if spec.kind == "call"]
    return found + [_incoming(row, name, node, name in published) for row, name in readings]


def _any(graph: Ros1RobotConfig, node: Node) -> list[Finding]:
    """What a service gets that takes any topic."""
    published = node.master.published()
    found = []
    for name in (resolve(name, graph.home) for name in graph.topics):
        who = ", ".join(node.master.publishers(name)) if name in published else ""
        says = f"from {who}" if who else "nobody publishes it yet; it is waited for"
        found.append(Finding(name, name, published.get(name, "any"), says, missing=not who))
    return found


def _incoming(row: TopicSpec, name: str, node: Node, published: bool) -> Finding:
    connected, refused = node.publishers_by_topic()[name]
    if refused:
        return Finding(row.name, name, row.type, next(iter(refused.values())), good=False)
    if connected:
        return Finding(row.name, name, row.type, "from " + ", ".join(info.caller for info in connected.values()))
    if published:
        return Finding(row.name, name, row.type, "is published, but its publisher cannot be reached", good=False)
    return Finding(row.name, name, row.type, "nobody publishes it yet; it is waited for", missing=True)


def _call(spec: TopicSpec, name: str, node: Node) -> Finding:
    if spec.direction == "in":
        return Finding(spec.name, name, spec.type, "will be offered")
    try:
        found = node.find_service(name)
    except (CallRefusedError, MasterError) as error:
        return Finding(spec.name, name, spec.type, str(error), good=False)
    says = "nobody offers it yet; it is waited for" if found is None else f"is offered, {found[1].type}"
    return Finding(spec.name, name, spec.type, says, missing=found is None)


def _wheels(cmd_vel: str, graph: Ros1RobotConfig, node: Node) -> Finding:
    name = resolve(cmd_vel, graph.home)
    kind = node.master.topic_types().get(name, "*")
    if kind not in ("*", "geometry_msgs/Twist"):
        return Finding("wheels", name, "geometry_msgs/Twist", f"is a {kind}", good=False)
    says = "is known to the master" if kind != "*" else "nobody listens to it yet; is cmd_vel right?"
    return Finding("wheels", name, "geometry_msgs/Twist", says)
