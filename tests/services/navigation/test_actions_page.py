"""The page's client for ROS 2, run with a played rclpy: its names and steps. That of ROS 1: tests/ros/ros1."""

from __future__ import annotations

import dataclasses
import re
import sys
from collections.abc import Callable
from pathlib import Path
from types import ModuleType, SimpleNamespace
from typing import Any

import pytest

from skytether.lab.world.plan import building
from skytether.messages import Message, NavigateToPoseGoal
from skytether.testing.actions import ActionClient
from skytether.testing.drive import Drive
from skytether_services.navigation.service import Navigation

pytestmark = pytest.mark.slow
PAGE = Path(__file__).parents[3] / "docs" / "navigation.md"
STATUS = {"succeeded": 4, "preempted": 5, "aborted": 6}


def opened(message: Any) -> Any:
    """A message whose fields can be set, as rclpy's."""
    if not isinstance(message, Message):
        return message
    return SimpleNamespace(**{name: opened(getattr(message, name)) for name in message.__slots__})


def closed(what: Any, like: Any) -> Any:
    """Back again; a field that there is not is found here."""
    if not isinstance(like, Message):
        return what
    assert set(vars(what)) == set(like.__slots__)
    fields = {name: closed(getattr(what, name), getattr(like, name)) for name in like.__slots__}
    return dataclasses.replace(like, **fields)  # type: ignore[type-var]


class Played:
    """rclpy and nav2_msgs, as far as the page goes, for a robot in the simulated building."""

    def __init__(self, drive: Drive) -> None:
        self.drive = drive

    def modules(self) -> dict[str, ModuleType]:
        rclpy, action, messages = (ModuleType(name) for name in ("rclpy", "rclpy.action", "nav2_msgs.action"))
        rclpy.__dict__.update(init=lambda: None, create_node=str, spin_until_future_complete=self.spin, action=action)
        action.__dict__.update(ActionClient=self.client)
        messages.__dict__.update(NavigateToPose=SimpleNamespace(Goal=lambda: opened(NavigateToPoseGoal())))
        return {
            "rclpy": rclpy,
            "rclpy.action": action,
            "nav2_msgs": ModuleType("nav2_msgs"),
            "nav2_msgs.action": messages,
        }

    def spin(self, node: str, future: SimpleNamespace) -> None:
        assert node == "courier"
        assert self.drive.run(30.0, future.done), self.drive.status

    def client(self, node: str, kind: Any, name: str) -> SimpleNamespace:
        assert node == "courier"
        client = ActionClient(self.drive.harness, name.removeprefix("/"))

        def send(goal: Any, feedback_callback: Callable[[Any], None]) -> SimpleNamespace:
            sent = client.send(closed(goal, NavigateToPoseGoal()))
            seen: list[Any] = []

            def ended() -> bool:
                for told in client.feedback(sent):
                    if told not in seen:
                        seen.append(told)
                        feedback_callback(SimpleNamespace(feedback=told))
                return client.end(sent) is not None

            def result() -> SimpleNamespace:
                end = client.end(sent)
                assert end is not None
                return SimpleNamespace(status=STATUS[end[0]], result=end[2])

            def handle() -> SimpleNamespace:
                ending = SimpleNamespace(done=ended, result=result)
                return SimpleNamespace(accepted=client.is_accepted(sent), get_result_async=lambda: ending)

            return SimpleNamespace(done=lambda: client.is_accepted(sent) is not None, result=handle)

        return SimpleNamespace(wait_for_server=lambda: None, send_goal_async=send)


def test_the_client_of_the_page_reaches_its_goal(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    codes = re.findall(r"```python\n(.*?)```", PAGE.read_text(), re.DOTALL)
    (code,) = (code for code in codes if "import rclpy" in code)
    drive = Drive(Navigation, tmp_path, {"controller": "dwa"}, building())
    for name, module in Played(drive).modules().items():
        monkeypatch.setitem(sys.modules, name, module)
    exec(compile(code, str(PAGE), "exec"), {"__name__": "__main__"})
    *way, last = capsys.readouterr().out.splitlines()
    left = [float(re.fullmatch(r"(\d\.\d\d) m to go", line)[1]) for line in way]  # type: ignore[index]
    assert len(left) > 5
    assert left[0] > 0.5 > left[-1]
    assert last == "status 4: "
    assert drive.status["state"] == "succeeded"
