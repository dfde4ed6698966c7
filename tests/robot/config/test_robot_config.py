import pytest

from skytether.api.config_file import ConfigError
from skytether.robot.config.gate_config import load_safety
from skytether.robot.config.robot_config import load_config, load_token
from skytether.robot.control.arbiter import LinkRequirements
from skytether.ros.permissions import Allowed
from skytether.ros.ros1.config import DEFAULT_MASTER

LEAST = """
robot: walker
orchestrator: http://127.0.0.1:8080
token_file: walker.token
service: virtual-trail
"""


@pytest.fixture
def read(tmp_path, monkeypatch):
    monkeypatch.delenv("ROS_MASTER_URI", raising=False)

    def read(more="ros1: {}"):
        path = tmp_path / "robot.yaml"
        path.write_text(LEAST + more)
        return load_config(path)

    return read


def test_little_need_be_written(read):
    settings = read()
    assert settings.ros1.master == DEFAULT_MASTER
    assert settings.fallback.name == "stop"
    assert settings.limits == {}


def test_the_environment_names_the_master(read, monkeypatch):
    monkeypatch.setenv("ROS_MASTER_URI", "http://robot:11311")
    assert read().ros1.master == "http://robot:11311"


def test_everything_can_be_written(read):
    settings = read(
        """
params: {stiffness: 3}
fallback: {name: admittance, options: {mass: 3.0}}
limits: {linear_max: 0.5}
rate_hz: 50
ros1:
  master: http://10.0.0.2:11311
  host: 10.0.0.2
  node: cloud/skytether
  namespace: /
  remap: {force: /wrench}
  cmd_vel: /base/cmd_vel
  idle_s: null
  readings: {force: geometry_msgs/msg/WrenchStamped}
  topics: [/camera/image]
  params: [/robot_description]
  use_sim_time: true
"""
    )
    assert settings.fallback.options == {"mass": 3.0}
    assert settings.ros1.idle_s is None
    assert read("fallback: admittance\nros1: {}").fallback.name == "admittance"


@pytest.mark.parametrize(
    ("text", "says"),
    [
        ("", "ros1: is missing; it, or ros2, says which graph the robot is"),
        ("ros1: {}\nros2: {}", "ros1: stands beside ros2"),
        ("ros2: {rooter: tcp/x:1}", "ros2.rooter: unknown key, did you mean 'router'"),
        ("ros2: {router: localhost}", "ros2.router"),
        ("ros2: {cmd_vel_type: geometry_msgs/msg/Pose}", "ros2.cmd_vel_type"),
        ("ros2: {cmd_vel: base/3d}", "cmd_vel: 'base/3d' is not a valid name of a ROS 2 graph"),
        ("ros1: {mastr: http://x}", "ros1.mastr: unknown key, did you mean 'master'"),
        ("ros1: {master: localhost}", "ros1.master: must be an address such as http://"),
        ("ros1: {}\nservise: x", "servise: unknown key, did you mean 'service'"),
        ("ros1: {}\nlimits: {linear_mx: 1}", "linear_mx: unknown key, did you mean 'linear_max'"),
        ("ros1: {}\nlimits: {linear_max: .nan}", "limits.linear_max: input should be a finite number"),
        ("ros1: {}\nlimits: {linear_max: .inf}", "limits.linear_max: input should be a finite number"),
        ("ros1: {remap: {scan: 3 d}}", "remap.scan: '3 d' is not a valid name of a graph"),
        ("ros1: {params: ['/a//b']}", "params.0: '/a//b' is not a valid name"),
        ("ros1: {readings: {force: std_msgs/msg/Nothing}}", "ros1.readings: force: no message type"),
        ("ros1: {idle_s: 0}", "ros1.idle_s"),
        ("ros1: {}\nparams: {speeds: [1, .nan]}", "params: speeds.1: must be a finite number, not nan"),
        ("ros1: {}\nparams: {since: 2020-01-01}", "params: since: must be text, a number, true or false"),
        ("ros1: {}\nfallback: {name: path, options: {speed: .inf}}", "fallback.options: speed: must be a finite"),
    ],
)
def test_a_mistake_is_named_by_its_key(read, text, says):
    with pytest.raises(ConfigError) as told:
        read(text)
    assert says in str(told.value)


