"""Starts on this machine's real engine, as the benchmark does them: its rows, and that nothing is left of it."""

import subprocess

import pytest
from docker_site import Images

from skytether.lab.bench import containers
from skytether.lab.bench.pair import BenchError
from skytether.lab.bench.pods import kubectl
from skytether.lab.bench.start import bench_start


def docker(*arguments: str) -> list[str]:
    return subprocess.run(["docker", *arguments], capture_output=True, text=True, check=True).stdout.split()


def test_a_runtime_that_is_none_is_refused():
    with pytest.raises(BenchError, match="no runtime 'dokker' to measure; there are process, docker, kubernetes"):
        bench_start(1, ["dokker"])


@pytest.mark.slow
@pytest.mark.docker
def test_containers_are_started_cold_and_warm_beside_docker_run_and_nothing_is_left(docker_images: Images):
    owners: set[str] = set()

    def on_start(row: str, seconds: float) -> None:
        owners.update(own.containers("virtual-trail", "skytether.io/owner"))

    with docker_images.apart("virtual-trail") as own:
        rows = bench_start(1, ["docker"], own.prefix, on_start)
        left = own.containers("virtual-trail")
    # How fast it is, the benchmark says where it is run for that; here a busy machine may take its time.
    assert [(row.runtime, row.standby, row.n) for row in rows] == [
        ("docker", 0, 1),
        ("docker run", 0, 1),
        ("docker", 1, 1),
    ]
    assert all(0 < row.p50_s == row.p99_s for row in rows)
    assert left == []
    (owner,) = owners
    assert owner.startswith("bench-")
    assert docker("network", "ls", "-q", "--filter", f"name={owner}") == []
    assert docker("volume", "ls", "-q", "--filter", f"name={owner}") == []


@pytest.mark.slow
@pytest.mark.docker
@pytest.mark.kubernetes
def test_pods_are_started_cold_and_warm_and_their_namespace_goes(
    docker_images: Images, kubeconfig: str, monkeypatch: pytest.MonkeyPatch
):
    monkeypatch.setenv("KUBECONFIG", kubeconfig)
    rows = bench_start(1, ["kubernetes"], docker_images.prefix)
    assert [(row.runtime, row.standby, row.n) for row in rows] == [("kubernetes", 0, 1), ("kubernetes", 1, 1)]
    assert all(0 < row.p50_s == row.p99_s for row in rows)
    said = kubectl(kubeconfig, "get", "namespaces", "--no-headers").splitlines()
    assert all("Terminating" in line for line in said if line.startswith("skytether-bench-"))


def test_a_container_that_the_site_removes_itself_just_then_is_waited_for(monkeypatch):
    """The engine refuses to remove what is being removed."""
    there, asked = ["c1"], []

    def engine(*words):
        asked.append(words[0])
        if words[0] == "rm":
            there.clear()
            raise BenchError("removal of container c1 is already in progress")
        return " ".join(there) if words[0] == "ps" else ""

    monkeypatch.setattr(containers, "docker", engine)
    containers.clean("bench-1", "net")
    assert asked == ["ps", "rm", "ps", "volume", "network"]
