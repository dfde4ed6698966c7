"""Which Python has ROS 2."""

from __future__ import annotations

import os
import shutil
import signal
import subprocess
import sys
from collections.abc import Mapping
from pathlib import Path

from ..seam import Ros2Error

NAMED = "SKYTETHER_ROS2_PYTHON"
"""Environment variable that names one."""
OLDEST = (3, 10)
"""ROS 2 Humble's."""
_TRY = f"import sys, rclpy; sys.exit(sys.version_info < {OLDEST})"
_TIMEOUT_S = 60.0


def find_python(named: str | None = None, environment: Mapping[str, str] | None = None) -> str:
    """The Python that ROS 2's rclpy runs in.

    Args:
        named: By the configuration, then no other is tried; None: the first that can import rclpy, of
            `NAMED`, ``python3``, this very one and the system's.
        environment: That it is to run in; None: this process's.

    Raises:
        Ros2Error: None can; the text says what to do.
    """
    environment = os.environ if environment is None else environment
    given = named or environment.get(NAMED)
    candidates = [given] if given else ["python3", sys.executable, "/usr/bin/python3"]
    tried: dict[str, str] = {}
    for name in candidates:
        path = shutil.which(os.path.expanduser(name), path=environment.get("PATH"))
        if path is None:
            tried[name] = "there is no such program"
        elif path not in tried:
            trouble = _trouble(path, environment)
            if not trouble:
                return path
            tried[path] = trouble
    raise Ros2Error(f"no Python with ROS 2 is here ({'; '.join(f'{p}: {t}' for p, t in tried.items())}): {_advice()}")


def _trouble(python: str, environment: Mapping[str, str]) -> str:
    try:
        done = subprocess.run(
            [python, "-c", _TRY],
            capture_output=True,
            text=True,
            timeout=_TIMEOUT_S,
            stdin=subprocess.DEVNULL,
            env=dict(environment),
        )
    except (OSError, subprocess.TimeoutExpired) as error:
        return str(error)
    if done.returncode == 0:
        return ""
    if done.returncode < 0:  # of a small /dev/shm, say, it is SIGBUS
        return f"ends by {signal.Signals(-done.returncode).name} as it imports rclpy"
    lines = done.stderr.strip().splitlines()
    return lines[-1] if lines else f"older than Python {OLDEST[0]}.{OLDEST[1]}"


def _advice() -> str:
    found = sorted(Path("/opt/ros").glob("*/setup.bash"))
    source = found[-1] if found else "/opt/ros/DISTRIBUTION/setup.bash"
    return (
        f"source ROS 2 before (. {source}), or name its Python as ros2.python; without ROS 2 on this machine, a graph "
        "with a Zenoh router is joined with ros2.dialect: rmw_zenoh or ros2dds"
    )
