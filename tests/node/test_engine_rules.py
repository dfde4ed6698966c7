"""What a node passes on to its engine: all that a Docker site asks for, and nothing that is the machine itself."""

from __future__ import annotations

import json
from typing import Any

import pytest

from skytether.api.grant import Grant
from skytether.api.manifest import ServiceSpec
from skytether.node.engine_rules import Call, judge
from skytether.orchestrator.runtimes.base import Launch
from skytether.orchestrator.runtimes.docker.objects import Declared, Namespace, container, epoch_volume, guard, holder
from skytether.orchestrator.runtimes.docker.options import DockerOptions

OWNER = {"skytether.io/owner": "edge"}
SECURITY = ["no-new-privileges", 'seccomp={"defaultAction": "SCMP_ACT_ERRNO"}']
ID = "f" * 64


def asked(method: str, path: str, body: Any = None, devices: tuple[str, ...] = (), **query: str) -> str | None:
    return judge(Call(method, path, query, body), devices)[0]


def launch(**needs: Any) -> Launch:
    spec = ServiceSpec.model_validate({"image": "registry.example/a:1", "needs": needs})
    given = {
        "instance": "i1",
        "robot": "walker",
        "service": "toy",
        "session_id": "00" * 8,
        "session_key": "",
        "topics": [],
    }
    return Launch(1, spec, Grant.model_validate(given))


def service(options: DockerOptions, namespace: Namespace | None = None, **needs: Any) -> dict[str, Any]:
    image = Declared("sha256:" + "a" * 64, ("/data",), {"Interval": 10**9})
    gpus = tuple(range(needs.get("gpu", 0)))
    return container(
        launch(**needs), options, "edge", image, 20_000, gpus, 4.0, {"a.example": ["192.0.2.1"]}, namespace
    )


@pytest.mark.parametrize(
    "body",
    [
        service(DockerOptions()),
        service(DockerOptions(), Namespace(ID, "held", 20_000)),
        service(DockerOptions(seccomp=None, gpu=2), gpu=2),
        service(DockerOptions(devices=("/dev/video0",), groups=(44,)), devices=["/dev/video0"]),
        guard(DockerOptions(), "edge", "sha256:" + "a" * 64, ID, "add table inet skytether"),
        holder(DockerOptions(), "edge", "sha256:" + "a" * 64),
    ],
)
def test_what_the_runtime_makes_is_passed_on(body: dict[str, Any]) -> None:
    sent = json.loads(json.dumps(body))
    assert asked("POST", "/v1.47/containers/create", sent, ("/dev/video0",), name="skytether-edge-i1-1") is None


@pytest.mark.parametrize(
    ("method", "path"),
    [
        *(
            ("GET", f"/v1.41/{path}")
            for path in ("version", "info", "events", "system/df", "containers/json", "volumes")
        ),
        *(("GET", f"/v1.41/containers/{ID}/{what}") for what in ("json", "logs", "stats", "archive")),
        *(("POST", f"/v1.41/containers/{ID}/{what}") for what in ("start", "kill", "wait")),
        ("HEAD", f"/v1.41/containers/{ID}/archive"),
        ("PUT", f"/v1.41/containers/{ID}/archive"),
        ("DELETE", f"/v1.41/containers/{ID}"),
        ("GET", "/v1.41/images/registry.example:5000/skytether/guard@sha256:aa/json"),
        ("GET", "/networks/skytether"),
        ("DELETE", "/networks/skytether"),
        ("DELETE", f"/volumes/{ID}"),
    ],
)
def test_what_the_runtime_asks_of_them_is_passed_on(method: str, path: str) -> None:
    refused, subjects = judge(Call(method, path, {}, None))
    assert refused is None
    about = path.partition("containers/")[2] or (path if method == "DELETE" else "")
    assert bool(subjects) == (bool(about) and about != "json")


def test_networks_volumes_pulls_and_limits_are_passed_on_as_the_runtime_asks_for_them() -> None:
    name, labels = epoch_volume("edge", 7)
    bridge = {"com.docker.network.bridge.name": "skt-0123456789", "com.docker.network.bridge.enable_icc": "false"}
    network = {"Name": "skytether", "CheckDuplicate": True, "Driver": "bridge", "Options": bridge, "IPAM": None}
    made = {**network, "Labels": {"skytether.io/network": "filtered"}}
    assert asked("POST", "/networks/create", made) is None
    assert (
        asked("POST", "/volumes/create", {"Name": name, "Driver": None, "DriverOpts": None, "Labels": labels}) is None
    )
    assert asked("POST", "/images/create", fromImage="registry.example/a", tag="1") is None
    assert (
        asked("POST", f"/containers/{ID}/update", {"Memory": 1, "MemorySwap": 1, "NanoCpus": 1, "CpuShares": 2}) is None
    )
    assert asked("POST", "/containers/prune", filters='{"label": ["skytether.io/guard"], "until": ["60s"]}') is None
    joins = {"Container": ID, "EndpointConfig": {"IPAMConfig": {}}}
    assert judge(Call("POST", "/networks/n/connect", {}, joins)) == (None, (("containers", ID),))


HOST = {"NetworkMode": "skytether", "CapDrop": ["ALL"], "SecurityOpt": SECURITY}


