"""Robots: they ask for services, keep and follow them, move and end them, at any of the orchestrators."""

from __future__ import annotations

import random
import threading
import time
from collections.abc import Callable
from typing import Any

from skytether.api.client import ApiError, Client, Unreachable
from skytether.api.rest import Instance, InstanceCreate, Renew

from .cluster import BOXED, STANDBYS, TOY, WARM, Cluster
from .history import History

LEASE_S = 10.0
RENEW_S = 2.0
_TRIES = 30
_MOST, _PAUSE_S = {TOY: 4, WARM: 4, BOXED: 2}, {TOY: (0.3, 1.0), WARM: (0.3, 1.0), BOXED: (1.0, 3.0)}
"""Of one client: instances at a time, and the time between two requests. Containers take ten times as long to start."""
_SAID = "usual", "usual", "usual", "other"
"""Parameters of services with standbys, which are given to whoever asks for the same ones, and replaced by others."""
_CHANGE_S = 15.0
"""A robot waits so long for what it is to change to."""


class Workload:
    """Clients with their instances, each followed and kept by threads of its own."""

    def __init__(self, cluster: Cluster, history: History, seed: int) -> None:
        self.cluster, self.history = cluster, history
        count = len(cluster.members)
        self.replicas = [cluster.client(number) for number in range(count)]
        self.stopped, self.ended = threading.Event(), threading.Event()
        """No more changes; no more at all."""
        self._lock = threading.Lock()
        self.robots: dict[str, Robot] = {}
        self._draining = False
        self._threads: list[threading.Thread] = []
        self._random = random.Random(f"{seed} robots")
        for number, service in enumerate((TOY if cluster.engine is None else BOXED, TOY, TOY, WARM)):
            one = Asker(self, f"client{number}", service, random.Random(f"{seed} {number}"))
            self.spawn(one.run, one.name)

    def spawn(self, call: Callable[[], object], name: str) -> None:
        thread = self.cluster.thread(call, name)
        with self._lock:
            self._threads.append(thread)

    def call(self, name: str, who: str, replica: int, ask: Callable[[Client], Instance | None], **fields: Any) -> Any:
        """One request to one orchestrator, noted; gives the answer, True if there is none, or None if it failed."""
        number, note = self.history.number(), self.history.add
        common = {"op": name, "n": number, "who": who, "replica": replica}
        note("op", step="invoke", lease_s=LEASE_S, **common, **fields)
        try:
            answer = ask(self.replicas[replica])
        except ApiError as error:
            note("op", step="fail", status=error.problem.status, reason=str(error), **common)
        except Unreachable as error:
            note("op", step="unknown", reason=str(error)[:200], **common)
        except Exception as error:  # the client promises that there is no other
            note("op", step="fail", status=500, reason=repr(error), **common)
        else:
            told = {"id": fields.get("id"), "state": "", "reason": ""}
            if answer is not None:
                told = {"id": answer.id, "state": answer.state.value, "reason": answer.reason}
                told |= {"successor": answer.successor} if answer.successor else {}
            note("op", step="ok", **common, **told)
            return answer or True
        return None

    def adopt(self, instance: str, follow: bool = True) -> Robot:
        """A robot for an instance that was acknowledged."""
        with self._lock:
            if instance in self.robots:
                return self.robots[instance]
            seed = self._random.random()
            robot = self.robots[instance] = Robot(self, instance, random.Random(seed))
            if self._draining:
                robot.leave()
        self.spawn(robot.keep, f"robot {instance}")
        if follow:
            self.spawn(robot.follow, f"follower {instance}")
        return robot

    def delete(self, instance: str, who: str, rng: random.Random) -> bool:
        """Until an orchestrator has acknowledged it."""
        for _ in range(_TRIES):
            ask = lambda client: client.delete_instance(instance)  # noqa: E731 (its type is known from call)
            if self.call("delete", who, rng.randrange(len(self.replicas)), ask, id=instance):
                return True
            time.sleep(0.3)
        return False

    def quiesce(self) -> None:
        """No more changes; what is there is kept."""
        self.stopped.set()

    def drain(self) -> None:
        """End all that is there. What robots hear of only now nobody keeps: it ends with its lease."""
        rng = random.Random(0)
        with self._lock:
            self._draining = True
            robots = list(self.robots.values())
        for robot in robots:
            if not robot.over:
                self.delete(robot.instance, "drain", rng)

    def close(self, patience: float) -> None:
        """Wait for all threads; those that follow streams end with these."""
        deadline = time.monotonic() + patience
        self.ended.set()
        for thread in list(self._threads):
            thread.join(max(0.0, deadline - time.monotonic()))
        for client in self.replicas:
            client.close()


