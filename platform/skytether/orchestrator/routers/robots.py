"""``/robots``: who may ask. For operators only."""

from __future__ import annotations

from fastapi import APIRouter, Response

from skytether.api.rest import Robot, RobotCreate, RobotCreated, RobotUse

from ..core import Orchestrator
from ..database import RobotRow
from ..instances import utc
from ..quotas import use_by_robot
from .deps import PREFIX, Core, Reader, RobotsOperator, made, says

router = APIRouter(prefix=f"{PREFIX}/robots", tags=["robots"], responses=says(401, 403))


def _show(core: Orchestrator, row: RobotRow, use: RobotUse | None = None) -> Robot:
    seen = utc(row.last_seen_at) if row.last_seen_at is not None else None
    most = core.settings.quotas
    return Robot(
        name=row.name,
        services=row.services,
        created_at=utc(row.created_at),
        last_seen_at=seen,
        use=use or RobotUse(),
        quota=RobotUse(instances=most.robot_instances, cpu=most.robot_cpu, memory_mb=most.robot_memory_mb),
    )


@router.get("")
def list_robots(core: Core, _: Reader) -> list[Robot]:
    """All registered robots."""
    use = use_by_robot(core.store.live())
    return [_show(core, row, use.get(row.name)) for row in core.store.robots()]


@router.post("", status_code=201, responses=says(409, 422))
def add_robot(core: Core, _: RobotsOperator, asked: RobotCreate, response: Response) -> RobotCreated:
    """Register a robot. Its token is in the answer and cannot be shown again."""
    row, token = core.access.register(asked.name, asked.services, asked.token_ttl_s)
    made(response, "robots", row.name)
    return RobotCreated(**_show(core, row).model_dump(), token=token)


@router.delete("/{robot}", status_code=204)
def delete_robot(core: Core, _: RobotsOperator, robot: str) -> None:
    """Revoke a robot's tokens and end what it holds."""
    core.access.revoke(robot)
    core.instances.end_all(robot)
