"""Behaviour trees from YAML files: who wants another behaviour writes a file, and no program.

A node is a name (``follow``), a name with parameters (``wait: {seconds: 2}``), or one of those below with children.
Errors name the line, and say what to do.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from difflib import get_close_matches
from pathlib import Path
from typing import Any, NoReturn

import yaml
from py_trees.behaviour import Behaviour
from py_trees.common import Status
from py_trees.composites import Composite, Selector, Sequence
from py_trees.decorators import Decorator, FailureIsSuccess, Inverter, Retry, SuccessIsFailure

from skytether.service import ConfigError, param
from skytether.service.params import read_params

from .behaviours import LEAVES, PlanPath, Robot

BUILT_IN = Path(__file__).with_name("behaviours.yaml")
MAX_BYTES = 65_536
MAX_NODES = 500
MAX_DEPTH = 50


class RoundRobin(Composite):
    """Another child each time, until one succeeds; fails when all have failed since the last success."""

    def __init__(self, name: str, children: list[Behaviour]) -> None:
        super().__init__(name, children)
        self._next = 0
        self._failed = 0

    def tick(self) -> Any:
        if self.status != Status.RUNNING:
            self._failed = 0
        while True:
            child = self.children[self._next]
            self.current_child = child
            yield from child.tick()
            if child.status == Status.RUNNING:
                self.status = Status.RUNNING
                break
            self._next = (self._next + 1) % len(self.children)
            if child.status == Status.SUCCESS:
                self.stop(Status.SUCCESS)
                break
            self._failed += 1
            if self._failed >= len(self.children):
                self.stop(Status.FAILURE)
                break
        yield self


class Timeout(Decorator):
    """Fails, and stops its child, when that takes too long by the robot's clock."""

    def __init__(self, name: str, child: Behaviour, robot: Robot, seconds: float) -> None:
        super().__init__(name, child)
        self._robot, self._seconds = robot, seconds

    def initialise(self) -> None:
        self._began = self._robot.now

    def update(self) -> Status:
        if self.decorated.status == Status.RUNNING and self._robot.now - self._began > self._seconds:
            return Status.FAILURE
        return self.decorated.status


class Counted(Decorator):
    """Tells the robot when its child, a recovery, begins."""

    def __init__(self, name: str, child: Behaviour, robot: Robot) -> None:
        super().__init__(name, child)
        self._robot = robot

    def initialise(self) -> None:
        self._robot.recovered()

    def update(self) -> Status:
        return self.decorated.status


@dataclass(frozen=True)
class _Nothing:
    """Of a decorator without parameters."""


@dataclass(frozen=True)
class _Times:
    """Of `retry` and `recover`."""

    times: int = param(ge=1, le=1000, doc="attempts")


@dataclass(frozen=True)
class _Seconds:
    """Of `timeout`."""

    seconds: float = param(gt=0, le=86_400, unit="s", doc="at most")


_COMPOSITES: dict[str, Callable[[list[Behaviour]], Behaviour]] = {
    "sequence": lambda children: Sequence("sequence", True, children),
    "reactive_sequence": lambda children: Sequence("reactive_sequence", False, children),
    "fallback": lambda children: Selector("fallback", True, children),
    "reactive_fallback": lambda children: Selector("reactive_fallback", False, children),
    "round_robin": lambda children: RoundRobin("round_robin", children),
}
_DECORATORS: dict[str, tuple[type[Any], Callable[[Behaviour, Robot, Any], Behaviour]]] = {
    "retry": (_Times, lambda child, _, params: Retry("retry", child, params.times)),
    "timeout": (_Seconds, lambda child, robot, params: Timeout("timeout", child, robot, params.seconds)),
    "invert": (_Nothing, lambda child, *_: Inverter("invert", child)),
    "succeed": (_Nothing, lambda child, *_: FailureIsSuccess("succeed", child)),
}
NAMES = (*_COMPOSITES, *_DECORATORS, "recover", *LEAVES)


def load_tree(path: Path, robot: Robot, planner_period: float) -> Behaviour:
    """Build a tree from a file.

    Args:
        path: The YAML file.
        robot: On which its leaves act.
        planner_period: Of `plan`, unless the file says otherwise [s].

    Raises:
        ConfigError: It cannot be read, or is no tree; the text names the line, and says what to do.
    """
    try:
        with path.open("rb") as file:
            text = file.read(MAX_BYTES + 1)
    except OSError as error:
        raise ConfigError(f"behaviours: {path} cannot be read: {error.strerror}") from None
    if len(text) > MAX_BYTES:
        raise ConfigError(f"behaviours: {path} has more than {MAX_BYTES} bytes; is it a behaviour tree?")
    return _Builder(str(path), robot, planner_period).build(text)


