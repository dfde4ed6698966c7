"""Instances as containers of a Docker engine: on this machine, or elsewhere over SSH or TLS.

``options`` is what a site is told, ``objects`` what is asked of the engine (pure), ``engine`` the way to it, ``images``
and ``network`` what must be there first, ``follow`` what is known of it, ``launch`` one start, ``runtime`` the six
calls of the contract.
"""

from .options import DockerOptions
from .runtime import DockerRuntime

__all__ = ["DockerOptions", "DockerRuntime"]
