"""What an orchestrator may ask of a node's engine: what its Docker sites need, and nothing that is the machine itself.

An engine gives whoever reaches it the whole machine: a container may mount ``/``, or be in the machine's own network.
So a node passes on those calls only that start, watch and end closed containers of ours. All here is pure.

What is asked is named by allow-lists, by method and path and by key of what a container is made of: what an engine
learns in a later version is refused until somebody has thought of it.
"""

from __future__ import annotations

import ipaddress
import json
import re
from collections.abc import Iterable, Mapping, Set
from dataclasses import dataclass
from typing import Any

from skytether.api.health_check import is_borne
from skytether.api.service_report import FILE_NAME

from .seccomp_rules import holds, keeps_in, once

OWNER, NETWORK, OLD_GUARD = "skytether.io/owner", "skytether.io/network", "skytether.io/guard"
"""Labels of what orchestrators made."""
NOBODY = "-"
"""As an owner: the node itself made it, and no orchestrator touches it."""
OPEN = "skytether.io/open"
"""Label of a network that the machine's owner made, and that containers of sites may be in."""
MADE, SEEN = "/networks/create", re.compile(r"/networks/[A-Za-z0-9][A-Za-z0-9_.-]*")
WEIGHED = "/system/df"
"""Says of all that an engine has what it is and how large: of the answer what is ours is passed on only."""
_CONTAINER_ID = "[0-9a-f]{64}"
"""Whole: an engine takes names and beginnings of ids, too, and what these mean may change between two calls."""
_ID = r"([A-Za-z0-9][A-Za-z0-9_.-]*)"
_NETWORK = r"skytether(?:-[A-Za-z0-9_.-]+)?"
_BEFORE = re.compile(r"^/v1\.(?:4[1-9]|[5-9]\d|[1-9]\d\d)(?=/)")
"""Versions of the engine's interface, from the oldest that a site uses on: ``start`` of 1.23 takes a ``HostConfig``."""
_CALLS = tuple(
    (
        methods.split(),
        re.compile(pattern.replace("CID", f"({_CONTAINER_ID})").replace("ID", _ID)),
        kind,
        frozenset(asks.split()),
    )
    for methods, pattern, kind, asks in (
        ("GET HEAD", r"/_ping|/version|/info", "", ""),
        ("GET", r"/events", "listed", "since until filters"),
        ("GET", r"/containers/json", "listed", "all limit size trunc_cmd filters"),
        ("GET", r"/volumes", "listed", "filters"),
        ("GET", WEIGHED, "", "type verbose"),
        ("POST", r"/containers/create", "create", "name"),
        ("POST", r"/containers/prune", "prune", "filters"),
        ("GET", r"/containers/CID/json", "container", ""),
        ("GET", r"/containers/CID/logs", "container", "stdout stderr timestamps follow tail since until"),
        ("GET", r"/containers/CID/stats", "container", "stream one-shot"),
        ("GET", r"/containers/(skytether-[A-Za-z0-9_.-]+)/json", "container", ""),
        ("GET HEAD PUT", r"/containers/CID/archive", "archive", "path"),
        ("POST", r"/containers/CID/start", "container", ""),
        ("POST", r"/containers/CID/kill", "container", "signal"),
        ("POST", r"/containers/CID/wait", "container", "condition"),
        ("POST", r"/containers/CID/update", "update", ""),
        ("DELETE", r"/containers/CID", "container", "v link force"),
        ("GET", r"/images/[A-Za-z0-9](?:[A-Za-z0-9_:@-]|[./](?![./]))*/json", "", ""),
        ("POST", r"/images/create", "pull", "fromImage tag"),
        ("GET", r"/networks/ID", "network seen", ""),
        ("POST", MADE, "network made", ""),
        ("POST", r"/networks/ID/(?:connect|disconnect)", "joined", ""),
        ("DELETE", rf"/networks/({_NETWORK})", "network", ""),
        ("POST", r"/volumes/create", "volume made", ""),
        ("DELETE", r"/volumes/(skytether-[A-Za-z0-9_.-]+|[0-9a-f]{64})", "volume", "force"),
    )
)
_WITH_BODY = {"create", "update", "network made", "joined", "volume made"}
_LIMITS = {"Memory", "MemorySwap", "NanoCpus", "CpuShares"}
_CONTAINER = {"Image", "Healthcheck", "User", "Env", "ExposedPorts", "Labels", "HostConfig", "Entrypoint", "Cmd"}
_CHECK = {"Test", "Interval", "Timeout", "StartPeriod", "StartInterval", "Retries"}
_HOST = _LIMITS | {
    *("NetworkMode", "PortBindings", "Dns", "ExtraHosts", "Init", "ReadonlyRootfs", "CapDrop", "CapAdd", "SecurityOpt"),
    *("PidsLimit", "IpcMode", "Tmpfs", "Mounts", "Devices", "GroupAdd", "DeviceRequests", "LogConfig", "CgroupParent"),
}
_NETWORK_OPTIONS = {"com.docker.network.bridge.name", "com.docker.network.bridge.enable_icc"}
_MOST_LABELS, _MOST_LABELLED, _MOST_OWNER = 64, 8 << 10, 128
"""Of one thing, and bytes of these: an engine tells of all of them whenever it lists what it has."""
PORT = "7600/udp"
"""Inside: where a service's end of the bridge is."""
_OURS = "skytether-"
"""What names of ours begin with: of containers, of networks but for one, and of volumes that outlive their containers.
By any other name, somebody else on this machine could have ours for his own: it is looked for before the beginnings of
ids, and by name where a container starts."""
LOOK = f"{_OURS}look-"
"""What names begin with of containers that the node makes itself, to look at an image; 8 hexadecimal digits follow."""
LOOKS = re.compile(f"/{LOOK}[0-9a-f]{{8}}")
"""Such a name, as an engine says it."""
_BRIDGE = "skt-[0-9A-Za-z]{1,11}"
_IMAGE = r"[A-Za-z0-9][A-Za-z0-9.-]*(?::\d+(?=/))?(?:/[A-Za-z0-9_][A-Za-z0-9_.-]*)*"
_TAG, DIGEST = r"[A-Za-z0-9_][A-Za-z0-9_.-]{0,127}", "sha256:[0-9a-f]{64}"
FOLDER, DATA = "/run/skytether", "/var/lib/skytether"
"""In containers: what is put into the first is for the service, and what it says of itself is in files in there; in the
second a folder is put for what it writes."""
_READ = {f"{FOLDER}/instance/{name}" for name in ("ready.json", FILE_NAME)}
_TMPFS = re.compile(r"(?:(?:size|mode|uid|gid|nr_inodes)=[0-9]+[kmg]?|nosuid|nodev|noexec|exec|rw|ro)")
"""Options of a file system in memory. Others would not make one: ``remount`` makes ``/sys`` as it is writable, and
``bind`` mounts what is there."""
_MOST_PIDS = 1 << 15
"""Of a container's processes and threads."""
_JSON_FILE = {"Type": "json-file"}
_LOG_OPTIONS = {"max-size": re.compile("[1-9][0-9]{0,3}[km]"), "max-file": re.compile("[1-9][0-9]?")}
"""Of a log. By others an engine does what costs the machine and not the container: of a ``tag`` it makes a text, by a
template that may ask for one of any length, and so of any memory; and it keeps lines in memory where it need not wait.
"""
_LAST_PORT = 65_535
_MOST_PORTS = 1
"""Published: each costs the machine a process of root or two."""


