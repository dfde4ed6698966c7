import numpy as np
import pytest
import yaml

from skytether.lab.world.occupancy import FREE, OCCUPIED, UNKNOWN, Occupancy
from skytether.lab.world.plan import building


def _at(occupancy: Occupancy, x: float, y: float) -> int:
    column = int((x - occupancy.origin[0]) / occupancy.resolution)
    return int(occupancy.grey[int((y - occupancy.origin[1]) / occupancy.resolution), column])


def test_walls_are_occupied_floors_free_the_outside_unknown_and_what_is_not_mapped_is_not_there() -> None:
    occupancy = Occupancy(building())
    assert _at(occupancy, 0.01, 5.0) == OCCUPIED  # the western wall
    assert _at(occupancy, 0.4, 4.2) == OCCUPIED  # the plant
    assert _at(occupancy, 5.0, 1.0) == FREE  # the first goal
    assert _at(occupancy, 1.9, 3.0) == FREE  # the parcel, which no map shows
    assert _at(occupancy, -0.3, 5.0) == UNKNOWN


def test_the_files_are_what_map_server_reads(tmp_path) -> None:
    occupancy = Occupancy(building(), 0.1)
    text, picture = occupancy.save(tmp_path / "building")
    document = yaml.safe_load(text.read_text())
    assert document["image"] == "building.pgm"
    assert (document["resolution"], document["negate"], document["origin"][2]) == (0.1, 0, 0.0)
    magic, size, depth, pixels = picture.read_bytes().split(b"\n", 3)
    columns, rows = map(int, size.split())
    assert (magic, depth) == (b"P5", b"255")
    assert (np.frombuffer(pixels, np.uint8).reshape(rows, columns)[::-1] == occupancy.grey).all()


def test_as_a_message() -> None:
    message = Occupancy(building(), 0.1).message()
    assert len(message.data) == message.info.width * message.info.height
    assert set(np.unique(message.data)) == {-1, 0, 100}
    with pytest.raises(ValueError, match="greater than 0"):
        Occupancy(building(), 0.0)
