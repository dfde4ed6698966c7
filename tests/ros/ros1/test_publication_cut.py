"""Whether what is published is known to be heard, behind a real cable that is cut."""

import asyncio
import contextlib
import socket
from math import inf

import pytest
from networks import cable

from skytether.guard.clock import now
from skytether.lab.netns import Namespace
from skytether.ros.ros1.publication import Publication
from skytether.ros.ros1.tcpros import pack_header, read_frame, read_header

PATIENCE_S, PERIOD_S = 0.1, 0.02
HOST, PORT = "10.79.1.1", 7411


class Graph:
    """A publication at one end of a cable, and who listens at the other."""

    def __init__(self, here, there):
        self._here, self._there = here, there

        def soon(callback):
            loop.call_soon_threadsafe(callback)
            return True

        loop = asyncio.get_running_loop()
        kind = "geometry_msgs/Twist"
        self.publication = Publication(
            "/me", soon, "/cmd_vel", kind, "a" * 32, "", latched=False, queue=1, awaited=["/base"]
        )

    async def serve(self, work):
        """Until work(self) is done."""

        async def serve(reader, writer):
            with contextlib.suppress(OSError):
                await self.publication.serve(await read_header(reader), reader, writer)

        listening = self._here.run(lambda: socket.create_server((HOST, PORT)))
        async with contextlib.AsyncExitStack() as self._ends, await asyncio.start_server(serve, sock=listening):
            await work(self)
        self.publication.close()
        await asyncio.sleep(PERIOD_S)  # for the connections to end

    async def listen(self, caller):
        sock = self._there.run(lambda: socket.create_connection((HOST, PORT)))
        reader, writer = await asyncio.open_connection(sock=sock)
        writer.write(pack_header({"callerid": caller, "topic": "/cmd_vel", "type": "*", "md5sum": "*"}))
        await read_header(reader)
        self._ends.callback(writer.close)
        return reader

    def cut(self):
        self._here.ip("link", "set", "to-base", "down")

    def join(self):
        self._here.ip("link", "set", "to-base", "up")

    async def publish_for(self, duration_s, payload=b"velocity"):
        end = now() + duration_s
        while now() < end:
            self.publication.publish(payload, now() + 1.0)
            await asyncio.sleep(PERIOD_S)
        return self.publication.heard(PATIENCE_S)


@pytest.fixture
def run(netns):
    """Call work(graph) in a loop."""

    async def main(work):
        await asyncio.wait_for(Graph(here, there).serve(work), 60)

    with Namespace() as here, Namespace() as there:
        cable(here, there, ("to-base", f"{HOST}/24"), ("eth0", "10.79.1.2/24"))
        yield lambda work: asyncio.run(main(work))


def test_what_a_cut_cable_keeps_is_not_heard_until_it_is_back(run):
    async def work(graph):
        await graph.listen("/recorder")
        assert await graph.publish_for(0.1) is None, "nobody whom it is for"
        await graph.listen("/base")
        heard = await graph.publish_for(0.5)
        assert heard.unread == ()
        graph.cut()
        cut_at = now()
        cut = await graph.publish_for(0.5)
        assert cut.unread == ("/base",)
        assert heard.at <= cut.at < cut_at
        assert graph.publication.heard(inf).unread == ()
        graph.join()
        for _ in range(100):
            back = await graph.publish_for(0.1)
            if not back.unread:
                break
        assert back.at > cut_at + 0.5

    run(work)


def test_what_has_not_got_there_by_the_end_is_not_sent_again(run):
    async def work(graph):
        reader = await graph.listen("/base")
        await graph.publish_for(0.2, b"early")
        graph.cut()
        await graph.publish_for(0.2, b"late")
        graph.publication.close()
        graph.join()
        frames = set()
        with contextlib.suppress(OSError, EOFError):
            async with asyncio.timeout(2.0):
                while True:
                    frames.add(await read_frame(reader))
        assert frames == {b"early"}

    run(work)
