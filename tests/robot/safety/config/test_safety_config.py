import math
from pathlib import Path

import pytest
import yaml

from skytether.api.config_file import ConfigError
from skytether.messages import Joy, LaserScan, PointCloud2, Range
from skytether.robot.config.gate_config import load_safety
from skytether.robot.safety.config.address import address
from skytether.robot.safety.config.safety_config import SafetyConfig, default_folder, default_record
from skytether.robot.safety.sensing.clouds import CloudMount
from skytether.robot.safety.sensing.coverage import Action

LEAST = {"footprint": {"radius": 0.3}, "sensors": {"scan": {}}}

CLOUDS = {"kind": "points", "x": 0.25, "z": 0.4, "max_z_m": 1.0, "range_max": 4.0}


@pytest.fixture
def load(tmp_path):
    def load(safety, **more) -> SafetyConfig:
        path = tmp_path / "robot.yaml"
        path.write_text(yaml.safe_dump({"safety": safety, **more}))
        return load_safety(path)

    return load


def test_little_need_be_written(load):
    config = load(LEAST)
    rules = config.rules()
    assert rules.limits.period_s == 0.02
    assert rules.limits.linear_max == 0.25
    assert rules.sensors["scan"].on_unknown is Action.STOP
    assert rules.sources.joystick is None
    assert rules.sources.button is None


def test_everything_can_be_written_and_goes_to_the_gate_unchanged(load):
    config = load(
        {
            "footprint": {"polygon": [[0.3, 0.2], [-0.3, 0.2], [-0.3, -0.2], [0.3, -0.2]]},
            "limits": {"linear_max": 0.5, "linear_min": -0.1},
            "zones": {"stop_m": 0.15, "slow_m": 0.8},
            "sensors": {
                "scan": {"x": 0.2, "yaw_deg": 90, "ignore_deg": [[-135, -90]], "on_unknown": "slow"},
                "sonar/left": {"kind": "sonar", "max_age_s": 1},
            },
            "joystick": {"deadman": 5},
            "estop": {"topic": "button", "pressed_is": False, "max_age_s": None},
            "rate_hz": 100,
            "guard_s": 0.05,
            "folder": "/run/walker",
            "sockets": {"sensors": "udp:127.0.0.1:5000", "wheels": "unix:/run/wheels"},
        }
    )
    assert SafetyConfig.model_validate_json(config.model_dump_json()) == config
    rules = config.rules()
    mount = rules.sensors["scan"].mount
    assert mount.yaw == pytest.approx(math.pi / 2)
    assert mount.ignore[0] == pytest.approx((-0.75 * math.pi, -math.pi / 2))
    assert rules.sources.joystick.deadman == 5
    assert (rules.sources.button.pressed_is, rules.sources.button.max_age_s) == (False, math.inf)
    assert config.kinds()["scan"] is LaserScan
    assert config.kinds()["sonar/left"] is Range
    assert config.kinds()["joy"] is Joy
    assert config.place() == Path("/run/walker")


def test_a_depth_camera_as_it_is_mounted_goes_to_the_gate_unchanged(load):
    angles = {"yaw_deg": 90, "pitch_deg": 20, "roll_deg": 180, "slope_deg": 5}
    depth = (
        CLOUDS | angles | {"optical": True, "min_z_m": 0.08, "min_points": 500, "fov_deg": [-40, 40], "frame_id": "d"}
    )
    config = load({"footprint": {"radius": 0.3}, "sensors": {"depth": depth}})
    assert SafetyConfig.model_validate_json(config.model_dump_json()) == config
    assert config.kinds() == {"depth": PointCloud2}
    sensor = config.rules().sensors["depth"]
    assert sensor.frame == "d"
    assert sensor.mount == CloudMount(
        x=0.25,
        z=0.4,
        yaw=math.pi / 2,
        pitch=math.radians(20),
        roll=math.pi,
        slope=math.tan(math.radians(5)),
        optical=True,
        min_z=0.08,
        max_z=1.0,
        range_max=4.0,
        min_points=500,
        fov=(math.radians(-40), math.radians(40)),
    )


