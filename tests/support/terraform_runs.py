"""Terraform on a copy of what it is given, with providers that are made up of their schemas."""

from __future__ import annotations

import json
import os
import platform
import shutil
import subprocess
import sys
from dataclasses import dataclass
from pathlib import Path

ROOT = Path(__file__).parents[2]
SCHEMAS = ROOT / "tests" / "terraform" / "schemas"
MODULES = sorted({path.parent.parent for path in (ROOT / "terraform").glob("*/*/tests/*.tftest.hcl")})
TIMEOUT_S = 240


@dataclass(frozen=True)
class Terraform:
    """A copy of the tree, and the configuration with which Terraform is run in it.

    Attributes:
        program: Terraform, or OpenTofu, which does the same.
        tree: What the modules refer to, by the same relative paths.
        settings: Of Terraform's command: where providers are, and nothing from elsewhere.
    """

    program: str
    tree: Path
    settings: Path

    def run(self, module: str, *words: str, **more: str) -> subprocess.CompletedProcess[str]:
        """Terraform's command in a module, `modules/node`; never asks."""
        environment = {key: value for key, value in os.environ.items() if not key.startswith("TF_")}
        environment |= {
            "TF_CLI_CONFIG_FILE": str(self.settings),
            "TF_IN_AUTOMATION": "1",
            "CHECKPOINT_DISABLE": "1",
            **more,
        }
        return subprocess.run(
            [self.program, *words],
            cwd=self.tree / "terraform" / module,
            env=environment,
            stdin=subprocess.DEVNULL,
            capture_output=True,
            text=True,
            timeout=TIMEOUT_S,
            check=False,
        )

    def initialised(self, module: str) -> Terraform:
        """With providers and modules found."""
        done = self.run(module, "init", "-input=false", "-no-color")
        assert done.returncode == 0, done.stderr
        return self


def copied(program: str, folder: Path, plugins: Path | None = None) -> Terraform:
    """A fresh copy in a folder; `plugins` is a mirror with real providers, instead of those made up."""
    tree = folder / "tree"
    for part in ("terraform", "helm/skytether", "docs/examples/orchestrator"):
        ignored = shutil.ignore_patterns(".terraform", ".terraform.lock.hcl", "*.tfstate*")
        shutil.copytree(ROOT / part, tree / part, ignore=ignored)
    settings = folder / "terraform.rc"
    mirror = plugins or made_up(folder / "plugins")
    settings.write_text(f'provider_installation {{\n  filesystem_mirror {{\n    path = "{mirror}"\n  }}\n}}\n')
    return Terraform(program, tree, settings)


def made_up(mirror: Path) -> Path:
    """A mirror of providers that know their schemas and nothing else."""
    machine = {"x86_64": "amd64", "aarch64": "arm64"}[platform.machine()]
    for file in SCHEMAS.glob("*.json"):
        found = json.loads(file.read_text())
        folder = mirror / "registry.terraform.io" / found["source"] / found["version"] / f"linux_{machine}"
        folder.mkdir(parents=True)
        plugin = folder / f"terraform-provider-{file.stem}_v{found['version']}"
        plugin.write_text(
            f"#!/bin/sh\nexec '{sys.executable}' '{Path(__file__).parent / 'schema_provider.py'}' '{file}'\n"
        )
        plugin.chmod(0o755)
    return mirror
