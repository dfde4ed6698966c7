"""What a cloud of points says, and all the ways in which it may say nothing."""

import math
from dataclasses import replace

import numpy as np
import pytest
from depth_camera import Camera, Face, cloud_of, optical
from hypothesis import given, settings
from hypothesis import strategies as st

from skytether.messages import LaserScan, PointCloud2, PointField
from skytether.robot.safety.geometry.footprint import polygon
from skytether.robot.safety.sensing.cloud_grid import CELL_M, MOST, Grid
from skytether.robot.safety.sensing.clouds import CloudMount, view_of_cloud
from skytether.robot.safety.sensing.ranges import Sight

OUTLINE = polygon([(0.3, 0.25), (0.3, -0.25), (-0.3, -0.25), (-0.3, 0.25)])
CAMERA = Camera()
WALL = Face(2.0)
POST = Face(1.0, (-0.02, 0.02), (0.0, 1.2))


def mount_of(camera=CAMERA, **changes) -> CloudMount:
    """As the camera is mounted, of a robot of 0.8 m, to be believed up to 4 m."""
    place = {"x": camera.x, "y": camera.y, "z": camera.z, "yaw": camera.yaw, "pitch": camera.pitch}
    return CloudMount(**{**place, "roll": camera.roll, "range_max": 4.0, "max_z": 0.8, **changes})


def view(cloud, mount=None, before=None):
    return view_of_cloud(mount or mount_of(), OUTLINE, cloud, before)


def scene(*faces, camera=CAMERA, **layout) -> PointCloud2:
    return cloud_of(camera.see(faces), **layout)


def ahead(seen, width=0.1) -> float:
    """Where the nearest thing stands straight on, from the base's origin."""
    points = seen.points[np.abs(seen.points[:, 1]) <= width]
    return float(points[:, 0].min()) if len(points) else math.inf


def test_a_wall_is_where_it_is_and_a_free_floor_is_clear():
    seen = view(scene(WALL))
    assert seen.sight is Sight.CLEAR
    assert 2.0 - CELL_M * 1.5 <= ahead(seen) <= 2.0
    assert 2.0 <= seen.points[:, 0].max() <= 2.0 + CELL_M * 1.5
    floor = view(scene())
    assert (floor.sight, len(floor.points)) == (Sight.CLEAR, 0)
    assert floor.looks[: 4 * 40].all()
    assert not floor.looks[4 * 60 : -4 * 60].any()


@pytest.mark.parametrize(
    ("up", "stops"),
    [((0.0, 0.04), False), ((0.0, 0.07), True), ((0.75, 0.9), True), ((0.82, 2.0), False), ((0.3, 0.4), True)],
    ids=["a sill", "a foot", "a table", "above the robot", "hanging"],
)
def test_only_what_is_as_high_as_the_robot_stops_it(up, stops):
    seen = view(scene(Face(1.6, up=up)))
    assert seen.sight is Sight.CLEAR
    assert (len(seen.points) > 0) is stops


@pytest.mark.parametrize(
    "layout",
    [
        {"step": 12},
        {"step": 32, "offsets": (16, 4, 24)},
        {"kind": ">f4"},
        {"kind": "<f8", "step": 40},
        {"kind": ">f8", "padding": 7},
        {"step": 13, "offsets": (1, 5, 9), "padding": 3},
    ],
    ids=str,
)
def test_every_layout_says_the_same(layout):
    expected, seen = view(scene(WALL, POST)), view(scene(WALL, POST, **layout))
    assert seen.sight is Sight.CLEAR
    assert seen.points == pytest.approx(expected.points)
    assert (seen.looks == expected.looks).all()


def test_a_cloud_of_one_row_needs_to_be_told_where_it_looks():
    points = CAMERA.see([WALL]).reshape(1, -1, 3)
    seen = view(cloud_of(points))
    assert seen.sight is Sight.NONSENSE
    assert "fov_deg is needed" in seen.detail
    told = mount_of(fov=(math.radians(-40), math.radians(40)))
    seen = view(cloud_of(points[:, ~np.isnan(points[0, :, 0])]), told)
    assert seen.sight is Sight.CLEAR
    assert ahead(seen) == pytest.approx(2.0, abs=0.03)
    half = view(cloud_of(points[:, points[0, :, 1] < 0]), told)
    assert half.sight is Sight.BLIND
    assert "no reading over 40 degrees" in half.detail


