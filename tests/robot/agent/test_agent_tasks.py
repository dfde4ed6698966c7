"""The agent with a task manager: what is decided is what is asked for."""

from dataclasses import replace

from skytether.api.client import ApiError
from skytether.api.rest import Placement, Problem
from skytether.robot.agent.agent import Agent
from skytether.robot.agent.config import AgentConfig
from skytether.robot.offload.site_prober import TaskConfig
from skytether.robot.offload.task_manager import Mode, Policy

CONFIG = AgentConfig(robot="walker", url="https://nowhere", token="old", service="guide", fallback="admittance")


def make(base, orchestrator, **changes):
    return Agent(replace(CONFIG, **changes), base, client=orchestrator, clock=lambda: 50.0)


def test_the_preferred_site_is_asked_for(base, orchestrator):
    agent = make(base, orchestrator, task=TaskConfig())
    agent._site_prober._decision = replace(agent._site_prober.decision, site="edge")
    request = agent._wanted().request
    assert request.measurements["edge"].preferred
    agent.ask()
    assert agent.status().decision.site == "edge"


def test_mode_local_asks_for_nothing(base, orchestrator):
    agent = make(base, orchestrator, task=TaskConfig(Policy(mode=Mode.LOCAL)))
    assert agent.ask() > 0
    assert orchestrator.calls == []
    agent.tick(50.01)
    assert agent.status().driver.source == "fallback"


def test_a_decision_for_local_lets_the_instance_and_its_session_go(base, orchestrator):
    agent = make(base, orchestrator, task=TaskConfig())
    agent.ask()
    agent._site_prober._decision = replace(agent._site_prober.decision, offload=False)
    agent.ask()
    assert orchestrator.calls[-1] == ("delete", "i1")
    assert agent.status().instance is None


def test_an_instance_elsewhere_is_wanted_when_it_was_so_decided(base, orchestrator):
    orchestrator.placement = Placement(site="cloud")
    agent = make(base, orchestrator, task=TaskConfig())
    agent.ask()
    agent.ask()
    assert [name for name, _ in orchestrator.calls] == ["create", "renew"]
    agent._site_prober._decision = replace(agent._site_prober.decision, site="edge")
    agent.ask()
    assert [name for name, _ in orchestrator.calls] == ["create", "renew", "renew", "create"]


def test_a_refused_token_is_read_again_from_where_it_came(base, monkeypatch):
    tokens = ["old", "new"]
    agent = Agent(replace(CONFIG, fresh_token=lambda: tokens.pop(0)), base, clock=lambda: 50.0)
    sent = []

    def refuse(request, **options):
        sent.append(request.headers["Authorization"])
        raise ApiError(Problem(title="no", status=401, detail="the token has expired"))

    monkeypatch.setattr(agent._own_client._http, "send", refuse)
    assert agent.ask() == 10.0, "the file holds the same"
    assert agent.ask() < 1.0
    monkeypatch.setattr(agent, "_config", replace(CONFIG, fresh_token=lambda: "new"))
    assert agent.ask() == 10.0
    assert sent == ["Bearer old", "Bearer old", "Bearer new"]
    agent.close()
