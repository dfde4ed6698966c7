"""Whether what is published is known to be heard, behind a real cable that is cut."""

import asyncio
import socket
import time
from math import inf

import pytest
from networks import cable

from skytether.lab.netns import Namespace
from skytether.ros.ros1.publication import Publication
from skytether.ros.ros1.tcpros import pack_header, read_header

PATIENCE_S = 0.1
HOST, PORT = "10.79.1.1", 7411


@pytest.fixture
def ends():
    """Where who publishes is, and where who listens is."""
    with Namespace() as here, Namespace() as there:
        cable(here, there, ("to-base", f"{HOST}/24"), ("eth0", "10.79.1.2/24"))
        yield here, there


def test_what_a_cut_cable_keeps_is_not_heard_until_it_is_back(ends):
    here, there = ends

    async def main():
        loop = asyncio.get_running_loop()
        publication = Publication(
            "/me",
            lambda callback: bool(loop.call_soon_threadsafe(callback)) or True,
            "/cmd_vel",
            "geometry_msgs/Twist",
            "a" * 32,
            "",
            latched=False,
            queue=1,
            awaited=["/base"],
        )

        async def serve(reader, writer):
            await publication.serve(await read_header(reader), reader, writer)

        async def listen(caller):
            sock = there.run(lambda: socket.create_connection((HOST, PORT)))
            reader, writer = await asyncio.open_connection(sock=sock)
            writer.write(pack_header({"callerid": caller, "topic": "/cmd_vel", "type": "*", "md5sum": "*"}))
            await read_header(reader)
            return writer

        async def publish_for(duration_s):
            end = time.monotonic() + duration_s
            while time.monotonic() < end:
                publication.publish(b"velocity", time.clock_gettime(time.CLOCK_BOOTTIME) + 1.0)
                await asyncio.sleep(0.02)
            return publication.heard(PATIENCE_S)

        server = await asyncio.start_server(serve, sock=here.run(lambda: socket.create_server((HOST, PORT))))
        other = await listen("/recorder")
        assert await publish_for(0.1) is None, "nobody whom it is for"
        base = await listen("/base")
        heard = await publish_for(0.5)
        assert heard.unread == ()
        here.ip("link", "set", "to-base", "down")
        cut_at = time.clock_gettime(time.CLOCK_BOOTTIME)
        cut = await publish_for(0.5)
        assert cut.unread == ("/base",)
        assert heard.at <= cut.at < cut_at
        assert publication.heard(inf).unread == ()
        here.ip("link", "set", "to-base", "up")
        for _ in range(100):
            back = await publish_for(0.1)
            if not back.unread:
                break
        assert back.at > cut_at + 0.5
        for writer in (other, base):
            writer.close()
        publication.close()
        server.close()

    asyncio.run(asyncio.wait_for(main(), 60))