@pytest.mark.parametrize(
    "camera",
    [
        Camera(yaw=2.0, pitch=0.4, x=-0.1, y=0.2),
        Camera(roll=math.pi),
        Camera(roll=0.2, pitch=0.1),
        Camera(z=1.1, pitch=0.7, fov=1.2),
    ],
    ids=["to the left behind", "head over", "aslant", "from a mast"],
)
@pytest.mark.parametrize("in_optical", [True, False])
def test_wherever_it_is_mounted_a_post_is_where_it_is(camera, in_optical):
    # A point half a metre above the floor, 1.2 m away in the middle of its view.
    bearing = camera.yaw
    post = np.array([camera.x + 1.2 * math.cos(bearing), camera.y + 1.2 * math.sin(bearing), 0.5])
    points = camera.see()
    clear = view(cloud_of(points), mount_of(camera))
    assert (clear.sight, len(clear.points)) == (Sight.CLEAR, 0)
    points[60, 80] = (post - (camera.x, camera.y, camera.z)) @ camera.turn()
    if in_optical:
        seen = view(cloud_of(optical(points), frame="depth_optical_frame"), mount_of(camera))
    else:
        seen = view(cloud_of(points), mount_of(camera))
    assert np.hypot(*(seen.points - post[:2]).T).max() <= 2 * CELL_M
    assert len(seen.points) == 4


def test_whether_a_cloud_is_optical_may_be_said():
    cloud = cloud_of(optical(CAMERA.see([WALL])), frame="depth")
    assert ahead(view(cloud, mount_of(optical=True))) == pytest.approx(2.0, abs=0.03)
    assert view(cloud, mount_of(optical=False)).sight is not Sight.CLEAR


@pytest.mark.parametrize(
    ("camera", "wrong"),
    [
        (CAMERA, {"pitch": -CAMERA.pitch}),
        (CAMERA, {"pitch": math.radians(60)}),
        (CAMERA, {"roll": math.pi}),
        (CAMERA, {"roll": math.pi / 2}),
        (CAMERA, {"optical": True}),
        (CAMERA, {"z": 1.2}),
        (Camera(pitch=-0.6), {}),
    ],
    ids=["pitch", "more pitch", "head over", "on its side", "optical", "z", "looks up"],
)
def test_a_sensor_that_is_not_mounted_as_said_does_not_call_a_low_box_clear(camera, wrong):
    seen = view(scene(Face(1.0, (-0.3, 0.3), (0.0, 0.3)), camera=camera), mount_of(camera, **wrong))
    assert seen.sight is not Sight.CLEAR or ahead(seen) <= 1.1


# What is not seen is unknown.


def no_reading(points, value=math.nan):
    return np.full_like(points, value)


@pytest.mark.parametrize("value", [math.nan, math.inf, -math.inf, 0.0])
def test_a_cloud_of_nothing_but_one_bad_value_is_blind(value):
    seen = view(cloud_of(no_reading(CAMERA.see(), value)))
    assert seen.sight is Sight.BLIND
    assert not seen.looks.any()
    assert not len(seen.points)


@pytest.mark.parametrize("shape", [(0, 0), (0, 5), (5, 0), (1, 0)])
def test_an_empty_cloud_is_unknown_and_not_clear(shape):
    seen = view(cloud_of(np.empty((*shape, 3))))
    assert (seen.sight, seen.detail) == (Sight.BLIND, "an empty cloud")


def test_too_few_points_are_blind():
    points = CAMERA.see([WALL])
    few = no_reading(points)
    few[40:42, 60:80] = points[40:42, 60:80]
    seen = view(cloud_of(few))
    assert (seen.sight, seen.detail) == (Sight.BLIND, "40 readings, 100 at least (min_points)")
    assert len(seen.points)  # what little is seen counts


