"""What a node passes on to its engine: all that a Docker site asks for, and nothing that is the machine itself."""

from __future__ import annotations

import json
from typing import Any

import pytest

from skytether.api.grant import Grant
from skytether.api.manifest import ServiceSpec
from skytether.node.archives import cleaned
from skytether.node.engine_rules import LOOK, Call, judge
from skytether.node.seccomp_calls import CALLS
from skytether.node.seccomp_rules import holds, keeps_in
from skytether.orchestrator.runtimes.base import Launch
from skytether.orchestrator.runtimes.docker.objects import (
    READY,
    REPORTS,
    Declared,
    Namespace,
    archives,
    container,
    epoch_volume,
    guard,
    holder,
)
from skytether.orchestrator.runtimes.docker.options import DockerOptions

OWNER = {"skytether.io/owner": "edge"}
NEEDED = {
    "names": ["close", "close_range", "execve", "exit_group", "futex", "mmap", "openat", "read", "write"],
    "action": "SCMP_ACT_ALLOW",
}
"""What runc calls."""


def profile(*entries: dict[str, Any], **more: Any) -> str:
    return json.dumps({"defaultAction": "SCMP_ACT_ERRNO", "syscalls": [NEEDED, *entries], **more})


SECURITY = ["no-new-privileges", f"seccomp={profile()}"]
ID = "f" * 64
JOINED = DockerOptions(engine="node://edge", advertise_host="192.0.2.1", seccomp="default")


def asked(method: str, path: str, body: Any = None, devices: tuple[str, ...] = (), /, **query: str) -> str | None:
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
    info = {"NCPU": 4, "CgroupDriver": "cgroupfs"}
    return container(
        launch(**needs), options, "edge", image, 20_000, gpus, info, {"a.example": ["192.0.2.1"]}, namespace
    )


@pytest.mark.parametrize(
    "body",
    [
        service(DockerOptions()),
        service(DockerOptions(), Namespace(ID, "held", 20_000)),
        service(DockerOptions(seccomp=None, gpu=2), gpu=2),
        service(DockerOptions(devices=("/dev/video0",), groups=(44,)), devices=["/dev/video0"]),
        guard(DockerOptions(), "edge", "sha256:" + "a" * 64, ID, "add table inet skytether"),
        guard(JOINED, "edge", "sha256:" + "a" * 64, ID, ""),
        holder(DockerOptions(), "edge", "sha256:" + "a" * 64),
    ],
)
def test_what_the_runtime_makes_is_passed_on(body: dict[str, Any]) -> None:
    sent = json.loads(json.dumps(body))
    devices = ("/dev/video0", "/dev/nvidia0", "/dev/nvidia1")
    assert asked("POST", "/v1.47/containers/create", sent, devices, name="skytether-edge-i1-1") is None