@dataclass(frozen=True)
class Call:
    """One request."""

    method: str
    path: str
    """Without what is escaped in it."""
    query: Mapping[str, str]
    body: Any
    """What its JSON says; None: it has none, or is an archive."""


Subject = tuple[str, str]
"""Kind and name of what must be ours: ``containers``, ``networks``, ``volumes``, if it is there at all. What is one of
``seen networks`` may be open to us, too, and so may ``joined networks``, which must be there. ``kept networks`` must be
there and ours: in these a guard has a right that others in there feel. ``guarded`` is a container that is in such ones
alone. ``images`` must not be there, or be from where they are pulled; ``pulled`` must be from a registry that may be
asked."""
_Judgement = tuple[str | None, tuple[Subject, ...]]
"""As `judge` gives it."""


def judge(call: Call, devices: Iterable[str] = ()) -> tuple[str | None, tuple[Subject, ...]]:
    """Why a call is not passed on, in a sentence, and what must be ours before it is.

    Args:
        call: What is asked.
        devices: Files of devices that containers may have.
    """
    path = plain(call.path)
    for methods, pattern, kind, asks in _CALLS:
        if call.method in methods and (found := pattern.fullmatch(path)):
            name = found[1] if found.groups() else ""
            refused, subjects = _judge(kind, name, call, devices)
            return refused or _only(call.query, asks, "the call"), subjects
    return f"{call.method} {path[:100]} is nothing that a site needs", ()


