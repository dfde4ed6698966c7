import os
import shlex
import sys
from pathlib import Path

import pytest
import yaml
from ros1_graph import Ros1Graph, debian_packages
from ros1_pair import Pair
from ros1_walker import Walker

from skytether.api.client import Client
from skytether.api.manifest import Manifest, TopicSpec
from skytether.api.rest import RobotCreate, SiteCreate
from skytether.lab.embedded import EmbeddedOrchestrator

EXAMPLES = Path(__file__).parents[3] / "docs" / "examples"


@pytest.fixture
def make_graph(ros1, tmp_path):
    made = []

    def make(name="graph", **options):
        graph = Ros1Graph(tmp_path / name, **options)
        made.append(graph)
        return graph

    yield make
    for graph in made:
        graph.close()


@pytest.fixture
def graph(make_graph):
    return make_graph().start_master()


@pytest.fixture
def make_pair(make_graph):
    """Two masters and a bridge between their graphs."""
    made = []

    def make(*specs, **options):
        robot, service = make_graph("robot").start_master(), make_graph("service").start_master()
        pair = Pair(robot, service, [TopicSpec(**spec) for spec in specs], **options)
        made.append(pair)
        return pair, robot, service

    yield make
    for pair in made:
        pair.close()


@pytest.fixture
def orchestrator(tmp_path):
    """An orchestrator that runs services from this checkout."""
    folders = [str(Path(__file__).parents[3] / folder) for folder in ("platform", "services", "docs/examples")]
    (tmp_path / "orchestrator").mkdir()
    with (
        EmbeddedOrchestrator(tmp_path / "orchestrator") as orchestrator,
        Client(orchestrator.url, orchestrator.operator_token) as client,
    ):
        packages = tmp_path / "packages"
        options = {
            "python_path": folders,
            "environment": debian_packages(packages),
            "readable": [str(packages)],
        }
        client.create_site(SiteCreate(name="here", tier="edge", runtime="process", options=options))
        client.delete_site("local")
        orchestrator.client = client
        yield orchestrator


@pytest.fixture
def program(tmp_path):
    """The command line of this checkout, as an installed program."""
    path = tmp_path / "skytether"
    folders = os.pathsep.join(sys.path)
    path.write_text(
        f'#!/bin/sh\nPYTHONPATH={shlex.quote(folders)} exec {shlex.quote(sys.executable)} -m skytether.cli "$@"\n'
    )
    path.chmod(0o755)
    return path


@pytest.fixture
def walker(graph):
    walker = Walker(graph)
    yield walker
    walker.close()


@pytest.fixture
def config(graph, orchestrator, tmp_path):
    """A robot.yaml, and the robot registered."""
    manifest = yaml.safe_load((EXAMPLES / "wall_stop" / "service.yaml").read_text())
    # How well a busy machine keeps time is not what is asked here.
    manifest["spec"]["needs"] = {"cpu": 0.1}
    orchestrator.client.put_service("wall-stop", Manifest.model_validate(manifest))
    token = tmp_path / "walker.token"
    token.touch(0o600)
    token.write_text(orchestrator.client.create_robot(RobotCreate(name="walker")).token)
    path = tmp_path / "robot.yaml"
    document = {
        "robot": "walker",
        "orchestrator": orchestrator.url,
        "token_file": "walker.token",
        "service": "wall-stop",
        "limits": {"max_gap_s": 1.0},
        "safety": "none",
        "ros1": {"master": graph.uri, "namespace": "/"},
    }
    path.write_text(yaml.safe_dump(document))
    return path
