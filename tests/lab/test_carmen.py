from __future__ import annotations

import gzip
import math
from pathlib import Path

import numpy as np
import pytest

from skytether.lab.bench.navigation import NavigationBenchError, load
from skytether.lab.carmen import CarmenError, Relations, ray_angles, read_log, read_relations
from skytether.lab.relations import nearest, score

LOG = """# a comment
PARAM robot_front_laser_max 80.99 1.0 host 1.0
ODOM 1 2 0.5 0 0 0 0.1 host 0.1
FLASER 3 1.0 2.0 81.91 4 5 0.1 1 2 0.5 0.3 host 0.3
FLASER 3 1.5 nan 3.0 4 5 0.1 1 2 0.5 0.2 host
SYNC x
"""


def written(folder: Path, text: str) -> Path:
    path = folder / "some.log"
    path.write_text(text)
    return path


def test_a_log_is_sorted_by_stamp_and_reads_the_same_gzipped(tmp_path: Path) -> None:
    log = read_log(written(tmp_path, LOG))
    assert log.stamps.tolist() == [0.2, 0.3]
    np.testing.assert_allclose(log.ranges, [[1.5, np.nan, 3], [1, 2, 81.91]], rtol=1e-6)
    assert (log.laser[0].tolist(), log.odometry[0].tolist()) == ([4, 5, 0.1], [1, 2, 0.5])
    assert (log.odom.tolist(), log.odom_stamps.tolist()) == ([[1, 2, 0.5]], [0.1])
    assert log.max_range == pytest.approx(0.98 * 81.91)  # less than the 80.99 that the robot was set to
    assert not log.laser_is_odometry
    zipped = tmp_path / "some.log.gz"
    zipped.write_bytes(gzip.compress(LOG.encode()))
    np.testing.assert_array_equal(read_log(zipped).ranges, log.ranges)


@pytest.mark.parametrize(
    ("rays", "first", "last"),
    # An even number lacks the ray at +90 degrees: 360 half degrees from -90 end at 89.5.
    [(360, -90, 89.5), (361, -90, 90), (180, -90, 89), (181, -90, 90), (1081, -135, 135), (401, -50, 50)],
)
def test_rays_of_usual_lasers(rays: int, first: float, last: float) -> None:
    angles = np.degrees(ray_angles(rays))
    np.testing.assert_allclose([angles[0], angles[-1]], [first, last])


def test_broken_lines_are_named_and_left_out(tmp_path: Path) -> None:
    good = "FLASER 2 1 2 0 0 0 0 0 0 {} host 1\n"
    lines = [good.format(i) for i in range(100)]
    lines[6] = "FLASER 2 1 x 0 0 0 0 0 0 6 host 1\n"
    lines[7] = "FLASER 3 1 2 3 0 0 0 0 0 0 7 host 1\n"
    lines[-1] = "FLASER 2 1 2 0 0"
    log = read_log(written(tmp_path, "".join(lines)))
    assert len(log.stamps) == 97
    assert [number for number, _ in log.broken] == [7, 8, 100]
    assert "3 ranges, others have 2" in log.broken[1][1]
    with pytest.raises(CarmenError, match=r"3 lines are broken: line 2: FLASER: a range is no number"):
        read_log(written(tmp_path, "".join(lines[5:10] + lines[-1:])))


@pytest.mark.parametrize("text", ["", "ODOM 1 2 0.5 0 0 0 0.1 host 0.1\n", "hello\n"])
def test_a_log_without_scans_is_refused(tmp_path: Path, text: str) -> None:
    with pytest.raises(CarmenError, match="there is no FLASER line"):
        read_log(written(tmp_path, text))


def test_files_that_cannot_be_read(tmp_path: Path) -> None:
    with pytest.raises(CarmenError, match="cannot be read"):
        read_log(tmp_path / "none.log")
    cut = tmp_path / "cut.gz"
    cut.write_bytes(gzip.compress(LOG.encode())[:-20])
    with pytest.raises(CarmenError, match="cannot be read"):
        read_log(cut)
    with pytest.raises(CarmenError, match="line 2: 8 numbers"):
        read_relations(written(tmp_path, "1 2 3 4 5 6 7 8\n1 2 3\n"))
    assert read_relations(written(tmp_path, "1 2 3 4 5 6 7 8\n")).motions.tolist() == [[3, 4, 8]]


def test_nearest_stamp() -> None:
    assert nearest(np.array([0.0, 1, 2]), np.array([-1, 0.4, 0.6, 5])).tolist() == [0, 0, 1, 2]
    assert nearest(np.array([3.0]), np.array([0.0, 9])).tolist() == [0, 0]


def test_score_of_two_relations() -> None:
    # The second pose, seen from the first, is (2, 0) and turned by a quarter; that is just what the first relation
    # says. The second one says (2, 0.1), unturned: e = found inverse(expected) = (2, 0, 90) (-2, -0.1, 0), and a
    # quarter turn makes of (-2, -0.1) (0.1, -2): e is (2.1, -2, 90 degrees).
    stamps, quarter = np.array([10.0, 30.0]), math.pi / 2
    poses = np.array([[1, 1, quarter], [1, 3, math.pi]])
    relations = Relations(np.array([[110.0, 130], [110.0, 130]]), np.array([[2, 0, quarter], [2, 0.1, 0]]))
    found = score(stamps, poses, relations, -100.0)
    assert found.all.translation_mean_m == pytest.approx(math.hypot(2.1, 2) / 2)
    assert found.all.rotation_std_deg == pytest.approx(45)
    assert (found.neighbours.relations, found.loops.relations) == (0, 2)
    with pytest.raises(CarmenError, match="no relation is of this log"):
        score(stamps, poses, relations)


def test_an_unknown_benchmark_is_named() -> None:
    with pytest.raises(NavigationBenchError, match="there is no benchmark 'flying'"):
        load("flying")
