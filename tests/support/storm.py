"""Robots that come and go, an API server that misbehaves, orchestrators that are killed; then it is judged."""

from __future__ import annotations

import random
import signal
import threading
import time
from collections.abc import Callable, Sequence
from pathlib import Path

from orchestrator_program import Program
from unruly_cluster import CALM, REGIMES, UnrulyCluster

from skytether.api.client import Client
from skytether.api.rest import InstanceCreate, RobotCreate, SiteCreate, State

TIMING = {
    "max_failures": 1000,
    "backoff": 0.2,
    "backoff_max": 2,
    "start_timeout": 8,
    "stop_grace": 3,
    "site_silent": 5,
}
MOST = 10
"""Instances at a time."""


def site(name: str, kubeconfig: Path, **options: object) -> SiteCreate:
    told = {
        "kubeconfig": str(kubeconfig),
        "namespace": name,
        "owner": name,
        "reach": "nodeport",
        "timeout_s": 2,
        **options,
    }
    return SiteCreate(name=name, tier="edge", runtime="kubernetes", options=told)


class Storm:
    """``programs`` run already, the first of them leads."""

    def __init__(
        self, seed: int, cluster: UnrulyCluster, programs: Sequence[Program], clients: Callable[[], list[Client]]
    ) -> None:
        self.rng = random.Random(seed)
        self.cluster, self.programs, self.clients = cluster, programs, clients
        self.wanted: set[str] = set()
        self.deleted: set[str] = set()
        self.moving: list[tuple[str, str]] = []
        self.robots = 0
        self.notes: list[str] = []
        self.counts: dict[str, int] = {}
        self._over = threading.Event()

    def note(self, text: str) -> None:
        self.notes.append(f"{time.strftime('%H:%M:%S')} {text}")

    def count(self, what: str) -> None:
        self.counts[what] = self.counts.get(what, 0) + 1

    def blow(self, seconds: float, *, kills: bool = True) -> None:
        users = threading.Thread(target=self._use)
        users.start()
        killer = threading.Thread(target=self._kill, args=(self.rng.random(),))
        if kills:
            killer.start()
        until = time.monotonic() + seconds
        while time.monotonic() < until:
            self.cluster.regime = CALM if self.rng.random() < 0.4 else self.rng.choice(REGIMES)
            self.note(f"regime {self.cluster.regime.name}")
            self.count(self.cluster.regime.name)
            time.sleep(self.rng.uniform(0.3, 2.5))
            self._meddle()
        self._over.set()
        users.join()
        if kills:
            killer.join()
        self.cluster.regime = CALM
        self.cluster.compact()
        self.note("calm")

    def _meddle(self) -> None:
        what = self.rng.choice(["pod", "pod at once", "secret", "fence", "policy", "restart", "compact", "", "", ""])
        match what:
            case "pod":
                self.cluster.remove_one("pods")
            case "pod at once":
                self.cluster.remove_one("pods", grace_s=0)
            case "secret":
                self.cluster.remove_one("secrets")
            case "fence":
                self.cluster.remove_one("configmaps")
            case "policy":
                self.cluster.remove_one("networkpolicies")
            case "restart":
                self.cluster.restart()
            case "compact":
                self.cluster.compact()
        if what:
            self.note(f"meddle {what}")
            self.count(f"meddle {what}")

    def _kill(self, seed: float) -> None:
        rng = random.Random(seed)
        while not self._over.wait(rng.uniform(4.0, 8.0)):
            program = rng.choice(self.programs)
            process = program.process
            assert process is not None
            if len(self.programs) > 1 and rng.random() < 0.6:
                self.note(f"freeze {process.pid}")
                self.count("freeze")
                process.send_signal(signal.SIGSTOP)
                self._over.wait(rng.uniform(1.0, 6.0))
                process.send_signal(signal.SIGCONT)
                self.note(f"thaw {process.pid}")
                continue
            self.note(f"kill {process.pid}")
            self.count("kill")
            process.kill()
            process.wait()
            self._over.wait(rng.uniform(0.0, 2.0))
            (program.folder / "address").unlink(missing_ok=True)
            program.spawn()

    def _use(self) -> None:
        rng = random.Random(self.rng.random())
        while not self._over.wait(rng.uniform(0.01, 0.08)):
            for client in self.clients():
                try:
                    self._act(rng, client)
                except Exception as error:  # of an orchestrator that is not there
                    self.count(f"error {type(error).__name__}")
                finally:
                    client.close()

    def _act(self, rng: random.Random, client: Client) -> None:
        for old, new in list(self.moving):
            state = client.get_instance(new).state
            if state is State.RUNNING:
                self.moving.remove((old, new))
                self.deleted.add(old)
                self.wanted.discard(old)
                client.delete_instance(old)
            elif state.final:
                self.moving.remove((old, new))
                self.wanted.discard(new)
                self.note(f"move to {new} failed: {client.get_instance(new).reason}")
        free = sorted(self.wanted - {one for pair in self.moving for one in pair})
        what = rng.choice(["ask", "ask", "ask", "renew", "delete", "move"])
        if what == "ask" and len(self.wanted) < MOST:
            self.robots += 1
            robot = f"r{self.robots}"
            client.create_robot(RobotCreate(name=robot))
            made = client.create_instance(InstanceCreate(robot=robot, service="toy", lease_s=1000))
            self.wanted.add(made.id)
            self.note(f"asked {made.id}")
        elif what == "renew" and free:
            client.renew_instance(rng.choice(free))
        elif what == "delete" and free:
            one = rng.choice(free)
            self.wanted.discard(one)
            self.deleted.add(one)
            self.note(f"delete {one}")
            client.delete_instance(one)
        elif what == "move" and free:
            old = rng.choice(free)
            new = client.migrate_instance(old).id
            self.note(f"move {old} to {new}")
            self.wanted.add(new)
            self.moving.append((old, new))
        else:
            return
        self.count(what)

    def put_toy(self, client: Client) -> None:
        """The service that robots ask for."""
        needs = {"cpu": 0.1, "memory_mb": 16, "tiers": ["edge"]}
        spec = {"image": "registry.invalid/toy:1", "needs": needs}
        manifest = {"apiVersion": "skytether.io/v1", "kind": "Service", "metadata": {"name": "toy"}, "spec": spec}
        client.put_service("toy", manifest)

    def wrong(self, client: Client) -> list[str]:
        """What is not as it should be, as of now."""
        told = {instance.id: instance for instance in client.instances()}
        runs = self.cluster.begun()
        wrong = []
        for old, new in list(self.moving):
            if told[new].state is State.RUNNING:
                self.moving.remove((old, new))
                self.wanted.discard(old)
                self.deleted.add(old)
                client.delete_instance(old)
            wrong.append(f"{old} moves to {new}: {told[old].state} {told[new].state} {told[new].reason}")
        for one in self.wanted:
            if one not in told:
                wrong.append(f"{one} is lost")
            elif told[one].state is not State.RUNNING and not any(one == old for old, _ in self.moving):
                wrong.append(f"{one} is {told[one].state}: {told[one].reason}")
        for one in self.deleted:
            if one in told and not told[one].state.final:
                try:
                    client.delete_instance(one)  # its answer may never have come
                except Exception as error:
                    wrong.append(str(error))
                wrong.append(f"{one} is {told[one].state}, and was deleted")
        for one, instance in told.items():
            at_work = [run for run in runs.get(one, []) if run.at_work]
            if instance.state is State.RUNNING and not at_work:
                wrong.append(f"{one} runs nowhere, and is told to run")
            if len(runs.get(one, [])) > 1:
                wrong.append(f"{one} runs twice: {runs[one]}")
        wrong += [f"{one} runs for nobody" for one in runs if one not in told or told[one].state.final]
        live = {run.uid for run in self.cluster.runs.values() if not run.over}
        pods = self.cluster.objects("pods")
        there = {pod["metadata"]["uid"] for pod in pods}
        for pod in pods:
            meta = pod["metadata"]
            one = meta["labels"]["skytether.io/instance"]
            if meta["uid"] in live and (one not in told or told[one].state.final):
                wrong.append(f"pod {meta['name']} is left")
            elif meta["uid"] in live and not self.cluster.runs[meta["uid"]].began:
                wrong.append(f"pod {meta['name']} was never begun")
        for kind in ("secrets", "networkpolicies"):
            for thing in self.cluster.objects(kind):
                owners = {o["uid"] for o in thing["metadata"].get("ownerReferences") or ()}
                if kind == "secrets" and not owners <= there:
                    wrong.append(f"{kind} {thing['metadata']['name']} is left")
        return wrong
