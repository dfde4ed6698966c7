import json

import pytest
from PIL import Image
from rosbags.highlevel import AnyReader
from rosbags.typesys import get_types_from_msg
from typer.testing import CliRunner

from skytether.cli.app import app
from skytether.lab.world.contacts import Contact, Touched
from skytether.lab.world.guide import Guide
from skytether.lab.world.picture import draw_gif, draw_run, frame
from skytether.lab.world.plan import building
from skytether.lab.world.recording import McapWriter, WorldRecorder
from skytether.lab.world.simulation import Simulation
from skytether.messages import LaserScan, OccupancyGrid, decode


def test_a_recording_opens_with_ros_2_types(tmp_path) -> None:
    from mcap.reader import make_reader

    world = Simulation(building(), seed=1, robots=2)
    with McapWriter(tmp_path / "world.mcap") as writer:
        recorder = WorldRecorder(writer)
        for _ in range(25):
            recorder(world, world.tick())
    with (tmp_path / "world.mcap").open("rb") as stream:
        reader = make_reader(stream, validate_crcs=True)
        summary = reader.get_summary()
        assert summary is not None
        topics = {channel.topic for channel in summary.channels.values()}
        schemas = {schema.name: schema.encoding for schema in summary.schemas.values()}
        messages = [(channel.topic, message) for _, channel, message in reader.iter_messages()]
    # What a player needs to jump about in it, and to read it by what it holds itself.
    assert summary.statistics is not None
    assert summary.statistics.message_count == len(messages)
    assert summary.chunk_indexes
    assert all(chunk.message_index_offsets for chunk in summary.chunk_indexes)
    assert {channel.message_encoding for channel in summary.channels.values()} == {"cdr"}
    for schema in summary.schemas.values():
        assert schema.name in get_types_from_msg(schema.data.decode(), schema.name)
    assert {"/map", "/goals", "/scan", "/tf", "/odom", "/truth", "/people", "/robot_1/scan"} <= topics
    assert set(schemas.values()) == {"ros2msg"}
    assert "sensor_msgs/msg/LaserScan" in schemas
    scans = [message for topic, message in messages if topic == "/scan"]
    assert len(scans) == 3
    assert len(decode(LaserScan, scans[0].data, "cdr").ranges) == 541
    (grid,) = (message for topic, message in messages if topic == "/map")
    assert decode(OccupancyGrid, grid.data, "cdr").info.resolution == pytest.approx(0.05)


def test_the_guide_turns_drives_and_stands_before_an_obstacle() -> None:
    world = Simulation(building(), seed=1)
    robot = world.robots[0]
    guide = Guide(building().goals, world.params)
    assert guide.step(robot.pose, None).linear.x == 0.0  # nothing was seen yet
    world.tick()
    assert guide.step(robot.pose, robot.scan).linear.x == pytest.approx(0.5)
    assert guide.step(robot.pose._replace(heading=2.0), robot.scan).linear.x == 0.0
    # 0.3 m before the western wall, and the goal behind it.
    blocked = Guide([robot.pose._replace(x=-3.0)], world.params)
    world.place(0, robot.pose._replace(x=0.7, heading=3.14159))
    for _ in range(12):
        world.tick()
    assert blocked.step(robot.pose, robot.scan).linear.x == 0.0


@pytest.mark.slow
def test_pictures(tmp_path) -> None:
    world = Simulation(building(), seed=1)
    frames = [frame(world)]
    for _ in range(3):
        for _ in range(20):
            world.tick()
        frames.append(frame(world))
    contact = Contact(0, Touched.WALL, "wall-0", 1.0, 1.0, 5.0, 0.1, 10.0)
    draw_run(world.plan, frames, tmp_path / "run.png", contacts=[contact], title="run")
    draw_gif(world.plan, frames, tmp_path / "run.gif", params=world.params)
    with Image.open(tmp_path / "run.png") as picture:
        assert picture.size[0] > 1000
    with Image.open(tmp_path / "run.gif") as moving:
        moving.seek(2)  # there are three at least


@pytest.mark.slow
def test_all_nine_goals_from_the_command_line(tmp_path) -> None:
    result = CliRunner().invoke(app, ["lab", "world", "--output", str(tmp_path), "--json"])
    assert result.exit_code == 0, result.output
    facts = json.loads(result.stdout)
    assert (facts["goals_reached"], facts["contacts"]) == (9, [])
    assert 40 < facts["distance_m"] < 42
    assert 80 < facts["time_s"] < 120
    assert {path.name for path in tmp_path.iterdir()} == {
        "building.yaml",
        "building.pgm",
        "building-seed1.png",
        "building-seed1.gif",
        "building-seed1.mcap",
    }
    with AnyReader([tmp_path / "building-seed1.mcap"]) as reader:
        assert reader.topics["/scan"].msgcount == pytest.approx(facts["time_s"] / 0.12, abs=1)


@pytest.mark.slow
def test_a_field_and_wrong_plans_from_the_command_line(tmp_path) -> None:
    result = CliRunner().invoke(app, ["lab", "world", "--output", str(tmp_path), "--field", "3", "--json"])
    assert result.exit_code == 0, result.output
    assert json.loads(result.stdout)["shortest_m"] > 10
    bad = tmp_path / "hall.yaml"
    bad.write_text("walls: []\n")
    result = CliRunner().invoke(app, ["lab", "world", "--plan", str(bad)])
    assert result.exit_code == 2
    assert "goals is missing" in result.stderr
    result = CliRunner().invoke(app, ["lab", "world", "--output", str(tmp_path), "--people", "9"])
    assert result.exit_code == 2
    assert "0 to 4 more people" in result.stderr
