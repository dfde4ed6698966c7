"""A machine joins, and a robot is driven from there, on this machine's real engine; nothing is left of it."""

import pytest
from docker_site import Images

from skytether.lab.bench.join import bench_join


@pytest.mark.slow
@pytest.mark.docker
def test_from_an_engine_to_the_first_command_each_step_has_its_row(docker_images: Images):
    began = []
    with docker_images.apart("virtual-trail") as own:
        rows = bench_join(own.prefix, began.append)
        left = own.containers("virtual-trail")
    steps = [row.step.partition(":")[0] for row in rows]
    assert steps == ["invite", *["join"] * 6, "run", "robot", "all"]
    assert all(row.took_s >= 0 for row in rows)
    assert rows[-1].took_s == pytest.approx(sum(row.took_s for row in rows if row.step in began), abs=0.01)
    assert left == []
