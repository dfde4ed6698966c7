"""What must hold after every fault: no instance is lost, none runs twice, and nothing runs or is left for nobody.

The machine is asked what runs there, not the orchestrator.
"""

from __future__ import annotations

import os
import re
import time
from collections.abc import Callable, Mapping
from pathlib import Path

from docker_site import DockerSite
from orchestrator_program import PATIENCE, environment

from skytether.api.client import Client
from skytether.api.rest import State
from skytether.orchestrator.runtimes.procfs import ProcessStat

HOLDS = (State.STARTING, State.RUNNING, State.STOPPING)
"""States in which an instance may have a run."""

Told = Callable[[], Mapping[str, State]]
"""Every instance's state, as the orchestrator tells it."""
Runs = Callable[[], Mapping[str, list[str]]]
"""What runs at one place, by instance: names that tell one run from another."""
Litter = Callable[[], list[str]]
"""What is there and belongs to nothing that runs or ran."""


def told(client: Client) -> Told:
    return lambda: {instance.id: instance.state for instance in client.instances()}


def processes(folder: Path) -> Runs:
    """The processes of a state folder's process sites: one for each session, with all that its leader started."""

    def look() -> dict[str, list[str]]:
        found: dict[str, set[str]] = {}
        mine = re.compile(b"SKYTETHER_GRANT=" + re.escape(os.fsencode(folder)) + b"[^\\0]*/instances/([^/\\0]+)/")
        for process in Path("/proc").glob("[0-9]*"):
            named = mine.search(environment(process))
            stat = ProcessStat.read(int(process.name)) if named else None
            if named and stat and not stat.zombie:
                found.setdefault(named[1].decode(), set()).add(f"session {stat.session}")
        return {instance: sorted(sessions) for instance, sessions in found.items()}

    return look


def containers(site: DockerSite) -> Runs:
    """The containers of a site that run."""
    return lambda: _containers(site, "running", "paused", "restarting")


def litter(site: DockerSite) -> Litter:
    """On an engine of a test's own: what was made and never begun, guards, volumes and networks that nobody uses.

    Beyond one of a site's networks that is held for the next start.
    """

    def look() -> list[str]:
        begun = [f"{i}: {c}" for i, cs in _containers(site, "created", "dead", "removing").items() for c in cs]
        holders = site.labelled("skytether.io/helper=")
        guards = sorted({*site.helpers()} - {*holders})
        spare = len(holders) > len(site.labelled("skytether.io/namespace", "status=running")) + 1
        epochs = site.docker("volume", "ls", "-q", "-f", "label=skytether.io/epoch").split()  # other owners' too
        kept = {*site.volumes(), *epochs} - {*site.volumes_with("skytether.io/epoch")[1:]}
        volumes = [v for v in site.docker("volume", "ls", "-q", "-f", "dangling=true").split() if v not in kept]
        known = {"bridge", "host", "none", site.network}
        networks = [n for n in site.docker("network", "ls", "--format", "{{.Name}}").split() if n not in known]
        return begun + guards + (holders if spare else []) + volumes + networks

    return look


def _containers(site: DockerSite, *statuses: str) -> dict[str, list[str]]:
    form = '{{.Label "skytether.io/instance"}} {{.ID}}'
    filters = [f"--filter=status={status}" for status in statuses]
    filters += [f"--filter=label={label}" for label in (f"skytether.io/owner={site.owner}", "skytether.io/instance")]
    rows = site.docker("ps", "-a", *filters, "--format", form)
    found: dict[str, list[str]] = {}
    for row in rows.splitlines():
        instance, container = row.split()
        found.setdefault(instance, []).append(container)
    return found


def assert_nothing_lost(
    states: Told, expected: Mapping[str, State], *places: Runs, left: Litter = list, patience: float = 2 * PATIENCE
) -> dict[str, list[str]]:
    """Wait until every instance is as it should be, and all that runs is somebody's; two runs of one fail at once.

    Args:
        states: What the orchestrator tells.
        expected: The state that each instance that was asked for comes to. More may be there: standbys, successors.
        places: All where anything may run.
        left: What else may be left behind.
        patience: Seconds.

    Returns:
        What runs, by instance.
    """
    deadline = time.monotonic() + patience
    while True:
        before = states()
        runs: dict[str, list[str]] = {}
        for place in places:
            for instance, names in place().items():
                runs.setdefault(instance, []).extend(names)
        after = states()
        assert not (doubles := {i: names for i, names in runs.items() if len(names) > 1}), f"started twice: {doubles}"
        wrong = [
            f"{i} is {after.get(i, 'lost')}, not {state}" for i, state in expected.items() if after.get(i) != state
        ]
        wrong += [f"{i} runs for nobody" for i in runs if before.get(i) not in HOLDS and after.get(i) not in HOLDS]
        wrong += [f"{i} runs nowhere" for i, state in after.items() if state is State.RUNNING and i not in runs]
        wrong += [f"left behind: {what}" for what in left()]
        if not wrong:
            return runs
        assert time.monotonic() < deadline, "; ".join(wrong)
        time.sleep(0.05)
