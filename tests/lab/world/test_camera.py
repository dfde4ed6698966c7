import ctypes.util
import io
import math
import threading
import time

import numpy as np
import pytest
from PIL import Image

from skytether.lab.trail import Pose
from skytether.lab.world.agent import Clockwork
from skytether.lab.world.camera import Camera, FaceStudio, Renderer, Sensor
from skytether.lab.world.lemniscate import Lemniscate
from skytether.lab.world.model import WorldError
from skytether.lab.world.operator import Operator
from skytether.lab.world.plan import hall
from skytether.lab.world.robot import RearParams, RobotParams
from skytether.lab.world.simulation import TICK, Simulation
from skytether.messages import CompressedImage, Message

REAR = RearParams()


def world() -> Simulation:
    return Simulation(hall(), seed=1, params=RobotParams(rear=REAR), operator=Operator(Lemniscate(), 1))


def skin(picture: np.ndarray) -> np.ndarray:
    """Rows and columns of what is clearly redder than blue: face, hair and neck, and nothing else in the hall."""
    red, blue = picture[..., 0].astype(int), picture[..., 2].astype(int)
    return np.argwhere(red - blue > 25)


@pytest.mark.slow
def test_the_face_is_in_view_and_turns_to_the_side_it_looks_to(gl: None) -> None:
    with FaceStudio(sensor=Sensor(REAR, 0, noise=0.0)) as studio:
        for distance in (0.7, 2.2):
            rows, columns = skin(studio.draw(0.0, distance)).T
            assert 0 < rows.min() < rows.max() < 479
            # Its width of 0.2 m, by the focal length of 532 pixels.
            assert np.ptp(columns) == pytest.approx(0.2 * 532 / distance, rel=0.35)
            assert np.median(columns) == pytest.approx(320, abs=12)
        # The face is brighter than the hair: it moves to the side it looks to, which is the robot's left.
        faces = []
        for yaw in (-40, 40):
            picture = studio.draw(math.radians(yaw), 0.9)
            places = skin(picture)
            bright = picture[tuple(places.T)].sum(axis=1) > 400
            faces.append(places[bright, 1].mean() - places[~bright, 1].mean())
        assert faces[0] < -10 < 10 < faces[1]
        # To the robot's left is to the right in the picture: 320 + 532 tan(20 degrees).
        aside = skin(studio.draw(0.0, 1.0, aside=math.radians(20)))
        assert np.median(aside[:, 1]) == pytest.approx(320 + 532 * math.tan(math.radians(20)), abs=15)


@pytest.mark.slow
def test_pictures_have_noise_by_a_seed_and_the_size_of_the_thesis(gl: None) -> None:
    def run(seed: int) -> tuple[np.ndarray, np.ndarray, int]:
        with FaceStudio(seed) as studio:
            first, second = (studio.draw(0.2, 1.0, robot=Pose(1.0, 0.5, 2.0)) for _ in range(2))
            return first, second, len(studio.sensor.jpeg(first))

    (first, second, size), (again, _, _), (other, _, _) = run(1), run(1), run(2)
    assert (first == again).all()
    assert not (first == other).all()
    # Of a difference of two: sqrt(2) times as much, where nothing is cut off.
    assert (second.astype(int) - first).std() == pytest.approx(4 * math.sqrt(2), rel=0.05)
    # Table 2: 47,611 bytes.
    assert size == pytest.approx(47_000, rel=0.15)


@pytest.mark.slow
def test_a_camera_sends_what_the_robot_sees_stamped_with_when_it_saw_it(gl: None) -> None:
    found: list[tuple[str, Message]] = []
    simulation = world()
    with Camera(simulation, lambda topic, message: found.append((topic, message))) as camera:
        clockwork = Clockwork(simulation, [camera.observe])
        for tick in range(40):
            clockwork.read(0, 1000.0 + tick * TICK)
            due = sum(at <= tick for at in (0, 7, 14, 20, 27, 34))
            until(lambda due=due: camera.taken == due)
    assert not camera.trouble
    assert (camera.taken, camera.dropped) == (6, 0)
    assert {topic for topic, _ in found} == {"camera/compressed"}
    images = [message for _, message in found if isinstance(message, CompressedImage)]
    stamps = [image.header.stamp.seconds() for image in images]
    assert stamps == pytest.approx([1000.00, 1000.07, 1000.14, 1000.20, 1000.27, 1000.34])
    assert {(image.header.frame_id, image.format) for image in images} == {("camera", "jpeg")}
    picture = np.asarray(Image.open(io.BytesIO(images[-1].data.tobytes())))
    assert picture.shape == (480, 640, 3)
    assert len(skin(picture)) > 2000


@pytest.mark.slow
def test_a_camera_that_is_behind_leaves_pictures_out_and_holds_nobody_up(gl: None) -> None:
    go_on, simulation = threading.Event(), world()
    with Camera(simulation, lambda _topic, _message: go_on.wait(20)) as camera:
        clockwork = Clockwork(simulation, [camera.observe])
        for tick in range(100):
            clockwork.read(0, tick * TICK)
        # 15 a second: one is held up in the graph, and no other one waits behind it.
        assert camera.dropped == 14
        go_on.set()
        until(lambda: camera.taken == 1)


def until(true, seconds: float = 20.0) -> None:
    ends = time.monotonic() + seconds
    while not true():
        assert time.monotonic() < ends
        time.sleep(0.001)


def test_fifteen_pictures_a_second_are_due() -> None:
    simulation = world()
    camera = Camera(simulation, lambda _topic, _message: None)
    for _ in range(200):
        camera.observe(simulation, simulation.tick())
    assert camera.dropped == 29  # the first waits for a thread that was not started


def test_a_robot_without_a_camera_takes_no_pictures() -> None:
    with pytest.raises(WorldError, match="no camera"):
        Camera(Simulation(hall(), seed=1), lambda _topic, _message: None)


def test_without_opengl_it_says_what_to_install(monkeypatch) -> None:
    monkeypatch.setattr(ctypes.util, "find_library", lambda _: None)
    with pytest.raises(WorldError, match="apt-get install libosmesa6"):
        Renderer(world().model, REAR)
    with pytest.raises(WorldError, match="apt-get install libosmesa6"), Camera(world(), lambda _a, _b: None):
        pass
