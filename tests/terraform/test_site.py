"""The modules `site` and `cluster` in real `apply` and `destroy`; who is asked is made up, and notes it."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest
from terraform_runs import Terraform, copied

pytestmark = pytest.mark.slow

TOKEN = "sky-join-0123456789abcdef.fingerprint"

# An orchestrator's command line that keeps its sites in a folder.
SKYTETHER = f"""#!/bin/sh
cd "$(dirname "$0")"
echo "skytether $*" >>asked
case "$1 $2" in
  "site list") printf '[' ; cat sites 2>/dev/null | sed 's/.*/{{"name":"&"}}/' ; printf ']\\n' ;;
  "site show") grep -qx "$3" sites && printf '{{"name":"%s","state":"ready"}}\\n' "$3" ;;
  "site invite") [ ! -e refuses ] || {{ echo "error: it refuses" >&2; exit 1; }}; echo "for people" >&2; echo {TOKEN} ;;
  "site drain") [ ! -e full ] || {{ echo "error: 2 instances are at site $3 still" >&2; exit 1; }} ;;
  "site remove") : >sites ;;
esac
"""
# A machine that cannot be reached at first, and then joins.
DELIVER = """#!/bin/sh
cd "$(dirname "$0")"
read -r token
echo "deliver $token" >>asked
[ -e up ] || { : >up; exit 255; }
[ ! -e broken ] || { echo "error: engine: there is no Docker engine" >&2; exit 1; }
echo ward-3 >sites
"""


@pytest.fixture(scope="module")
def terraform(terraform_program: str, tmp_path_factory: pytest.TempPathFactory) -> Terraform:
    return copied(terraform_program, tmp_path_factory.mktemp("site"))


class Played:
    """A module with programs that are played, in a state of its own."""

    def __init__(self, terraform: Terraform, module: str, folder: Path, variables: dict[str, Any]) -> None:
        self.folder = folder
        self._terraform = terraform.initialised(module)
        self._module = module
        self._chosen = ["-auto-approve", "-input=false", "-no-color", f"-state={folder / 'state'}"]
        (folder / "given.tfvars.json").write_text(json.dumps(variables))
        self._chosen.append(f"-var-file={folder / 'given.tfvars.json'}")

    def program(self, name: str, text: str) -> str:
        file = self.folder / name
        file.write_text(text)
        file.chmod(0o755)
        return str(file)

    def run(self, verb: str, *more: str, **environment: str) -> tuple[int, str]:
        done = self._terraform.run(self._module, verb, *self._chosen, *more, **environment)
        return done.returncode, done.stdout + done.stderr

    def asked(self) -> list[str]:
        file = self.folder / "asked"
        lines = file.read_text().splitlines() if file.exists() else []
        file.unlink(missing_ok=True)
        return lines

    def state(self) -> str:
        return (self.folder / "state").read_text()


@pytest.fixture
def site(terraform: Terraform, tmp_path: Path) -> Played:
    words = {
        "cli": [str(tmp_path / "skytether")],
        "deliver": [str(tmp_path / "deliver")],
        "forget": ["rm", str(tmp_path / "up")],
    }
    played = Played(terraform, "modules/site", tmp_path, {"name": "ward-3", "machine": "192.0.2.7", **words})
    played.program("skytether", SKYTETHER)
    played.program("deliver", DELIVER)
    return played


def test_a_machine_is_a_site_until_it_is_destroyed(site: Played) -> None:
    code, said = site.run("apply")
    assert code == 0, said
    asked = [line for line in site.asked() if not line.startswith("skytether site list")]
    # One token, brought once more when the machine was up.
    assert asked == [
        "skytether site invite ward-3 --tier edge --valid 1h",
        f"deliver {TOKEN}",
        f"deliver {TOKEN}",
        "skytether site show ward-3 --json",
    ]
    assert not (site.folder / "up").exists(), "what `deliver` left was to be forgotten"
    assert TOKEN not in site.state() + said
    assert site.run("apply")[0] == 0
    assert site.asked() == [], "what is there is not asked for again"
    code, said = site.run("destroy")
    assert code == 0, said
    assert [line for line in site.asked() if "list" not in line] == [
        "skytether site drain ward-3 --timeout-s 900",
        "skytether site remove ward-3 --timeout-s 900",
    ]


def test_what_cannot_be_drained_is_not_destroyed(site: Played) -> None:
    (site.folder / "up").touch()
    assert site.run("apply")[0] == 0
    (site.folder / "full").touch()
    code, said = site.run("destroy", "-var=drain_minutes=0.1")
    assert code == 1
    assert "2 instances are at site ward-3 still" in said
    assert "make room elsewhere, and destroy again" in " ".join(said.split())
    assert "terraform_data" in site.state()
    (site.folder / "full").unlink()
    assert site.run("destroy")[0] == 0


def test_another_machine_is_drained_and_joins_anew(site: Played) -> None:
    (site.folder / "up").touch()
    assert site.run("apply")[0] == 0
    site.asked()
    (site.folder / "up").touch()
    assert site.run("apply", "-var=machine=192.0.2.8")[0] == 0
    order = [line.split()[2] if line.startswith("skytether") else "deliver" for line in site.asked()]
    assert [word for word in order if word != "list"] == ["drain", "remove", "invite", "deliver", "show"]


def test_a_machine_that_does_not_join_says_why_and_is_no_site(site: Played) -> None:
    (site.folder / "up").touch()
    (site.folder / "broken").touch()
    code, said = site.run("apply")
    assert code == 1
    assert "there is no Docker engine" in said
    assert "has not joined, for the reason above" in " ".join(said.split())
    assert not (site.folder / "sites").exists()
    assert TOKEN not in said
    (site.folder / "broken").unlink()
    assert site.run("apply")[0] == 0, "the next apply makes it good"


def test_a_name_that_is_taken_and_an_orchestrator_that_refuses_are_told(site: Played) -> None:
    (site.folder / "sites").write_text("ward-3\n")
    code, said = site.run("apply")
    assert code == 1
    assert "there is a site of this name already" in said
    (site.folder / "sites").unlink()
    (site.folder / "refuses").touch()
    code, said = site.run("apply")
    assert code == 1
    assert "error: it refuses" in said
    assert not [line for line in site.asked() if line.startswith("deliver")]


def test_an_orchestrator_that_is_away_is_waited_for_and_then_named(site: Played) -> None:
    code, said = site.run("apply", "-var=wait_minutes=0.02", '-var=cli=["false"]')
    assert code == 1
    assert "the orchestrator did not answer within 0.02 min" in " ".join(said.split())


# SSH that runs nothing but notes it; a token of k3s is what it must not show.
SSH = """#!/bin/sh
cd "$(dirname "$0")"
while [ $# -gt 0 ]; do
  case $1 in
    -o|-l|-S|-L|-O) shift 2 ;;
    -f|-N|-M) shift ;;
    *) break ;;
  esac
