from __future__ import annotations

import math
from pathlib import Path

import numpy as np
import pytest

from skytether_services.navigation.grid_map import (
    GridMap,
    MapError,
    Mode,
    draw_map,
    load_map,
    save_map,
    save_png,
)

YAML = (
    "image: map.pgm\nresolution: 0.5\norigin: [1.0, 2.0, 0.0]\nnegate: 0\noccupied_thresh: 0.65\nfree_thresh: 0.196\n"
)
PGM = b"P5\n# a comment\n3 2\n255\n" + bytes([254, 205, 0, 0, 254, 205])


def written(folder: Path, text: str = YAML, image: bytes = PGM) -> Path:
    (folder / "map.yaml").write_text(text)
    (folder / "map.pgm").write_bytes(image)
    return folder / "map.yaml"


def test_the_images_top_is_the_maps_far_side(tmp_path: Path) -> None:
    grid = load_map(written(tmp_path))
    # Bottom line of the image: 0 (occupied), 254 (free), 205 (unknown).
    assert grid.cells.tolist() == [[100, 0, -1], [0, -1, 100]]
    assert (grid.resolution, grid.origin) == (0.5, (1.0, 2.0, 0.0))
    assert grid.at(1.1, 2.1) == 100
    assert grid.at(2.4, 2.9) == 100
    assert grid.at(0.9, 2.1) == -1


def test_plain_pgm_of_another_depth_reads_the_same(tmp_path: Path) -> None:
    plain = b"P2 # c\n3 # width\n2\n1000\n996 800 0\n0 996 800\n"
    assert load_map(written(tmp_path, image=plain)).cells.tolist() == [[100, 0, -1], [0, -1, 100]]
    deep = b"P5 3 2 65535\n" + np.array([65000, 52000, 0, 0, 65000, 52000], dtype=">u2").tobytes()
    assert load_map(written(tmp_path, image=deep)).cells.tolist() == [[100, 0, -1], [0, -1, 100]]


@pytest.mark.parametrize(
    ("more", "shades", "cells"),
    [
        ("negate: 1", [255, 0, 100], [100, 0, -1]),
        # 1 - 128/255 = 0.498 of the way from 0.196 to 0.65: 66.5 percent.
        ("mode: scale", [255, 0, 128], [0, 100, 67]),
        ("mode: raw", [0, 100, 101], [0, 100, -1]),
    ],
)
def test_modes(tmp_path: Path, more: str, shades: list[int], cells: list[int]) -> None:
    text = YAML.replace("negate: 0\n", "") + more + "\n"
    path = written(tmp_path, text, b"P5 3 1 255\n" + bytes(shades))
    assert load_map(path).cells.tolist() == [cells]


def test_an_origin_with_yaw_turns_the_map() -> None:
    grid = GridMap(np.zeros((4, 4), np.int8), 0.5, (1.0, 2.0, math.pi / 2))
    # One metre along the map's own x axis is one metre along y of the map frame.
    points = np.array([[1.0, 3.0], [0.5, 2.0]])
    np.testing.assert_allclose(grid.to_cells(points), [[2.0, 0.0], [0.0, 1.0]], atol=1e-12)
    np.testing.assert_allclose(grid.to_points(grid.to_cells(points)), points, atol=1e-12)


@pytest.mark.parametrize("mode", ["trinary", "raw", "scale"])
def test_saved_and_loaded(tmp_path: Path, mode: Mode) -> None:
    cells = np.array([[0, 100, 0], [100, -1, 0]], np.int8)
    if mode == "raw":
        cells[0, 2] = 37
    if mode == "scale":
        cells[1] = (25, 50, 75)
    grid = GridMap(cells, 0.05, (-3.25, 4.5, 0.1))
    save_map(tmp_path / "m.yaml", grid, mode=mode)
    again = load_map(tmp_path / "m.yaml")
    assert again.cells.tolist() == cells.tolist()
    assert (again.resolution, again.origin) == (0.05, (-3.25, 4.5, 0.1))
    assert sorted(file.name for file in tmp_path.iterdir()) == ["m.pgm", "m.yaml"]


@pytest.mark.parametrize(
    ("text", "image", "says"),
    [
        ("a: [", PGM, "not YAML"),
        ("- 1", PGM, "name: value"),
        (YAML.replace("0.5", "-1"), PGM, "resolution is -1"),
        (YAML.replace("resolution: 0.5\n", ""), PGM, "resolution is missing"),
        (YAML.replace("[1.0, 2.0, 0.0]", "[1.0, .nan, 0]"), PGM, "origin is"),
        (YAML.replace("0.196", "0.7"), PGM, "not in order"),
        (YAML.replace("negate: 0", "negate: no way"), PGM, "negate is"),
        (YAML + "mode: grey\n", PGM, "trinary, scale, raw"),
        (YAML.replace("map.pgm", "other.pgm"), PGM, "other.pgm: it cannot be read"),
        (YAML, b"P5 3 2 255\n" + bytes(5), "ends after 5 of 6"),
        (YAML, b"P2 3 2 255\n1 2 3 4 5", "ends after 5 of 6"),
        (YAML, b"P2 3 2 255\n1 2 3 4 5 x", "words"),
        (YAML, b"P2 3 2 255\n1 2 3 4 5 256", "0 to 255"),
        (YAML, b"P5 99999999 99999 255\n", "99999999 x 99999"),
        (YAML, b"P5 x", "header"),
        (YAML, b"P5 3 2 0\n", "largest value is 0"),
        (YAML, b"GIF89a", "OpenCV"),
        (YAML, b"", "OpenCV"),
    ],
)
def test_broken_files_are_named_with_what_is_wrong(tmp_path: Path, text: str, image: bytes, says: str) -> None:
    with pytest.raises(MapError, match=says) as told:
        load_map(written(tmp_path, text, image))
    assert str(tmp_path) in str(told.value)
    assert ";" in str(told.value)


def test_what_cannot_be_written(tmp_path: Path) -> None:
    grid = GridMap(np.full((1, 1), -1, np.int8), 0.05)
    with pytest.raises(MapError, match="raw or trinary"):
        save_map(tmp_path / "m.yaml", grid, mode="scale")
    with pytest.raises(MapError, match="cannot be written"):
        save_map(tmp_path / "none" / "m.yaml", grid)
    with pytest.raises(MapError, match=r"none\.yaml: it cannot be read"):
        load_map(tmp_path / "none.yaml")


def test_a_picture_has_north_up_and_reads_as_a_map(tmp_path: Path) -> None:
    cells = np.array([[100, 0, -1], [0, -1, 100]], np.int8)
    grid = GridMap(cells, 0.5, (1.0, 2.0, 0.0))
    picture = draw_map(grid, scale=1)
    assert picture[:, :, 0].tolist() == [[255, 205, 0], [0, 255, 205]]
    red = draw_map(grid, scale=4, points=[(np.array([[2.25, 2.75]]), (0, 0, 255))])
    assert red[2, 9].tolist() == [0, 0, 255]
    save_png(tmp_path / "map.png", picture)
    path = written(tmp_path, YAML.replace("map.pgm", "map.png"))
    assert load_map(path).cells.tolist() == cells.tolist()