def test_columns_without_a_reading_are_missed_in_the_first_cloud_already():
    for missing in (slice(0, 40), slice(60, 100), slice(120, 160)):
        points = CAMERA.see([WALL])
        points[:, missing] = math.nan
        seen = view(cloud_of(points))
        assert seen.sight is Sight.BLIND, missing
        assert "no reading over" in seen.detail
    points = CAMERA.see([WALL])
    points[:, 80:84] = math.nan  # 3 degrees
    assert view(cloud_of(points)).sight is Sight.CLEAR


def test_a_field_of_view_that_was_seen_once_is_asked_for():
    whole = view(scene(WALL))
    half = cloud_of(CAMERA.see([WALL])[:, :80])
    assert view(half).sight is Sight.CLEAR
    assert view(half, before=whole.spans).sight is Sight.BLIND


def test_something_too_near_to_be_measured_is_a_hole_in_the_floor_and_the_sensor_is_blind():
    """The most dangerous of all: a depth camera says NaN for what is too near, and sees the wall behind and above."""
    camera = replace(CAMERA, near=0.3)
    before = view(scene(WALL, camera=camera), mount_of(camera))
    assert before.sight is Sight.CLEAR
    for box in (
        Face(0.45, (-0.2, 0.2), (0.0, 0.35)),
        Face(0.45, (0.0, 0.1), (0.0, 0.35)),
        Face(0.5, (-0.1, 0.1), (0.2, 0.35)),
    ):
        cloud = scene(WALL, box, camera=camera)
        assert ahead(view(cloud, mount_of(camera))) == pytest.approx(2.0, abs=0.03)  # not seen at all
        assert view(cloud, mount_of(camera), before.spans).sight is Sight.BLIND, box


def test_what_is_nearer_than_range_min_counts_as_something_too_close():
    mount = mount_of(range_min=0.3)
    seen = view(scene(WALL, Face(0.45, (-0.2, 0.2), (0.0, 0.7))), mount)
    assert seen.sight is Sight.CLEAR
    assert ahead(seen) == pytest.approx(0.3, abs=0.01)  # at the outline
    assert not seen.looks[:100].any()
    everything = view(scene(Face(0.26, up=(-3.0, 3.0))), mount)
    assert everything.sight is Sight.BLIND
    assert "too close" in everything.detail


def test_the_sky_need_not_answer():
    seen = view(scene(camera=replace(CAMERA, pitch=0.0, far=3.0)), mount_of(replace(CAMERA, pitch=0.0)))
    assert seen.sight is Sight.CLEAR


def test_sight_ends_where_the_floor_is_seen_last():
    floor = view(scene(camera=replace(CAMERA, far=2.0)))
    middle = floor.edge[np.abs(np.arctan2(floor.edge[:, 1], floor.edge[:, 0] - CAMERA.x)) < 0.6]
    away = np.hypot(middle[:, 0] - CAMERA.x, middle[:, 1])
    assert 1.8 < away.min() <= away.max() < 2.8  # 2 m along the middle of the picture
    assert np.hypot(*(view(scene()).edge - [CAMERA.x, 0]).T).max() == pytest.approx(4.0, abs=1e-3)


def test_what_the_lowest_ray_passes_over_is_not_seen():
    seen = view(scene())
    # 120 rows of 0.6 to 0.7 degrees: down to 15 + 35 degrees; 0.35 m above what counts, 0.29 m away.
    assert 0.27 < seen.near[0] < 0.34
    assert view(scene(camera=replace(CAMERA, pitch=0.0)), mount_of(replace(CAMERA, pitch=0.0))).near[0] > 0.48
    assert view(scene(), mount_of(min_z=0.3)).near[0] < 0.1


def test_ignored_directions_count_neither_as_seen_nor_as_missing():
    mount = mount_of(ignore=((math.radians(-10), math.radians(10)),))
    points = CAMERA.see([Face(0.6, (-0.03, 0.03))])
    seen = view(cloud_of(points), mount)
    assert (seen.sight, len(seen.points)) == (Sight.CLEAR, 0)
    assert not seen.looks[:40].any()


# The floor is not always flat.