done
machine=$1
shift
echo "$machine: $*" >>asked
case "$*" in
  *"token create"*) echo k3s-secret ;;
  *config.yaml*) cat >"config-$machine" ;;
  *"head -n 1"*) echo "k3s version v1.34.1+k3s1 (abc)" ;;
  *"cat /etc/rancher/k3s/k3s.yaml"*) echo "server: https://127.0.0.1:6443" ;;
  *"sh -s"*) cat >/dev/null ;;
esac
"""
HELM = """#!/bin/sh
cd "$(dirname "$0")"
echo "helm $* with $(cat "$KUBECONFIG")" >>asked
while [ $# -gt 0 ]; do [ "$1" != --values ] || cat "$2" >>values; shift; done
"""


def test_a_cluster_is_joined_gets_the_chart_and_is_taken_apart(terraform: Terraform, tmp_path: Path) -> None:
    given = {
        "server": {"address": "192.0.2.10", "internal": "10.86.0.10"},
        "agents": {"one": {"address": "192.0.2.11"}},
        "values": ["image: {pullPolicy: Never}\n"],
    }
    cluster = Played(terraform, "modules/cluster", tmp_path, given)
    cluster.program("ssh", SSH)
    cluster.program("helm", HELM)
    path = f"{tmp_path}:/usr/local/bin:/usr/bin:/bin"
    code, said = cluster.run("apply", PATH=path)
    assert code == 0, said
    asked = cluster.asked()
    (helm,) = [line for line in asked if line.startswith("helm")]
    assert "upgrade --install skytether" in helm
    assert "--namespace skytether --create-namespace --wait --timeout 20m --values" in helm
    assert "server: https://127.0.0.1:16443" in helm
    assert asked.index(helm) > max(number for number, line in enumerate(asked) if "kubectl wait" in line)
    assert (tmp_path / "values").read_text() == "image: {pullPolicy: Never}\n"
    server = (tmp_path / "config-192.0.2.10").read_text()
    assert 'node-ip: "10.86.0.10"' in server
    assert 'service-node-port-range: "20000-20099"' in server
    agent = (tmp_path / "config-192.0.2.11").read_text()
    assert 'server: "https://10.86.0.10:6443"' in agent
    assert 'token: "k3s-secret"' in agent
    assert "k3s-secret" not in cluster.state() + said + "".join(asked)
    code, said = cluster.run("apply", '-var=values=["image: {pullPolicy: Always}"]', PATH=path)
    assert code == 0, said
    assert [line.partition(" with")[0].split()[1] for line in cluster.asked() if line.startswith("helm")] == ["upgrade"]
    code, said = cluster.run("destroy", PATH=path)
    assert code == 0, said
    order = [line for line in cluster.asked() if "helm uninstall" in line or "kubectl d" in line]

    assert order[0].startswith("helm uninstall skytether")
    assert order[1].startswith("192.0.2.10: sudo k3s kubectl drain one")
    assert order[2].startswith("192.0.2.10: sudo k3s kubectl delete node one")