def test_the_robots_own_limits_hold_unless_the_section_has_some(load):
    assert load(LEAST, limits={"linear_max": 0.4}).rules().limits.linear_max == 0.4
    assert load(LEAST | {"limits": {"linear_max": 0.2}}, limits={"linear_max": 0.4}).rules().limits.linear_max == 0.2


def test_the_robots_graph_is_the_gates_too_unless_it_says_otherwise(load):
    graph = {"master": "http://robot:11311", "namespace": None, "remap": {"force": "/wrench"}, "cmd_vel": "/wheels"}
    way = load(LEAST, robot="my-walker", ros1=graph).ros1
    assert (way.master, way.namespace, way.cmd_vel, way.node) == (
        "http://robot:11311",
        "/my_walker",
        "/wheels",
        "skytether",
    )
    own = load(LEAST | {"ros1": {"namespace": "/", "node": "gate"}}, robot="my-walker", ros1=graph).ros1
    assert (own.master, own.namespace, own.node) == ("http://robot:11311", "/", "gate")
    assert load(LEAST | {"sockets": {}}, ros1=graph).ros1 is None
    assert load(LEAST).ros1 is None


def test_the_same_holds_for_ros_2(load, tmp_path):
    graph = {"dialect": "rmw_zenoh", "router": "tcp/robot:7447", "domain": 7, "zenoh_config": "zenoh.json5"}
    graph |= {"readings": {}, "node": "walker"}
    way = load(LEAST, robot="my-walker", ros2=graph).ros2
    assert (way.router, way.domain, way.namespace, way.node) == ("tcp/robot:7447", 7, "/my_walker", "walker")
    assert way.zenoh_config == tmp_path / "zenoh.json5"


def test_mistakes_in_other_sections_do_not_stop_the_gate(load):
    assert load(LEAST, srevice="virtual-trail")