@pytest.mark.parametrize(
    ("method", "path"),
    [
        *(("GET", f"/v1.41/{path}") for path in ("version", "info", "system/df")),
        *(("GET", f"/v1.41/containers/{ID}/{what}") for what in ("json", "logs", "stats")),
        *(("POST", f"/v1.41/containers/{ID}/{what}") for what in ("start", "kill", "wait")),
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
    assert bool(subjects) == any(kind in path for kind in ("containers", "networks", "volumes"))


def test_of_files_in_containers_those_are_passed_on_that_the_runtime_asks_for() -> None:
    path = f"/v1.41/containers/{ID}/archive"
    for file in (READY, REPORTS):
        assert asked("HEAD", path, path=file) is asked("GET", path, path=file) is None
    for folder, archive in archives(launch()):
        assert asked("PUT", path, path=folder) is None
        assert cleaned(archive, folder) == archive
    for odd in ("/", "/etc/shadow", "/run/skytether/data/a", f"{READY}/..", ""):
        assert {"is no file" in str(asked(method, path, path=odd)) for method in ("HEAD", "GET", "PUT")} == {True}
    assert asked("GET", path)
    assert asked("PUT", path, path=READY)


@pytest.mark.parametrize("path", ["events", "containers/json", "volumes"])
def test_of_lists_only_what_orchestrators_made_is_passed_on(path: str) -> None:
    def listed(filters: str) -> str | None:
        return asked("GET", f"/v1.41/{path}", filters=filters)

    assert listed('{"label": ["skytether.io/owner=edge", "a"]}') is None
    assert listed('{"label": ["skytether.io/owner"], "type": ["container"]}') is None
    for odd in (
        *("", "{}", "[]", '{"label": []}', '{"label": ["skytether.io/owners"]}', '{"label": ["a=skytether.io/owner"]}'),
        '{"label!": ["skytether.io/owner"]}',
        '{"label": ["skytether.io/owner"], "label": []}',
    ):
        assert "only what has the label" in str(listed(odd)), odd
    for more in ('"since": ["a"]', '"before": ["a"]', '"name": ["a"]', '"Label": ["a"]', '"ancestor": {"a": true}'):
        assert "which no site asks for" in str(listed(f'{{"label": ["skytether.io/owner"], {more}}}')), more


def test_networks_volumes_pulls_and_limits_are_passed_on_as_the_runtime_asks_for_them() -> None:
    name, labels = epoch_volume("edge", 7)
    bridge = {"com.docker.network.bridge.name": "skt-0123456789", "com.docker.network.bridge.enable_icc": "false"}
    network = {"Name": "skytether", "CheckDuplicate": True, "Driver": "bridge", "Options": bridge, "IPAM": None}
    made = {**network, "Labels": {"skytether.io/network": "filtered"}}
    assert asked("POST", "/networks/create", made) is None
    assert (
        asked("POST", "/volumes/create", {"Name": name, "Driver": None, "DriverOpts": None, "Labels": labels}) is None
    )
    pulled = {"fromImage": "registry.example:5000/a/b", "tag": "1.2-x"}
    for tag in ("1.2-x", f"sha256:{ID}"):
        about = (("pulled", "registry.example:5000/a/b"),)
        assert judge(Call("POST", "/images/create", {**pulled, "tag": tag}, None)) == (None, about)
    assert (
        asked("POST", f"/containers/{ID}/update", {"Memory": 1, "MemorySwap": 1, "NanoCpus": 1, "CpuShares": 2}) is None
    )
    assert asked("POST", "/containers/prune", filters='{"label": ["skytether.io/guard"], "until": ["60s"]}') is None
    joins = {"Container": ID, "EndpointConfig": {"IPAMConfig": {}}}
    assert judge(Call("POST", "/networks/n/connect", {}, joins)) == (
        None,
        (("containers", ID), ("kept networks", "n")),
    )


def gpu(*numbers: str) -> dict[str, Any]:
    return {"Driver": "nvidia", "DeviceIDs": list(numbers), "Capabilities": [["gpu"]]}


def named(**options: Any) -> dict[str, Any]:
    return {"Type": "volume", "Source": "skytether-a", "Target": "/d", "VolumeOptions": options}


def log(**options: str) -> dict[str, Any]:
    return {"Type": "json-file", "Config": {"max-size": "2m", "max-file": "2", **options}}


HOST: dict[str, Any] = {
    "LogConfig": log(),
    "NetworkMode": "skytether",
    "CapDrop": ["ALL"],
    "SecurityOpt": SECURITY,
    "ReadonlyRootfs": True,
    "Init": True,
    "PidsLimit": 64,
}


@pytest.mark.parametrize(
    ("changes", "says"),
    [
        ({"Binds": ["/:/host"]}, "'Binds', which no site asks for"),
        ({"binds": ["/:/host"]}, "'binds', which no site asks for"),
        ({"Privileged": True}, "'Privileged'"),
        ({"PidMode": "host"}, "'PidMode'"),
        ({"UsernsMode": "host"}, "'UsernsMode'"),
        ({"CgroupnsMode": "host"}, "'CgroupnsMode'"),
        ({"VolumesFrom": ["database"]}, "'VolumesFrom'"),
        ({"Runtime": "runc"}, "'Runtime'"),
        ({"DeviceCgroupRules": ["a *:* rwm"]}, "'DeviceCgroupRules'"),
        ({"MaskedPaths": []}, "'MaskedPaths'"),
        ({"Init": False}, "its first process is not the engine's own"),
        ({"Init": None}, "its first process is not the engine's own"),
        ({"NetworkMode": "host"}, "its network is 'host'"),
        ({"NetworkMode": "ns:/proc/1/ns/net"}, "its network is 'ns:"),
        ({"NetworkMode": "container:database"}, "its network is 'container:database'"),
        ({"PortBindings": {"53/udp": [{"HostPort": "53"}]}}, "'53/udp', which no site asks for"),
        ({"IpcMode": "host"}, "it shares memory"),
        ({"CgroupParent": "/system.slice/docker.service"}, "in a group of other processes"),
        ({"CgroupParent": ""}, "in a group of other processes"),
        ({"CgroupParent": ["/"]}, "in a group of other processes"),
        ({"CapDrop": []}, "it keeps rights of root"),
        ({"CapAdd": ["SYS_ADMIN"]}, "it has the rights ['SYS_ADMIN']"),
        ({"CapAdd": ["NET_ADMIN"]}, "it has the rights ['NET_ADMIN']"),
        (
            {"CapAdd": ["NET_ADMIN"], "NetworkMode": f"container:{ID}", "SecurityOpt": SECURITY[:1]},
            "its right ends at its own network",
        ),
        ({"CapAdd": ["NET_ADMIN", "SYS_ADMIN"], "NetworkMode": f"container:{ID}"}, "it has the rights"),
        ({"SecurityOpt": []}, "lets go of what holds it"),
        ({"SecurityOpt": [*SECURITY[:1], "seccomp=unconfined"]}, "lets go of what holds it"),
        ({"SecurityOpt": [*SECURITY, "apparmor=unconfined"]}, "lets go of what holds it"),
        ({"Mounts": [{"Type": "bind", "Source": "/", "Target": "/host"}]}, "it mounts something of this machine"),
        ({"Mounts": [{"Type": "volume", "Source": "database", "Target": "/d"}]}, "the volume 'database', which is not"),
        ({"Mounts": [{"Type": "volume", "type": "bind", "Target": "/d"}]}, "a mount has 'type'"),
        (
            {
                "Mounts": [
                    {"Type": "volume", "Target": "/d", "VolumeOptions": {"Labels": {str(i): "" for i in range(65)}}}
                ]
            },
            "a volume with more than 64 labels",
        ),
        (
            {"Mounts": [{"Type": "volume", "Target": "/d", "VolumeOptions": {"Labels": {"a": "b" * 9000}}}]},
            "a volume with labels of more than 8 KiB",
        ),
        (
            {"Mounts": [{"Type": "volume", "Target": "/d", "VolumeOptions": {"DriverConfig": {"Options": {}}}}]},
            "a volume has 'DriverConfig'",
        ),
        ({"Mounts": [named(NoCopy=True)]}, "a volume without the label skytether.io/owner"),
        ({"Mounts": [{"Type": "volume", "Target": "/d"}]}, "a volume without the label skytether.io/owner"),
        ({"Mounts": [named()]}, "it copies files of its image"),
        ({"Mounts": [named(NoCopy=False)]}, "it copies files of its image"),
        ({"Mounts": [named(nocopy=True)]}, "it copies files of its image"),
        ({"Mounts": [named(NoCopy=True, nocopy=False)]}, "a volume has 'nocopy'"),
        # What is there already, such as the kernel's files, to be written to.
        ({"Tmpfs": {"/sys/": "remount,rw"}}, "at /sys/ is mounted by 'remount'"),
        ({"Tmpfs": {"/tmp": "size=1m", "/link/to/sys": "rw,nosuid,remount"}}, "is mounted by 'remount'"),
        ({"Tmpfs": {"/tmp": "rbind"}}, "is mounted by 'rbind'"),
        ({"Tmpfs": {"/link/../a": "size=1m"}}, "its file system in memory is at /link/../a"),
        ({"Tmpfs": {"/tmp": "shared"}}, "is mounted by 'shared'"),
        ({"Tmpfs": {"/tmp": ["remount"]}}, "is mounted by"),
        ({"Tmpfs": ["/sys/"]}, "is mounted by"),
        ({"Devices": [{"PathOnHost": "/dev/sda"}]}, "by `site join --device /dev/sda`"),
        ({"Devices": [{"PathOnHost": "/dev/video0", "pathonhost": "/dev/sda"}]}, "a device has 'pathonhost'"),
        # In a volume that others have, on a way that they move as it is made: it would be anywhere on the machine.
        ({"Devices": [{"PathOnHost": "/dev/video0", "PathInContainer": "/d/a/b"}]}, "/dev/video0 at another path"),
        ({"Devices": ["/dev/video0"]}, "it has the device /dev/video0"),
        ({"DeviceRequests": [{"Driver": "cdi", "DeviceIDs": ["vendor.com/all=all"]}]}, "odd devices"),
        ({"DeviceRequests": [gpu("0")]}, "by `site join --device /dev/nvidia0`"),
        ({"DeviceRequests": [gpu("0/../sda")]}, "by `site join --device /dev/nvidia0/../sda`"),
        ({"DeviceRequests": [gpu()]}, "by `site join --device /dev/nvidia0`"),
        ({"DeviceRequests": [{**gpu("0"), "Capabilities": [["gpu", "display"]]}]}, "odd devices"),
        ({"LogConfig": {"Type": "syslog"}}, "its log goes elsewhere"),
        # To an engine whose own kind of log goes elsewhere, it says where to.
        ({"LogConfig": {"Config": {"syslog-address": "udp://127.0.0.1:53"}}}, "its log goes elsewhere"),
        # Of a template, an engine makes a text of any length as it starts it: gigabytes of its own memory.
        ({"LogConfig": log(tag='{{pad "a" 100000000000 0}}')}, "its log has tag"),
        ({"LogConfig": log(mode="non-blocking")}, "its log has mode 'non-blocking'"),
        ({"LogConfig": log(**{"max-size": "99999m"})}, "its log has max-size '99999m'"),
        ({"LogConfig": log(**{"max-file": "1000000000"})}, "its log has max-file"),
        ({"LogConfig": log(**{"Max-File": "2"})}, "its log has Max-File"),
        ({"LogConfig": {"Type": "json-file", "Config": ["tag"]}}, "its log has"),
        ({"NetworkMode": None}, "its network is ''"),  # and not the network of that name
        ({"ReadonlyRootfs": False}, "it may change its own files"),
        ({"ReadonlyRootfs": None}, "it may change its own files"),
        ({"PidsLimit": None}, "its PidsLimit is None"),
        ({"PidsLimit": -1}, "its PidsLimit is -1"),
        ({"PidsLimit": True}, "its PidsLimit is True"),
        ({"PortBindings": {"7600/udp": [{"HostPort": "1"}, {"HostPort": "2"}]}}, "it publishes too many ports"),
        # Of other addresses and ports, the node does not see whether they are free.
        ({"PortBindings": {"7600/udp": [{"HostPort": "7600-7700"}]}}, "it is published at :7600-7700"),
        ({"PortBindings": {"7600/udp": [{"HostPort": "65536"}]}}, "it is published at :65536"),
        ({"PortBindings": {"7600/udp": [{"HostPort": "07600"}]}}, "it is published at :07600"),
        ({"PortBindings": {"7600/udp": [{"HostIp": "127.0.0.01", "HostPort": "1"}]}}, "published at 127.0.0.01:1"),
        ({"PortBindings": {"7600/udp": [{"HostIp": "::ffff:127.0.0.1"}]}}, "published at ::ffff:127.0.0.1:"),
        ({"PortBindings": {"7600/udp": [{"HostIp": "fe80::1%eth0"}]}}, "published at fe80::1%eth0:"),
        ({"PortBindings": {"7600/udp": [{"HostPort": "1", "hostport": "2"}]}}, "a port has 'hostport'"),
        ({"PortBindings": {"7600/udp": ["53"]}}, "it is published at 53"),
    ],
)
def test_no_container_is_made_that_is_the_machine_itself(changes: dict[str, Any], says: str) -> None:
    body = {"Image": "a", "Labels": OWNER, "HostConfig": HOST}
    assert asked("POST", "/containers/create", body) is None
    refused = asked("POST", "/v1.47/containers/create", {**body, "HostConfig": {**HOST, **changes}}, ("/dev/video0",))
    assert says in str(refused)


@pytest.mark.parametrize(
    ("check", "says"),
    [
        (None, "None"),
        ({}, "None"),
        ({"Interval": 10**9}, "None"),
        ({"Test": ["CMD", "true"], "Interval": 10**9, "StartInterval": 10**9}, "None"),
        ({"Test": ["CMD"]}, "its health check ['CMD'] has no command"),
        ({"Test": ["CMD-SHELL"]}, "has no command"),
        ({"Test": "CMD"}, "has no command"),
        ({"test": ["CMD"]}, "a health check has 'test'"),
        ({"Test": ["NONE"], "TEST": ["CMD"]}, "a health check has 'TEST'"),
        (["CMD"], "a health check has ''"),
    ],
)
def test_no_container_is_made_whose_health_check_ends_the_engine(check: Any, says: str) -> None:
    """It looks for the first word of a command that has none, and all containers of the machine end with it."""
    body = {"Image": "a", "Labels": OWNER, "HostConfig": HOST, "Healthcheck": check}
    assert says in str(asked("POST", "/containers/create", body))


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
        ("POST", "/images/create", None, {"fromImage": "a", "tag": ""}),  # all tags
        ("POST", "/images/create", None, {"fromImage": "a:1", "tag": "2"}),
        ("POST", "/images/create", None, {"fromImage": "a@sha256:" + ID, "tag": "2"}),
        ("POST", "/images/create", None, {"fromImage": "a/../b", "tag": "2"}),
        ("POST", "/volumes/prune", None, {}),
        ("POST", "/volumes/create", {"Name": "database", "Labels": OWNER}, {}),
        ("POST", "/volumes/create", {"Name": "skytether-x", "Labels": OWNER | {str(i): "" for i in range(64)}}, {}),
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
        ("GET", "/networks/0123456789ab", None, {}),  # the beginning of an id
        # Who makes one by that name would find it gone, if it was not there yet as we looked.
        ("DELETE", "/networks/database", None, {}),
        ("DELETE", "/volumes/database", None, {}),
        # Of 1.23 a start takes what a container is made of.
        ("POST", f"/v1.23/containers/{ID}/start", None, {}),
        ("POST", f"/v1.40/containers/{ID}/start", None, {}),
        ("POST", f"/v1.41/containers/{ID}/start", {"Binds": ["/:/host"]}, {}),
        ("POST", f"/containers/{ID}/start", None, {"checkpoint": "a", "checkpoint-dir": "/tmp"}),
        # A form, where an engine reads one: a document of JSON, too.
        ("POST", "/containers/prune", "a&filters={}&", {"filters": '{"label": ["skytether.io/guard"]}'}),
        ("POST", "/containers/prune", None, {"filters": '{"label": ["skytether.io/guard"], "label": ["a"]}'}),
        ("POST", "/images/create", "a&fromImage=&fromSrc=http://a/b&repo=debian&", {"fromImage": "a"}),
        ("GET", "/plugins", None, {}),
        ("POST", "/swarm/init", {}, {}),
        ("POST", "/session", None, {}),
    ],
)
def test_nothing_else_is_passed_on(method: str, path: str, body: Any, query: dict[str, str]) -> None:
    assert judge(Call(method, path, query, body))[0]


