"""Faces of pictures: the simulated operator's head, pasted flat, and things that are none."""

from __future__ import annotations

import hashlib
import io
import math
from importlib.resources import files

import numpy as np
import pytest
from numpy.typing import NDArray
from PIL import Image

from skytether_services.follow_in_front.camera_image import PictureError, decode
from skytether_services.follow_in_front.face_choice import FaceChoice, choose
from skytether_services.follow_in_front.face_tracker import Face, FaceTracker
from skytether_services.follow_in_front.head_pose import PAIRS, turned

VIEW = 1.08
SIZE = (640, 480)
HEAD = Image.open(str(files("skytether.lab.world") / "assets" / "head.png")).convert("RGB")


def picture(*heads: tuple[float, float, float]) -> NDArray[np.uint8]:
    """A grey picture with heads: middle x, y and width of each [pixels]."""
    image = Image.new("RGB", SIZE, (150, 150, 140))
    for x, y, width in heads:
        head = HEAD.resize((round(width), round(width * HEAD.height / HEAD.width)))
        image.paste(head, (round(x - head.width / 2), round(y - head.height / 2)))
    return np.asarray(image)


def jpeg(pixels: NDArray[np.uint8], quality: int = 85) -> bytes:
    buffer = io.BytesIO()
    Image.fromarray(pixels).save(buffer, "JPEG", quality=quality)
    return buffer.getvalue()


def test_the_networks_are_those_that_the_page_beside_them_names() -> None:
    folder = files("skytether_services.follow_in_front") / "models"
    page = (folder / "README.md").read_text()
    names = [one.name for one in folder.iterdir() if one.name.endswith(".tflite")]
    assert len(names) == 2
    for name in names:
        assert hashlib.sha256((folder / name).read_bytes()).hexdigest() in page


def test_a_face_is_found_where_it_is_and_points_straight_ahead() -> None:
    tracker = FaceTracker(VIEW)
    found = tracker.step(picture((420, 240, 150)))
    assert len(found) == 1
    assert math.degrees(found[0].bearing) == pytest.approx(
        math.degrees(math.atan(100 / 320 * math.tan(VIEW / 2))), abs=2
    )
    # It looks at the camera: so it points as far to the left as it is to the right.
    assert math.degrees(found[0].angle) == pytest.approx(-math.degrees(found[0].bearing), abs=4)
    assert found[0].score > 0.9


def test_small_faces_are_found_in_parts_of_the_picture_within_a_few() -> None:
    tracker = FaceTracker(VIEW)
    counts = [len(tracker.step(picture((200, 300, 70)))) for _ in range(4)]
    assert counts[-1] == 1


def test_a_face_that_leaps_is_followed_or_lost_but_never_seen_where_it_is_not() -> None:
    """The landmarks' network is sure of half a face: here it sees, in the old place, what it makes a face of."""
    tracker = FaceTracker(VIEW)
    assert tracker.step(picture((320, 240, 150)))
    for x in (360, 300, 390, 250, 480, 150):
        for face in tracker.step(picture((x, 240, 150))):
            there = math.atan((x / 320 - 1) * math.tan(VIEW / 2))
            assert math.degrees(face.bearing) == pytest.approx(math.degrees(there), abs=2.5)
            assert math.degrees(face.angle) == pytest.approx(-math.degrees(there), abs=6)


def test_two_faces_are_two() -> None:
    tracker = FaceTracker(VIEW)
    both = picture((180, 240, 150), (460, 240, 150))
    found = [tracker.step(both) for _ in range(8)][-1]
    assert sorted(math.copysign(1, face.bearing) for face in found) == [-1, 1]


def test_no_face_is_seen_in_noise_or_on_a_wall() -> None:
    noise = np.random.default_rng(3).integers(0, 255, (480, 640, 3), dtype=np.uint8)
    for pixels in (noise, picture()):
        tracker = FaceTracker(VIEW)
        assert not any(tracker.step(pixels) for _ in range(6))


def test_a_face_that_is_gone_is_gone() -> None:
    tracker = FaceTracker(VIEW)
    assert tracker.step(picture((320, 240, 150)))
    assert tracker.step(picture()) == []


def test_a_camera_sees_less_than_half_of_the_world() -> None:
    with pytest.raises(ValueError, match="field of view"):
        FaceTracker(4.0)


def test_pictures_that_show_nothing_are_refused_with_the_reason() -> None:
    good = jpeg(picture((320, 240, 150)))
    assert decode(good).shape == (480, 640, 3)
    broken = {
        b"": "broken",
        b"no picture": "broken",
        good[: len(good) // 2]: "broken",
        b"\xff\xd8" + good[40:]: "broken",
    }
    for data, text in broken.items():
        with pytest.raises(PictureError, match=text):
            decode(data)
    with pytest.raises(PictureError, match="black"):
        decode(jpeg(np.zeros((480, 640, 3), np.uint8)))
    with pytest.raises(PictureError, match="too few"):
        decode(jpeg(np.full((20, 640, 3), 90, np.uint8)))
    with pytest.raises(PictureError, match="more than"):
        decode(jpeg(np.full((2100, 2000, 3), 90, np.uint8)))


def test_bytes_of_any_kind_are_a_picture_or_refused() -> None:
    random = np.random.default_rng(5)
    good = np.frombuffer(jpeg(picture((320, 240, 150))), np.uint8)
    for _ in range(60):
        bad = good.copy()
        places = random.integers(0, len(bad), 12)
        bad[places] = random.integers(0, 256, 12)
        try:
            assert decode(bad[: random.integers(1, len(bad))].tobytes()).ndim == 3
        except PictureError:
            continue


def face(bearing: float, size: float = 100) -> Face:
    return Face(0.1, math.radians(bearing), size, 1.0)


def test_the_operators_face_is_the_one_above_the_operators_legs() -> None:
    legs = math.radians(-10)
    assert choose([face(-8), face(25)], legs) == (face(-8), FaceChoice.SEEN)
    assert choose([face(25)], legs) == (None, FaceChoice.NONE)
    assert choose([], legs) == (None, FaceChoice.NONE)
    assert choose([face(-8), face(-14)], legs) == (None, FaceChoice.SEVERAL)
    # One of them is further than any of the operator's is, but legs are seen less exactly than that.
    assert choose([face(-8), face(8)], legs) == (None, FaceChoice.SEVERAL)
    assert choose([face(8)], legs) == (None, FaceChoice.NONE)
    assert choose([face(-14, 50), face(-8)], legs) == (face(-8), FaceChoice.SEEN)


def test_without_legs_only_a_single_face_counts() -> None:
    assert choose([face(20)], None) == (face(20), FaceChoice.SEEN)
    assert choose([face(20), face(-20, 50)], None) == (None, FaceChoice.SEVERAL)


@pytest.mark.parametrize("degrees", [-30, 0, 20])
def test_the_angle_is_that_of_the_lines_between_mirrored_landmarks(degrees: float) -> None:
    points = np.zeros((468, 3))
    turn = math.radians(degrees)
    for number, (right, left) in enumerate(PAIRS):
        half = 10.0 + number
        points[left] = half * math.cos(turn), number, half * math.sin(turn)
        points[right] = -points[left, 0], number, -points[left, 2]
    assert turned(points, slope=1.0) == pytest.approx(turn)
    assert turned(points, slope=0.8) == pytest.approx(turn / 0.8)