@pytest.mark.parametrize(
    ("change", "says"),
    [
        ({"zoens": {}}, "safety.zoens: unknown key, did you mean 'zones'?"),
        ({"zones": {"stop": 0.1}}, "safety.zones.stop: unknown key, did you mean 'stop_m'?"),
        ({"zones": {"stop_m": -0.1}}, "safety.zones: zones: stop_m must be above 0 and finite, not -0.1"),
        ({"zones": {"stop_m": math.nan}}, "safety.zones.stop_m: input should be a finite number"),
        ({"limits": {"linear_mx": 1}}, "safety.limits.linear_mx: unknown key, did you mean 'linear_max'?"),
        ({"limits": {"linear_max": math.inf}}, "safety.limits.linear_max: input should be a finite number"),
        ({"limits": {"linear_braking": 0.1}}, "braking must not be slower than ordinary acceleration"),
        ({"limits": {"max_gap_s": 0.03}}, "limits.max_gap_s must be two periods of rate_hz or more: 0.04"),
        ({"footprint": {}}, "safety.footprint: give either polygon or radius"),
        ({"footprint": {"radius": 0}}, "safety.footprint.radius: input should be greater than 0"),
        ({"footprint": {"polygon": [[0, 0], [1, 0], [2, 0]]}}, "three corners that are not on one line"),
        (
            {"sensors": {"scan": {"kind": "lidar"}}},
            "safety.sensors.scan.kind: input should be 'laser', 'sonar' or 'points'",
        ),
        ({"sensors": {"scan": {"yaw": 90}}}, "safety.sensors.scan.yaw: unknown key, did you mean 'yaw_deg'?"),
        ({"sensors": {"scan": {"on_unknown": "free"}}}, "on_unknown: input should be 'stop' or 'slow'"),
        ({"sensors": {"scan": {"z": 0.4}}}, "sensors.scan: z means nothing without kind: points"),
        ({"sensors": {"scan": {"max_z_m": 1}}}, "sensors.scan: max_z_m means nothing without kind: points"),
        ({"sensors": {"depth": {**CLOUDS, "z": 0}}}, "z is needed with kind: points (height of the sensor"),
        ({"sensors": {"depth": {**CLOUDS, "max_z_m": 0}}}, "max_z_m is needed with kind: points (height of the robot)"),
        ({"sensors": {"depth": {**CLOUDS, "range_max": 0}}}, "range_max is needed with kind: points (a cloud does not"),
        ({"sensors": {"depth": {**CLOUDS, "min_z_m": 1.2}}}, "min_z_m 1.2 must be below max_z_m 1.0"),
        ({"sensors": {"depth": {**CLOUDS, "upside_down": True}}}, "upside_down means nothing with kind: points"),
        (
            {"sensors": {"depth": {**CLOUDS, "no_echo_is_free": True}}},
            "no_echo_is_free means nothing with kind: points",
        ),
        ({"sensors": {"depth": {**CLOUDS, "z": 4}}}, "sensors.depth.z must be 0.02 to 3 m, not 4"),
        ({"sensors": {"depth": {**CLOUDS, "max_z_m": 1800}}}, "sensors.depth.max_z_m must be 0.1 to 3 m, not 1800"),
        ({"sensors": {"depth": {**CLOUDS, "slope_deg": 20}}}, "sensors.depth.slope_deg must be 0 to 10 degrees"),
        ({"joystick": {"topic": "scan"}}, "safety: the topic 'scan' cannot be two things"),
        ({"sockets": {}, "ros1": {}}, "safety: there are sockets and ros1"),
        ({"ros1": {"cmd_vel": "1x"}}, "safety.ros1.cmd_vel: '1x' is not a valid name of a graph"),
        ({"ros1": {}, "sensors": {"my scan": {}}}, "'my scan' is not a valid name of a graph"),
        ({"guard_s": 0.03}, "guard_s must be two periods of rate_hz or more: 0.04"),
        ({"limits": {"linear_max": True}}, "safety.limits: linear_max: is neither yes nor no"),
        ({"zones": {"stop_m": True}}, "safety.zones: stop_m: is neither yes nor no"),
        ({"estop": {"max_age_s": True}}, "safety.estop.max_age_s: is neither yes nor no"),
        ({"sensors": {"scan": {"fov_deg": [-90, 90], "ignore_deg": [[-90, 0], [0, 90]]}}}, "it would see nothing"),
        ({"sockets": {"wheels": "wheels.sock"}}, "must be unix:PATH or udp:HOST:PORT, not 'wheels.sock'"),
    ],
)
def test_a_mistake_names_its_key(load, change, says):
    with pytest.raises(ConfigError) as error:
        load(LEAST | change)
    assert says in str(error.value)


def test_a_section_that_is_missing_or_misspelt_is_named(tmp_path):
    path = tmp_path / "robot.yaml"
    path.write_text("limits: {}")
    with pytest.raises(ConfigError, match="safety: is missing"):
        load_safety(path)
    for slip in ("saftey", "Safety", "safty"):  # with a graph no section is a gate without sensors
        path.write_text(f"ros2: {{}}\n{slip}: {{footprint: {{radius: 0.3}}, sensors: {{scan: {{}}}}}}")
        with pytest.raises(ConfigError, match=f"the key '{slip}' is unknown, did you mean 'safety'?"):
            load_safety(path)
    path.write_text("ros2: {}\nrobot: walker\nservice: wall-stop")
    assert load_safety(path).sensors == {}


