"""A real ROS 1 graph for tests: a master and real nodes, each a process of its own, all ended at the end."""

from __future__ import annotations

import contextlib
import os
import signal
import socket
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any
from xmlrpc.client import ServerProxy

import psutil

WAIT_S = 30.0


def wait_for(condition: Callable[[], Any], what: str = "it", seconds: float = WAIT_S) -> Any:
    """Poll until the condition gives something true, and return that."""
    deadline = time.monotonic() + seconds
    while not (found := condition()):
        assert time.monotonic() < deadline, f"waited {seconds:.0f} s for {what} in vain"
        time.sleep(0.02)
    return found


class Ros1Graph:
    """One ROS 1 master at a port of its own.

    Args:
        folder: For logs and ROS_HOME.
        inside: Runs a function where the graph is to be (a network namespace); here if not given.
        port: Of the master; 0: a free one.
    """

    def __init__(self, folder: Path, inside: Callable[[Callable[[], Any]], Any] | None = None, port: int = 0) -> None:
        self.folder = folder
        folder.mkdir(parents=True, exist_ok=True)
        self._inside = inside or (lambda function: function())
        self.port = port or self._inside(_free_port)
        self.uri = f"http://127.0.0.1:{self.port}"
        self._processes: list[subprocess.Popen[bytes]] = []
        self._master: subprocess.Popen[bytes] | None = None

    @property
    def environment(self) -> dict[str, str]:
        kept = {k: v for k, v in os.environ.items() if k in ("HOME", "LANG", "TMPDIR")}
        return {
            **kept,
            "PATH": "/usr/local/sbin:/usr/local/bin:/usr/sbin:/usr/bin:/sbin:/bin",
            "ROS_MASTER_URI": self.uri,
            "ROS_IP": "127.0.0.1",
            "ROS_HOME": str(self.folder),
            "ROS_LOG_DIR": str(self.folder / "log"),
            "PYTHONUNBUFFERED": "1",
        }

    def start_master(self) -> Ros1Graph:
        """Start it; also after `kill_master`, at the same port."""
        self._master = self.start("rosmaster", "--core", "-p", str(self.port))
        wait_for(self.answers, "the ROS master")
        return self

    def kill_master(self) -> None:
        assert self._master is not None
        self._master.kill()
        self._master.wait()

    def answers(self) -> bool:
        def ask() -> bool:
            try:
                with ServerProxy(self.uri) as proxy:
                    return bool(proxy.getPid("/test")[0] == 1)  # type: ignore[index]
            except OSError:
                return False

        return bool(self._inside(ask))

    def start(self, *command: str, **more: Any) -> subprocess.Popen[bytes]:
        """Start a program in the graph; what it says is in ``NAME.log`` unless taken by a pipe."""
        name = Path(command[0]).name
        log = (self.folder / f"{name}.log").open("ab")
        more = {"stdout": log, "stderr": log, "stdin": subprocess.DEVNULL, "env": self.environment, **more}
        process: subprocess.Popen[bytes] = self._inside(
            lambda: subprocess.Popen([*command], start_new_session=True, **more)
        )
        log.close()
        self._processes.append(process)
        return process

    def python(self, script: str, *arguments: str, **more: Any) -> subprocess.Popen[bytes]:
        """Start a script under the Python that has rospy."""
        return self.start("/usr/bin/python3", "-c", script, *arguments, **more)

    def skytether(self, *arguments: str, **more: Any) -> subprocess.Popen[bytes]:
        """Start the command line of Skytether in the graph."""
        environment = {**self.environment, "PATH": os.environ["PATH"], "PYTHONPATH": os.pathsep.join(sys.path)}
        return self.start(sys.executable, "-m", "skytether.cli", *arguments, **{"env": environment, **more})

    def ask(self, *command: str, seconds: float = WAIT_S) -> str:
        """Run a program in the graph to its end, and return what it printed."""
        done = self._inside(
            lambda: subprocess.run(
                [*command], capture_output=True, text=True, timeout=seconds, env=self.environment, check=False
            )
        )
        assert done.returncode == 0, f"{command}: {done.stdout}{done.stderr}"
        return str(done.stdout)

    def call(self, method: str, *arguments: Any) -> Any:
        """Ask the master."""

        def ask() -> Any:
            with ServerProxy(self.uri, allow_none=True) as proxy:
                return getattr(proxy, method)("/test", *arguments)

        code, status, value = self._inside(ask)
        assert code == 1, status
        return value

    def publishers(self, topic: str) -> list[str]:
        return dict(self.call("getSystemState")[0]).get(topic, [])

    def subscribers(self, topic: str) -> list[str]:
        return dict(self.call("getSystemState")[1]).get(topic, [])

    def end(self, process: subprocess.Popen[bytes], number: int = signal.SIGINT) -> int:
        """End one program in order."""
        process.send_signal(number)
        return process.wait(WAIT_S)

    def processes(self) -> list[psutil.Process]:
        """All that live of what was started here, with what they started."""
        home = str(self.folder)
        return [
            process
            for process in psutil.process_iter(["environ", "status"])
            if (process.info["environ"] or {}).get("ROS_HOME") == home
            and process.info["status"] != psutil.STATUS_ZOMBIE
        ]

    def close(self) -> None:
        """End everything that was started here, with all that it started."""
        # Nodes that roscore and roslaunch start lead sessions of their own: all have our folder in their environment.
        while left := self.processes():
            for found in left:
                with contextlib.suppress(psutil.Error):
                    found.kill()
            psutil.wait_procs(left, timeout=WAIT_S)
        for process in reversed(self._processes):
            process.wait()
            for pipe in (process.stdin, process.stdout, process.stderr):
                if pipe is not None:
                    pipe.close()


PACKAGE = """<package format="2"><name>{name}</name><version>1.0.0</version><description>-</description>
<maintainer email="a@b.c">-</maintainer><license>BSD</license>{more}</package>"""
_PLUGINS = """<library path="lib/libimage_proc">
<class name="image_proc/debayer" type="image_proc::DebayerNodelet" base_class_type="nodelet::Nodelet"/>
<class name="image_proc/rectify" type="image_proc::RectifyNodelet" base_class_type="nodelet::Nodelet"/>
</library>"""


def debian_packages(folder: Path) -> dict[str, str]:
    """Debian has the programs of topic_tools and image_proc, but not what roslaunch and pluginlib find them by.

    Args:
        folder: Where to put that.

    Returns:
        Variables that name it.
    """
    share, lib = folder / "share", folder / "lib"
    lib.mkdir(parents=True)
    exported = '<export><nodelet plugin="${prefix}/nodelet_plugins.xml"/></export>'
    depends = "<depend>nodelet</depend>" + exported
    for name, more in (("nodelet", ""), ("topic_tools", ""), ("image_proc", depends)):
        (share / name).mkdir(parents=True)
        (share / name / "package.xml").write_text(PACKAGE.format(name=name, more=more))
    (share / "image_proc" / "nodelet_plugins.xml").write_text(_PLUGINS)
    for name, program in (("topic_tools", "relay"), ("topic_tools", "throttle"), ("image_proc", "image_proc")):
        (share / name / program).symlink_to(f"/usr/lib/{name}/{program}")
    (library,) = Path("/usr/lib").glob("*/libimage_proc.so.0d")
    (lib / "libimage_proc.so").symlink_to(library)
    return {"ROS_PACKAGE_PATH": f"{share}:/usr/share", "CMAKE_PREFIX_PATH": str(folder)}


def _free_port() -> int:
    with socket.socket() as sock:
        sock.bind(("127.0.0.1", 0))
        return int(sock.getsockname()[1])