@pytest.mark.parametrize("address", ["", "0.0.0.0", "192.0.2.1", "::", "::1", "2001:DB8::01"])
def test_a_container_is_published_at_a_plain_address(address: str) -> None:
    for port in ("", "7600", "65535"):
        bindings = {"7600/udp": [{"HostIp": address, "HostPort": port}]}
        body = {"Image": "a", "Labels": OWNER, "HostConfig": {**HOST, "PortBindings": bindings}}
        assert asked("POST", "/containers/create", body) is None


def test_of_containers_networks_and_volumes_it_has_to_be_looked_whose_they_are() -> None:
    mounts = [named(NoCopy=True, Labels=OWNER)]
    held = {**HOST, "NetworkMode": f"container:{ID}", "CapAdd": ["NET_ADMIN"], "Mounts": mounts}
    held["SecurityOpt"] = SECURITY
    made = {"Image": "a", "Labels": OWNER, "HostConfig": held}
    assert judge(Call("POST", "/containers/create", {}, made)) == (
        None,
        (("containers", ID), ("guarded", ID), ("volumes", "skytether-a")),
    )
    held.pop("CapAdd")
    assert judge(Call("POST", "/containers/create", {}, made))[1] == (("containers", ID), ("volumes", "skytether-a"))
    made["HostConfig"] = HOST
    assert judge(Call("POST", "/containers/create", {}, made)) == (None, (("joined networks", "skytether"),))
    assert judge(Call("DELETE", "/networks/skytether-n", {}, None)) == (None, (("networks", "skytether-n"),))
    volume = {"Name": "skytether-a", "Labels": OWNER}  # what is there by that name, an engine tells all of
    assert judge(Call("POST", "/volumes/create", {}, volume)) == (None, (("volumes", "skytether-a"),))
    assert judge(Call("PUT", f"/containers/{ID}/archive", {"path": "/run/skytether"}, None)) == (
        None,
        (("containers", ID),),
    )


