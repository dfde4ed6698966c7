"""``skytether robot run --check``: is everything there that a run will need?"""

from __future__ import annotations

import os
import time
from collections.abc import Collection, Sequence
from dataclasses import dataclass

from rich.table import Table

from skytether.api.client import ApiError, Client, Unreachable
from skytether.api.manifest import ANY_TOPIC, Manifest, TopicSpec
from skytether.guard.record import lost_at_reboot
from skytether.messages import hash_of
from skytether.robot.config.robot_config import RobotConfig
from skytether.robot.graphs.ros1 import Ros1RobotConfig
from skytether.robot.graphs.wheels_watch import sentence, strangers
from skytether.robot.safety.client import GateError, ask, listens
from skytether.robot.session.topic_table import spoken
from skytether.ros.names import Names, resolve
from skytether.ros.permissions import Permissions, refused
from skytether.ros.ros1.master import MasterError
from skytether.ros.ros1.node import Node
from skytether.ros.ros1.services import CallRefusedError
from skytether.ros.ros1.subscription import Listener

from ...output import cell, console, print_whole
from .gate_process import ASSUMED, NO_GATE

_LOOK_S = 3.0
"""For publishers to say what they publish."""


@dataclass(frozen=True, slots=True)
class Finding:
    """One row of the answer.

    Attributes:
        what: Topic of the bridge, or what else is needed.
        where: Its name in the graph, or its address.
        kind: Its type.
        says: What was found.
        good: Whether that will do; a topic that nobody publishes yet will.
        missing: It is waited for.
    """

    what: str
    where: str
    kind: str
    says: str
    good: bool = True
    missing: bool = False


def look(settings: RobotConfig, graph: Ros1RobotConfig, node: Node, token: str) -> list[Finding]:
    """Everything that a run will need, one by one."""
    manifest, findings = look_at_orchestrator(settings, token)
    findings.append(_master(node))
    if manifest is not None and findings[-1].good:
        specs = spoken(manifest.spec.robot_topics, "action")
        names = graph.names(specs)
        findings += _topics(settings, names, node, specs)
        if any(row.name == ANY_TOPIC for spec in specs for row in spec.rows()):
            findings += _any(graph, node)
        findings += forbidden(graph.permissions(), specs, names, settings.command_topic)
        if graph.cmd_vel is not None:
            findings.append(_wheels(graph.cmd_vel, graph, node))
        if graph.wheels is not None:
            own = graph.drivers or [settings.node()]
            findings += other_publishers(graph.wheels, node.master.publishers(graph.wheels), own)
    return [*findings, *plausible(settings), look_at_gate(settings), *look_at_record(settings)]


def plausible(settings: RobotConfig) -> list[Finding]:
    """The numbers that the file says are meant to be beyond what is plausible; they will do."""
    notes = list(settings.notes())
    notes += [f"safety.{note}" for note in (settings.safety.notes() if settings.safety else ())]
    return [Finding("beyond", "robot.yaml", "", note) for note in notes]


def check_robot(settings: RobotConfig, graph: Ros1RobotConfig, node: Node, token: str) -> bool:
    """Look, and print a table. True if nothing is wrong."""
    return show(look(settings, graph, node, token))


def show(findings: Sequence[Finding]) -> bool:
    """Print a table. True if nothing is wrong."""
    table = Table(box=None, pad_edge=False)
    for head in ("", "what", "in the graph", "type", "found"):
        table.add_column(head, overflow="fold")
    for f in findings:
        table.add_row(
            "!!" if not f.good else ".." if f.missing else "ok", *map(cell, (f.what, f.where, f.kind, f.says))
        )
    print_whole(table)
    wrong = sum(not f.good for f in findings)
    missing = [f.where or f.what for f in findings if f.missing]
    said = f"{wrong} to mend, marked !!" if wrong else "all is there" if not missing else "nothing is to mend"
    said += f"; not there yet, and waited for: {', '.join(missing)}" if missing else ""
    console.print(said, markup=False, soft_wrap=True)
    return not wrong


def look_at_orchestrator(settings: RobotConfig, token: str) -> tuple[Manifest | None, list[Finding]]:
    """Whether it has the service, and what that takes and gives."""
    try:
        with Client(
            settings.orchestrator,
            token,
            ca_file=settings.ca_file or os.environ.get("SKYTETHER_CA_FILE"),
            insecure_http=settings.insecure_http,
        ) as client:
            manifest = client.get_service(settings.service)
    except (ApiError, Unreachable) as error:
        return None, [Finding("orchestrator", settings.orchestrator, "", str(error), good=False)]
    says = f"service {settings.service}, {len(manifest.spec.topics)} topics, calls and actions"
    return manifest, [Finding("orchestrator", settings.orchestrator, "", says)]


