import pytest
from pydantic import ValidationError

from skytether.api.manifest import GRAPH_ENTRYPOINTS, ServiceSpec, TopicSpec
from skytether.bridge.spec import topics_from_api
from skytether.wire.topic import Role

MOVE = {"name": "move_base", "kind": "action", "type": "move_base_msgs/action/MoveBase", "direction": "in"}


def test_an_action_is_carried_on_its_five_topics_each_as_it_needs():
    goal, cancel, feedback, result, status = topics_from_api([TopicSpec(**MOVE, priority=90)])
    assert (goal.name, goal.type) == ("move_base/goal", "move_base_msgs/msg/MoveBaseActionGoal")
    assert (cancel.name, cancel.type) == ("move_base/cancel", "actionlib_msgs/msg/GoalID")
    assert (feedback.name, feedback.type) == ("move_base/feedback", "move_base_msgs/msg/MoveBaseActionFeedback")
    assert (result.name, result.type) == ("move_base/result", "move_base_msgs/msg/MoveBaseActionResult")
    assert (status.name, status.type) == ("move_base/status", "actionlib_msgs/msg/GoalStatusArray")
    assert [t.direction.sender for t in (goal, cancel)] == [Role.ROBOT, Role.ROBOT]
    assert [t.direction.sender for t in (feedback, result, status)] == 3 * [Role.SERVICE]
    assert [t.reliable for t in (goal, cancel, feedback, result, status)] == [True, True, False, True, False]
    assert {t.priority for t in (goal, cancel, feedback, result, status)} == {90}
    assert (goal.depth, feedback.depth, feedback.lifespan, goal.lifespan) == (64, 1, 1.0, 60.0)


def test_an_action_of_the_service_goes_the_other_way():
    rows = TopicSpec(**{**MOVE, "direction": "out"}).rows()
    assert [row.direction for row in rows] == ["out", "out", "in", "in", "in"]


def test_an_action_of_ros2_is_three_calls_and_two_topics():
    row = TopicSpec(name="go", kind="ros2_action", type="nav2_msgs/action/NavigateToPose", direction="in", priority=90)
    rows = {t.name.removeprefix("go/_action/"): t for t in topics_from_api([row])}
    assert {name: t.type.removeprefix("nav2_msgs/action/NavigateToPose_") for name, t in rows.items()} == {
        "send_goal/request": "SendGoal_Request",
        "send_goal/response": "SendGoal_Response",
        "cancel_goal/request": "action_msgs/srv/CancelGoal_Request",
        "cancel_goal/response": "action_msgs/srv/CancelGoal_Response",
        "get_result/request": "GetResult_Request",
        "get_result/response": "GetResult_Response",
        "feedback": "FeedbackMessage",
        "status": "action_msgs/msg/GoalStatusArray",
    }
    assert [n for n, t in rows.items() if t.direction.sender is Role.ROBOT] == [
        f"{call}/request" for call in ("send_goal", "cancel_goal", "get_result")
    ]
    assert [n for n, t in rows.items() if not t.reliable] == ["feedback"]
    assert [n for n, t in rows.items() if t.latched] == ["status"]
    assert rows["get_result/response"].lifespan == 3600
    assert {t.priority for t in rows.values()} == {90}


def test_an_action_is_neither_latched_nor_unreliable():
    for more in ({"latched": True}, {"reliable": False}):
        with pytest.raises(ValidationError, match="kind: action is reliable and not latched"):
            TopicSpec(**MOVE, **more)


@pytest.mark.parametrize("kind", ["action", "ros2_action"])
def test_an_action_has_no_type_hash_for_each_of_its_parts_has_one_of_its_own(kind):
    with pytest.raises(ValidationError, match=f"kind: {kind} has no type_hash: each of its topics and calls"):
        TopicSpec(**MOVE | {"kind": kind}, type_hash="RIHS01_" + "0" * 64)


def test_a_service_with_a_graph_needs_only_its_launch_file():
    spec = ServiceSpec(graph="ros1", launch="/launch/nav.launch", topics=[MOVE], remap={"move_base": "/move_base"})
    assert spec.entrypoint == GRAPH_ENTRYPOINTS["ros1"]
    assert ServiceSpec(graph="ros1", launch="a/b.launch", entrypoint="own").entrypoint == "own"


def test_a_graph_of_ros_2_gets_numbers_as_its_nodes_declare_them():
    number, words = {"type": "number"}, {"type": "string"}
    planner = {"type": "object", "properties": {"speed": number, "name": words}}
    schema = {"properties": {"rate": number, "count": {"type": "integer"}, "planner": planner, "xs": {"items": number}}}
    spec = ServiceSpec(graph="ros2", launch="/nodes/guide.py", params=schema)
    assert spec.entrypoint == GRAPH_ENTRYPOINTS["ros2"]
    given = {"rate": 2, "count": 2, "planner": {"speed": 1, "name": "x"}, "xs": [1, 2.5, True], "more": 3}
    typed = spec.typed(given)
    assert typed == given
    assert isinstance(typed["rate"], float)
    assert isinstance(typed["planner"]["speed"], float)
    assert [type(x) for x in typed["xs"]] == [float, float, bool]
    assert {type(typed["count"]), type(typed["more"])} == {int}
    assert spec.typed({"rate": 10**400}) == {"rate": 10**400}
    assert isinstance(ServiceSpec(graph="ros1", launch="/a", params=schema).typed(given)["rate"], int)


@pytest.mark.parametrize(
    ("spec", "says"),
    [
        ({"graph": "ros1"}, "needs launch"),
        ({"entrypoint": "x", "launch": "/a.launch"}, "add graph: ros1"),
        ({"entrypoint": "x", "remap": {"a": "/b"}}, "add graph: ros1"),
        ({"graph": "ros1", "launch": "/a.launch", "remap": {"scan": "/x"}}, "the service has no topic 'scan'"),
        ({"graph": "ros2"}, "graph: ros2 needs launch"),
        ({"graph": "ros2", "launch": "/a", "topics": [MOVE]}, "'move_base': kind: action is an action of ROS 1"),
        ({"graph": "yarp", "launch": "/a.launch", "entrypoint": "x"}, "graph\n.*should be 'ros1' or 'ros2'"),
    ],
)
def test_what_does_not_fit_together_is_named(spec, says):
    with pytest.raises(ValidationError, match=says):
        ServiceSpec(**spec)
