"""A person who walks behind a robot, and the service that keeps it ahead, from the topics on; made-up time."""

from __future__ import annotations

import io
import json
import math
from collections.abc import Sequence
from dataclasses import dataclass, field
from importlib.resources import files
from typing import Any

import numpy as np
from leg_scans import FIRST, LIMITS, STEP, feet, scan
from PIL import Image

from skytether.messages import (
    CompressedImage,
    Header,
    LaserScan,
    Message,
    Odometry,
    Point,
    Pose,
    PoseWithCovariance,
    Time,
    quaternion_from_yaw,
)
from skytether.testing.service import Harness
from skytether_services.follow_in_front.camera_image import Picture, decode
from skytether_services.follow_in_front.face_tracker import Face
from skytether_services.follow_in_front.service import FollowInFront

LASER = {"x": -0.2, "yaw": math.pi}
HEAD = Image.open(str(files("skytether.lab.world") / "assets" / "head.png")).convert("RGB")


def picture(*middles: int) -> bytes:
    """Faces beside each other, all of one size, that look into the camera."""
    image = Image.new("RGB", (640, 480), (150, 150, 140))
    for x in middles:
        image.paste(HEAD.resize((150, 150 * HEAD.height // HEAD.width)), (x - 75, 160))
    return jpeg(image)


def jpeg(image: Image.Image) -> bytes:
    buffer = io.BytesIO()
    image.save(buffer, "JPEG", quality=85)
    return buffer.getvalue()


ONE, NONE, TWO, ASIDE = picture(320), picture(), picture(240, 400), picture(560)
BLACK = jpeg(Image.new("RGB", (640, 480)))


class Drawn:
    """In place of `FaceTracker`: knows the pictures of this file, at no cost."""

    def __init__(self, _field_of_view: float) -> None:
        straight = Face(0.0, 0.0, 150, 1.0)
        aside = Face(-0.42, 0.42, 150, 1.0)
        both = [straight._replace(bearing=0.15), straight._replace(bearing=-0.15)]
        self._known = {
            decode(jpeg).tobytes(): faces for jpeg, faces in ((ONE, [straight]), (ASIDE, [aside]), (TWO, both))
        }

    def step(self, pixels: Picture) -> list[Face]:
        return self._known.get(pixels.tobytes(), [])


class Walker:
    """Comes up behind the robot, and stops 0.65 m behind its middle."""

    def __init__(self, x: float = -1.7, y: float = 0.0, speed: float = 0.45, until: float = math.inf) -> None:
        self.x, self.y, self._speed, self._until, self._way = x, y, speed, until, 0.0

    def feet(self, robot: float, dt: float) -> list[tuple[float, float]]:
        step = min(self._speed * dt, max(min(robot - 0.65, self._until) - self.x, 0.0))
        self.x, self._way = self.x + step, self._way + step
        return feet((self.x, self.y), 0.0, self._way)


class Chair:
    """Four legs that stand."""

    def feet(self, _robot: float, _dt: float) -> list[tuple[float, float]]:
        return [(-1.0 + dx, dy) for dx in (0.0, 0.4) for dy in (-0.2, 0.2)]


@dataclass
class Scene:
    """A robot that does what it is told at once, and people behind it.

    Attributes:
        picture: What the camera sees; None: nothing comes from it.
        people: All who are there; None: no scans come.
        late: How old a picture is when it comes [s].
        all_late: The same of everything, as a link with a long queue makes it [s]; nothing of it is lost.
        clock_error: How well the robot's clock is known [s].
        odometry: Whether it comes.
        odometry_late: How much later than a scan of its moment it comes [s].
    """

    harness: Harness[FollowInFront]
    random: np.random.Generator = field(default_factory=lambda: np.random.default_rng(7))
    picture: bytes | None = ONE
    people: Sequence[Walker | Chair] | None = field(default_factory=lambda: [Walker()])
    late: float = 0.0
    all_late: float = 0.0
    clock_error: float = 0.0
    odometry: bool = True
    odometry_late: float = 0.0
    x: float = 0.0
    time: float = 0.0
    commands: list[tuple[float, float]] = field(default_factory=list)
    codes: list[str] = field(default_factory=list)
    _steps: int = 0
    _under_way: list[tuple[int, int, str, Message]] = field(default_factory=list)

    def run(self, seconds: float) -> None:
        """Go on."""
        for _ in range(round(seconds * 60)):
            self._step()

    def _step(self) -> None:
        number = self._steps
        stamp = Time.from_seconds(100 + self.time)
        if self.odometry and number % 6 == 0:
            pose = Pose(Point(self.x), quaternion_from_yaw(0.0))
            odometry = Odometry(Header(stamp, "odom"), "base_link", PoseWithCovariance(pose))
            self._send("RosAria/pose", odometry, self.odometry_late)
        if self.people is not None and number % 6 == 0:
            legs = [foot for person in self.people for foot in person.feet(self.x, 0.1)]
            ranges = scan(legs, [((-9.0, 3.0), (20.0, 3.0))], (self.x - 0.2, 0.0, math.pi), self.random)
            low, high = LIMITS
            self._send("scan", LaserScan(Header(stamp, "rear"), FIRST, 0.0, STEP, 0.0, 0.0, low, high, ranges))
        if self.picture is not None and number % 4 == 0:
            data = np.frombuffer(self.picture, np.uint8)
            message = CompressedImage(Header(stamp, "camera"), "jpeg", data)
            self._send("usb_cam/image_raw/compressed", message, self.late)
        self._deliver()
        self.harness.step()
        twist = self.harness.newest("cmd_vel")
        if twist is not None:
            self.x += twist.linear.x / 60
            self.commands.append((twist.linear.x, twist.angular.z))
        if (told := self.status) is not None:
            self.codes.append(told["code"])
        self._steps += 1
        self.time = self._steps / 60

    def _send(self, topic: str, message: Message, late: float = 0.0) -> None:
        arrives = self._steps + round((late + self.all_late) * 60)
        self._under_way.append((arrives, self._steps, topic, message))

    def _deliver(self) -> None:
        """What arrives now, in the order in which it was sent."""
        arrived = [one for one in self._under_way if one[0] <= self._steps]
        self._under_way = [one for one in self._under_way if one[0] > self._steps]
        for _, sent, topic, message in arrived:
            self.harness.send(topic, message, age=(self._steps - sent) / 60, clock_error=self.clock_error)

    @property
    def status(self) -> Any:
        """The newest, or None."""
        newest = self.harness.newest("status")
        return None if newest is None else json.loads(newest.data)


def scene(**params: Any) -> Scene:
    return Scene(Harness(FollowInFront, {"laser": LASER, **params}))