def _master(node: Node) -> Finding:
    try:
        topics = len(node.master.published())
    except MasterError as error:
        return Finding("ROS master", node.master_uri, "", f"{error}; is roscore running?", good=False)
    return Finding("ROS master", node.master_uri, "", f"answers; {topics} topics are published")


def _topics(settings: RobotConfig, names: Names, node: Node, specs: Sequence[TopicSpec]) -> list[Finding]:
    rows = [row for spec in specs if spec.kind != "call" for row in spec.rows() if row.name != ANY_TOPIC]
    taken = [row for row in rows if row.direction == "in"]
    for row in taken:
        node.subscribe(names.of(row.name), row.type, hash_of(row.type, "ros1"), Listener(lambda *_: None))
    found = [unknown(name) for name in names.unused(settings.ros1.readings if settings.ros1 else ())]
    published = node.master.published()
    deadline = time.monotonic() + _LOOK_S
    awaited = {names.of(row.name) for row in taken} & set(published)
    while time.monotonic() < deadline and any(not any(node.look()[name]) for name in awaited):
        time.sleep(0.05)
    for row in rows:
        name = names.of(row.name)
        if row.direction == "in":
            found.append(_incoming(row, name, node, name in published))
        elif row.name == settings.command_topic:
            found.append(Finding(row.name, "", row.type, "drives, past the supervisor"))
        else:
            found.append(Finding(row.name, name, row.type, "will be published"))
    found += [_call(spec, names.of(spec.name), node) for spec in specs if spec.kind == "call"]
    return found


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
    connected, refused = node.look()[name]
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


def look_at_gate(settings: RobotConfig) -> Finding:
    """Whether there is a gate before the wheels, or will be, and whether it is stopped."""
    safety = settings.safety
    if safety is None:
        return Finding("gate", "", "", f"warning: {NO_GATE}")
    assumed = f"; {ASSUMED}" if settings.gate_is_assumed else ""
    where = str(safety.place())
    if not listens(safety.place()):
        return Finding("gate", where, "", f"does not run yet; `skytether robot run` starts it{assumed}")
    try:
        stopped = ask(safety.place(), {"do": "status"})["stopped"]
    except GateError as error:
        return Finding("gate", where, "", str(error), good=False)
    says = f"has the wheels, and is stopped: {stopped}" if stopped else "has the wheels"
    return Finding("gate", where, "", f"{says}{assumed}", good=not stopped)


def look_at_record(settings: RobotConfig) -> list[Finding]:
    """Whether what stopped the robot will be known after a reboot; a warning, for the gate does its work without."""
    safety = settings.safety
    lost = "" if safety is None else lost_at_reboot(str(safety.record_file()))
    return [Finding("event record", "", "", f"warning: {lost}")] if lost else []


def _wheels(cmd_vel: str, graph: Ros1RobotConfig, node: Node) -> Finding:
    name = resolve(cmd_vel, graph.home)
    kind = node.master.topic_types().get(name, "*")
    if kind not in ("*", "geometry_msgs/Twist"):
        return Finding("wheels", name, "geometry_msgs/Twist", f"is a {kind}", good=False)
    says = "is known to the master" if kind != "*" else "nobody listens to it yet; is cmd_vel right?"
    return Finding("wheels", name, "geometry_msgs/Twist", says)


def other_publishers(topic: str | None, found: Collection[str], own: Collection[str]) -> list[Finding]:
    """Who else tells the wheels what to do."""
    names = strangers(found, own)
    if topic is None or not names:
        return []
    return [Finding("wheels", topic, "", sentence(topic, names), good=False)]


def forbidden(permissions: Permissions, specs: Sequence[TopicSpec], names: Names, command_topic: str) -> list[Finding]:
    """What the service wants in the graph and is not allowed: with any of it there is no session."""
    return [
        Finding(row, name, "", sentence, good=False)
        for row, name, sentence in refused(permissions, specs, names, command_topic)
    ]


def unknown(name: str) -> Finding:
    """A remapping of nothing that there is."""
    return Finding(f"remap.{name}", "", "", "the service has no such topic, call or action", good=False)
