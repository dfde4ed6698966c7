"""Occupancy maps: a grid of cells, read and written in the format of ROS's map_server, and drawn.

A map is a YAML file with the names below and an image, PGM (P2 or P5) or whatever else OpenCV reads. What is computed
on maps belongs elsewhere.
"""

from __future__ import annotations

import contextlib
import math
import os
import tempfile
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Literal, NoReturn, cast

import cv2
import numpy as np
import yaml
from numpy.typing import NDArray

Mode = Literal["trinary", "scale", "raw"]
MODES: tuple[Mode, ...] = ("trinary", "scale", "raw")

UNKNOWN = -1
"""Value of a cell that nobody has seen."""
FREE = 0
OCCUPIED = 100

MAX_CELLS = 100_000_000
"""Of one map: 500 m by 500 m at 5 cm. A file that asks for more is broken, or would fill the memory."""
MAX_YAML_BYTES = 65_536
MAX_IMAGE_BYTES = 5 * MAX_CELLS
"""A plain PGM (P2) has up to four bytes for each cell."""

_FREE_SHADE, _UNKNOWN_SHADE, _OCCUPIED_SHADE = 254, 205, 0
_FREE_THRESHOLD, _OCCUPIED_THRESHOLD = 0.196, 0.65
"""As map_saver of ROS 1 writes them. Nav2's 0.25 would make free what is unknown: the shade 205 is 0.1961."""


class MapError(ValueError):
    """A map cannot be read or written; the text names the file, what is wrong, and what to do."""


@dataclass(frozen=True)
class GridMap:
    """An occupancy grid, as ``nav_msgs/OccupancyGrid`` has it.

    Attributes:
        cells: int8, rows by columns; row 0 is the one with the smallest y of the map's own frame. -1 is unknown,
            0 free, 100 occupied, in between the probability in percent.
        resolution: Side of a cell [m].
        origin: Pose of the corner of cell (0, 0) in the map frame: x [m], y [m], yaw [rad].
    """

    cells: NDArray[np.int8]
    resolution: float
    origin: tuple[float, float, float] = (0.0, 0.0, 0.0)

    def __post_init__(self) -> None:
        if self.cells.ndim != 2 or self.cells.dtype != np.int8 or self.cells.size == 0:
            raise ValueError("cells must be an int8 array of rows by columns with at least one cell")
        if not (math.isfinite(self.resolution) and self.resolution > 0):
            raise ValueError(f"resolution must be a positive number of metres, not {self.resolution}")
        if len(self.origin) != 3 or not all(math.isfinite(value) for value in self.origin):
            raise ValueError("origin must be three finite numbers: x, y, yaw")

    @property
    def rows(self) -> int:
        """Number of cells along the map's own y axis."""
        return int(self.cells.shape[0])

    @property
    def columns(self) -> int:
        """Number of cells along the map's own x axis."""
        return int(self.cells.shape[1])

    def to_cells(self, points: NDArray[np.float64]) -> NDArray[np.float64]:
        """Points of the map frame [m], n by 2, as (column, row); cell (c, r) is what lies in [c, c+1) by [r, r+1)."""
        x, y, yaw = self.origin
        cos, sin = math.cos(yaw), math.sin(yaw)
        moved = np.asarray(points, dtype=np.float64) - np.array([x, y])
        return cast(NDArray[np.float64], moved @ np.array([[cos, -sin], [sin, cos]]) / self.resolution)

    def to_points(self, cells: NDArray[np.float64]) -> NDArray[np.float64]:
        """The inverse of ``to_cells``: (column, row), n by 2, as points of the map frame [m]."""
        x, y, yaw = self.origin
        cos, sin = math.cos(yaw), math.sin(yaw)
        turned = np.asarray(cells, dtype=np.float64) * self.resolution @ np.array([[cos, sin], [-sin, cos]])
        return cast(NDArray[np.float64], turned + np.array([x, y]))

    def at(self, x: float, y: float) -> int:
        """The value of the cell at a point of the map frame [m]; what is off the map is unknown."""
        column, row = np.floor(self.to_cells(np.array([[x, y]]))[0]).astype(int)
        if 0 <= row < self.rows and 0 <= column < self.columns:
            return int(self.cells[row, column])
        return UNKNOWN


