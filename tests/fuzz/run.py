"""Fuzz with coverage: `make fuzz`, or one target: python tests/fuzz/run.py peers --seconds 600.

New inputs are collected in .fuzz/TARGET; what breaks a promise is written to .fuzz/crash-*. `--keep` puts
inputs that reach all that was reached into tests/fuzz/corpus, where the tests replay them.
"""

from __future__ import annotations

import argparse
import hashlib
import os
import shutil
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from types import FrameType
from typing import Any

HERE = Path(__file__).parent
CORPUS = HERE / "corpus"
WORK = HERE.parent.parent / ".fuzz"
MAX_INPUT = 2048
Step = tuple[str, int, int]
INSTRUMENTED = ["skytether.wire", "skytether.bridge.relay_table"]


def main() -> int:
    """Run the targets one after the other, each in a process of its own; the status tells whether one broke."""
    from fuzz_targets import TARGETS

    parser = argparse.ArgumentParser(description="Fuzz every byte that can arrive.")
    parser.add_argument("targets", nargs="*", metavar="TARGET", help=f"some of {', '.join(TARGETS)}; all unless given")
    parser.add_argument("--seconds", type=int, default=30, help="for each target (30)")
    parser.add_argument("--keep", action="store_true", help="add what was found to tests/fuzz/corpus, minimised")
    options = parser.parse_args()
    unknown = set(options.targets) - set(TARGETS)
    if unknown:
        parser.error(f"there is no target {', '.join(sorted(unknown))}; there are {', '.join(TARGETS)}")
    try:
        import atheris  # noqa: F401
    except ImportError:
        print("atheris is missing: .venv/bin/pip install atheris (Linux on x86-64)", file=sys.stderr)
        return 2
    broken = []
    for name in options.targets or TARGETS:
        (WORK / name).mkdir(parents=True, exist_ok=True)
        (CORPUS / name).mkdir(parents=True, exist_ok=True)
        print(f"--- {name}", flush=True)
        if libfuzzer(name, str(WORK / name), str(CORPUS / name), f"-max_total_time={options.seconds}"):
            broken.append(name)
        elif options.keep:
            keep(name)
    if broken:
        print(f"broken: {', '.join(broken)}; the inputs are {WORK}/crash-*", file=sys.stderr)
    return bool(broken)


def keep(name: str) -> None:
    """Replace a target's corpus by few inputs that reach the same steps from line to line, short ones first."""
    from fuzz_targets import TARGETS

    inputs = sorted({f.read_bytes() for folder in (CORPUS, WORK) for f in (folder / name).iterdir()}, key=len)
    reached: set[Step] = set()
    shutil.rmtree(CORPUS / name)
    (CORPUS / name).mkdir()
    for one in inputs:
        new = steps(TARGETS[name], one) - reached
        if new:
            reached |= new
            (CORPUS / name / hashlib.sha1(one, usedforsecurity=False).hexdigest()).write_bytes(one)


def steps(target: Callable[[bytes], None], data: bytes) -> set[Step]:
    """Which line came after which in the code under test."""
    found: set[Step] = set()

    def trace(frame: FrameType, event: str, _argument: Any) -> Callable[..., Any] | None:
        if "skytether" not in frame.f_code.co_filename:
            return None
        last = frame.f_lineno

        def line(frame: FrameType, event: str, _argument: Any) -> Callable[..., Any]:
            nonlocal last
            found.add((frame.f_code.co_filename, last, frame.f_lineno))
            last = frame.f_lineno
            return line

        return line

    sys.settrace(trace)
    try:
        target(data)
    finally:
        sys.settrace(None)
    return found


def libfuzzer(name: str, *options: str) -> int:
    """Start this file again as the program that libFuzzer runs in."""
    arguments = [*options, f"-max_len={MAX_INPUT}", f"-artifact_prefix={WORK}/", "-verbosity=0", "-print_final_stats=1"]
    return subprocess.run(
        [sys.executable, __file__, *arguments], env=os.environ | {"FUZZ_TARGET": name}, check=False
    ).returncode


def fuzz(name: str) -> None:
    """What the started program does; never returns."""
    import atheris

    with atheris.instrument_imports(include=INSTRUMENTED):
        from fuzz_targets import TARGETS
    atheris.Setup(sys.argv, TARGETS[name])
    atheris.Fuzz()


if __name__ == "__main__":
    if "FUZZ_TARGET" in os.environ:
        fuzz(os.environ["FUZZ_TARGET"])
    sys.exit(main())