def test_a_ramp_is_an_obstacle_unless_it_is_said_that_there_are_ramps():
    ramp = replace(CAMERA, slope=math.tan(math.radians(4)))
    assert len(view(scene(camera=ramp)).points)
    told = mount_of(slope=math.tan(math.radians(5)))
    seen = view(scene(camera=ramp), told)
    assert (seen.sight, len(seen.points)) == (Sight.CLEAR, 0)
    # 10 cm stand out of it up to 0.5 m away, 30 cm up to 2.8 m.
    assert ahead(view(scene(Face(0.65, up=(0.0, 0.1))), told)) == pytest.approx(0.65, abs=0.03)
    assert ahead(view(scene(Face(1.6, up=(0.0, 0.3))), told)) == pytest.approx(1.6, abs=0.03)
    assert ahead(view(scene(Face(1.6, up=(0.0, 0.1))), told)) == math.inf


def test_a_robot_that_nods_takes_its_floor_for_an_obstacle_and_goes_on_seeing_walls():
    nods = replace(CAMERA, pitch=CAMERA.pitch + math.radians(2))
    assert len(view(scene(camera=nods)).points)
    rears = replace(CAMERA, pitch=CAMERA.pitch - math.radians(3))
    assert ahead(view(scene(Face(2.0, up=(0.0, 0.3)), camera=rears))) == pytest.approx(2.0, abs=0.06)


def test_a_staircase_down_before_the_robot_is_not_clear():
    points = replace(CAMERA, z=1.4).see()  # all of the floor is 1 m lower
    seen = view(cloud_of(points))
    assert seen.sight is Sight.NONSENSE
    assert "deep below the floor" in seen.detail


# What makes no sense.

GOOD = scene(WALL)
X, Y, Z = GOOD.fields


@pytest.mark.parametrize(
    ("changes", "says"),
    [
        ({"fields": [X, Y]}, "0 fields of the name z"),
        ({"fields": [X, Y, Z, Z]}, "2 fields of the name z"),
        ({"fields": []}, "0 fields of the name x"),
        ({"fields": [X] * 1000}, "1000 fields"),
        ({"fields": [X, Y, PointField("z", 8, 5, 1)]}, "not 1 of datatype 5"),
        ({"fields": [X, Y, PointField("z", 8, 7, 3)]}, "not 3 of datatype 7"),
        ({"fields": [X, Y, PointField("z", 13, 7, 1)]}, "field z at byte 13 is not within the 16 bytes"),
        ({"fields": [X, Y, PointField("z", 8, 8, 1)], "point_step": 12, "row_step": 12 * 160}, "not within the 12"),
        ({"fields": [X, Y, PointField("z", 2**32 - 1, 7, 1)]}, "at byte 4294967295"),
        ({"point_step": 0}, "not within the 0 bytes"),
        ({"row_step": 16 * 160 - 1}, "row_step 2559 is less than 160 points of 16 bytes"),
        ({"row_step": 2**32 - 1}, "there are 307200"),
        ({"width": 161}, "row_step 2560 is less"),
        ({"height": 121}, "160 by 121 points need 309760 bytes, and there are 307200"),
        ({"width": 2**32 - 1, "height": 2**32 - 1}, "500000 at most"),
        ({"width": 1, "height": 400_000}, "bytes, and there are 307200"),
        ({"data": np.empty(0, dtype=np.uint8)}, "and there are 0"),
    ],
)
def test_a_cloud_that_claims_more_than_it_holds_is_refused(changes, says):
    seen = view(replace(GOOD, **changes))
    assert (seen.sight, len(seen.points)) == (Sight.NONSENSE, 0)
    assert says in seen.detail


def test_another_type_is_refused():
    assert "LaserScan" in view(LaserScan()).detail


@pytest.mark.parametrize("kind", ["<f4", ">f4", "<f8", ">f8"])
def test_bytes_the_wrong_way_round_are_never_clear(kind):
    cloud = scene(WALL, kind=kind, step=24)
    seen = view(replace(cloud, is_bigendian=not cloud.is_bigendian))
    assert seen.sight not in (Sight.CLEAR, Sight.EMPTY)