@pytest.mark.parametrize(
    ("change", "says"),
    [
        ({"sources": {"nav": {"topic": "joy", "priority": 20}}, "joystick": {}}, "'joy' cannot be two things"),
        ({"sources": {"nav": {"topic": "nav_vel", "priority": 10}}}, "agent and nav have the same priority 10"),
        ({"sources": {"agent": {"topic": "nav_vel", "priority": 20}}}, "that name is taken"),
        ({"sources": {"nav": {"topic": "nav_vel"}}}, "priority"),
        ({"sources": {"nav": {"topic": "a", "priority": 20, "type": "std_msgs/msg/Bool"}}}, "type"),
        ({"sources": {"nav": {"topic": "a", "priority": 20, "timeout_s": 3600}}}, "timeout_s"),
        ({"locks": {"pause": {"topic": "p", "priority": 256}}}, "priority"),
        ({"joystick": {"linear_axis": 1, "angular_axis": 1}}, "must be two axes"),
        ({"joystick": {"max_still_s": 100}}, "max_still_s"),
        ({"estop": {"on_silence": "ignore"}}, "on_silence"),
    ],
)
def test_an_order_of_sources_that_is_none_is_refused_by_its_key(load, change, says):
    with pytest.raises(ConfigError, match=says):
        load({"footprint": {"radius": 0.3}, "sensors": {}, **change})


def test_sources_and_locks_become_rules(load):
    settings = load(
        {
            "footprint": {"radius": 0.3},
            "sensors": {},
            "joystick": {"max_still_s": None, "priority": 90},
            "estop": {"on_silence": "latch"},
            "sources": {"keys": {"topic": "k", "type": "geometry_msgs/msg/TwistStamped", "priority": 50}},
            "locks": {"pause": {"topic": "p", "priority": 60, "max_age_s": None}},
        }
    )
    sources = settings.rules().sources
    assert (sources.joystick.max_still_s, sources.joystick_priority, sources.agent_priority) == (math.inf, 90, 10)
    assert sources.further["k"].stamped
    assert (sources.locks["p"].priority, sources.locks["p"].max_age_s) == (60, math.inf)
    assert sources.on_silence == "latch"
    kinds = {topic: kind.TYPE for topic, kind in settings.kinds().items()}
    assert kinds["k"] == "geometry_msgs/msg/TwistStamped"
    assert kinds["p"] == "std_msgs/msg/Bool"


def test_the_window_of_odometry_follows_from_the_rest_of_the_configuration(load):
    section = {"footprint": {"radius": 0.3}, "sensors": {}, "rate_hz": 20, "zones": {"reaction_s": 0.2}}
    settings = load(section | {"odometry": {"latency_s": 0.1, "lag_s": 0.2, "type": "geometry_msgs/msg/TwistStamped"}})
    odometry = settings.rules().odometry
    # Two periods of 0.05 s and the wheels' 0.2 s; then 0.1 s of latency and four lags.
    assert odometry.params.dead_s == pytest.approx(0.3)
    assert odometry.params.window_s == pytest.approx(1.2)
    assert settings.kinds()["odom"].TYPE == "geometry_msgs/msg/TwistStamped"
    with pytest.raises(ConfigError, match="'odom' cannot be two things"):
        load(section | {"odometry": {}, "joystick": {"topic": "odom"}})


def test_the_example_of_the_documentation_is_a_configuration(load):
    text = (Path(__file__).parents[4] / "docs" / "safety.md").read_text()
    example = yaml.safe_load(text.split("```yaml")[1].split("```")[0])
    rules = load(example["safety"]).rules()
    assert set(rules.sensors) == {"scan", "sonar_left", "camera/depth/points"}


def test_addresses():
    assert address("unix:/run/x") == "/run/x"
    assert address("udp:127.0.0.1:80") == ("127.0.0.1", 80)
    assert address("udp:[::1]:80") == ("::1", 80)
    for bad in ("", "/run/x", "unix:", "udp:1", "udp:h:0", "udp:h:99999", "udp::5", "unix:/" + "x" * 120):
        with pytest.raises(ValueError, match=r"must be unix:PATH|longer than"):
            address(bad)


def test_the_usual_folder_is_the_users_own(monkeypatch):
    monkeypatch.setattr("os.geteuid", lambda: 1000)
    monkeypatch.setenv("XDG_RUNTIME_DIR", "/run/user/1000")
    assert default_folder() == Path("/run/user/1000/skytether")
    monkeypatch.setattr("os.geteuid", lambda: 0)
    assert default_folder() == Path("/run/skytether")