@pytest.mark.parametrize("name", ["database", "0123456789ab", ID, "skytether", ""])
def test_nothing_is_made_by_a_name_that_somebody_else_has_or_looks_for(name: str) -> None:
    """A container's name goes before the beginning of another's id; a network's is looked up where one starts."""
    made = {"Image": "a", "Labels": OWNER, "HostConfig": HOST}
    assert "it is named" in str(asked("POST", "/containers/create", made, name=name))
    bridge = {"com.docker.network.bridge.name": "skt-0123456789"}
    network = {"CheckDuplicate": True, "Driver": "bridge", "Options": bridge, "Labels": {"skytether.io/network": ""}}
    refused = asked("POST", "/networks/create", {**network, "Name": name})
    assert refused is None if name == "skytether" else "the name of a network" in str(refused)
    for odd in ("skt-", "skt-+", "skt-a/b", "skt-0123456789ab", "br0", None):
        changed = {**network, "Name": "skytether", "Options": {"com.docker.network.bridge.name": odd}}
        assert "a bridge of its own" in str(asked("POST", "/networks/create", changed))


@pytest.mark.parametrize("labels", [{"skytether.io/network": "x"}, {}])
def test_nothing_is_made_that_is_nobodys(labels: dict[str, str]) -> None:
    """The node says that of what it makes itself: no orchestrator could remove it, in whose way it is."""
    labels = {**labels, "skytether.io/owner": "-"}
    bridge = {"com.docker.network.bridge.name": "skt-0123456789"}
    network = {"Name": "skytether-n", "CheckDuplicate": True, "Driver": "bridge", "Options": bridge}
    mount = {"Type": "volume", "Target": "/data", "VolumeOptions": {"Labels": labels}}
    for path, body, query in (
        ("/networks/create", network, {}),
        ("/volumes/create", {"Name": "skytether-v"}, {}),
        ("/containers/create", {"Image": "a", "HostConfig": HOST}, {"name": "skytether-c"}),
    ):
        assert "of what is nobody's" in str(asked("POST", path, {**body, "Labels": labels}, **query))
    container = {"Image": "a", "Labels": OWNER, "HostConfig": {**HOST, "Mounts": [mount]}}
    assert "of what is nobody's" in str(asked("POST", "/containers/create", container, name="skytether-c"))


