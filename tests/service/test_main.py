"""What is refused before anything runs."""

from __future__ import annotations

import base64
from dataclasses import dataclass

import pytest

from skytether.messages import LaserScan, Twist
from skytether.service import Input, NoParams, Output, Service, ServiceError, param
from skytether.service.main import serve


@dataclass(frozen=True)
class Params:
    speed: float = param(0.2, gt=0, doc="Speed.")


class Stop(Service[Params]):
    rate_hz = 10.0
    scan = Input(LaserScan)
    cmd_vel = Output(Twist)

    def step(self, now: float) -> None:
        raise AssertionError("nothing may run")


def refused(capsys: pytest.CaptureFixture[str], environ: dict[str, str], status: int = 2) -> str:
    assert serve(Stop, environ) == status
    captured = capsys.readouterr()
    assert captured.out == ""
    assert captured.err.count("\n") == 1
    assert captured.err.startswith("error: ")
    return captured.err


def test_no_grant(capsys, tmp_path) -> None:
    text = refused(capsys, {"SKYTETHER_GRANT": str(tmp_path / "none.json")})
    assert "cannot read the grant" in text
    assert "No such file" in text


def test_a_grant_that_is_none(capsys, tmp_path) -> None:
    path = tmp_path / "grant.json"
    path.write_text("{")
    assert "is wrong: document: Invalid JSON" in refused(capsys, {"SKYTETHER_GRANT": str(path)})


def test_a_wrong_grant_names_the_keys_and_never_the_secret(capsys, grant) -> None:
    secret = base64.b64encode(bytes(32)).decode()
    text = refused(capsys, grant(session_key=[secret], colour="red"))
    assert "session_key: " in text
    assert "colour: " in text
    assert secret not in text


def test_a_graph_is_no_service_of_ours(capsys, grant) -> None:
    text = refused(capsys, grant(graph="ros2", launch="/nodes/guide.py"))
    assert "says graph: ros2, but its image or entry point starts a service without a graph" in text
    assert "build the image on skytether/ros2-base" in text


@pytest.mark.parametrize(("change", "field"), [({"session_key": "c2hvcnQ="}, "key"), ({"session_id": "12"}, "id")])
def test_a_session_that_is_none(capsys, grant, change, field) -> None:
    text = refused(capsys, grant(**change))
    assert f"session: {field} must be" in text
    assert "c2hvcnQ=" not in text


@pytest.mark.parametrize(
    ("topics", "sentence"),
    [
        ([], "topic 'scan' of Stop is not in the manifest of wall-stop; add it there"),
        (
            [("scan", "sensor_msgs/msg/LaserScan", "in"), ("cmd", "geometry_msgs/msg/Twist", "out")],
            "topic 'cmd_vel' of Stop is not in the manifest of wall-stop; add it there",
        ),
        (
            [("scan", "sensor_msgs/msg/LaserScan", "in"), ("cmd_vel", "geometry_msgs/msg/TwistStamped", "out")],
            "topic 'cmd_vel' is out geometry_msgs/msg/TwistStamped in the manifest of wall-stop, "
            "but out geometry_msgs/msg/Twist in Stop",
        ),
        (
            [("scan", "sensor_msgs/msg/LaserScan", "out"), ("cmd_vel", "geometry_msgs/msg/Twist", "out")],
            "topic 'scan' is out sensor_msgs/msg/LaserScan in the manifest of wall-stop, "
            "but in sensor_msgs/msg/LaserScan in Stop",
        ),
        (
            [
                ("scan", "sensor_msgs/msg/LaserScan", "in"),
                ("cmd_vel", "geometry_msgs/msg/Twist", "out"),
                ("odom", "nav_msgs/msg/Odometry", "in"),
            ],
            "topic 'odom' in the manifest of wall-stop is not declared by Stop",
        ),
    ],
)
def test_class_and_manifest_must_speak_of_the_same_topics(capsys, grant, topics, sentence) -> None:
    rows = [dict(zip(("name", "type", "direction"), topic, strict=True)) for topic in topics]
    assert refused(capsys, grant(topics=rows)) == f"error: {sentence}\n"


def test_wrong_params(capsys, grant) -> None:
    text = refused(capsys, grant(params={"speed": -1}))
    assert text == "error: parameter 'speed': input should be greater than 0, not -1\n"


class RefusesToStart(Service[NoParams]):
    rate_hz = 10.0

    def start(self) -> None:
        raise ServiceError("the model is missing; put it beside the service")

    def step(self, now: float) -> None:
        pass

    def stop(self) -> None:
        raise AssertionError("what was not started is not stopped")


def test_a_service_that_refuses_to_start_says_why(capsys, grant) -> None:
    assert serve(RefusesToStart, grant(topics=[])) == 1
    assert capsys.readouterr().err == "error: the model is missing; put it beside the service\n"
    assert not grant.ready.exists()
