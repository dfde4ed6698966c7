import struct
import zlib
from pathlib import Path

import numpy as np
from matplotlib.image import imread

from skytether.lab.measures import Sample
from skytether.lab.plot import plot_walk
from skytether.lab.trail import Trail
from skytether.robot.control.command import Source


def colours(file: Path) -> set[int]:
    """Every colour of a PNG, as 0xRRGGBB."""
    pixels = (np.asarray(imread(file))[..., :3] * 255).round().astype(int)
    return set(np.unique(pixels @ (1 << 16, 1 << 8, 1)).tolist())


def test_draws_each_source_in_its_colour(tmp_path: Path) -> None:
    trail = Trail([{"length": 3.0}])
    source = {0: Source.CLOUD, 1: Source.FALLBACK, 2: Source.STOP}
    samples = [Sample(i / 100, i / 100, 0.1, source[i // 100]) for i in range(300)]
    file = tmp_path / "walk.png"
    plot_walk(samples, trail, file, title="Walk", caption="completed")
    data = file.read_bytes()
    width, height = struct.unpack(">II", data[16:24])
    assert data.startswith(b"\x89PNG")
    assert (width, zlib.crc32(data[12:29])) == (1500, struct.unpack(">I", data[29:33])[0])
    assert height > 300
    found = colours(file)
    assert {0x0072B2, 0xD55E00, 0x111111} <= found

    plot_walk([s._replace(source=Source.CLOUD) for s in samples], trail, file, title="Walk")
    assert 0xD55E00 not in colours(file)


def test_draws_a_walk_of_one_sample(tmp_path: Path) -> None:
    file = tmp_path / "walk.png"
    plot_walk([Sample(0.0, 0.0, 0.0, Source.STOP)], Trail([{"length": 1.0}]), file, title="Nothing")
    assert file.stat().st_size > 1000