def test_no_orchestrator_takes_the_name_of_what_the_node_makes_itself() -> None:
    """One that no engine ends would be in the way of every look at an image."""
    made = {"Image": "a", "Labels": OWNER, "HostConfig": HOST}
    assert "as what the node makes itself" in str(asked("POST", "/containers/create", made, name=f"{LOOK}0123abcd"))
    assert asked("POST", "/containers/create", made, name=f"{LOOK}0123abcd-i1-1") is None


@pytest.mark.parametrize("name", ["abc", "0123456789ab", ID[:63], "skytether-a"])
def test_a_container_is_named_by_its_whole_id_alone(name: str) -> None:
    """A name may be that of another one by the time when the engine looks: the beginning of its id."""
    made = {"Image": "a", "Labels": OWNER, "HostConfig": {**HOST, "NetworkMode": f"container:{name}"}}
    assert asked("POST", "/containers/create", made)
    assert asked("POST", "/networks/n/connect", {"Container": name})
    for call in ("start", "kill", "wait", "update"):
        assert asked("POST", f"/containers/{name}/{call}", {})
    assert asked("PUT", f"/containers/{name}/archive", path="/run/skytether")
    assert asked("DELETE", f"/containers/{name}")


def allowed(*names: str, **more: Any) -> dict[str, Any]:
    return {"names": list(names), "action": "SCMP_ACT_ALLOW", **more}


