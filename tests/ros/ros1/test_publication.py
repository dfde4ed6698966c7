"""Queues of a publication, on real sockets of loopback but without a master."""

import asyncio
import os
import socket

import pytest

from skytether.ros.ros1.publication import Publication
from skytether.ros.ros1.tcpros import pack_frame, pack_header, read_frame, read_header
from skytether.ros.ros2.native.side.comers import FINDS_S


def run(work, **options):
    """Call work(publication, connect) in a loop in which the publication is served."""

    async def main():
        loop = asyncio.get_running_loop()

        def soon(callback):
            loop.call_soon_threadsafe(callback)
            return True

        options.setdefault("latched", False)
        options.setdefault("queue", 5)
        publication = Publication("/me", soon, "/big", "std_msgs/String", "a" * 32, "string data", **options)

        async def serve(reader, writer):
            try:
                await publication.serve(await read_header(reader), reader, writer)
            except OSError:
                pass
            finally:
                writer.close()

        server = await asyncio.start_server(serve, "127.0.0.1", 0)
        address = server.sockets[0].getsockname()

        async def connect(**header):
            sock = socket.socket()
            sock.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 4096)
            sock.setblocking(False)
            await loop.sock_connect(sock, address)
            reader, writer = await asyncio.open_connection(sock=sock, limit=4096)
            fields = {"callerid": "/you", "topic": "/big", "type": "*", "md5sum": "*", **header}
            writer.write(pack_header(fields))
            return reader, writer, await read_header(reader)

        async with server:
            try:
                await asyncio.wait_for(work(publication, connect), 30)
            finally:
                publication.close()

    asyncio.run(main())


def test_a_slow_subscriber_loses_the_oldest_and_gets_the_newest():
    async def work(publication, connect):
        reader, writer, header = await connect()
        assert (header["md5sum"], header["message_definition"]) == ("a" * 32, "string data")
        size, count = 200_000, 100
        for number in range(count):
            publication.publish(number.to_bytes(4) + bytes(size))
            await asyncio.sleep(0)
        got = []
        while not got or got[-1] != count - 1:
            frame = await read_frame(reader)
            assert len(frame) == size + 4
            got.append(int.from_bytes(frame[:4]))
        assert got == sorted(got)
        assert len(got) < count
        assert got[-5:] == list(range(count - 5, count))
        writer.close()

    run(work)


def test_messages_are_held_for_a_first_subscriber_and_a_latched_one_for_all():
    async def held(publication, connect):
        publication.publish(b"goal")
        await asyncio.sleep(0.01)
        reader, writer, _ = await connect()
        assert await read_frame(reader) == b"goal"
        publication.publish(b"next")
        assert await read_frame(reader) == b"next"
        writer.close()

    run(held, hold_s=60.0)

    async def latched(publication, connect):
        publication.publish(b"old")
        publication.publish(b"map")
        await asyncio.sleep(0.01)
        for _ in range(2):
            reader, writer, header = await connect()
            assert header["latching"] == "1"
            assert await read_frame(reader) == b"map"
            writer.close()

    run(latched, latched=True)


def test_who_begins_to_listen_after_somebody_has_left_counts():
    """Beside a recorder, say, the wheels' node may have been started again; who only comes besides does not count.

    Nor does anybody know who was told something by one that was killed, and in whose place this one is.
    """
    now = 100.0

    async def work(publication, connect):
        async def listen(count, name):
            _, writer, _ = await connect(callerid=name)
            writers.append(writer)
            while len(publication.subscribers) != count:
                await asyncio.sleep(0.001)

        nonlocal now
        writers = []
        await listen(1, "/recorder")
        await listen(2, "/base")
        assert publication.renewed == 2
        now += FINDS_S
        publication.renewed = 0
        writers[1].close()
        while len(publication.subscribers) != 1:
            await asyncio.sleep(0.001)
        await listen(2, "/echo")  # may be it, by another name
        await listen(3, "/base")
        assert publication.renewed == 2
        await listen(4, "/other")
        assert publication.renewed == 2
        for writer in writers:
            writer.close()

    run(work, clock=lambda: now)


def test_what_was_wanted_before_somebody_came_is_no_first_word_for_him():
    async def work(publication, connect):
        _, first, _ = await connect(callerid="/base")
        while not publication.subscribers:
            await asyncio.sleep(0.001)
        first.close()
        while publication.subscribers:
            await asyncio.sleep(0.001)
        before = publication.renewed
        reader, second, _ = await connect(callerid="/base")
        while not publication.subscribers:
            await asyncio.sleep(0.001)
        publication.publish(b"fast", renewed=before)
        publication.publish(b"stand", renewed=publication.renewed)
        publication.publish(b"goes on", renewed=publication.renewed)
        assert [await read_frame(reader), await read_frame(reader)] == [b"stand", b"goes on"]
        second.close()

    run(work)