class _Builder:
    """Of one file."""

    def __init__(self, source: str, robot: Robot, planner_period: float) -> None:
        self._source, self._robot, self._period = source, robot, planner_period
        self._nodes = 0

    def build(self, text: bytes) -> Behaviour:
        try:
            document = yaml.compose(text.decode(), Loader=yaml.SafeLoader)
        except (yaml.YAMLError, UnicodeDecodeError, RecursionError) as error:
            mark = getattr(error, "problem_mark", None)
            where = f" line {mark.line + 1}" if mark is not None else ""
            what = getattr(error, "problem", None) or "it is not UTF-8 text in YAML"
            raise ConfigError(f"behaviours: {self._source}{where}: {what}") from None
        if document is None:
            raise ConfigError(f"behaviours: {self._source} is empty; write a node, such as 'follow'")
        return self._node(document, 0)

    def _node(self, node: yaml.Node, depth: int) -> Behaviour:
        self._nodes += 1
        if self._nodes > MAX_NODES or depth > MAX_DEPTH:
            self._refuse(node, f"the tree has more than {MAX_NODES} nodes, or {MAX_DEPTH} below one another")
        name, content = self._split(node)
        if name in _COMPOSITES:
            return _COMPOSITES[name](self._children(name, content, node, depth))
        if name in _DECORATORS:
            given, parts = self._mapping(name, content, node, ("child",))
            kind, make = _DECORATORS[name]
            params = self._params(name, kind, given, node)
            return make(self._node(parts["child"], depth + 1), self._robot, params)
        if name == "recover":
            return self._recover(content, node, depth)
        if name not in LEAVES:
            near = get_close_matches(name, NAMES, 1)
            hint = f"did you mean {near[0]}?" if near else f"there are {', '.join(NAMES)}"
            self._refuse(node, f"there is no node '{name}'; {hint}")
        given = self._mapping(name, content, node, ())[0] if content is not None else {}
        leaf = LEAVES[name]
        behaviour = leaf(name, self._robot, self._params(name, leaf.params_type, given, node))
        if isinstance(behaviour, PlanPath):
            behaviour.period = self._period
        return behaviour

    def _recover(self, content: yaml.Node | None, node: yaml.Node, depth: int) -> Behaviour:
        """Do something; where that fails, the recovery, and then again, so many times."""
        given, parts = self._mapping("recover", content, node, ("do", "by"))
        times = self._params("recover", _Times, given, node).times
        do, by = (self._node(parts[key], depth + 1) for key in ("do", "by"))
        mended = SuccessIsFailure("again", Counted("recovery", by, self._robot))
        return Retry("recover", Selector("do_or_recover", True, [do, mended]), times + 1)

    def _split(self, node: yaml.Node) -> tuple[str, yaml.Node | None]:
        """Name and content of a node."""
        if isinstance(node, yaml.ScalarNode):
            return str(node.value), None
        if isinstance(node, yaml.MappingNode) and len(node.value) == 1:
            key, content = node.value[0]
            return str(key.value), content
        return self._refuse(node, "write one node here: a name, or 'name: {parameters}'")

    def _children(self, name: str, content: yaml.Node | None, node: yaml.Node, depth: int) -> list[Behaviour]:
        if not isinstance(content, yaml.SequenceNode) or not content.value:
            self._refuse(node, f"{name} needs a list of nodes below it, each beginning with '-'")
        return [self._node(child, depth + 1) for child in content.value]

    def _mapping(
        self, name: str, content: yaml.Node | None, node: yaml.Node, nodes: tuple[str, ...]
    ) -> tuple[dict[str, Any], dict[str, yaml.Node]]:
        """Parameters, and the nodes among them."""
        if not isinstance(content, yaml.MappingNode):
            needs = " and ".join((*nodes, "its parameters") if nodes else ("its parameters",))
            self._refuse(node, f"{name} needs {needs}, as 'name: value'")
        rows = {str(key.value): value for key, value in content.value}
        for missing in (key for key in nodes if key not in rows):
            self._refuse(node, f"{name} needs '{missing}', a node")
        plain = {key: value for key, value in rows.items() if key not in nodes}
        constructor = yaml.SafeLoader("")
        try:
            given = {key: constructor.construct_object(value, deep=True) for key, value in plain.items()}
        except (yaml.YAMLError, ValueError) as error:
            self._refuse(content, f"{name}: {' '.join(str(error).split())}")
        return given, {key: rows[key] for key in nodes}

    def _params(self, name: str, kind: type[Any], given: Mapping[str, Any], node: yaml.Node) -> Any:
        try:
            return read_params(kind, given)
        except (ConfigError, TypeError) as error:  # a date, which JSON has not
            return self._refuse(node, f"{name}: {error}")

    def _refuse(self, node: yaml.Node, text: str) -> NoReturn:
        raise ConfigError(f"behaviours: {self._source} line {node.start_mark.line + 1}: {text}")