def plain(path: str) -> str:
    """A path without the version of the interface that is meant."""
    return _BEFORE.sub("", path)


def _judge(kind: str, name: str, call: Call, devices: Iterable[str]) -> _Judgement:
    body, expects = call.body, kind in _WITH_BODY
    if expects and not isinstance(body, dict):
        return "the call wants an object", ()
    if body is not None and not expects:
        return "the call has a body", ()
    if expects and (odd := _labels(body)):
        return f"it has {odd}", ()
    match kind:
        case "create":
            return _created(call, devices)
        case "update":
            return _only(body, _LIMITS, "limits"), (("containers", name),)
        case "joined":
            return _joined(name, body)
        case "network made":
            return _network(body), ()
        case "volume made":
            return _volume(body), (("volumes", _text(body, "Name")),)  # or an engine tells what it is that is there
        case "prune":
            return _pruned(call), ()
        case "pull":
            return _pulled(call)
        case "listed":
            return _listed(call), ()
        case "network seen":
            return _network_name(name), (("seen networks", name),)
        case "network":
            return _network_name(name), (("networks", name),)
        case "archive":
            return _archive(call), (("containers", name),)
        case "container" | "volume":
            return None, ((f"{kind}s", name),)
    return None, ()


def _created(call: Call, devices: Iterable[str]) -> _Judgement:
    host = _at(call.body, "HostConfig")
    network = _text(host, "NetworkMode")
    within = network.partition("container:")[2]
    volumes = [one.get("Source") for one in _list(host, "Mounts") if isinstance(one, dict)]
    name = call.query.get("name", _OURS)
    odd = None if name.startswith(_OURS) else f"it is named '{name[:80]}', and ours begin with {_OURS}"
    if LOOKS.fullmatch(f"/{name}"):
        # With one by that name that no engine ends, the node looked at no image any more, whoever's it is.
        odd = f"it is named '{name}', as what the node makes itself"
    return odd or _container(call.body, set(devices)), (
        ("containers", within) if within else ("joined networks", network),
        *((("guarded", within),) if within and host.get("CapAdd") else ()),
        *(("volumes", str(volume)) for volume in volumes if volume),
    )


def _joined(network: str, body: Mapping[str, Any]) -> _Judgement:
    settings = {key: one for key, one in _at(body, "EndpointConfig").items() if one}
    refused = _only(body, {"Container", "EndpointConfig", "Force"}, "the call") or _only(settings, set(), "it")
    container = _text(body, "Container")
    if not re.fullmatch(_CONTAINER_ID, container):
        return "a container is named by its whole id", ()
    return refused or _network_name(network), (("containers", container), ("kept networks", network))


def _pulled(call: Call) -> _Judgement:
    image, tag = call.query.get("fromImage", ""), call.query.get("tag", "")
    good = re.fullmatch(_IMAGE, image) and (re.fullmatch(DIGEST, tag) or re.fullmatch(_TAG, tag))
    return None if good else "a pull names one image", (("pulled", image),)