def test_where_it_is_known_who_turns_the_wheels_nobody_else_counts():
    async def work(publication, connect):
        for name, renewed in (("/tool", 0), ("/tool", 0), ("/base", 1), ("/tool", 1), ("/base", 2)):
            _, writer, _ = await connect(callerid=name)
            while not publication.subscribers:
                await asyncio.sleep(0.001)
            assert publication.renewed == renewed
            writer.close()
            while publication.subscribers:
                await asyncio.sleep(0.001)

    run(work, awaited=["/base"])


def test_who_reads_no_more_and_ends_keeps_no_descriptor():
    """A stranger who did that had a gate use up all that it may have."""

    async def work(publication, connect):
        before = len(os.listdir("/proc/self/fd"))
        _, writer, _ = await connect()
        writer.transport.pause_reading()
        for _ in range(50):
            publication.publish(bytes(100_000))
            await asyncio.sleep(0.001)
        writer.write_eof()
        while publication.subscribers:
            await asyncio.sleep(0.001)
        while len(os.listdir("/proc/self/fd")) > before + 1:
            await asyncio.sleep(0.001)
        writer.transport.abort()

    run(work)


def test_a_node_whose_connection_has_ended_is_missed_for_as_long_as_it_wants_the_topic():
    now, graph = [100.0], ["/you", "/other"]

    def missed():
        return publications[0].is_missed(lambda: graph)

    async def leave(publication, connect, caller="/you"):
        _, writer, _ = await connect(callerid=caller)
        writer.close()
        while publication.subscribers:
            await asyncio.sleep(0.001)

    publications = []

    async def work(publication, connect):
        publications.append(publication)
        await leave(publication, connect)
        assert not missed(), "it may be about to come back"
        at = []
        for step in range(200):
            now[0] = 101.0 + step
            at += [step] if missed() else []
        assert at == [0, 2, 6, 14, 30, 62, 94, 126, 158, 190], "it may have crashed, or its port is closed for long"
        await leave(publication, connect)
        now[0] += 1.0
        assert missed()
        _, writer, _ = await connect()
        while not publication.subscribers:
            await asyncio.sleep(0.001)
        now[0] += 100.0
        assert not missed(), "it is back"
        writer.close()
        while publication.subscribers:
            await asyncio.sleep(0.001)
        await leave(publication, connect, "/left")
        now[0] += 1.0
        graph.remove("/you")
        assert not missed(), "they want it no more"

    run(work, clock=lambda: now[0])


def test_what_is_too_old_by_the_time_that_it_is_sent_is_not():
    """The process stood still between `publish` and the thread of the node, or before a slow subscriber had room."""
    now = 100.0

    async def work(publication, connect):
        nonlocal now
        reader, writer, _ = await connect()
        while not publication.subscribers:
            await asyncio.sleep(0.001)
        publication.publish(b"old", until=100.1)
        now = 102.0
        publication.publish(b"of any age")
        publication.publish(b"new", until=102.1)
        assert [await read_frame(reader) for _ in range(2)] == [b"of any age", b"new"]
        publication.publish(bytes(16_000_000))  # now the subscriber is slow
        await asyncio.sleep(0.01)
        publication.publish(b"waits", until=102.1)
        await asyncio.sleep(0.01)
        now = 103.0
        publication.publish(b"last", until=103.1)
        assert len(await read_frame(reader)) == 16_000_000
        assert await read_frame(reader) == b"last"
        writer.close()

    run(work, clock=lambda: now)


@pytest.mark.parametrize(
    "header", [{"md5sum": "b" * 32, "type": "std_msgs/String"}, {"md5sum": "*", "type": "std_msgs/Bool"}]
)
def test_another_type_is_refused_with_both_sums_and_named_once(header, caplog):
    async def work(publication, connect):
        for _ in range(3):
            _, writer, answer = await connect(**header)
            assert "a" * 32 in answer["error"]
            assert header["md5sum"] in answer["error"]
            writer.close()
        assert publication.subscribers == []

    run(work)
    assert len(caplog.records) == 1


def test_frames_are_the_message_behind_its_length():
    assert pack_frame(memoryview(b"abc")) == b"\x03\0\0\0abc"