class Asker:
    """Asks for instances, moves and ends them; some it forgets, as robots do that vanish."""

    def __init__(self, workload: Workload, name: str, service: str, rng: random.Random) -> None:
        self._workload, self.name, self._service, self._random = workload, name, service, rng
        self._mine: list[Robot] = []
        self._count = 0

    def run(self) -> None:
        while not self._workload.stopped.wait(self._random.uniform(*_PAUSE_S[self._service])):
            mine = dict.fromkeys(one for robot in self._mine for one in (robot, robot.successor) if one)
            self._mine = [robot for robot in mine if not robot.over]
            choice = self._random.random()
            if not self._mine or (len(self._mine) < _MOST[self._service] and choice < 0.5):
                self._create()
            elif choice < 0.75:
                robot = self._mine.pop(self._random.randrange(len(self._mine)))
                robot.leave()
                self._workload.delete(robot.instance, self.name, self._random)
            elif choice < 0.9 and self._service != BOXED:
                self._move(self._random.choice(self._mine))
            elif choice < 0.95:
                robot = self._mine.pop(self._random.randrange(len(self._mine)))
                self._workload.history.add(
                    "op", op="vanish", step="ok", n=0, who=self.name, replica=-1, id=robot.instance
                )
                robot.leave()

    def _create(self) -> None:
        self._count += 1
        key = f"{self.name} {self._count}"
        say = self._random.choice(_SAID) if self._service in STANDBYS else key
        asked = InstanceCreate(robot=self.name, service=self._service, lease_s=LEASE_S, params={"say": say})
        made: list[Instance] = []

        def ask(client: Client) -> Instance:
            return client.create_instance(asked, idempotency_key=key)

        def at(replica: int) -> None:
            answer = self._workload.call("create", self.name, replica, ask, key=key)
            if answer is not None:
                made.append(answer)

        for _ in range(_TRIES):
            first, second = self._random.sample(range(len(self._workload.replicas)), 2)
            if self._random.random() < 0.3:  # a retry that overtakes the request
                other = self._workload.cluster.thread(lambda: at(second), f"{key} again")  # noqa: B023 (joined below)
                at(first)
                other.join()
            else:
                at(first)
            if made:
                break
            time.sleep(0.3)
        if made:
            self._mine.append(self._workload.adopt(made[0].id, follow=self._random.random() < 0.7))

    def _move(self, robot: Robot) -> None:
        replica = self._random.randrange(len(self._workload.replicas))
        ask = lambda client: client.migrate_instance(robot.instance)  # noqa: E731
        coming = self._workload.call("migrate", self.name, replica, ask, of=robot.instance)
        if coming is not None:
            self._mine.append(self._workload.adopt(coming.id))
            robot.change_to(coming.id)


class Robot:
    """Keeps one instance, asking any orchestrator that answers; and follows what becomes of it."""

    def __init__(self, workload: Workload, instance: str, rng: random.Random) -> None:
        self._workload, self.instance, self._random = workload, instance, rng
        self.running = threading.Event()
        self.over = False
        """It has ended, or is left."""
        self.successor: Robot | None = None
        """What it changes to as soon as that runs."""
        self._left = threading.Event()
        self._lock = threading.Lock()

    def leave(self) -> None:
        """Renew no more."""
        self.over = True
        self._left.set()

    def change_to(self, coming: str) -> None:
        """Make before break: it was moved, or a standby takes over."""
        with self._lock:
            if self.over or self.successor is not None:
                return
            successor = self.successor = self._workload.adopt(coming)
        self._workload.spawn(lambda: self._change(successor), f"change to {coming}")

    def _change(self, successor: Robot) -> None:
        if not successor.running.wait(_CHANGE_S):
            self.successor = None
        elif not self.over:
            self.leave()
            self._workload.delete(self.instance, "robot", self._random)

    def keep(self) -> None:
        while not self._left.wait(RENEW_S * self._random.uniform(0.8, 1.2)) and not self._workload.ended.is_set():
            replicas = list(range(len(self._workload.replicas)))
            self._random.shuffle(replicas)
            for replica in replicas:
                ask = lambda client: client.renew_instance(self.instance, Renew())  # noqa: E731
                answer = self._workload.call("renew", "robot", replica, ask, id=self.instance)
                if answer is None:
                    continue
                if answer.state.final or answer.state.value == "stopping":
                    self.leave()
                elif answer.state.value == "running":
                    self.running.set()
                if answer.successor:
                    self.change_to(answer.successor)
                break

    def follow(self) -> None:
        """All events, over as many connections as it takes."""
        stream, note = self._workload.history.number(), self._workload.history.add
        note("stream", stream=stream, id=self.instance, step="begin")
        replicas = list(range(len(self._workload.replicas)))
        self._random.shuffle(replicas)
        after = 0
        with self._workload.cluster.client(*replicas) as client:
            while True:
                try:
                    for event in client.watch(self.instance, after):
                        after = event.id
                        fields = {"event": event.id, "state": event.state.value, "reason": event.reason}
                        note("event", stream=stream, id=self.instance, **fields)
                        if event.state.final:
                            note("stream", stream=stream, id=self.instance, step="end")
                            return
                    note("stream", stream=stream, id=self.instance, step="again", reason="it ended")
                except (ApiError, Unreachable) as error:
                    note("stream", stream=stream, id=self.instance, step="again", reason=str(error)[:200])
                if self._workload.ended.wait(0.5):
                    note("stream", stream=stream, id=self.instance, step="lost")
                    return