def test_the_usual_record_is_where_a_person_looks_for_it(monkeypatch):
    monkeypatch.setattr("os.geteuid", lambda: 1000)
    monkeypatch.setenv("XDG_STATE_HOME", "/home/walker/state")
    assert default_record() == Path("/home/walker/state/skytether/safety-record")
    monkeypatch.setenv("STATE_DIRECTORY", "/var/lib/skytether:/var/lib/other")  # a unit with StateDirectory=skytether
    of_the_unit = default_record()
    monkeypatch.setattr("os.geteuid", lambda: 0)  # sudo skytether robot safety-log
    assert default_record() == of_the_unit == Path("/var/lib/skytether/safety-record")


def test_two_gates_of_one_user_have_a_record_each(monkeypatch):
    monkeypatch.setattr("os.geteuid", lambda: 1000)
    monkeypatch.setenv("XDG_STATE_HOME", "/home/walker/state")
    monkeypatch.setenv("XDG_RUNTIME_DIR", "/run/user/1000")
    usual = default_record()
    found = []
    for folder in (
        "/run/user/1000/skytether",
        "/run/walkers/one",
        "/run/walkers/two",
        "/run/strollers/one",
        "/run/a b*",
    ):
        monkeypatch.setenv("SKYTETHER_GATE_FOLDER", folder)
        found.append(default_record())
    assert found[0] == usual
    assert len(set(found)) == len(found)
    assert {record.parent for record in found} == {usual.parent}
    assert [record.name.rpartition("-")[0] for record in found[1:]] == [
        "safety-record-one",
        "safety-record-two",
        "safety-record-one",
        "safety-record-a_b_",
    ]


@pytest.mark.parametrize(
    ("enable", "words"),
    [
        ({"file": "/sys/class/gpio/gpio17/value"}, ("file", "/sys/class/gpio/gpio17/value")),
        ({"chip": "/dev/gpiochip0", "line": 17}, ("gpio", "/dev/gpiochip0", "17")),
        ({"socket": "unix:/run/power"}, ("unix", "/run/power")),
        ({"socket": "udp:127.0.0.1:900"}, ("udp", "127.0.0.1", "900")),
    ],
)
def test_an_enable_signal_has_one_line(load, enable, words):
    assert load({"footprint": {"radius": 0.3}, "sensors": {}, "enable": enable}).enable_words() == words


def test_an_enable_signal_that_would_wait_for_a_disk_is_refused_unless_it_is_meant(load, tmp_path):
    value, link = tmp_path / "value", tmp_path / "link"
    value.touch()
    link.symlink_to(value)
    section = {"footprint": {"radius": 0.3}, "sensors": {}}
    for path in (value, link):
        with pytest.raises(OSError, match=rf"enable.file: {path} is a regular file.*safety.beyond"):
            load({**section, "enable": {"file": str(path)}}).enable_words()
    config = load({**section, "enable": {"file": str(value)}, "beyond": {"enable.file": "a RAM disk"}})
    assert config.enable_words() == ("file-on-disk", str(value))
    assert "a RAM disk" in config.notes()[0]
    with pytest.raises(ConfigError, match=r"beyond.enable.file: no number"):
        load({**section, "beyond": {"enable.file": "a RAM disk"}})


@pytest.mark.parametrize(
    ("enable", "says"),
    [
        ({}, "give one of file"),
        ({"file": "/a", "socket": "unix:/b"}, "give one of file"),
        ({"chip": "/dev/gpiochip0"}, "chip and line go together"),
        ({"topic": "on"}, "enable.topic needs ros1 or ros2"),
        ({"socket": "power"}, "must be unix:PATH"),
        ({"file": "/a", "after_s": 60}, "enable.after_s must be 0 to 3 s"),
    ],
)
def test_an_enable_signal_that_is_none_is_refused(load, enable, says):
    with pytest.raises(ConfigError, match=says):
        load({"footprint": {"radius": 0.3}, "sensors": {}, "enable": enable})
