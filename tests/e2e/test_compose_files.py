"""compose.yaml, Prometheus' rules and Grafana's dashboard as they are written; `test_compose` starts them."""

from __future__ import annotations

import itertools
import json
import re
from pathlib import Path
from typing import Any

import pytest
import yaml

from skytether.api import report_metrics as reported
from skytether.orchestrator.runtimes.containers import USER
from skytether.orchestrator.telemetry import metrics as exported

ROOT = Path(__file__).parents[2]
COMPOSE = yaml.safe_load((ROOT / "compose.yaml").read_text())
SERVICES = COMPOSE["services"]
DASHBOARD = json.loads((ROOT / "images/grafana/dashboards/skytether.json").read_text())
PANELS = [panel for panel in DASHBOARD["panels"] if panel["type"] != "row"]
RULES = yaml.safe_load((ROOT / "images/prometheus/rules.yml").read_text())


@pytest.mark.parametrize("name", SERVICES)
def test_a_container_may_nothing_that_it_does_not_need(name: str) -> None:
    service = SERVICES[name]
    assert service["read_only"] is True
    assert service["cap_drop"] == ["ALL"]
    assert service["security_opt"] == ["no-new-privileges:true"]
    assert int(service["user"].split(":")[0]) > 0
    assert "privileged" not in service
    assert "cap_add" not in service
    assert "docker.sock" not in json.dumps(service)
    assert service.get("network_mode", "none") == "none"
    assert service["restart"] == ("no" if name in ("passwords", "token") else "unless-stopped")
    assert "healthcheck" in service
    image = re.fullmatch(r"\$\{[A-Z]+_IMAGE:-(.+):(.+)}", service["image"])
    assert image is not None
    assert re.fullmatch(r"1|v?\d+\.\d+[.\w-]*", image[2])
    if image[1].startswith("skytether/"):
        assert service["pull_policy"] == "never", "in a public registry anybody may have that name"
    for port in service.get("ports", ()):
        assert re.match(r"127\.0\.0\.1:|\$\{SKYTETHER_INSECURE_HTTP_ADDRESS:-127\.0\.0\.1}:", port)


def test_the_orchestrator_is_another_user_than_the_services() -> None:
    """On an engine without user namespaces, a service that got out of its container would be the orchestrator."""
    users = {
        name: re.findall(r"^USER (\d+:\d+)$", (ROOT / "images" / name / "Dockerfile").read_text(), re.MULTILINE)
        for name in ("base", "ros1-base", "ros2-base", "orchestrator")
    }
    ours = (("base", USER), ("ros1-base", USER), ("ros2-base", USER), ("orchestrator", 65531))
    assert users == {name: [f"{u}:{u}"] for name, u in ours}
    own = {SERVICES[name]["user"] for name in ("orchestrator", "passwords", "token")}
    assert own == set(users["orchestrator"])
    others = [service["user"].split(":")[0] for service in SERVICES.values() if service["user"] not in own]
    assert len(others) == len(set(others))
    assert str(USER) not in others


def test_no_password_is_written_down_and_each_is_seen_only_by_those_who_need_it() -> None:
    for service in SERVICES.values():
        for key, value in service.get("environment", {}).items():
            assert "PASSWORD" not in key or (key.endswith("_FILE") and value.startswith("/secrets/"))
    seen = {
        volume: {name for name, s in SERVICES.items() if any(v.startswith(f"{volume}:") for v in s.get("volumes", ()))}
        for volume in COMPOSE["volumes"]
    }
    assert seen["database-secret"] == {"passwords", "postgres", "orchestrator"}
    assert seen["grafana-secret"] == {"passwords", "grafana"}
    assert seen["prometheus-secret"] == {"token", "prometheus"}
    assert seen["state"] == {"token", "orchestrator"}


def test_database_and_prometheus_have_no_way_outside() -> None:
    for name in ("postgres", "prometheus", "token"):
        assert all(COMPOSE["networks"][network].get("internal") for network in SERVICES[name]["networks"])
    assert set(SERVICES["postgres"]["networks"]).isdisjoint(SERVICES["grafana"]["networks"])


def test_the_dashboard_shows_the_data_source_that_is_provisioned() -> None:
    folder = ROOT / "images/grafana/provisioning"
    (source,) = yaml.safe_load((folder / "datasources/skytether.yaml").read_text())["datasources"]
    (provider,) = yaml.safe_load((folder / "dashboards/skytether.yaml").read_text())["providers"]
    mounts = [mount.split(":") for mount in SERVICES["grafana"]["volumes"]]
    assert provider["options"]["path"] in [mount[1] for mount in mounts]
    assert all((ROOT / mount[0]).is_dir() for mount in mounts if mount[0].startswith("."))
    told = {"type": source["type"], "uid": source["uid"]}
    variables = DASHBOARD["templating"]["list"]
    assert all(part["datasource"] == told for part in [*PANELS, *variables])
    assert all(target["datasource"] == told for panel in PANELS for target in panel["targets"])


def test_panels_have_a_place_of_their_own() -> None:
    every = DASHBOARD["panels"]
    assert len({panel["id"] for panel in every}) == len(every)
    for panel in every:
        place = panel["gridPos"]
        assert place["x"] + place["w"] <= 24
    for one, two in itertools.combinations([panel["gridPos"] for panel in every], 2):
        beside = one["x"] + one["w"] <= two["x"] or two["x"] + two["w"] <= one["x"]
        assert beside or one["y"] + one["h"] <= two["y"] or two["y"] + two["h"] <= one["y"]
    for panel in PANELS:
        assert panel["title"]
        refs = [target["refId"] for target in panel["targets"]]
        assert len(set(refs)) == len(refs) > 0


def names() -> set[str]:
    """All that an orchestrator exports, from its source: `test_compose` asks for them all."""
    source = Path(str(exported.__file__)).read_text() + Path(str(reported.__file__)).read_text()
    found = {f"skytether_{name}_total" for name in (*reported.COUNTERS, *exported.USED)}
    for kind, name in re.findall(r"\b(counter|gauge|Counter|Histogram)\(\s*\"(?:skytether_)?(\w+)\"", source):
        ends = {"counter": ["_total"], "Counter": ["_total"], "Histogram": ["_bucket", "_sum", "_count"]}
        found |= {f"skytether_{name}{end}" for end in ends.get(kind, [""])}
    return found


def expressions() -> list[Any]:
    shown = [target["expr"] for panel in PANELS for target in panel["targets"]]
    rules = [rule["expr"] for group in RULES["groups"] for rule in group["rules"]]
    return shown + rules + [variable["query"]["query"] for variable in DASHBOARD["templating"]["list"]]


@pytest.mark.parametrize("expression", expressions())
def test_what_is_asked_for_is_exported(expression: str) -> None:
    asked = set(re.findall(r"\bskytether_\w+", expression))
    assert asked or "up{" in expression
    assert asked <= names()


def test_every_metric_is_shown() -> None:
    shown = {name for text in expressions() for name in re.findall(r"\bskytether_\w+", text)}
    assert {name for name in names() if not name.endswith(("_sum", "_count"))} - shown == set()