def _pruned(call: Call) -> str | None:
    filters = _json(call.query.get("filters", ""))
    ours = isinstance(filters, dict) and filters.get("label") in ([OLD_GUARD], {OLD_GUARD: True})
    return None if ours else "only what earlier releases left is pruned"


def _listed(call: Call) -> str | None:
    filters = _json(call.query.get("filters", ""))
    labels = filters.get("label") if isinstance(filters, dict) else None
    ours = isinstance(labels, list) and any(str(one).partition("=")[0] == OWNER for one in labels)
    if not ours or not isinstance(filters, dict):
        return f"only what has the label {OWNER} is listed"
    # By others an engine tells of what is not listed: whether there is a container by a name, and when it was made.
    return _only(filters, {"label", "type", "dangling"}, "a list")


def _archive(call: Call) -> str | None:
    path = call.query.get("path")
    known = path in (FOLDER, DATA) if call.method == "PUT" else path in _READ
    return None if known else f"{str(path)[:80]} is no file that a site asks for"


def _container(body: Mapping[str, Any], devices: set[str]) -> str | None:
    host = _at(body, "HostConfig")
    mode = _text(host, "NetworkMode")
    pids, bindings = host.get("PidsLimit"), [_list(_at(host, "PortBindings"), PORT)]
    checks = (
        _only(body, _CONTAINER, "a container"),
        _only(host, _HOST, "a container"),
        _only(_at(body, "Healthcheck"), _CHECK, "a health check"),
        checked(body.get("Healthcheck")),
        None if OWNER in _at(body, "Labels") else f"it has no label {OWNER}",
        None if re.fullmatch(f"container:{_CONTAINER_ID}|{_ID}", mode) else f"its network is '{mode[:80]}'",
        None if mode.startswith("container:") else _network_name(mode),
        _only(_at(body, "ExposedPorts"), {PORT}, "a container"),
        _only(_at(host, "PortBindings"), {PORT}, "a container"),
        *(published(one) for bound in bindings for one in bound),
        None if all(len(bound) <= _MOST_PORTS for bound in bindings) else "it publishes too many ports",
        # A process of its own as the first may end its first thread and go on: by no engine does it end any more.
        None if host.get("Init") is True else "its first process is not the engine's own (Init)",
        None if host.get("ReadonlyRootfs") is True else "it may change its own files",
        None if type(pids) is int and 0 < pids <= _MOST_PIDS else f"its PidsLimit is {str(pids)[:80]}",
        None if host.get("CapDrop") == ["ALL"] else "it keeps rights of root",
        _rights(host.get("CapAdd") or [], mode),
        _security(host.get("SecurityOpt"), guards=bool(host.get("CapAdd"))),
        None if host.get("CgroupParent", "/") == "/" else "it is to be in a group of other processes",
        None if host.get("IpcMode", "none") in ("none", "private") else "it shares memory with others",
        # Without a type, an engine gives what is set here to its own kind of log, which may be one that goes elsewhere.
        None if (_at(host, "LogConfig") or _JSON_FILE).get("Type") == "json-file" else "its log goes elsewhere",
        _only(_at(host, "LogConfig"), {"Type", "Config"}, "a log"),
        *(_log_option(key, value) for key, value in _at(_at(host, "LogConfig"), "Config").items()),
        *(_tmpfs(path, options) for path, options in _at(host, "Tmpfs").items()),
        *(_mount(mount) for mount in _list(host, "Mounts")),
        *(_device(one, devices) for one in _list(host, "Devices")),
        *(_gpu(one, devices) for one in _list(host, "DeviceRequests")),
    )
    return next(filter(None, checks), None)


def _rights(added: Any, mode: str) -> str | None:
    if not added or (added == ["NET_ADMIN"] and mode.startswith("container:")):
        return None  # the right of a guard, to the network of that container
    return f"it has the rights {str(added)[:80]}"