def load_map(path: Path | str) -> GridMap:
    """Read a map that map_server, map_saver or ``save_map`` wrote.

    Shades become occupancy as in Nav2's map_server; in mode ``raw``, ``negate`` makes no difference there either.

    Args:
        path: Its YAML file. The image is looked for relative to it.

    Raises:
        MapError: A file is missing or broken.
    """
    path = Path(path)
    fields = _read_yaml(path)
    resolution = _number(path, fields, "resolution")
    if resolution <= 0:
        _refuse(path, f"resolution is {resolution:g}", "write the side of a cell in metres, such as 0.05")
    origin = fields.get("origin")
    if not isinstance(origin, list) or len(origin) != 3 or not all(_is_finite(value) for value in origin):
        _refuse(path, f"origin is {origin!r}", "write three numbers, as in 'origin: [-10.0, -5.0, 0.0]'")
    mode = fields.get("mode", "trinary")
    if mode not in MODES:
        _refuse(path, f"mode is {mode!r}", f"write one of {', '.join(MODES)}, or leave it out for trinary")
    negate = fields.get("negate", 0)
    if negate not in (0, 1, False, True):
        _refuse(path, f"negate is {negate!r}", "write 0 (dark is occupied) or 1 (bright is occupied)")
    free = _number(path, fields, "free_thresh", 0.25 if mode != "raw" else 0.0)
    occupied = _number(path, fields, "occupied_thresh", 0.65 if mode != "raw" else 1.0)
    if not 0 <= free < occupied <= 1:
        wrong = f"free_thresh {free:g} and occupied_thresh {occupied:g} are not in order"
        _refuse(path, wrong, "write 0 <= free_thresh < occupied_thresh <= 1, such as 0.196 and 0.65")
    name = fields.get("image")
    if not isinstance(name, str) or not name:
        _refuse(path, f"image is {name!r}", "write the name of the image file beside the YAML file")
    shades, known = _read_image(path.parent / name, path)
    cells = cells_of(shades, mode, negate=bool(negate), free=free, occupied=occupied)
    if known is not None and mode != "raw":
        cells[~known] = UNKNOWN
    # The image's first line is the top of the map, the grid's first row its bottom.
    return GridMap(
        np.ascontiguousarray(cells[::-1]), resolution, (float(origin[0]), float(origin[1]), float(origin[2]))
    )


def cells_of(
    shades: NDArray[np.float64], mode: Mode, *, negate: bool, free: float, occupied: float
) -> NDArray[np.int8]:
    """Occupancy of shades, as map_server makes it.

    Args:
        shades: 0 is black, 1 is white.
        mode: ``trinary``: free, unknown, occupied by the thresholds; ``scale``: in percent between them; ``raw``: the
            shade times 255 is the value, and above 100 it is unknown.
        negate: Bright is occupied.
        free: Below it a cell is free.
        occupied: Above it a cell is occupied.
    """
    if mode == "raw":
        values = np.rint(shades * 255)
        return np.where(values <= OCCUPIED, values, UNKNOWN).astype(np.int8)
    occupancy = shades if negate else 1.0 - shades
    between: float | NDArray[np.float64] = UNKNOWN
    if mode == "scale":
        between = np.rint((occupancy - free) / (occupied - free) * 100)
    result = np.where(occupancy > occupied, OCCUPIED, np.where(occupancy < free, FREE, between))
    return cast(NDArray[np.int8], result.astype(np.int8))


def save_map(path: Path | str, grid: GridMap, *, mode: Mode = "trinary") -> Path:
    """Write a map as YAML, and as PGM (P5) with the same stem beside it.

    Args:
        path: The YAML file.
        grid: The map.
        mode: ``trinary`` keeps free, unknown and occupied (by the thresholds 20 and 65 percent); ``scale`` keeps
            percentages, but has nothing for unknown; ``raw`` keeps all.

    Returns:
        The path of the image.

    Raises:
        MapError: A file cannot be written, or the mode cannot hold the map.
    """
    path = Path(path)
    image = path.with_suffix(".pgm")
    cells = grid.cells[::-1].astype(np.int16)
    free, occupied = _FREE_THRESHOLD, _OCCUPIED_THRESHOLD
    if mode == "raw":
        shades = np.where(cells < 0, 255, cells)
    elif mode == "scale":
        if (cells < 0).any():
            _refuse(path, "mode scale has no value for the map's unknown cells", "save it as raw or trinary")
        free, occupied = 0.0, 1.0
        shades = 255 - np.rint(cells * 2.55)
    else:
        shades = np.full(cells.shape, _UNKNOWN_SHADE)
        shades[(cells >= 0) & (cells < 100 * free)] = _FREE_SHADE
        shades[cells > 100 * occupied] = _OCCUPIED_SHADE
    header = f"P5\n# Skytether: {grid.resolution:g} m a cell\n{grid.columns} {grid.rows}\n255\n".encode()
    fields = {
        "image": image.name,
        "mode": mode,
        "resolution": float(grid.resolution),
        "origin": [float(value) for value in grid.origin],
        "negate": 0,
        "occupied_thresh": occupied,
        "free_thresh": free,
    }
    # The image first: whoever finds the YAML file finds its image.
    _write(image, header + shades.astype(np.uint8).tobytes())
    _write(path, yaml.safe_dump(fields, sort_keys=False, default_flow_style=None).encode())
    return image


