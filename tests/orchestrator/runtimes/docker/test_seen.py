"""What an engine's answers mean."""

from typing import Any

from skytether.orchestrator.runtimes.docker.seen import parse

LABELS = {
    "skytether.io/instance": "i1",
    "skytether.io/attempt": "2",
    "skytether.io/port": "7601",
    "skytether.io/gpus": "0,1",
}


def described(**labels: str) -> dict[str, Any]:
    return {
        "Id": "a" * 64,
        "Name": "/skytether-i1",
        "Config": {"Labels": {**LABELS, **{f"skytether.io/{key}": value for key, value in labels.items()}}},
        "State": {"Status": "created", "ExitCode": 0, "OOMKilled": False, "Error": ""},
        "HostConfig": {},
        "NetworkSettings": {},
    }


def test_numbers_are_those_of_labels() -> None:
    seen = parse(described())
    assert seen is not None
    assert (seen.attempt, seen.host_port, seen.gpus) == (2, 7601, {0, 1})


def test_a_label_that_python_does_not_read_as_a_number_is_none() -> None:
    """Of an image it may be anything: by one of 5000 digits nothing of that engine was understood any more."""
    long = "1" * 5000
    seen = parse(described(port=long, gpus=f"0,{long},²"))
    assert seen is not None
    assert (seen.host_port, seen.gpus) == (None, {0})
    assert parse(described(attempt=long)) is None
