"""Who joins the network of one that ends is ended, and nobody who wants its end is kept waiting for good."""

import asyncio

import pytest

from skytether.node import join_watch
from skytether.node.cgroups import Cgroups
from skytether.node.join_watch import JoinWatch, Life

X, J, OLD = ("1" * 64, "2" * 64, "3" * 64)


class Machine:
    """What the kernel shows, and what is done there; an engine says nothing unless it is told to."""

    def __init__(self, root, monkeypatch):
        self.root, self.done, self.shims = root, [], {J}
        self.says: type[Exception] | None = TimeoutError
        (root / "pids").mkdir()
        (root / "pids" / "cgroup.procs").write_text("")
        self.stopped = True
        monkeypatch.setattr("skytether.node.join_watch.shims.is_any", self.shims.intersection)
        monkeypatch.setattr("skytether.node.join_watch.shims.resume", self.resume)
        monkeypatch.setattr("skytether.node.join_watch.shims.stop", lambda one, _: self.done.append(("stop", one)))
        monkeypatch.setattr(join_watch, "_MOMENT_S", 0.0)
        monkeypatch.setattr(join_watch, "Cgroups", lambda: Cgroups(root))
        monkeypatch.setattr(Cgroups, "end", lambda _, one: self.done.append(("end", one)))
        monkeypatch.setattr(join_watch, "ask_soon", self.ask)
        monkeypatch.setattr(join_watch, "killed", self.kill)
        monkeypatch.setattr(join_watch, "state_of", self.state)
        monkeypatch.setattr(join_watch, "_LONG_S", 0.0)
        monkeypatch.setattr(join_watch, "_LOOK_S", 0.0)
        self.asked = 0

    def runs(self, container, *, lives=True):
        folder = self.root / "pids" / "docker" / container
        folder.mkdir(parents=True, exist_ok=True)
        (folder / "tasks").write_text("7" if lives else "")

    def resume(self, container):
        self.done.append(("on", container))
        return self.stopped

    async def ask(self, *_, **__):
        self.asked += 1
        if self.says is not None:
            raise self.says

    async def kill(self, _, container):
        self.done.append(("kill", container))

    async def state(self, *_, **__):
        return {"Running": True}

    def watch(self, until, *, first_look_s=0.0):
        """Have one that has ended, or not, be joined by a new one and an old one, until something is so."""

        async def run():
            life = await Life("", X).begin()
            watch = JoinWatch("", X, (J, OLD), life, first_look_s)
            async with asyncio.timeout(10):
                while not until():
                    await asyncio.sleep(0)
            watch.close()

        asyncio.run(run())


@pytest.fixture
def machine(tmp_path, monkeypatch):
    made = Machine(tmp_path, monkeypatch)
    for one in (X, OLD):
        made.runs(one)
    return made


def test_one_that_is_waited_for_goes_on_at_once_where_no_start_is_beyond_asking_for_it(machine):
    """For a moment: much that is asked of the engine for it keeps it silent, too, and nothing was held after that."""
    machine.shims.clear()
    machine.watch(lambda: len(machine.done) > 1)
    assert (machine.asked, machine.done) == (1, [("on", X), ("stop", X)])


@pytest.mark.parametrize("by", ["its end", "another start"])
def test_it_is_not_stopped_where_nobody_has_it_go_on(machine, by):
    machine.shims.clear()
    machine.stopped = by == "its end"

    def ends():
        machine.runs(X, lives=not (machine.done and by == "its end"))
        return machine.asked > 2

    machine.watch(ends)
    assert ("on", X) in machine.done
    assert ("stop", X) not in machine.done


def test_otherwise_a_start_that_takes_long_is_ended_first_and_nobody_else(machine):
    def begins():
        machine.runs(J)
        return ("on", X) in machine.done

    machine.watch(begins)
    assert machine.asked == 4
    assert [one for one in machine.done if one != ("on", X)] == [("end", J)] * 2


@pytest.mark.parametrize("says", [None, ConnectionRefusedError, ValueError])
def test_an_engine_that_is_away_or_says_something_waits_for_nobody(machine, says):
    machine.says = says
    machine.watch(lambda: machine.asked > 9)
    assert machine.done == []


def test_who_joins_one_that_has_ended_is_ended_also_if_that_is_there_again(machine):
    def ends():
        machine.runs(J)
        machine.runs(X, lives=len(machine.done) > 1)
        return len(machine.done) > 9

    machine.watch(ends, first_look_s=60)
    assert ("end", J) in machine.done[-5:]
    assert ("kill", J) in machine.done


def test_who_has_joined_is_not_looked_after_any_more(machine):
    async def run():
        life = await Life("", X).begin()
        watch = JoinWatch("", X, (OLD,), life, 60)
        watch.has_joined(OLD)
        machine.runs(X, lives=False)
        for _ in range(99):
            await asyncio.sleep(0)
        watch.close()

    asyncio.run(run())
    assert machine.done == []
