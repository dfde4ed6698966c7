"""Network namespaces for experiments: a network of one's own, apart from the machine's. Needs root and Linux.

A namespace made here has no name. It lives as long as a descriptor to it is open or a process is in it, so nothing
stays behind however a program ends, not even when it is killed. Devices inside end with it.
"""

from __future__ import annotations

import ctypes
import os
import subprocess
import sys
import threading
from collections.abc import Callable
from types import TracebackType
from typing import TypeVar

_CLONE_NEWNET = 0x40000000

_T = TypeVar("_T")


class NetworkError(Exception):
    """The system refused a namespace, a device or a setting; the text says which and what is needed."""


def why_unavailable() -> str | None:
    """One sentence when this process may not make namespaces and TUN devices here; None when it may."""
    if sys.platform != "linux":
        return "network namespaces exist on Linux only"
    if not os.access("/dev/net/tun", os.R_OK | os.W_OK):
        return "/dev/net/tun cannot be opened: run as root"
    try:
        Namespace().close()
    except NetworkError as error:
        return str(error)
    return None


def enter(path: str) -> None:
    """Move this thread, and what it starts from now on, into a namespace.

    Args:
        path: `Namespace.path` of a process that is still alive.

    Raises:
        NetworkError: The namespace is gone, or this needs root.
    """
    try:
        descriptor = os.open(path, os.O_RDONLY | os.O_CLOEXEC)
    except OSError as error:
        raise NetworkError(f"the network namespace {path} is gone") from error
    try:
        _system("setns", descriptor, _CLONE_NEWNET)
    finally:
        os.close(descriptor)


class Namespace:
    """A new, empty network namespace with its loopback device up.

    Attributes:
        path: For `enter`, in any process, while this object is open.
    """

    def __init__(self) -> None:
        """Make it.

        Raises:
            NetworkError: This needs root.
        """
        self._descriptor = _in_new_thread(_unshare)
        self.path = f"/proc/{os.getpid()}/fd/{self._descriptor}"
        self.ip("link", "set", "lo", "up")

    def run(self, function: Callable[[], _T]) -> _T:
        """Call a function inside, in a thread of its own, and return what it returns.

        Sockets opened and programs started there stay inside.
        """

        def inside() -> _T:
            enter(self.path)
            return function()

        return _in_new_thread(inside)

    def ip(self, *arguments: str) -> None:
        """Run ``ip ARGUMENTS`` inside.

        Raises:
            NetworkError: With what `ip` said.
        """
        try:
            self.run(lambda: subprocess.run(["ip", *arguments], check=True, capture_output=True, text=True))  # noqa: S607 - wherever the system has it
        except FileNotFoundError as error:
            raise NetworkError("the program 'ip' is missing: install iproute2") from error
        except subprocess.CalledProcessError as error:
            raise NetworkError(f"'ip {' '.join(arguments)}' failed: {error.stderr.strip()}") from error

    def sysctl(self, name: str, value: str) -> None:
        """Set a kernel setting of this namespace, ``net.ipv4.tcp_congestion_control``.

        Raises:
            NetworkError: There is no such setting, or it does not take the value.
        """

        def write() -> None:
            with open("/proc/sys/" + name.replace(".", "/"), "w") as file:
                file.write(value)

        try:
            self.run(write)
        except OSError as error:
            raise NetworkError(f"sysctl {name}={value} failed: {error.strerror}") from error

    def close(self) -> None:
        """Let go of it. It ends with the last process inside. May be called again."""
        if self._descriptor >= 0:
            os.close(self._descriptor)
            self._descriptor = -1

    def __enter__(self) -> Namespace:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()


def _unshare() -> int:
    _system("unshare", _CLONE_NEWNET)
    return os.open("/proc/thread-self/ns/net", os.O_RDONLY | os.O_CLOEXEC)


def _system(call: str, *arguments: int) -> None:
    """One of the C library's calls that Python names only from 3.12 on."""
    library = ctypes.CDLL(None, use_errno=True)
    if getattr(library, call)(*arguments) != 0:
        number = ctypes.get_errno()
        raise NetworkError(f"network namespaces are not permitted here ({os.strerror(number)}): run as root")


def _in_new_thread(function: Callable[[], _T]) -> _T:
    """A namespace belongs to a thread, so whoever changes it must be one that ends."""
    results: list[_T] = []
    errors: list[BaseException] = []

    def run() -> None:
        try:
            results.append(function())
        except BaseException as error:  # handed to the caller
            errors.append(error)

    thread = threading.Thread(target=run, name="namespace", daemon=True)
    thread.start()
    thread.join()
    if errors:
        raise errors[0]
    return results[0]