def test_plain_http_to_another_machine_needs_a_word(read, tmp_path):
    for address in ("http://192.0.2.7:8600", '"https://a:1, http://cloud:8600"'):
        path = tmp_path / "robot.yaml"
        path.write_text(LEAST.replace("http://127.0.0.1:8080", address) + "ros1: {}")
        with pytest.raises(ConfigError, match=r"the token could be read on the way: .*add insecure_http: true"):
            load_config(path)
        path.write_text(path.read_text() + "\ninsecure_http: true")
        assert load_config(path).insecure_http
    assert read("ros1: {}\nca_file: ca.pem").ca_file == tmp_path / "ca.pem"


def test_a_token_is_read_from_a_file_that_nobody_else_may_read(read, tmp_path):
    settings = read()
    path = tmp_path / "walker.token"
    with pytest.raises(ConfigError, match="skytether robot add walker"):
        load_token(settings, tmp_path)
    path.write_text("secret\n")
    path.chmod(0o644)
    with pytest.raises(ConfigError, match="chmod 600") as told:
        load_token(settings, tmp_path)
    assert "secret" not in str(told.value)
    path.chmod(0o600)
    assert load_token(settings, tmp_path) == "secret"
    path.write_text("\n")
    with pytest.raises(ConfigError, match="is empty"):
        load_token(settings, tmp_path)
    path.write_bytes(b"\xff\xfe")
    with pytest.raises(ConfigError, match="no token"):
        load_token(settings, tmp_path)


GATED = """
ros1: {namespace: /base, readings: {force: geometry_msgs/msg/WrenchStamped}}
safety: {footprint: {radius: 0.3}, sensors: {scan: {}}, joystick: {topic: /joy}, estop: {}}
"""


def test_what_the_service_may_do_in_the_graph_is_listed_by_absolute_names_or_in_the_robot_s_namespace(read):
    settings = read(GATED + "cloud: {publish: [map, /tf], call: [/static_map]}")
    assert settings.allowed == Allowed(["/base/map", "/tf"], ["/static_map"], [])


@pytest.mark.parametrize(
    "name", ["scan", "/base/scan", "/joy", "/base/estop", "cmd_vel", "~cmd_vel", "force", "/Joy", "/clock"]
)
@pytest.mark.parametrize("access", ["publish", "call", "offer"])
def test_what_is_safety_s_cannot_be_listed(read, name, access):
    with pytest.raises(ConfigError, match=rf"cloud\.{access}\.1.* is never the cloud's"):
        read(GATED + f"cloud: {{{access}: [map, '{name}']}}")


def test_a_name_that_is_none_cannot_be_listed(read):
    with pytest.raises(ConfigError, match=r"cloud\.publish\.0.*not a valid name of a graph"):
        read(GATED + "cloud: {publish: [/a//b]}")


def test_the_link_has_needs_of_the_robot_s_own(read):
    assert read().needs.needs() == LinkRequirements(max_rtt_s=1.0, max_loss=0.5, max_late=0.5)
    assert read("ros1: {}\nneeds: {max_rtt_ms: 300}").needs.needs().max_rtt_s == 0.3


@pytest.mark.parametrize(
    "bad", ["max_rtt_ms: 3600000", "max_rtt_ms: null", "max_loss: 1.0", "max_late: .inf", "max_rtt_ms: 0"]
)
def test_needs_that_would_be_none_are_refused(read, bad):
    with pytest.raises(ConfigError, match=f"needs.{bad.split(':')[0]}"):
        read(f"ros1: {{}}\nneeds: {{{bad}}}")


def test_the_enable_signal_may_be_a_topic_of_the_graph_that_the_file_names(read, tmp_path):
    more = "ros1: {}\nsafety: {footprint: {radius: 0.3}, sensors: {}, enable: {topic: /motors_on}}\n"
    assert read(more).safety.enable.topic == "/motors_on"
    assert load_safety(tmp_path / "robot.yaml").enable.words() == ("topic",)