def test_columns_that_are_taken_for_others_are_never_clear():
    for names in ("xzy", "zyx", "yxz"):
        fields = [PointField(name, 4 * i, 7, 1) for i, name in enumerate(names)]
        seen = view(replace(scene(WALL, POST), fields=fields), mount_of(fov=(-0.6, 0.6)))
        assert seen.sight is not Sight.CLEAR or ahead(seen, 0.35) < 1.05, names


# Nothing is lost.


@settings(max_examples=60, deadline=None)
@given(st.integers(0, 119), st.integers(0, 159), st.floats(0.06, 0.79), st.floats(0.2, 3.5))
def test_one_point_among_all_is_never_lost(row, column, height, away):
    points = CAMERA.see([WALL])
    bearing = (column - 80) / 80 * 0.7
    point = np.array([away * math.cos(bearing), away * math.sin(bearing), height - CAMERA.z])
    points[row, column] = point @ replace(CAMERA, x=0, y=0).turn()
    if np.linalg.norm(point) >= 4.0:
        return
    seen = view(cloud_of(points))
    off = np.abs(seen.points - (CAMERA.x + point[0], CAMERA.y + point[1]))
    assert (off <= CELL_M + 1e-4).all(axis=1).sum() >= 4


@pytest.mark.parametrize("far", [0.5, 4.0, 30.0, 100.0])
@pytest.mark.parametrize("count", [1, 50, 200_000])
def test_all_points_lie_between_the_corners_of_their_cells_and_there_are_never_too_many(far, count):
    random = np.random.default_rng(count)
    away, bearing = far * random.random(count) ** 0.5 * 0.9999, random.uniform(-math.pi, math.pi, count)
    ahead, left = (away * np.cos(bearing)).astype(np.float32), (away * np.sin(bearing)).astype(np.float32)
    grid = Grid(far)
    grid.add(ahead, left)
    corners = grid.corners()
    assert 4 <= len(corners) <= min(MOST, 4 * count)
    apart = np.diff(np.unique(np.round(corners[:, 0], 6)))
    cell = apart[apart > 1e-4].min()
    for x, y in np.column_stack((ahead, left))[:50]:
        beside = corners[(np.abs(corners[:, 0] - x) <= cell + 1e-4) & (np.abs(corners[:, 1] - y) <= cell + 1e-4)]
        assert beside[:, 0].min() <= x + 1e-4
        assert beside[:, 0].max() >= x - 1e-4
        assert beside[:, 1].min() <= y + 1e-4
        assert beside[:, 1].max() >= y - 1e-4


wild = st.floats(allow_nan=True, allow_infinity=True, width=32)


@settings(max_examples=100, deadline=None)
@given(
    st.lists(wild, max_size=60),
    st.integers(0, 8),
    st.integers(0, 8),
    st.integers(0, 40),
    st.integers(0, 200),
    st.lists(st.tuples(st.sampled_from("xyzw"), st.integers(0, 40), st.integers(0, 9), st.integers(0, 2)), max_size=5),
    st.booleans(),
)
def test_any_cloud_gives_finite_points_and_never_raises(numbers, height, width, step, row, fields, big):
    message = PointCloud2(
        height=height,
        width=width,
        fields=[PointField(*field) for field in fields],
        is_bigendian=big,
        point_step=step,
        row_step=row,
        data=np.frombuffer(np.array(numbers, dtype=np.float32).tobytes(), dtype=np.uint8),
    )
    for mount in (mount_of(min_points=1), mount_of(min_points=1, range_min=0.5, slope=0.1, fov=(-1.0, 1.0))):
        seen = view(message, mount)
        assert np.isfinite(seen.points).all()
        assert seen.points.shape[1] == 2
        assert np.isfinite(seen.edge).all()


def test_numbers_as_they_come_do_the_same():
    random = np.random.default_rng(1)
    for _ in range(20):
        data = random.integers(0, 256, 16 * 200, dtype=np.uint8)
        cloud = replace(GOOD, height=10, width=20, row_step=320, data=data)
        seen = view(cloud, mount_of(min_points=1))
        assert np.isfinite(seen.points).all()
        assert seen.sight is not Sight.CLEAR
