"""Known faults of what requirements.lock names, as far as advisories can be had.

make audit

pip-audit asks the package index; `make audit WHERE="-s osv --osv-url URL"` asks a mirror of OSV of your own. An index
that has no advisories answers nothing for any package, which pip-audit counts as no fault: here that is said.
"""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path

LOCK = Path(__file__).parents[1] / "requirements.lock"
_COMMAND = ["-r", str(LOCK), "--require-hashes", "--disable-pip", "--format", "json", "--progress-spinner", "off"]


def main(pip_audit: str, *more: str) -> int:
    """Exit status: 1 if a package has a known fault, or the audit itself fails."""
    run = subprocess.run([pip_audit, *_COMMAND, *more], capture_output=True, text=True, check=False)
    try:
        found = json.loads(run.stdout)["dependencies"]
    except ValueError:
        sys.stderr.write(f"error: the audit failed: {run.stderr.strip()[-500:]}\n")
        return 1
    asked = [package for package in found if "vulns" in package]
    faults = [(package, fault) for package in asked for fault in package["vulns"]]
    for package, fault in faults:
        mended = ", ".join(fault["fix_versions"]) or "no version"
        sys.stdout.write(f"{package['name']} {package['version']}: {fault['id']}, mended in {mended}\n")
    sys.stdout.write(f"audit: advisories for {len(asked)} of {len(found)} packages, {len(faults)} known faults\n")
    return 1 if faults else 0


if __name__ == "__main__":
    sys.exit(main(*sys.argv[1:]))