def _security(options: Any, *, guards: bool) -> str | None:
    given = options if isinstance(options, list) else []
    profiles = [str(one) for one in given if one != "no-new-privileges"]
    if len(profiles) == len(given) or not all(p.startswith("seccomp=") and holds(p[8:]) for p in profiles):
        return "its SecurityOpt lets go of what holds it"
    if guards and not (profiles and all(keeps_in(profile[8:]) for profile in profiles)):
        return "a guard has a seccomp profile by which its right ends at its own network"
    return None


def checked(check: Any) -> str | None:
    """Why a health check would end the engine, in a sentence: of what is asked for, or of a container's description."""
    test = check.get("Test") if isinstance(check, dict) else check
    return None if is_borne(test) else f"its health check {str(test)[:80]} has no command: an engine ends by that"


def published(bound: Any) -> str | None:
    """Why a container is not published there, in a sentence.

    At plain ports it is, of which the node sees whether they are free. Of an address that is none an engine makes all.
    """
    if not isinstance(bound, dict):
        return f"it is published at {str(bound)[:40]}"
    address, port = bound.get("HostIp") or "", bound.get("HostPort") or ""
    plain_port = port == "" or (re.fullmatch("[1-9][0-9]{0,4}", str(port)) and int(port) <= _LAST_PORT)
    if not plain_port or (address and not _is_plain_address(address)):
        return f"it is published at {str(address)[:40]}:{str(port)[:40]}"
    return _only(bound, {"HostIp", "HostPort"}, "a port")


def _is_plain_address(text: Any) -> bool:
    try:
        found = ipaddress.ip_address(str(text))
    except ValueError:
        return False
    return isinstance(text, str) and "%" not in text and getattr(found, "ipv4_mapped", None) is None


def _network_name(name: str) -> str | None:
    """Names that an engine might take for the beginning of an id are not taken."""
    odd = name in ("host", "none", "default") or re.fullmatch("[0-9a-f]+", name)
    return f"its network is '{name[:80]}'" if odd else None


def _tmpfs(path: str, options: Any) -> str | None:
    if ".." in path.split("/"):
        # Where an image has a link before that, it is another path than it reads as: in a volume that others move.
        return f"its file system in memory is at {path[:80]}"
    odd = [one for one in str(options).split(",") if one and not _TMPFS.fullmatch(one)]
    return f"its file system in memory at {path[:80]} is mounted by '{odd[0][:40]}'" if odd else None


def _log_option(key: str, value: Any) -> str | None:
    known = _LOG_OPTIONS.get(key)
    if known and isinstance(value, str) and known.fullmatch(value):
        return None
    return f"its log has {key[:40]} '{str(value)[:40]}', which no site asks for"


def _mount(mount: Any) -> str | None:
    if not isinstance(mount, dict) or mount.get("Type") != "volume":
        return "it mounts something of this machine"
    name = mount.get("Source") or _OURS
    if not str(name).startswith(_OURS):
        return f"it mounts the volume '{str(name)[:80]}', which is not ours"
    options = _at(mount, "VolumeOptions")
    if mount.get("Source") and options.get("NoCopy") is not True:
        # An engine writes into it from the outside, and follows a link that somebody who has it too puts there.
        return "it copies files of its image into a volume that others may have"
    if odd := _labels(options):
        return f"it has a volume with {odd}"
    refused = _only(options, {"Labels", "NoCopy"}, "a volume") or _only(
        mount, {"Type", "Source", "Target", "VolumeOptions"}, "a mount"
    )
    # One that is not there an engine makes: without that, nobody could have or remove it any more.
    unowned = None if OWNER in _at(options, "Labels") else f"it has a volume without the label {OWNER}"
    return refused or unowned


def _device(device: Any, devices: set[str]) -> str | None:
    path = device.get("PathOnHost") if isinstance(device, dict) else device
    if isinstance(device, dict) and isinstance(path, str) and path in devices:
        if device.get("PathInContainer", path) != path:
            # In a volume, an engine makes it on a way that others move meanwhile, to anywhere on the machine.
            return f"it has the device {path[:80]} at another path"
        return _only(device, {"PathOnHost", "PathInContainer", "CgroupPermissions"}, "a device")
    return f"it has the device {str(path)[:80]}, and this machine gives none but by `site join --device {path}`"


