"""``skytether echo``: the UDP echo of a site, for robots to measure and to find out what the network lets through."""

from __future__ import annotations

from typing import Annotated

import typer

from skytether.bridge.echo import EchoServer

from ..end_signal import EndSignal
from ..output import console, fail


def echo(
    host: Annotated[str, typer.Option(help="Address to listen on.")] = "0.0.0.0",  # noqa: S104 - it is for others
    port: Annotated[int, typer.Option(min=0, max=65_535, help="UDP port; 0: any free one.")] = 8600,
) -> None:
    """Answer UDP echoes until interrupted. Never sends more than it gets, little to each address, needs no token.

    Robots name it in robot.yaml under task.echoes, by site; `skytether doctor` uses it to look at the network.
    """
    end = EndSignal()
    try:
        with EchoServer(host, port) as server:
            console.print(f"echo on UDP {server.address[0]}:{server.address[1]}", markup=False)
            end.wait()
    except OSError as error:
        fail(f"cannot listen on UDP {host}:{port}: {error.strerror}; give another with --host or --port")
