"""``/robots``: who may ask, and orders to stop. For operators only, but for a robot's own order."""

from __future__ import annotations

from collections.abc import Mapping

from fastapi import APIRouter, Response

from skytether.api.rest import (
    GateReport,
    Robot,
    RobotCreate,
    RobotCreated,
    RobotGroup,
    RobotUse,
    StopOrder,
    StopRobot,
)

from ...access.quotas import use_by_robot
from ...core import Orchestrator
from ...scheduling.instances import utc
from ...store.database import GateRow, RobotRow, StopRow
from .deps import PREFIX, Caller, Core, Reader, RobotsOperator, made, says

router = APIRouter(prefix=f"{PREFIX}/robots", tags=["robots"], responses=says(401, 403))


def _show(
    core: Orchestrator,
    row: RobotRow,
    data: Mapping[str, int],
    use: RobotUse | None = None,
    stop: StopRow | None = None,
    gate: GateRow | None = None,
) -> Robot:
    seen = utc(row.last_seen_at) if row.last_seen_at is not None else None
    return Robot(
        name=row.name,
        services=row.services,
        group=row.group,
        created_at=utc(row.created_at),
        last_seen_at=seen,
        use=core.quotas.with_rest(row.name, use or RobotUse(), data),
        quota=core.quotas.of_robot,
        stop=None if stop is None else _order(stop),
        gate=None if gate is None else gate.report,
        gate_heard_at=None if gate is None else utc(gate.at),
    )


def _order(row: StopRow) -> StopOrder:
    acknowledged = utc(row.acknowledged_at) if row.acknowledged_at is not None else None
    return StopOrder(
        id=row.id, robot=row.robot, reason=row.reason, by=row.by, at=utc(row.at), acknowledged_at=acknowledged
    )


@router.get("")
def list_robots(core: Core, _: Reader) -> list[Robot]:
    """All registered robots, with what they use, their last order to stop and what they said of their gates."""
    use, gates, stops = use_by_robot(core.store.live()), core.gates.all(), core.store.stops()
    rows, data = core.store.robots(), core.quotas.data()
    return [_show(core, row, data, use.get(row.name), stops.get(row.name), gates.get(row.name)) for row in rows]


@router.post("", status_code=201, responses=says(409, 422))
def add_robot(core: Core, _: RobotsOperator, asked: RobotCreate, response: Response) -> RobotCreated:
    """Register a robot. Its token is in the answer and cannot be shown again."""
    row, token = core.access.register(asked.name, asked.services, asked.token_ttl_s, asked.group)
    core.shared_topics.learn_groups()
    made(response, "robots", row.name)
    return RobotCreated(**_show(core, row, core.quotas.data()).model_dump(), token=token)


@router.delete("/{robot}", status_code=204)
def delete_robot(core: Core, _: RobotsOperator, robot: str) -> None:
    """Revoke a robot's tokens and end what it holds."""
    core.access.revoke(robot)
    core.instances.end_all(robot)


@router.put("/{robot}/group", status_code=204, responses=says(404, 422))
def set_group(core: Core, _: RobotsOperator, robot: str, asked: RobotGroup) -> None:
    """With whom a robot's services share what they see; it holds within a second."""
    core.shared_topics.put(robot, asked.group)


@router.post("/stop", responses=says(422))
def stop_robots(core: Core, caller: RobotsOperator, asked: StopRobot) -> list[StopOrder]:
    """Order all robots to stop. One that has not acknowledged an order yet keeps that one."""
    rows = core.stop_orders.order(caller, [row.name for row in core.store.robots()], asked.reason)
    return [_order(row) for row in rows.values()]


@router.post("/{robot}/stop", responses=says(404, 422))
def stop_robot(core: Core, caller: RobotsOperator, robot: str, asked: StopRobot) -> StopOrder:
    """Order a robot to stop; only a person beside it can reset it.

    It obeys if its own configuration allows it, within some seconds of hearing of it, and acknowledges. While it has
    not, asking again changes nothing.
    """
    return _order(core.stop_orders.order(caller, [robot], asked.reason)[robot])


@router.get("/{robot}/stop", responses=says(404))
def get_stop(core: Core, caller: Caller, robot: str) -> StopOrder | None:
    """The last order to a robot to stop. Robots ask for their own, every two seconds if they obey such orders."""
    row = core.stop_orders.last(caller, robot)
    return None if row is None else _order(row)


@router.post("/{robot}/stop/{order}/acknowledge", responses=says(404))
def acknowledge_stop(core: Core, caller: Caller, robot: str, order: str) -> StopOrder:
    """The robot says that it stands. With the robot's own token only; the first time counts."""
    return _order(core.stop_orders.acknowledge(caller, robot, order))


@router.put("/{robot}/gate", status_code=204, responses=says(404, 422))
def report_gate(core: Core, caller: Caller, robot: str, report: GateReport) -> None:
    """The robot says how the gate before its wheels is, with an instance or without; with its own token only."""
    core.gates.receive_report(caller, robot, report)
