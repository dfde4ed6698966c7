"""Orders to robots to stop: kept, shown, acknowledged by the robot itself and by nobody else."""

import pytest
from pydantic import ValidationError

from skytether.api.client import ApiError
from skytether.api.rest import RobotCreate, TokenCreate
from skytether.orchestrator.access.access import Principal
from skytether.orchestrator.domain.security import TokenHash, new_token
from skytether.orchestrator.store.database import RobotRow, StopRow, TokenRow
from skytether.orchestrator.store.store import Store


def test_an_order_is_given_once_shown_and_acknowledged_by_its_robot_only(served):
    operator = served.operator
    walker = served.client(operator.create_robot(RobotCreate(name="walker")).token)
    stranger = served.client(operator.create_robot(RobotCreate(name="stranger")).token)
    assert walker.stop_order("walker") is None
    order = operator.stop_robot("walker", "somebody fell")
    assert (order.robot, order.reason, order.by, order.acknowledged_at) == ("walker", "somebody fell", "operator", None)
    assert operator.stop_robot("walker", "again") == order, "asking again changes nothing"
    assert walker.stop_order("walker") == order
    shown = {robot.name: robot.stop for robot in operator.robots()}
    assert shown == {"walker": order, "stranger": None}
    for who, says in ((stranger, "only robot 'walker' itself"), (operator, "only robot 'walker' itself")):
        with pytest.raises(ApiError, match=says):
            who.acknowledge_stop("walker", order.id)
    with pytest.raises(ApiError, match="orders to itself only"):
        stranger.stop_order("walker")
    with pytest.raises(ApiError, match="is not the last order"):
        walker.acknowledge_stop("walker", "0123")
    done = walker.acknowledge_stop("walker", order.id)
    assert done.acknowledged_at is not None
    assert walker.acknowledge_stop("walker", order.id) == done, "the first time counts"
    assert operator.robots()[-1].stop == done
    newer = operator.stop_robot("walker", "and again")
    assert newer.id != order.id
    with pytest.raises(ApiError, match="is not the last order"):
        walker.acknowledge_stop("walker", order.id)


def test_all_robots_at_once_and_scopes(served):
    operator = served.operator
    for name in ("one", "two"):
        operator.create_robot(RobotCreate(name=name))
    first = operator.stop_robot("one", "alone")
    orders = {order.robot: order for order in operator.stop_robots("fire")}
    assert orders["one"] == first
    assert orders["two"].reason == "fire"
    reader = served.client(operator.create_token(TokenCreate(name="looks", scopes=("read",))).token)
    with pytest.raises(ApiError, match="needs the scope 'robots'"):
        reader.stop_robots("no")
    assert {robot.stop.reason for robot in reader.robots()} == {"alone", "fire"}
    with pytest.raises(ApiError, match="there is no robot 'nobody'"):
        operator.stop_robot("nobody", "fire")
    with pytest.raises(ValidationError, match="reason"):
        operator.stop_robot("one", "x" * 201)


def test_an_order_outlives_the_orchestrator_and_goes_with_its_robot(tmp_path):
    url = f"sqlite:///{tmp_path / 'state.db'}"
    store = Store(url)
    store.migrate()
    token = TokenRow("t", "walker", "walker", (), TokenHash.of(new_token()), 0.0)
    store.add_robot(RobotRow("walker", ("*",), 0.0), token)
    order = StopRow("walker", "a", 1.0, "fire", Principal(None).owner)
    store.order_stops([order, StopRow("gone", "b", 1.0, "fire", "operator")])
    store.close()
    again = Store(url)
    again.migrate()
    assert again.stops() == {"walker": order}
    again.delete_robot("walker")
    assert again.stops() == {}
    again.close()
