"""Every key of the configurations of a bridge and a relay: a wrong value is answered by the key and what is allowed."""

import copy

import pytest

from skytether.api.config_file import ConfigError, check_config
from skytether.api.manifest import TopicSpec
from skytether.bridge.local_network import LocalNetwork
from skytether.bridge.relay_config import RelayConfig
from skytether.cli.commands.bridge.config import BridgeConfig, LinkConfig

END = {"host": "127.0.0.1", "port": 8700}
TOPIC = {
    "name": "a", "kind": "topic", "type": "t/msg/T", "direction": "in", "type_hash": "", "encoding": "cdr",
    "priority": 1, "period_ms": 10, "lifespan_ms": 100, "depth": 1, "delivery": 0.9, "reliable": True, "latched": True,
    "compression": "zstd", "paths": "redundant", "shared": False,
}  # fmt: skip
LINK = {"delay_ms": 1, "jitter_ms": 1, "loss": 0.1, "burst": 2, "rate_mbps": 5, "seed": 1}
ROBOT = {
    "role": "robot", "id": "0123456789abcdef", "key_file": "key", "bind": END, "peer": END,
    "paths": [{"local": "eth0", "cost": 1, "peer": END}], "topics": [TOPIC], "rate_mbps": 5,
    "sources": [{"topic": "a", "size": 1, "rate_hz": 1}],
}  # fmt: skip
BOTH = {**ROBOT, "role": "both", "peer": None, "link": {"up": LINK, "down": LINK}}
RELAY = {
    "listen": END, "upstream": END, "routes": [{"id": "01*", "target": END}],
    "kubernetes": {"kubeconfig": "k", "context": "c", "namespace": "n", "owner": "o"},
    "limits": {"sessions": 1, "addresses": 1, "newcomers": 1, "rate_mbps": 1, "idle_s": 1},
}  # fmt: skip
ROOTS: dict[str, tuple[type, dict]] = {
    "robot": (BridgeConfig, ROBOT),
    "both": (BridgeConfig, BOTH),
    "relay": (RelayConfig, RELAY),
}


def leaves(document, place=()):
    """Where the values are."""
    if isinstance(document, dict | list):
        items = document.items() if isinstance(document, dict) else enumerate(document)
        for step, value in items:
            yield from leaves(value, (*place, step))
    elif document is not None:
        yield place


def changed(document, place, value):
    document = copy.deepcopy(document)
    here = document
    for step in place[:-1]:
        here = here[step]
    here[place[-1]] = value
    return document


ALL = [(root, place) for root, (_, document) in ROOTS.items() for place in leaves(document)]


@pytest.mark.parametrize("root", ROOTS)
def test_the_examples_are_right(root):
    model, document = ROOTS[root]
    check_config(document, model, "file")


def test_the_examples_have_every_key():
    for model, row in (
        (TopicSpec, TOPIC), (LinkConfig, LINK), (LocalNetwork, ROBOT["paths"][0]), (RelayConfig, RELAY),
    ):  # fmt: skip
        assert set(model.model_fields) == set(row)
    assert set(BridgeConfig.model_fields) - set(BOTH) <= {"ros1", "ros2"}  # a graph beside it: tested with its port


@pytest.mark.parametrize("wrong", [["x"], {"x": 1}, "\x00nonsense", -1, 1e300, float("nan")], ids=repr)
@pytest.mark.parametrize(("root", "place"), ALL, ids=lambda x: x if isinstance(x, str) else ".".join(map(str, x)))
def test_a_wrong_value_is_answered_by_its_key_and_what_it_should_be(root, place, wrong):
    model, document = ROOTS[root]
    try:
        check_config(changed(document, place, wrong), model, "file")
    except ConfigError as error:
        told, key = str(error), ".".join(map(str, place))
        assert told.startswith("file: ")
        assert key in told or f"{place[0]}:" in told or f"'{document.get('role')}'" in told, told
        assert any(word in told for word in ("should", "must", "is not sent", "may be", "needs", "listed")), told
    else:
        assert isinstance(wrong, str | int | float), "only a value of the right kind can be right"
        assert wrong == wrong, "what is no number is never right"


@pytest.mark.parametrize(("root", "place"), [(r, p) for r, p in ALL if not isinstance(p[-1], int)])
def test_an_unknown_key_is_answered_by_what_there_is(root, place):
    model, document = ROOTS[root]
    with pytest.raises(ConfigError, match="unknown key"):
        check_config(changed(document, (*place[:-1], f"{place[-1]}x"), 1), model, "file")
