import logging

import pytest

from skytether.api.client import ApiError, Unreachable
from skytether.api.manifest import Manifest
from skytether.api.rest import Placement, Problem, Refusal, Site
from skytether.bridge.echo import EchoServer
from skytether.robot.offload.site_prober import SiteProber, TaskConfig, system_battery
from skytether.robot.offload.task_manager import PathQuality

MANIFEST = Manifest.model_validate(
    {
        "apiVersion": "skytether.io/v1",
        "kind": "Service",
        "metadata": {"name": "guide"},
        "spec": {"entrypoint": "guide", "needs": {"max_rtt_ms": 100}},
    }
)


class Sites:
    """Two sites whose round trips are told by the test; fails as it is told."""

    def __init__(self):
        self.rtt = {"edge": 0.01, "cloud": 0.05}
        self.fail = None
        self.listed = 0

    def sites(self):
        if self.fail:
            raise self.fail
        self.listed += 1
        return [Site(name=name, tier=name, runtime="process") for name in self.rtt]

    def get_service(self, name):
        if self.fail:
            raise self.fail
        return MANIFEST

    def probe(self, site):
        if self.fail:
            raise self.fail
        return self.rtt[site]


class Rig:
    def __init__(self, sites, **config):
        self.now = 100.0
        self.sites = sites
        task = TaskConfig(**{"battery": lambda: (0.5, False), **config})
        self.tasks = SiteProber(task, sites, "guide", drives=True, clock=lambda: self.now, load=lambda: 0.3)

    def step(self, times=1):
        for _ in range(times):
            self.tasks.step()
            self.now += 1.0
        return self.tasks.decision


@pytest.fixture
def rig():
    return Rig(Sites())


def test_it_probes_and_decides_and_says_each_decision_once(rig, caplog):
    caplog.set_level(logging.WARNING)
    decision = rig.step(20)
    assert decision.site == "edge"
    assert [m[:32] for m in caplog.messages] == ["task: offload: nothing is measur", "task: offload: edge 0.17 (delay "]
    assert rig.sites.listed == 1
    told = rig.tasks.measurements()
    assert (told["edge"].preferred, told["edge"].rtt_ms) == (True, 10.0)
    assert (told["cloud"].preferred, told["cloud"].rtt_ms) == (False, 50.0)
    assert (rig.tasks.robot.load, rig.tasks.robot.battery) == (0.3, 0.5)


def test_an_orchestrator_that_is_away_changes_nothing_and_is_asked_again(rig):
    rig.sites.fail = Unreachable("away")
    assert rig.step(50).offload
    rig.sites.fail = None
    assert rig.step(5).site == "edge"
    rig.sites.fail = ApiError(Problem(title="no", status=500))
    assert rig.step(100).site == "edge", "who is away is no slow site"


def test_it_moves_when_the_link_to_where_it_is_has_been_bad(rig, orchestrator):
    rig.step(5)
    orchestrator.placement = Placement(site="edge")
    here = orchestrator.get_instance("i1")
    rig.tasks.placed(here)
    rig.tasks.live(PathQuality(0.5, 0.0, 0.0))
    assert rig.step(3).site == "edge"
    assert rig.step(3).site == "cloud"
    rig.tasks.placed(here)
    assert rig.tasks.decision.site == "cloud", "what is held still is no news"
    rig.tasks.stayed(here, "no room")
    assert rig.tasks.decision.site == "edge"
    option = {o.name: o for o in rig.step().options}["cloud"]
    assert option.refused == "no room"


def test_what_placement_refused_is_not_asked_for_again_at_once(rig, orchestrator):
    rig.step(5)
    refused = (Refusal(site="edge", reason="cpu", detail="needs 1 core"),)
    orchestrator.placement = Placement(site="cloud", refused=refused)
    rig.tasks.placed(orchestrator.get_instance("i1"))
    assert rig.step(30).site == "cloud"
    assert rig.step(60).site == "edge"


def test_a_site_with_an_echo_is_probed_by_udp():
    with EchoServer("127.0.0.1", 0) as server:
        rig = Rig(Sites(), echoes={"cloud": server.address})
        rig.sites.rtt["cloud"] = 9.0  # what the orchestrator would say
        decision = rig.step(4)
    assert {o.name: o.refused for o in decision.options}["cloud"] == ""
    rig.tasks.run(Ended())


class Ended:
    def is_set(self):
        return True


def test_the_systems_battery_is_known_or_not():
    found = system_battery()
    assert found is None or 0 <= found[0] <= 1


def test_a_move_by_the_orchestrator_is_not_contradicted(rig, orchestrator):
    rig.step(5)
    for site in ("edge", "cloud"):
        orchestrator.placement = Placement(site=site)
        rig.tasks.placed(orchestrator.get_instance("i1"))
    assert rig.tasks.decision.site == "cloud"
