"""Terraform's own tests and checks, of each module and each example."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest
from terraform_runs import MODULES, ROOT, Terraform, copied

pytestmark = pytest.mark.slow

NAMES = [str(path.relative_to(ROOT / "terraform")) for path in MODULES]


@pytest.fixture(scope="module")
def terraform(terraform_program: str, tmp_path_factory: pytest.TempPathFactory) -> Terraform:
    return copied(terraform_program, tmp_path_factory.mktemp("terraform"))


def test_files_are_formatted(terraform: Terraform) -> None:
    done = terraform.run(".", "fmt", "-check", "-diff", "-recursive")
    assert done.returncode == 0, done.stdout


def test_every_module_and_example_has_tests() -> None:
    folders = {str(file.parent.relative_to(ROOT / "terraform")) for file in (ROOT / "terraform").rglob("main.tf")}
    assert folders == {*NAMES, "examples/aws"}  # which is the module aws and nothing else


@pytest.mark.parametrize("module", NAMES)
def test_its_own_tests_pass(terraform: Terraform, module: str) -> None:
    done = terraform.initialised(module).run(module, "test", "-no-color")
    assert done.returncode == 0, done.stdout + done.stderr
    sys.stdout.write(done.stdout)


@pytest.mark.parametrize("example", ["aws", "google", "openstack", "hybrid", "edge"])
def test_an_example_is_valid(terraform: Terraform, example: str) -> None:
    done = terraform.initialised(f"examples/{example}").run(f"examples/{example}", "validate", "-no-color")
    assert done.returncode == 0, done.stdout + done.stderr


def test_terraform_itself_refuses_a_name_that_a_provider_does_not_have(terraform_program: str, tmp_path: Path) -> None:
    terraform = copied(terraform_program, tmp_path)
    file = terraform.tree / "terraform/examples/google/network.tf"
    file.write_text(file.read_text().replace("auto_create_subnetworks", "auto_create_subnets"))
    done = terraform.initialised("examples/google").run("examples/google", "validate", "-no-color")
    assert done.returncode == 1
    assert 'An argument named "auto_create_subnets" is not expected here.' in done.stderr


def test_a_variable_of_a_wrong_type_is_named(terraform: Terraform) -> None:
    done = terraform.initialised("modules/node").run(
        "modules/node", "plan", "-input=false", "-no-color", "-var=name=ward-3", "-var=session_ports=many"
    )
    assert done.returncode == 1
    assert "session_ports" in done.stderr
    typed = terraform.run(
        "modules/node", "plan", "-input=false", "-no-color", "-var=name=ward-3", '-var=session_ports={first="a",last=2}'
    )
    assert typed.returncode == 1
    assert "a number is required" in " ".join(typed.stderr.split())


def test_the_real_provider_takes_it(terraform_program: str, tmp_path: Path) -> None:
    """AWS's own provider, where a mirror has it; the largest of the three."""
    mirror = Path(os.environ.get("SKYTETHER_TERRAFORM_PLUGINS", ""))
    if not (mirror / "registry.terraform.io/hashicorp/aws").is_dir():
        pytest.skip("SKYTETHER_TERRAFORM_PLUGINS names no mirror with AWS's provider")
    terraform = copied(terraform_program, tmp_path, mirror).initialised("modules/aws")
    done = terraform.run("modules/aws", "test", "-no-color")
    assert done.returncode == 0, done.stdout + done.stderr


def test_scripts_are_scripts() -> None:
    for file in (ROOT / "terraform").rglob("*.sh"):
        shell = file.read_text().partition("\n")[0].removeprefix("#!")
        done = subprocess.run([shell, "-n", str(file)], capture_output=True, text=True, check=False)
        assert done.returncode == 0, done.stderr