NEW = {"index": 0, "value": 0x7E020000, "valueTwo": 0, "op": "SCMP_CMP_MASKED_EQ"}
OF_FAMILY = {"index": 0, "value": 2, "op": "SCMP_CMP_EQ"}
MORE = (
    *("fanotify_init", "quotactl_fd", "set_mempolicy", "mbind", "move_pages", "migrate_pages", "personality", "chroot"),
    *("listmount", "statmount", "syslog", "socketcall", "ipc", "ptrace", "pidfd_getfd", "process_madvise", "swapon"),
    *("name_to_handle_at", "vmsplice", "seccomp", "modify_ldt", "io_setup", "settimeofday", "sethostname", "clone3"),
)


@pytest.mark.parametrize(
    ("entry", "good"),
    [
        (allowed("read", "write"), True),
        (allowed("clone", args=[NEW]), True),
        (allowed("unshare", includes={"caps": ["CAP_SYS_ADMIN"]}), True),
        ({"names": ["clone3", "mount"], "action": "SCMP_ACT_ERRNO", "errnoRet": 38}, True),
        (allowed("read", "unshare"), False),
        (allowed("read", "io_uring_setup"), False),
        # What an engine's own profile refuses, or takes with some arguments only, or what kernels have learned since.
        *((allowed("read", name), False) for name in MORE),
        (allowed("READ"), False),
        (allowed("read", "unshare\0"), False),  # in C, that is where the name ends
        ({"name": "unshare\0a", "action": "SCMP_ACT_ALLOW"}, False),
        ({"names": [["unshare"]], "action": "SCMP_ACT_ALLOW"}, False),
        ({"name": "mount", "action": "SCMP_ACT_ALLOW"}, False),
        (allowed("unshare", includes={"caps": ["CAP_NET_ADMIN"]}), False),
        (allowed("unshare", includes={"arches": ["amd64"]}), False),
        (allowed("clone"), False),
        (allowed("clone", args=[{**NEW, "value": 0}]), False),
        (allowed("clone", args=[{**NEW, "index": 1}]), False),  # whoever calls chooses that one
        (allowed("clone", args=[{**NEW, "index": 1}], includes={"arches": ["s390", "s390x"]}), True),
        (allowed("clone", args=[{**NEW, "index": 1}], includes={"arches": ["s390x", "amd64"]}), False),
        (allowed("clone", args=[7]), False),
        # To the kernel's ciphers, and to the machine below this one.
        (allowed("read", "socket"), False),
        (allowed("socketcall"), False),
        (allowed("socket", args=[OF_FAMILY]), True),
        (allowed("socket", args=[OF_FAMILY, {**OF_FAMILY, "index": 2}]), True),
        (allowed("socket", args=[{**OF_FAMILY, "value": 16}]), True),
        (allowed("socket", args=[{**OF_FAMILY, "value": 17}]), False),
        (allowed("socket", args=[{**OF_FAMILY, "value": 2.0}]), False),
        (allowed("socket", args=[{**OF_FAMILY, "value": 3, "op": "SCMP_CMP_LT"}]), False),
        (allowed("socket", args=[{**OF_FAMILY, "value": 38}]), False),
        (allowed("socket", args=[{**OF_FAMILY, "value": 40}]), False),
        (allowed("socket", args=[{**OF_FAMILY, "value": (1 << 32) + 40}]), False),
        (allowed("socket", args=[{**OF_FAMILY, "value": 40, "op": "SCMP_CMP_NE"}]), False),
        (allowed("socket", args=[{**OF_FAMILY, "value": 40, "op": "SCMP_CMP_GT"}]), False),
        (allowed("socket", args=[OF_FAMILY, {**OF_FAMILY, "value": 40}]), False),
        (allowed("socket", args=[{**OF_FAMILY, "Value": 40}]), False),
        (allowed("socket", args=[{**OF_FAMILY, "index": 1}]), False),
        ({"Names": ["unshare"], "action": "SCMP_ACT_ALLOW"}, False),
        ({"names": ["unshare"], "action": "SCMP_ACT_LOG"}, False),
        ({"names": ["unshare"], "action": "SCMP_ACT_NOTIFY"}, False),
        ({"names": ["unshare"], "action": ["SCMP_ACT_ERRNO"]}, False),
    ],
)
def test_a_seccomp_profile_lets_through_no_way_out(entry: dict[str, Any], good: bool) -> None:
    assert holds(profile(entry)) is good