@pytest.mark.parametrize(
    ("changes", "says"),
    [
        ({"Binds": ["/:/host"]}, "'Binds', which no site asks for"),
        ({"binds": ["/:/host"]}, "'binds', which no site asks for"),
        ({"Privileged": True}, "'Privileged'"),
        ({"PidMode": "host"}, "'PidMode'"),
        ({"UsernsMode": "host"}, "'UsernsMode'"),
        ({"CgroupParent": "/"}, "'CgroupParent'"),
        ({"VolumesFrom": ["database"]}, "'VolumesFrom'"),
        ({"Runtime": "runc"}, "'Runtime'"),
        ({"DeviceCgroupRules": ["a *:* rwm"]}, "'DeviceCgroupRules'"),
        ({"MaskedPaths": []}, "'MaskedPaths'"),
        ({"NetworkMode": "host"}, "its network is 'host'"),
        ({"NetworkMode": "ns:/proc/1/ns/net"}, "its network is 'ns:"),
        ({"IpcMode": "host"}, "it shares memory"),
        ({"CapDrop": []}, "it keeps rights of root"),
        ({"CapAdd": ["SYS_ADMIN"]}, "it has the rights ['SYS_ADMIN']"),
        ({"CapAdd": ["NET_ADMIN"]}, "it has the rights ['NET_ADMIN']"),
        ({"CapAdd": ["NET_ADMIN", "SYS_ADMIN"], "NetworkMode": f"container:{ID}"}, "it has the rights"),
        ({"SecurityOpt": []}, "lets go of what holds it"),
        ({"SecurityOpt": [*SECURITY[:1], "seccomp=unconfined"]}, "lets go of what holds it"),
        ({"SecurityOpt": [*SECURITY, "apparmor=unconfined"]}, "lets go of what holds it"),
        ({"Mounts": [{"Type": "bind", "Source": "/", "Target": "/host"}]}, "it mounts something of this machine"),
        ({"Mounts": [{"Type": "volume", "Source": "database", "Target": "/d"}]}, "the volume 'database', which is not"),
        ({"Mounts": [{"Type": "volume", "type": "bind", "Target": "/d"}]}, "a mount has 'type'"),
        (
            {"Mounts": [{"Type": "volume", "Target": "/d", "VolumeOptions": {"DriverConfig": {"Options": {}}}}]},
            "a volume has 'DriverConfig'",
        ),
        ({"Devices": [{"PathOnHost": "/dev/sda"}]}, "by `site join --device /dev/sda`"),
        ({"Devices": [{"PathOnHost": "/dev/video0", "pathonhost": "/dev/sda"}]}, "a device has 'pathonhost'"),
        ({"DeviceRequests": [{"Driver": "cdi", "DeviceIDs": ["vendor.com/all=all"]}]}, "odd devices"),
        ({"LogConfig": {"Type": "syslog"}}, "its log goes elsewhere"),
    ],
)
def test_no_container_is_made_that_is_the_machine_itself(changes: dict[str, Any], says: str) -> None:
    body = {"Image": "a", "Labels": OWNER, "HostConfig": HOST}
    assert asked("POST", "/containers/create", body) is None
    refused = asked("POST", "/v1.47/containers/create", {**body, "HostConfig": {**HOST, **changes}}, ("/dev/video0",))
    assert says in str(refused)


@pytest.mark.parametrize(
    ("method", "path", "body", "query"),
    [
        ("POST", f"/containers/{ID}/exec", {}, {}),
        ("POST", f"/containers/{ID}/attach", None, {}),
        ("GET", f"/containers/{ID}/export", None, {}),
        ("POST", "/build", None, {}),
        ("POST", "/commit", None, {}),
        ("GET", "/containers/../images/json", None, {}),
        ("POST", "/containers/create", None, {}),
        ("POST", "/containers/create", ["a"], {}),
        ("POST", "/containers/create", {"Image": "a", "hostconfig": {"Privileged": True}}, {}),
        ("POST", "/containers/create", {"Image": "a", "HostConfig": HOST}, {}),  # no label of ours
        ("POST", "/containers/create", {"Image": "a", "Labels": OWNER, "HostConfig": ["Privileged"]}, {}),
        ("POST", f"/containers/{ID}/update", {"Devices": [{"PathOnHost": "/dev/sda"}]}, {}),
        ("POST", "/containers/prune", None, {}),
        ("POST", "/containers/prune", None, {"filters": '{"until": ["1s"]}'}),
        ("POST", "/images/create", None, {"fromSrc": "-"}),
        ("POST", "/volumes/prune", None, {}),
        ("POST", "/volumes/create", {"Name": "database", "Labels": OWNER}, {}),
        ("POST", "/volumes/create", {"Name": "skytether-x", "Labels": OWNER, "DriverOpts": {"device": "/"}}, {}),
        ("POST", "/networks/create", {"Name": "n", "Driver": "macvlan", "Labels": {"skytether.io/network": ""}}, {}),
        (
            "POST",
            "/networks/create",
            {
                "Name": "n",
                "Driver": "bridge",
                "Labels": {"skytether.io/network": ""},
                "Options": {"com.docker.network.bridge.name": "br0"},
            },
            {},
        ),
        ("POST", "/networks/n/connect", {"Container": ID, "EndpointConfig": {"Aliases": ["database"]}}, {}),
        ("GET", "/plugins", None, {}),
        ("POST", "/swarm/init", {}, {}),
        ("POST", "/session", None, {}),
    ],
)
def test_nothing_else_is_passed_on(method: str, path: str, body: Any, query: dict[str, str]) -> None:
    assert judge(Call(method, path, query, body))[0]


def test_of_containers_networks_and_volumes_it_has_to_be_looked_whose_they_are() -> None:
    held = {**HOST, "NetworkMode": "container:abc", "CapAdd": ["NET_ADMIN"]}
    made = {"Image": "a", "Labels": OWNER, "HostConfig": held}
    assert judge(Call("POST", "/containers/create", {}, made)) == (None, (("containers", "abc"),))
    assert judge(Call("DELETE", "/networks/n", {}, None)) == (None, (("networks", "n"),))
    assert judge(Call("PUT", "/containers/abc/archive", {}, None)) == (None, (("containers", "abc"),))
