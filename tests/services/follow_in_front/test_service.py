"""The service from its topics on: a person who walks behind a robot, and what can be wrong with what is measured."""

from __future__ import annotations

from importlib.resources import files
from typing import Any

import pytest
import yaml
from follow_scene import ASIDE, BLACK, NONE, ONE, TWO, Chair, Drawn, Scene, Walker, picture, scene

from skytether.api.manifest import Manifest
from skytether.service import ConfigError, params_schema
from skytether.testing.service import Harness
from skytether_services.follow_in_front.service import FollowInFront
from skytether_services.follow_in_front.status import Code


@pytest.fixture
def drawn(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("skytether_services.follow_in_front.service.FaceTracker", Drawn)


@pytest.fixture
def following(drawn: None) -> Scene:
    """One that goes well."""
    found = scene()
    found.run(3.5)
    assert found.status["code"] == "following"
    assert found.commands[-1][0] > 0.3
    return found


@pytest.fixture(scope="module")
def manifest() -> Manifest:
    text = (files("skytether_services.follow_in_front") / "service.yaml").read_text()
    return Manifest.model_validate(yaml.safe_load(text))


def test_the_manifest_says_what_the_service_is(manifest: Manifest) -> None:
    assert manifest.spec.params == params_schema(FollowInFront)
    assert set(manifest.spec.states) == set(Code)
    declared = {(d.topic, d.type_name, str(d.direction)) for d in FollowInFront.declared}
    assert {(t.name, t.type, str(t.direction)) for t in manifest.spec.topics} == declared


def test_priorities_are_those_of_table_2(manifest: Manifest) -> None:
    came = sorted((t for t in manifest.spec.topics if t.direction == "in"), key=lambda t: -t.priority)
    assert [t.name for t in came] == [
        "tf",
        "usb_cam/image_raw/compressed",
        "scan",
        "RosAria/pose",
        "RosAria/laserscan",
        "RosAria/sonar",
    ]


@pytest.mark.slow
def test_the_robot_goes_ahead_of_the_person_at_its_distance() -> None:
    found = scene()
    found.run(7.0)
    status = found.status
    assert status["code"] == "following"
    assert status["operator"]["distance"] == pytest.approx(0.9, abs=0.12)
    assert status["operators"] == 1
    assert status["face_rate"] == pytest.approx(15, abs=1)
    assert found.commands[-1][0] == pytest.approx(0.45, abs=0.1)
    assert abs(found.commands[-1][1]) < 0.05
    assert all(linear >= 0 for linear, _ in found.commands)


@pytest.mark.slow
def test_a_face_aside_turns_the_robot_there() -> None:
    """A face that looks into the camera from the picture's right points to the robot's right."""
    found = scene()
    found.picture = picture(395)  # some 8 degrees; within what counts as the operator's
    found.run(4.0)
    assert found.status["code"] == "following"
    assert found.status["face"] < -0.09
    assert found.commands[-1][1] < -0.02


@pytest.mark.parametrize(
    ("change", "code"),
    [
        ({"picture": ONE[:2000]}, "bad_picture"),
        ({"picture": BLACK}, "bad_picture"),
        ({"picture": NONE}, "no_face"),
        ({"picture": TWO}, "several_faces"),
        ({"picture": ASIDE}, "no_face"),  # somebody else's: the operator is not there
        ({"picture": None}, "camera_silent"),
        ({"late": 1.5}, "late"),
        ({"people": None}, "laser_silent"),
        ({"odometry": False}, "odometry_silent"),
        ({"people": []}, "operator_lost"),
    ],
    ids=["broken", "black", "none", "two", "another's", "no camera", "late", "no laser", "no odometry", "gone"],
)
def test_whatever_is_missing_the_robot_stands_and_says_why(following: Scene, change: dict[str, Any], code: str) -> None:
    for name, value in change.items():
        setattr(following, name, value)
    following.run(1.9)
    assert following.status["code"] == code
    assert following.status["state"] == "standing"
    # By 1.2 s the law stands, however fast it was; nothing older than that moves the robot.
    assert all(command == (0.0, 0.0) for command in following.commands[-30:])


def test_it_goes_on_when_the_trouble_is_over(following: Scene) -> None:
    following.picture = NONE
    following.run(1.0)
    assert following.commands[-1][0] < 0.4
    following.picture = ONE
    following.run(2.0)
    assert following.status["code"] == "following"
    assert following.status["operators"] == 1, "the same person"


@pytest.mark.usefixtures("drawn")
def test_with_fewer_faces_than_it_needs_the_robot_goes_slowly() -> None:
    found = scene(face_rate=3)
    found.run(3.5)
    assert found.status["code"] == "face_slow"
    assert 0 < found.commands[-1][0] < 0.35


@pytest.mark.usefixtures("drawn")
def test_a_chair_is_nobody_to_go_ahead_of() -> None:
    found = scene()
    found.picture, found.people = NONE, [Chair()]
    found.run(3.0)
    assert found.status["code"] == "no_operator"
    assert all(command == (0.0, 0.0) for command in found.commands)


@pytest.mark.usefixtures("drawn")
def test_of_two_who_come_up_side_by_side_neither_is_guessed() -> None:
    found = scene()
    found.picture, found.people = TWO, [Walker(y=0.35), Walker(y=-0.35)]
    found.run(3.5)
    assert found.status["code"] == "several_people"
    assert all(command == (0.0, 0.0) for command in found.commands)


def test_nobody_takes_the_operators_place_unnoticed(following: Scene) -> None:
    """The operator goes away and a stranger comes up: nobody is followed meanwhile, and a new operator is counted."""
    following.people, seen = [], len(following.codes)
    following.run(2.5)
    assert following.commands[-1] == (0.0, 0.0)
    following.people = [Walker(x=following.x - 1.6)]
    following.run(3.5)
    assert following.status["code"] == "following"
    assert following.status["operators"] == 2
    assert "operator_lost" in following.codes[seen:]


@pytest.mark.usefixtures("drawn")
def test_a_laser_whose_place_nobody_tells_is_told_of() -> None:
    found = Scene(Harness(FollowInFront))
    found.run(1.0)
    assert found.status["code"] == "laser_unknown"
    assert "parameter laser" in found.status["message"]


def test_states_that_last_become_reports(following: Scene) -> None:
    following.picture = None
    following.run(1.9)
    codes = [report.code for report in following.harness.service.reports.recent]
    assert codes[-2:] == ["following", "camera_silent"]


@pytest.mark.usefixtures("drawn")
@pytest.mark.parametrize(
    ("params", "text"),
    [({"near": 2.0}, "near must be below far"), ({"slow_after": 3.0}, "stop_after must be above slow_after")],
)
def test_parameters_that_do_not_fit_each_other_are_refused(params: dict[str, Any], text: str) -> None:
    with pytest.raises(ConfigError, match=text):
        Harness(FollowInFront, params)


def test_a_robot_that_stands_is_never_said_to_follow(following: Scene) -> None:
    following.people = []
    following.run(2.5)
    following.people = [Walker(x=following.x - 1.6)]
    for _ in range(210):
        following.run(1 / 60)
        assert (following.status["state"] == "standing") <= (following.status["code"] != "following")
    assert following.status["operators"] == 2


@pytest.mark.usefixtures("drawn")
def test_a_camera_that_never_sent_anything_is_silent() -> None:
    found = scene()
    found.picture = None
    found.run(0.8)
    assert found.status["code"] == "no_operator"
    found.run(2.5)
    assert found.status["code"] == "camera_silent"