def _gpu(request: Any, devices: set[str]) -> str | None:
    if not isinstance(request, dict) or request.get("Driver") != "nvidia" or request.get("Capabilities") != [["gpu"]]:
        return "it asks for odd devices"
    numbers = _list(request, "DeviceIDs")
    closed = [one for one in numbers if not re.fullmatch(r"\d+", str(one)) or f"/dev/nvidia{one}" not in devices]
    if closed or not numbers:
        what = f"/dev/nvidia{str(closed[0])[:20]}" if closed else "/dev/nvidia0"
        return f"it has a GPU, and this machine gives none but by `site join --device {what}`"
    return _only(request, {"Driver", "DeviceIDs", "Capabilities"}, "a GPU")


def _network(body: Mapping[str, Any]) -> str | None:
    options = _at(body, "Options")
    ours = NETWORK in _at(body, "Labels") and body.get("Driver") == "bridge" and not body.get("IPAM")
    if not ours or not re.fullmatch(_BRIDGE, _text(options, "com.docker.network.bridge.name")):
        return "it is no network of ours, which is a bridge of its own"
    if not re.fullmatch(_NETWORK, str(body.get("Name"))):
        return f"the name of a network of ours begins with {_OURS}"
    if body.get("CheckDuplicate") is not True:
        return "another network may have that name: a site asks for CheckDuplicate"
    known = {"Name", "CheckDuplicate", "Driver", "Options", "IPAM", "Labels"}
    return _only(options, _NETWORK_OPTIONS, "a network") or _only(body, known, "a network")


def _volume(body: Mapping[str, Any]) -> str | None:
    if body.get("DriverOpts") or body.get("Driver") not in (None, "", "local"):
        return "the volume is something else of this machine"
    if not str(body.get("Name", "")).startswith(_OURS) or OWNER not in _at(body, "Labels"):
        return "it is no volume of ours"
    return _only(body, {"Name", "Driver", "DriverOpts", "Labels"}, "a volume")


def _labels(given: Mapping[str, Any]) -> str | None:
    labels = _at(given, "Labels")
    if labels.get(OWNER) == NOBODY:  # which is the node's own word: no orchestrator could remove it any more
        return f"the label {OWNER} of what is nobody's"
    owner = str(labels.get(OWNER, ""))
    if len(owner) > _MOST_OWNER or not owner.isascii():  # it is told again and again
        return f"a label {OWNER} of more than {_MOST_OWNER} plain characters"
    if len(labels) > _MOST_LABELS:
        return f"more than {_MOST_LABELS} labels"
    much = sum(len(key) + len(str(value)) for key, value in labels.items()) > _MOST_LABELLED
    return f"labels of more than {_MOST_LABELLED >> 10} KiB" if much else None


def _only(given: Mapping[str, Any], known: Set[str], what: str) -> str | None:
    """Exact keys: an engine takes them in any case, and so knows more spellings than are asked for."""
    odd = sorted(key for key in given if key not in known)
    return f"{what} has '{odd[0][:40]}', which no site asks for" if odd else None


def _at(given: Mapping[str, Any], key: str) -> Mapping[str, Any]:
    found = given.get(key) or {}
    return found if isinstance(found, dict) else {"": found}


def _text(given: Mapping[str, Any], key: str) -> str:
    """Empty where it is none: an engine takes ``null`` for nothing, and not for a word."""
    found = given.get(key)
    return found if isinstance(found, str) else ""


def _list(given: Mapping[str, Any], key: str) -> list[Any]:
    found = given.get(key) or []
    return found if isinstance(found, list) else [found]


def _json(text: str) -> Any:
    try:
        return json.loads(text, object_pairs_hook=once)
    except (ValueError, RecursionError):
        return None
