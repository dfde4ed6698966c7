"""A Docker engine of a test's own, which it may kill and stop: with its own folders, socket and network namespace.

It runs beside the engine that the machine has, shares nothing with it but the programs, and gets its images from it.
"""

from __future__ import annotations

import json
import os
import secrets
import shutil
import signal
import subprocess
import tempfile
import time
from pathlib import Path

PATIENCE = 30.0
_PATH = "/usr/local/sbin:/usr/local/bin:/usr/sbin:/usr/bin:/sbin:/bin"
"""For the engine: a runtime that is a script is begun by the system's Python, several times for each container."""


class OwnEngine:
    """``dockerd`` with the ``containerd`` that it starts."""

    def __init__(self) -> None:
        self.folder = Path(tempfile.mkdtemp(prefix="skytether-engine-"))  # short: a socket's path has 107 bytes at most
        self.address = f"unix://{self.folder}/engine.sock"
        self._namespace = f"sky-engine-{secrets.token_hex(4)}"
        self._process: subprocess.Popen[bytes] | None = None
        subprocess.run(["ip", "netns", "add", self._namespace], check=True)
        # Only the network is its own: what `ip netns exec` changes besides, containers would not outlive.
        self._inside = ["nsenter", f"--net=/run/netns/{self._namespace}"]
        subprocess.run([*self._inside, "ip", "link", "set", "lo", "up"], check=True)

    def start(self, *flags: str) -> None:
        """Begin, or begin again over what is left; returns when it answers."""
        command = [*self._inside, "dockerd", "-H", self.address, *_as_the_machines_own(), *flags]
        command += [f"--{name}={self.folder}/{name}" for name in ("data-root", "exec-root", "pidfile")]
        with (self.folder / "log").open("ab") as log:
            self._process = subprocess.Popen(command, stdout=log, stderr=log, env={**os.environ, "PATH": _PATH})
        deadline = time.monotonic() + PATIENCE
        while subprocess.run(["docker", "-H", self.address, "version"], capture_output=True).returncode:
            assert self._process.poll() is None, (self.folder / "log").read_text()
            assert time.monotonic() < deadline, (self.folder / "log").read_text()
            time.sleep(0.05)

    def load(self, *images: str) -> None:
        """Copy images from the machine's own engine."""
        saved = subprocess.Popen(["docker", "save", *images], stdout=subprocess.PIPE)
        load = ["docker", "-H", self.address, "load", "-q"]
        subprocess.run(load, stdin=saved.stdout, check=True, stdout=subprocess.DEVNULL)
        assert saved.wait() == 0
        assert saved.stdout is not None
        saved.stdout.close()

    def docker(self, *arguments: str) -> str:
        done = subprocess.run(["docker", "-H", self.address, *arguments], check=True, capture_output=True, text=True)
        return done.stdout.strip()

    def signal(self, number: int) -> None:
        """To both programs; containers are not touched."""
        for pid in self._pids():
            os.kill(pid, number)

    def kill(self) -> None:
        """End both as a crash would; containers run on."""
        assert self._process is not None
        pids = self._pids()
        self.signal(signal.SIGKILL)
        self._process.wait(PATIENCE)
        deadline = time.monotonic() + PATIENCE
        while any(_runs(pid) for pid in pids):
            assert time.monotonic() < deadline
            time.sleep(0.01)
        # A machine that starts its engine again has begun anew, or has its init remove them.
        (self.folder / "pidfile").unlink(missing_ok=True)
        (self.folder / "exec-root/containerd/containerd.pid").unlink(missing_ok=True)

    def close(self) -> None:
        """Nothing is left."""
        if self._process is not None and self._process.poll() is None:
            self.signal(signal.SIGCONT)
            containers = self.docker("ps", "-aq").split()
            if containers:
                self.docker("rm", "-f", *containers)
            self.kill()
        # What would hold a container while there is no engine, and what was about to become one as it was killed: to a
        # node of another test that is a container that goes on though it has ended.
        for pid in {*_mentioning(f"{self.folder}/"), *_mentioning(f"{self.folder}/", "environ")}:
            os.kill(pid, signal.SIGKILL)
        mounts = [line.split()[1] for line in Path("/proc/mounts").read_text().splitlines()]
        for mount in reversed(mounts):
            if mount.startswith(f"{self.folder}/"):
                subprocess.run(["umount", "-l", mount], check=True)
        subprocess.run(["ip", "netns", "del", self._namespace], check=True)
        shutil.rmtree(self.folder)

    def _pids(self) -> list[int]:
        assert self._process is not None
        engine = self._process.pid
        return [engine, *_mentioning(f"{self.folder}/exec-root/containerd/containerd.toml")]


def _as_the_machines_own() -> list[str]:
    """Flags for the runtime that containers have here by default, which a machine may need."""
    asked = ["docker", "info", "--format", '{"all": {{json .Runtimes}}, "default": "{{.DefaultRuntime}}"}']
    known = json.loads(subprocess.run(asked, check=True, capture_output=True, text=True).stdout)
    name = known["default"]
    path = known["all"].get(name, {}).get("path", "")
    return [f"--default-runtime={name}", *([f"--add-runtime={name}={path}"] if path != name else [])]


def _mentioning(text: str, where: str = "cmdline") -> list[int]:
    """Processes with this in their command line, or environment."""
    found = []
    for process in Path("/proc").glob("[0-9]*"):
        try:
            command = (process / where).read_bytes()
        except OSError:  # gone meanwhile
            continue
        if text.encode() in command:
            found.append(int(process.name))
    return found


def _runs(pid: int) -> bool:
    try:
        return Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0] not in "ZX"
    except OSError:
        return False
