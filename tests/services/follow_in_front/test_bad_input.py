"""What a robot may send by mistake or malice: nothing ends the service, holds it up, or moves the robot by old data."""

from __future__ import annotations

import io
import math
import struct
import time
import zlib
from collections.abc import Iterator
from typing import Any

import numpy as np
import pytest
from follow_scene import HEAD, ONE, Drawn, Scene, jpeg, scene
from leg_scans import FIRST, LIMITS, STEP, feet, scan
from PIL import Image

from skytether.messages import (
    CompressedImage,
    Header,
    LaserScan,
    Odometry,
    Point,
    Pose,
    PoseWithCovariance,
    Quaternion,
    TFMessage,
    Time,
    Transform,
    TransformStamped,
    Vector3,
)
from skytether_services.follow_in_front.camera_image import PictureError, decode
from skytether_services.follow_in_front.face_landmarks import FaceMesh
from skytether_services.follow_in_front.face_tracker import FaceTracker
from skytether_services.follow_in_front.formation import Formation, FormationParams, State
from skytether_services.follow_in_front.tracker import PeopleTracker

GREY = Image.new("RGB", (640, 480), (150, 150, 140))
NAN, INF = math.nan, math.inf


def png(image: Image.Image) -> bytes:
    buffer = io.BytesIO()
    image.save(buffer, "PNG")
    return buffer.getvalue()


def chunk(kind: bytes, data: bytes) -> bytes:
    return struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data))


def progressive(scans: int) -> bytes:
    """One whose last scan comes again and again; each takes as long as the picture is large."""
    buffer = io.BytesIO()
    Image.new("RGB", (2000, 2000), (150, 150, 140)).save(buffer, "JPEG", progressive=True)
    whole = buffer.getvalue()
    last = whole[whole.rindex(b"\xff\xda") : -2]
    return whole[:-2] + last * scans + whole[-2:]


PNG, JPEG = png(GREY), jpeg(GREY)
PROFILE = chunk(b"iCCP", b"a\0\0" + zlib.compress(bytes(900_000)))


@pytest.mark.parametrize(
    "data",
    [
        b"",
        b"\xff\xd8\xff",
        PNG[:8],
        PNG[:40],
        bytes(100_000),
        JPEG[:2] + b"\xff\xef\0\2" * 1_900_000 + JPEG[2:],
        JPEG[:2] + b"\xff" * 7_900_000 + JPEG[2:],
        JPEG[:2] + bytes(7_900_000) + JPEG[2:],
        PNG[:33] + chunk(b"abCd", b"") * 600_000 + PNG[33:],
        progressive(50_000),
        JPEG.replace(struct.pack(">HH", 480, 640), struct.pack(">HH", 65_000, 65_000), 1),
        JPEG.replace(struct.pack(">HH", 480, 640), struct.pack(">HH", 0, 640), 1),
        jpeg(Image.new("RGB", (40, 4000), (150, 150, 140))),
        bytes(9_000_000),
    ],
    ids=lambda data: f"{len(data)} bytes",
)
def test_what_is_no_picture_is_refused_at_once(data: bytes) -> None:
    begun = time.process_time()
    with pytest.raises(PictureError):
        decode(data)
    assert time.process_time() - begun < 0.5


@pytest.mark.parametrize(
    "data",
    [
        png(GREY.convert("1")),
        png(GREY.convert("LA")),
        png(GREY.convert("L").convert("I;16")),
        png(GREY.convert("P")),
        png(GREY.convert("RGBA")),
        jpeg(GREY.convert("L")),
        jpeg(GREY.convert("CMYK")),
        PNG[:33] + PROFILE * 2000 + PNG[33:],  # 2 GB in all
        *(PNG[:-12] + chunk(kind, b"\1\2\3\4\5") + PNG[-12:] for kind in (b"cHRM", b"gAMA", b"tRNS", b"fdAT", b"eXIf")),
        JPEG[:2] + b"\xff\xe1\0\x08Exif\0\0" + b"\xff\xe2\0\x0aMPF\0MM\0*" + JPEG[2:],
        JPEG[:2] + b"\xff\xff\xff" + JPEG[2:],
    ],
)
def test_a_picture_of_any_kind_is_read_whatever_is_in_it_beside(data: bytes) -> None:
    begun = time.process_time()
    assert decode(data).shape == (480, 640, 3)
    assert time.process_time() - begun < 0.5