HANGS = ("KILL", "KILL_THREAD", "NOTIFY", "TRACE", "LOG", "NOTHING")


@pytest.mark.parametrize(
    "entries",
    [
        [],
        [allowed(*(name for name in NEEDED["names"] if name != "close"))],
        [{**NEEDED, "args": [OF_FAMILY]}],
        [{**NEEDED, "includes": {"minKernel": "99.0"}}],
        [{**NEEDED, "excludes": {"arches": ["amd64"]}}],
        [NEEDED, {"names": ["close", "close_range"], "action": "SCMP_ACT_ERRNO"}],
        [NEEDED, {"name": "close", "action": "SCMP_ACT_ERRNO"}],
        [NEEDED, {"names": ["clone3"], "action": "SCMP_ACT_ERRNO", "errnoRet": 0}],
        [NEEDED, {"names": ["clone3"], "action": "SCMP_ACT_KILL_THREAD"}],
        [NEEDED, {"names": ["clone3"], "action": "SCMP_ACT_KILL"}],
        *([NEEDED, {"names": ["close"], "action": f"SCMP_ACT_{word}"}] for word in HANGS),
        *([NEEDED, {"names": ["getpid"], "action": f"SCMP_ACT_{word}"}] for word in HANGS),
        [NEEDED, {"names": ["clone3"], "action": "SCMP_ACT_ERRNO", "errnoRet": 1 << 16}],
        [NEEDED, {"names": ["clone3"], "action": "SCMP_ACT_ERRNO", "errnoRet": "38"}],
    ],
)
def test_a_seccomp_profile_lets_runc_end(entries: list[dict[str, Any]]) -> None:
    """Without ``close``, or with one that seems to go well, a start never ended, and so no other one by that engine."""
    assert not holds(profile(syscalls=entries))
    assert not holds(profile(defaultErrnoRet=0))
    assert holds(profile(defaultErrnoRet=38))


