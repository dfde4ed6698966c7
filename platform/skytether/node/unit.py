"""The unit of systemd that runs a node: made from what it may need, and nothing more."""

from __future__ import annotations

import shlex
import subprocess
import sys
from pathlib import Path

from .store import DEFAULT_FOLDER, NodeError

NAME = "skytether-node.service"
UNITS = Path("/etc/systemd/system")
_PATIENCE_S = 60.0
_TOO_OFTEN = 3
"""Starts of a unit after which it is no accident."""
_TEXT = """\
# A machine that joined an orchestrator as a site: it calls there, and nothing calls it but probes of its echo.
# Written by `skytether site join`; `skytether site leave` takes it away.
[Unit]
Description=Skytether node
Wants=network-online.target
After=network-online.target docker.service
StartLimitIntervalSec=0

[Service]
# Root without any right but to read and to end processes: the engine's socket is root's, and whoever may use it is root
# anyway. Reports are in volumes that belong to services, and a container that may be in the machine's network is ended.
ExecStart={program} site run --folder {folder}
Restart=always
RestartSec=2
UMask=0077
NoNewPrivileges=yes
CapabilityBoundingSet=CAP_DAC_READ_SEARCH CAP_KILL
ProtectSystem=strict
ReadWritePaths={folder}
ProtectHome={home}
PrivateTmp=yes
PrivateDevices=yes
PrivateMounts=yes
ProtectClock=yes
ProtectHostname=yes
ProtectKernelLogs=yes
ProtectKernelModules=yes
ProtectKernelTunables=yes
ProtectControlGroups=yes
RestrictNamespaces=yes
RestrictRealtime=yes
RestrictSUIDSGID=yes
LockPersonality=yes
MemoryDenyWriteExecute=yes
RestrictAddressFamilies=AF_INET AF_INET6 AF_UNIX AF_NETLINK
SystemCallArchitectures=native
SystemCallFilter=@system-service
SystemCallFilter=~@privileged @resources
SystemCallErrorNumber=EPERM
MemoryMax=512M
LimitNOFILE=65536
TasksMax=256
Environment=OPENBLAS_NUM_THREADS=1

[Install]
WantedBy=multi-user.target
"""


def unit(program: str, folder: Path = DEFAULT_FOLDER, engine: str = "/var/run/docker.sock") -> str:
    """What is in the unit.

    Args:
        program: What is run, with its first arguments.
        folder: Of the node.
        engine: The engine's socket: one in a home, or of a user's session, is not hidden.
    """
    home = "no" if engine.startswith(("/home/", "/root/", "/run/user/")) else "yes"
    if any(program.startswith(hidden) for hidden in ("/home/", "/root/")):
        home = "read-only" if home == "yes" else home
    return _TEXT.format(program=program, folder=folder, home=home)


def own_program() -> str:
    """How the program that runs now is started."""
    beside = Path(sys.executable).with_name("skytether")
    if beside.exists():
        return shlex.quote(str(beside))
    return f"{shlex.quote(sys.executable)} -m skytether.cli"


def install(text: str, units: Path = UNITS) -> None:
    """Write the unit, and start it, now and at each boot.

    Raises:
        NodeError: It does not start; nothing of it is left.
    """
    path = units / NAME
    try:
        path.write_text(text)
        path.chmod(0o644)
        _systemctl("daemon-reload")
        _systemctl("enable", "--now", NAME)
    except (OSError, NodeError) as error:
        remove(units)
        raise NodeError(f"the unit {path} cannot be started: {error}") from error


def trouble() -> str:
    """Why the unit does not come up, where it was begun again and again; empty: nothing says so."""
    try:
        shown = _systemctl("show", "--property=NRestarts", "--value", NAME)
        if int(shown or 0) < _TOO_OFTEN:
            return ""
        last = _said("journalctl", "-u", NAME, "-n", "3", "-o", "cat", "--no-pager")
    except (NodeError, ValueError):
        return ""
    return f"{NAME} ended {shown} times; its log ends with: {' / '.join(last.splitlines())[-500:]}"


def remove(units: Path = UNITS) -> None:
    """End it, and take it away. May be called again."""
    path = units / NAME
    if path.exists():
        for words in (("disable", "--now", NAME), ("daemon-reload",)):
            try:
                if words[0] == "daemon-reload":
                    path.unlink(missing_ok=True)
                _systemctl(*words)
            except NodeError:
                path.unlink(missing_ok=True)


def _systemctl(*words: str) -> str:
    return _said("systemctl", *words)


def _said(*words: str) -> str:
    try:
        done = subprocess.run(
            words,
            capture_output=True,
            text=True,
            timeout=_PATIENCE_S,
            check=False,
        )
    except (OSError, subprocess.TimeoutExpired) as error:
        raise NodeError(f"{words[0]}: {error}") from error
    if done.returncode:
        why = done.stderr.strip().splitlines()
        raise NodeError(f"{' '.join(words)}: {why[-1] if why else f'exit status {done.returncode}'}")
    return done.stdout.strip()