Colour = tuple[int, int, int]
"""Blue, green, red."""


def draw_map(
    grid: GridMap,
    *,
    paths: Sequence[tuple[NDArray[np.float64], Colour]] = (),
    points: Sequence[tuple[NDArray[np.float64], Colour]] = (),
    scale: int = 2,
) -> NDArray[np.uint8]:
    """A picture of a map: free is white, occupied black, unknown grey.

    Args:
        grid: The map. Its own axes are those of the picture, whatever the origin's yaw.
        paths: Lines through points of the map frame [m], n by 2, each with a colour.
        points: Dots at points of the map frame, as particles are.
        scale: Pixels along the side of a cell.

    Returns:
        uint8, height by width by 3 (blue, green, red), top row first.
    """
    cells = grid.cells.astype(np.int16)
    grey = np.where(cells < 0, _UNKNOWN_SHADE, 255 - np.rint(cells * 2.55)).astype(np.uint8)
    grey = np.repeat(np.repeat(grey[::-1], scale, axis=0), scale, axis=1)
    picture = cv2.cvtColor(grey, cv2.COLOR_GRAY2BGR)

    def pixels(where: NDArray[np.float64]) -> NDArray[np.int32]:
        at = grid.to_cells(np.asarray(where, dtype=np.float64)[:, :2]) * scale
        at[:, 1] = grey.shape[0] - 1 - at[:, 1]
        # Far outside the picture is as good as just outside, and fits the integers that OpenCV draws with.
        return cast(NDArray[np.int32], np.clip(np.nan_to_num(at), -30_000, 30_000).astype(np.int32))

    for line, colour in paths:
        if len(line):
            cv2.polylines(picture, [pixels(line)], False, colour, max(1, scale // 2), cv2.LINE_AA)
    for dots, colour in points:
        for x, y in pixels(dots) if len(dots) else ():
            cv2.circle(picture, (int(x), int(y)), max(1, scale // 2), colour, -1)
    return cast(NDArray[np.uint8], picture)


def save_png(path: Path | str, picture: NDArray[np.uint8]) -> None:
    """Write a picture of ``draw_map`` as PNG.

    Raises:
        MapError: The file cannot be written.
    """
    encoded, data = cv2.imencode(".png", picture)
    if not encoded:
        _refuse(Path(path), "the picture cannot be encoded", "draw it with fewer pixels for each cell")
    _write(Path(path), data.tobytes())


def _refuse(path: Path, wrong: str, remedy: str) -> NoReturn:
    raise MapError(f"{path}: {wrong}; {remedy}")


def _is_finite(value: object) -> bool:
    return isinstance(value, int | float) and not isinstance(value, bool) and math.isfinite(value)


def _number(path: Path, fields: dict[str, object], name: str, default: float | None = None) -> float:
    value = fields.get(name, default)
    if value is None or not _is_finite(value):
        _refuse(path, f"{name} is {value!r}" if name in fields else f"{name} is missing", "write a number")
    return float(cast(float, value))


def _read(path: Path, limit: int, remedy: str) -> bytes:
    try:
        with path.open("rb") as file:
            data = file.read(limit + 1)
    except OSError as error:
        _refuse(path, f"it cannot be read ({error.strerror})", remedy)
    if len(data) > limit:
        _refuse(path, f"it has more than {limit:,} bytes", remedy)
    return data


def _write(path: Path, data: bytes) -> None:
    """All or nothing: who reads meanwhile sees the old file or the new one."""
    temporary = ""
    try:
        handle, temporary = tempfile.mkstemp(dir=path.parent, prefix=f".{path.name}.")
        with os.fdopen(handle, "wb") as file:
            file.write(data)
        Path(temporary).chmod(0o644)
        Path(temporary).replace(path)
    except OSError as error:
        with contextlib.suppress(OSError):
            Path(temporary).unlink()
        _refuse(path, f"it cannot be written ({error.strerror})", "choose a folder that exists and has room")


def _read_yaml(path: Path) -> dict[str, object]:
    data = _read(path, MAX_YAML_BYTES, "name the YAML file that map_saver wrote")
    try:
        fields = yaml.safe_load(data.decode())
    except (yaml.YAMLError, UnicodeDecodeError, RecursionError, ValueError) as error:
        what = " ".join(str(error).split())[:200]
        _refuse(path, f"it is not YAML ({what})", "name the map's YAML file, not its image")
    if not isinstance(fields, dict):
        _refuse(path, "it does not have 'name: value' lines", "name the YAML file that map_saver wrote")
    return cast(dict[str, object], fields)


def _read_image(path: Path, named_by: Path) -> tuple[NDArray[np.float64], NDArray[np.bool_] | None]:
    """Shades from 0 to 1, and which pixels are known (an image without transparency: None)."""
    data = _read(path, MAX_IMAGE_BYTES, f"put the image that {named_by} names there, or correct its name")
    if data[:2] in (b"P2", b"P5"):
        return _read_pgm(path, data), None
    try:
        pixels = cv2.imdecode(np.frombuffer(data, dtype=np.uint8), cv2.IMREAD_UNCHANGED)
    except cv2.error:
        pixels = None
    if pixels is None:
        _refuse(path, "it is no image that OpenCV can read", "convert it to PGM, as with 'convert map.x map.pgm'")
    shades = pixels.astype(np.float64) / (65_535 if pixels.dtype == np.uint16 else 255)
    if shades.ndim == 2:
        return shades, None
    known = shades[:, :, 3] >= 1.0 if shades.shape[2] == 4 else None
    return shades[:, :, :3].mean(axis=2), known


def _read_pgm(path: Path, data: bytes) -> NDArray[np.float64]:
    remedy = "save the map anew, or convert the image to a PGM of 8 bits"
    numbers, start = _pgm_header(data)
    if len(numbers) < 3:
        _refuse(path, "its header is not that of a PGM (width, height, largest value)", remedy)
    width, height, largest = numbers
    if not 0 < largest <= 65_535:
        _refuse(path, f"its largest value is {largest}, not 1 to 65535", remedy)
    if width <= 0 or height <= 0 or width * height > MAX_CELLS:
        _refuse(path, f"it has {width} x {height} cells, where 1 to {MAX_CELLS:,} can be read", remedy)
    if data[:2] == b"P5":
        kind = np.dtype(np.uint8 if largest < 256 else ">u2")
        have = (len(data) - start) // kind.itemsize
        if have < width * height:
            _refuse(path, f"it ends after {have:,} of {width * height:,} cells", remedy)
        values = np.frombuffer(data, dtype=kind, count=width * height, offset=start).astype(np.float64)
    else:
        words = data[start:].split(maxsplit=width * height)[: width * height]
        if len(words) < width * height:
            _refuse(path, f"it ends after {len(words):,} of {width * height:,} cells", remedy)
        try:
            values = np.array([int(word) for word in words], dtype=np.float64)
        except ValueError:
            _refuse(path, "it has words among its cells' numbers", remedy)
    if values.max() > largest or values.min() < 0:
        _refuse(path, f"a cell has a value that is not in 0 to {largest}", remedy)
    return (values / largest).reshape(height, width)


def _pgm_header(data: bytes) -> tuple[list[int], int]:
    """Up to three numbers after the magic one, and where the cells begin; comments run from # to the line's end."""
    numbers: list[int] = []
    at = 2
    while len(numbers) < 3 and at < len(data):
        if data[at : at + 1].isspace():
            at += 1
        elif data[at : at + 1] == b"#":
            end = data.find(b"\n", at)
            at = len(data) if end < 0 else end + 1
        else:
            begin = at
            while at < len(data) and at - begin < 10 and data[at : at + 1].isdigit():
                at += 1
            if at == begin:
                break
            numbers.append(int(data[begin:at]))
    return numbers, at + 1
