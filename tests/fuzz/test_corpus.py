"""Replays what fuzzing found: inputs that together reach everything, and those that once broke something."""

from pathlib import Path
from random import Random

import pytest
from fuzz_targets import TARGETS

CORPUS = Path(__file__).parent / "corpus"


@pytest.mark.parametrize("name", TARGETS)
def test_inputs_that_fuzzing_found(name):
    inputs = sorted((CORPUS / name).iterdir())
    assert inputs
    for one in inputs:
        try:
            TARGETS[name](one.read_bytes())
        except Exception as error:
            raise AssertionError(f"{one.name} breaks {name}") from error


@pytest.mark.parametrize("name", TARGETS)
def test_random_inputs(name):
    random = Random(name)
    for _ in range(20):
        TARGETS[name](random.randbytes(random.randrange(700)))