def test_what_a_profile_may_let_through_is_what_ours_does() -> None:
    """A node has no orchestrator's files, and so it has these names itself."""
    ours = json.loads(next(row[8:] for row in DockerOptions().security if row.startswith("seccomp=")))
    entries = [one for one in ours["syscalls"] if one["action"] == "SCMP_ACT_ALLOW"]
    assert {name for one in entries for name in one["names"]} == CALLS
    assert holds(json.dumps(ours))
    for one in entries:
        if one.get("args"):
            assert not holds(json.dumps({**ours, "syscalls": [NEEDED, {**one, "args": []}]})), one["names"]


@pytest.mark.parametrize(
    ("arches", "good"),
    [
        ({}, True),
        ({"archMap": [{"architecture": "SCMP_ARCH_X86_64", "subArchitectures": []}]}, True),
        ({"archMap": [{"architecture": "SCMP_ARCH_X86_64"}]}, True),
        ({"architectures": ["SCMP_ARCH_X86_64"]}, True),
        ({"archMap": [{"architecture": "SCMP_ARCH_X86_64", "subArchitectures": ["SCMP_ARCH_X86"]}]}, False),
        ({"archMap": [{"architecture": "SCMP_ARCH_X86_64", "SubArchitectures": ["SCMP_ARCH_X86"]}]}, False),
        ({"archMap": {"architecture": "SCMP_ARCH_X86_64"}}, False),
        ({"architectures": ["SCMP_ARCH_X86_64", "SCMP_ARCH_X86"]}, False),
        ({"architectures": ["SCMP_ARCH_X32"]}, False),
        ({"architectures": "SCMP_ARCH_X86"}, False),
    ],
)
def test_a_seccomp_profile_is_for_the_machines_own_calls_alone(arches: dict[str, Any], good: bool) -> None:
    """In 32 bits one call makes all sockets, and the filter does not see of which family."""
    assert holds(profile(**arches)) is good


def made_by(*values: int, **more: Any) -> dict[str, Any]:
    """Sockets with these arguments, the second of which is free."""
    args = [{"index": 2 * at, "value": value, "op": "SCMP_CMP_EQ", **more} for at, value in enumerate(values)]
    return allowed("socket", args=args)


@pytest.mark.parametrize(
    ("entry", "good"),
    [
        (allowed("read", "recvmsg"), True),
        (made_by(16, 12), True),
        ({"names": ["socketpair", "socket"], "action": "SCMP_ACT_ERRNO"}, True),
        # By one of AF_UNIX it is given one of another network; half of a pair takes a name, and what is sent to it.
        *((made_by(family), False) for family in (1, 2, 10)),
        (allowed("read", "socketpair"), False),
        (allowed("socketpair", args=[OF_FAMILY]), False),
        ({"name": "socketpair", "action": "SCMP_ACT_ALLOW"}, False),
        (made_by(16, 0), False),
        (made_by(16, 16), False),
        (made_by(16), False),
        (made_by(17), False),
        (made_by(16, 12, op="SCMP_CMP_NE"), False),
        (allowed("socket"), False),
        (allowed("read", "socket", args=[]), False),
        ({"name": "socket", "action": "SCMP_ACT_ALLOW"}, False),
        ({**made_by(16, 0), "action": "SCMP_ACT_LOG"}, False),
    ],
)
def test_by_the_profile_of_a_guard_nobody_asks_the_kernel_for_links_of_the_machine(
    entry: dict[str, Any], good: bool
) -> None:
    """Its right is one over every network that a socket for routes can name, and it names the machine's by a number."""
    assert keeps_in(profile(entry)) is good


@pytest.mark.parametrize(
    "text",
    [
        profile(defaultAction="SCMP_ACT_ALLOW"),
        profile(DefaultAction="SCMP_ACT_ALLOW"),
        profile().replace("{", '{"defaultAction": "SCMP_ACT_ALLOW", ', 1),
        profile(listenerPath="/run/x"),
        "unconfined",
        "[]",
        "[" * 100_000,
    ],
)
def test_a_profile_that_holds_nothing_is_refused(text: str) -> None:
    assert not holds(text)
