"""Data of services on a real cluster, over runs and instances."""

from __future__ import annotations

import json
import re
import secrets
from collections.abc import Iterator
from contextlib import closing
from pathlib import Path

import pytest
from docker_runs import PYTHON, launch, until
from kubernetes_site import KubernetesSite

from skytether.orchestrator.runtimes.base import Phase, RuntimeFailure
from skytether.orchestrator.runtimes.kubernetes import KubernetesRuntime

pytestmark = [pytest.mark.slow, pytest.mark.docker, pytest.mark.kubernetes]

WRITE = "open('/run/skytether/data/note', 'x').write('kept')"
READ = "print(open('/run/skytether/data/note').read())"


@pytest.fixture
def storage_class(kubernetes_site: KubernetesSite, tmp_path: Path) -> Iterator[str]:
    """One with a single volume, a folder of this machine, which is the cluster's node."""
    name = f"skytether-test-{secrets.token_hex(4)}"
    folder = tmp_path / "volume"
    folder.mkdir()
    folder.chmod(0o777)  # of such a volume a pod's group is not made the owner
    volume = {
        "apiVersion": "v1",
        "kind": "PersistentVolume",
        "metadata": {"name": name},
        "spec": {
            "storageClassName": name,
            "capacity": {"storage": "64Mi"},
            "accessModes": ["ReadWriteOnce"],
            "hostPath": {"path": str(folder)},
        },
    }
    kubernetes_site.kubectl("apply", "-f", "-", given=json.dumps(volume))
    yield name
    kubernetes_site.kubectl("delete", "pv", name, "--wait=false")


def run(runtime: KubernetesRuntime, site: KubernetesSite, instance: str) -> str:
    """Start an instance; its pod."""
    runtime.start(launch(site, instance))
    until(lambda: runtime.observe()[instance].phase is Phase.RUNNING, 90.0)
    (pod,) = site.there("pods", f"skytether.io/instance={instance}")
    return str(pod["metadata"]["name"])


def test_what_a_service_wrote_is_there_for_the_next_instance(
    kubernetes_site: KubernetesSite, storage_class: str, tmp_path: Path
) -> None:
    def inside(pod: str, program: str) -> str:
        return kubernetes_site.kubectl("-n", kubernetes_site.namespace, "exec", pod, "--", PYTHON, "-c", program)

    kept = {"keep_data": True, "storage_class": storage_class, "data_mb": 64}
    with closing(kubernetes_site.open(tmp_path, **kept)) as runtime:
        inside(run(runtime, kubernetes_site, "i1"), WRITE)
        runtime.remove("i1")
        assert inside(run(runtime, kubernetes_site, "i2"), READ) == "kept"
        runtime.remove("i2")
        runtime.dismantle()
    claims = [one["metadata"]["name"] for one in kubernetes_site.there("pvc")]
    assert claims == [f"skytether-{kubernetes_site.owner}-data-walker-toy"]


def test_a_cluster_without_a_storage_class_refuses_to_keep_data_with_the_reason(
    kubernetes_site: KubernetesSite, tmp_path: Path
) -> None:
    with closing(kubernetes_site.open(tmp_path, keep_data=True)) as runtime:
        wanted = "the cluster has no default StorageClass: name one in the site's option 'storage_class'"
        with pytest.raises(RuntimeFailure, match=re.escape(wanted)):
            runtime.start(launch(kubernetes_site))
        until(lambda: kubernetes_site.there("pvc") == [])
        assert kubernetes_site.there("pods", f"skytether.io/owner={kubernetes_site.owner}") == []


def test_a_storage_class_that_is_not_there_is_named_while_it_is_waited_for(
    kubernetes_site: KubernetesSite, tmp_path: Path
) -> None:
    with closing(kubernetes_site.open(tmp_path, keep_data=True, storage_class="nobodys")) as runtime:
        runtime.start(launch(kubernetes_site))
        told = until(lambda: runtime.observe()["i1"].detail, 90.0)
        assert "PersistentVolumeClaim" in told
        assert told.endswith("says why; site's option 'storage_class')")
        runtime.stop("i1", force=True)
