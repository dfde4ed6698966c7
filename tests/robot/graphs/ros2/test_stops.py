"""Buttons of a real ROS 2 graph, whatever each of them offers."""

from contextlib import closing

import pytest
from ros2_nodes import ros2_nodes, until

from skytether.messages import Bool
from skytether.robot.graphs.inbox import Topics
from skytether.robot.graphs.ros2.gate_io import Ros2Sensors
from skytether.robot.graphs.ros2.sections import Ros2Way

__all__ = ["ros2_nodes"]
BUTTON = """
from std_msgs.msg import Bool
button = node.create_publisher(Bool, "/estop", qos(latched={latched}, depth=1))
button.publish(Bool(data={pressed}))
def work():
    while not {latched}:
        button.publish(Bool(data={pressed}))
        time.sleep(0.05)
threading.Thread(target=work, daemon=True).start()
"""


@pytest.mark.slow
@pytest.mark.ros2
@pytest.mark.parametrize("first", ["the one that is pressed", "the other one"])
def test_of_two_buttons_one_that_is_pressed_once_and_keeps_that_is_heard(ros2_nodes, first):
    released, pressed = (BUTTON.format(latched=kept, pressed=kept) for kept in (False, True))
    heard: list[bool] = []

    def hears(value):
        heard.extend(message.data for _, message in sensors.stops() if isinstance(message, Bool))
        return value in heard

    if first == "the one that is pressed":
        ros2_nodes.start(pressed, name="pressed")
    topics = Topics({"/estop": Bool}, {"/estop": lambda message: bool(message.data)})
    with closing(Ros2Sensors(Ros2Way(), topics, lambda *_: None)) as sensors:
        ros2_nodes.start(released, name="released")
        until(lambda: hears(False), "the button that is released")
        if first != "the one that is pressed":
            assert True not in heard
            ros2_nodes.start(pressed, name="pressed")
        until(lambda: hears(True), "the button that is pressed")