def test_broken_bytes_are_never_worse_than_no_picture() -> None:
    random = np.random.default_rng(3)
    for source in (ONE, png(GREY.resize((160, 120)))):
        for _ in range(150):
            data = bytearray(source)
            for _ in range(int(random.integers(1, 20))):
                data[int(random.integers(len(data)))] = int(random.integers(256))
            try:
                picture = decode(bytes(data[: int(random.integers(len(data) // 2, len(data)))]))
            except PictureError:
                continue
            assert picture.ndim == 3


def test_pictures_may_change_their_size() -> None:
    large = Image.new("RGB", (2000, 1500), (150, 150, 140))
    large.paste(HEAD.resize((500, 500 * HEAD.height // HEAD.width)), (1450, 900))
    tracker = FaceTracker(1.08)
    for _ in range(2):
        assert len(tracker.step(np.asarray(large))) == 1
        assert tracker.step(np.asarray(GREY.resize((64, 64)))) == []
        tracker.step(np.asarray(GREY.resize((64, 3000))))


def test_a_wall_of_portraits_takes_no_longer_than_a_few_faces(monkeypatch: pytest.MonkeyPatch) -> None:
    wall = GREY.copy()
    head = HEAD.resize((70, 70 * HEAD.height // HEAD.width))
    for x in range(0, 570, 71):
        for y in range(0, 400, 95):
            wall.paste(head, (x, y))
    tracker, looked = FaceTracker(1.08), 0
    look = FaceMesh.detect

    def counted(*args: Any) -> Any:
        nonlocal looked
        looked += 1
        return look(*args)

    monkeypatch.setattr(FaceMesh, "detect", counted)
    for _ in range(6):
        looked = 0
        assert len(tracker.step(np.asarray(wall))) <= 3
        assert looked <= 12


BAD_SCANS = {
    "no rays": ([], FIRST, STEP, LIMITS),
    "one ray": ([1.0], FIRST, STEP, LIMITS),
    "nothing": ([NAN, INF, -INF, -1.0, 0.0] * 100, FIRST, STEP, LIMITS),
    "angle NaN": ([1.0] * 700, NAN, STEP, LIMITS),
    "angle infinite": ([1.0] * 700, INF, STEP, LIMITS),
    "increment NaN": ([1.0] * 700, FIRST, NAN, LIMITS),
    "increment infinite": ([1.0] * 700, FIRST, -INF, LIMITS),
    "increment 0": ([1.0, 2.0] * 350, FIRST, 0.0, LIMITS),
    "increment huge": ([1.0, 2.0] * 350, FIRST, 3e38, LIMITS),
    "no limits": ([1.0, INF, 3e38] * 250, FIRST, STEP, (-INF, INF)),
    "limits NaN": ([1.0] * 700, FIRST, STEP, (NAN, NAN)),
    "limits the other way round": ([1.0] * 700, FIRST, STEP, (10.0, 0.1)),
}


@pytest.mark.parametrize("case", BAD_SCANS.values(), ids=BAD_SCANS)
def test_a_scan_that_means_nothing_shows_nobody(case: tuple[list[float], float, float, tuple[float, float]]) -> None:
    ranges, first, step, limits = case
    tracker = PeopleTracker()
    for number in range(10):
        assert tracker.step(np.array(ranges, np.float32), first, step, limits, (0.0, 0.0, 0.0), 0.1 * number) == ()


@pytest.mark.parametrize("spread", [0.0, 3.0], ids=["a wall", "a million legs"])
def test_a_scan_of_a_million_rays_takes_no_longer_than_a_step_may(spread: float) -> None:
    random, tracker = np.random.default_rng(1), PeopleTracker()
    # Runs of four equal ranges look like legs.
    for number in range(3):
        ranges = (1.5 + spread * np.repeat(random.random(250_000), 4)).astype(np.float32)
        begun = time.process_time()
        tracker.step(ranges, 0.0, 0.01, LIMITS, (0.0, 0.0, 0.0), 0.1 * number)
        assert time.process_time() - begun < 0.5


def test_a_laser_that_turns_to_the_right_sees_the_same_people() -> None:
    found = []
    for turned in (False, True):
        random, tracker = np.random.default_rng(1), PeopleTracker()
        for number in range(30):
            ranges = scan(feet((2.5 - 0.05 * number, 0.2), math.pi, 0.05 * number), random=random)
            if turned:
                people = tracker.step(ranges[::-1], -FIRST, -STEP, LIMITS, (0.0, 0.0, 0.0), 0.1 * number)
            else:
                people = tracker.step(ranges, FIRST, STEP, LIMITS, (0.0, 0.0, 0.0), 0.1 * number)
        found.append([person.place.tolist() for person in people])
    assert len(found[0]) == 1
    assert found[1][0] == pytest.approx(found[0][0], abs=0.02)


@pytest.fixture
def following(monkeypatch: pytest.MonkeyPatch) -> Scene:
    monkeypatch.setattr("skytether_services.follow_in_front.service.FaceTracker", Drawn)
    found = scene()
    found.run(3.5)
    assert found.status["code"] == "following"
    return found


def stands(found: Scene, seconds: float) -> None:
    """From now on nothing moves the robot."""
    begun = len(found.commands)
    found.run(seconds)
    assert len(found.commands) > begun
    assert set(found.commands[begun:]) == {(0.0, 0.0)}


def send_from_the_future(found: Scene) -> None:
    """One picture and one scan that were sent in an hour, by the clock."""
    stamp = Time.from_seconds(100 + found.time - 0.15)
    legs = feet((-0.9, 0.0), 0.0, 0.0)
    ranges = scan(legs, laser=(-0.2, 0.0, math.pi))
    message = LaserScan(Header(stamp, "rear"), FIRST, 0.0, STEP, 0.0, 0.0, *LIMITS, ranges)
    found.harness.send("scan", message, age=-3600)
    picture = CompressedImage(Header(stamp), "jpeg", np.frombuffer(ONE, np.uint8))
    found.harness.send("usb_cam/image_raw/compressed", picture, age=-3600)


@pytest.mark.parametrize("silent", ["picture", "people"])
def test_what_pretends_to_be_of_the_future_is_not_new_for_ever(following: Scene, silent: str) -> None:
    setattr(following, silent, None)
    following.run(0.1)
    send_from_the_future(following)
    following.run(1.3)
    stands(following, 1.0)
    assert following.status["state"] == "standing"


def test_it_sees_again_after_a_message_of_the_future(following: Scene) -> None:
    for _ in range(10):  # one of them is not overtaken
        send_from_the_future(following)
        following.run(1 / 60)
    following.run(3.0)
    assert following.status["code"] == "following"


def test_a_link_that_delays_all_by_three_seconds_moves_nothing(following: Scene) -> None:
    following.all_late = 3.0
    following.run(1.2)
    stands(following, 6.0)
    assert following.status["code"] == "late"


def test_as_long_as_nobody_knows_how_old_it_is_nothing_moves_the_robot(following: Scene) -> None:
    following.clock_error = INF
    following.run(0.2)
    stands(following, 2.0)
    assert following.status["code"] == "late"
    following.clock_error = 0.25  # a round trip of half a second
    following.run(3.0)
    assert following.status["code"] == "following"
    following.clock_error = 1.3  # it may be older than the limit
    following.run(0.2)
    stands(following, 1.0)


@pytest.mark.parametrize("late", [0.15, 0.25])
def test_odometry_that_comes_later_than_scans_is_waited_for(following: Scene, late: float) -> None:
    following.odometry_late = late
    following.run(3.0)
    assert following.status["code"] == "following"
    assert following.commands[-1][0] > 0.2


def odometry(stamp: float, x: float, *, frame: str = "odom", rotation: Quaternion | None = None) -> Odometry:
    pose = Pose(Point(x), rotation or Quaternion(w=1.0))
    return Odometry(Header(Time.from_seconds(stamp), frame), "base_link", PoseWithCovariance(pose))


def test_odometry_that_says_the_same_again_and_again_is_silent(following: Scene) -> None:
    """A driver that hangs, and something that repeats its last message."""
    following.odometry = False
    last = odometry(100 + following.time, following.x)
    for _ in range(120):
        following.harness.send("RosAria/pose", last)
        following.run(1 / 60)
    assert following.status["code"] == "odometry_silent"
    assert following.commands[-1] == (0.0, 0.0)


@pytest.mark.parametrize("x", [NAN, INF, 1e308, -1e12])
def test_odometry_that_cannot_be_is_left_out(following: Scene, x: float) -> None:
    for _ in range(30):
        following.harness.send("RosAria/pose", odometry(100 + following.time, x))
        following.harness.send("RosAria/pose", odometry(100 + following.time, 0.0, rotation=Quaternion(w=x)))
        following.run(0.1)
    assert following.status["code"] == "following"


def test_odometry_that_jumps_moves_nobody(following: Scene) -> None:
    commands = len(following.commands)
    following.x += 500.0
    for person in following.people or []:
        person.x += 500.0  # type: ignore[union-attr]
    following.run(3.0)
    assert following.status["code"] == "following"
    assert following.status["operators"] == 1
    assert max(linear for linear, _ in following.commands[commands:]) < 0.7


def link(parent: str, child: str, x: float = 0.0) -> TransformStamped:
    return TransformStamped(Header(frame_id=parent), child, Transform(Vector3(x=x), Quaternion(w=1.0)))


def test_trees_of_frames_with_circles_and_names_that_change_harm_nobody(following: Scene) -> None:
    loops = [link("odom", "base_link"), link("base_link", "odom"), link("base_link", "base_link")]
    for number in range(180):
        odd = [*loops, link(f"f{number}", f"f{number + 1}", x=(NAN, 1e308, 0.0)[number % 3])]
        following.harness.send("tf", TFMessage(odd))
        if number % 6 == 1:
            name = f"odom{number}"
            following.harness.send("RosAria/pose", odometry(100 + following.time, following.x, frame=name))
        following.run(1 / 60)
    assert following.status["operators"] == 1
    assert following.commands[-1][0] >= 0


def test_a_tree_of_a_hundred_thousand_frames_does_not_hold_up_a_step(following: Scene) -> None:
    following.harness.send("tf", TFMessage([link("odom", "base_link")] * 100_000))
    begun = time.process_time()
    following.run(1 / 60)
    assert time.process_time() - begun < 0.3


def test_stamps_that_go_back_and_jump_are_got_over(following: Scene) -> None:
    for jump in (-90.0, 1e6, -1e6, 0.4):
        following.harness.send("RosAria/pose", odometry(100 + following.time + jump, following.x))
        following.run(0.3)
    following.run(2.0)
    assert following.status["code"] == "following"


def broken_messages() -> Iterator[tuple[str, bytes]]:
    for topic in ("tf", "usb_cam/image_raw/compressed", "scan", "RosAria/pose", "RosAria/laserscan", "RosAria/sonar"):
        yield topic, b""
        yield topic, bytes(3)
        yield topic, b"\xff" * 200


def test_bytes_that_are_no_message_are_passed_over(following: Scene) -> None:
    for topic, payload in broken_messages():
        following.harness.send(topic, payload)
        following.run(1 / 60)
    following.run(1.0)
    assert following.status["code"] == "following"


def formation(speed: float = 1.5, **params: Any) -> Formation:
    """One that drives as fast as it may, at time 10 s."""
    found = Formation(FormationParams(**params))
    for number in range(101):
        now = 0.1 * number
        found.legs(-0.3, 0.0, speed, 0.0, now)
        found.face(0.0, now)
        found.step(now)
    return found


def test_nothing_moves_the_robot_after_the_limit_however_fast_it_was() -> None:
    law = formation(max_linear=1.5, braking=0.5)
    for number in range(1, 30):
        now = 10.0 + 0.1 * number
        velocity, state = law.step(now)
        if number >= 13:
            assert (velocity, state) == ((0.0, 0.0), State.STANDING)
        else:
            assert velocity.linear > 0


def test_a_new_operator_is_gone_ahead_of_from_a_stand_only() -> None:
    law = formation(stop_after=10.0, slow_after=5.0, braking=0.5, predict=False)
    law.lose()
    stood = False
    for number in range(1, 60):
        now = 10.0 + 0.1 * number
        law.legs(-0.5, 0.0, 0.4, 0.0, now)
        law.face(0.0, now)
        velocity, state = law.step(now)
        stood = stood or velocity.linear == 0
        assert stood or state is State.STANDING
    assert stood
    assert velocity.linear > 0.3


def test_what_may_be_older_than_the_limit_moves_nothing() -> None:
    law = formation()
    law.doubt = 1.0
    assert law.step(10.1).velocity.linear > 0
    law.doubt = 1.11
    assert law.step(10.1).velocity == (0.0, 0.0)
