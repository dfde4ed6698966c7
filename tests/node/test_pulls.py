"""What orchestrators call an image, the node keeps itself: no name of the engine changes."""

from __future__ import annotations

import asyncio
import json
from http import HTTPStatus
from pathlib import Path
from typing import Any

import pytest

from skytether.node.asking import Asking, RefusedCall
from skytether.node.machine import Answer
from skytether.node.pulls import Pulls
from skytether.node.registries import Registries
from skytether.node.store import NodeStore

FIRST, SECOND = f"sha256:{'a' * 64}", f"sha256:{'b' * 64}"


class Engine(Asking):
    """Has images by what they are asked for by, and asks a registry that has others."""

    def __init__(self, *has: str) -> None:
        super().__init__("")
        self.has = set(has)
        self.registry: dict[str, Any] = {}

    async def ask(self, path: str, **_: Any) -> Answer:
        kind, name = path.removeprefix("/v1.41").removesuffix("/json").strip("/").split("/", 1)
        if kind == "images":
            return Answer(HTTPStatus.OK if name in self.has else HTTPStatus.NOT_FOUND, {}, b"")
        found = self.registry.get(name, "no such manifest")
        said = {"Descriptor": {"digest": found[0]}} if isinstance(found, list) else {"message": found} if found else {}
        return Answer(HTTPStatus.NOT_FOUND if isinstance(found, str) else HTTPStatus.OK, {}, json.dumps(said).encode())


def pulls(engine: Engine, store: NodeStore) -> Pulls:
    return Pulls(engine, Registries(), store.names(), store.save_names)


@pytest.fixture
def store(tmp_path: Path) -> NodeStore:
    return NodeStore(tmp_path)


def test_by_a_name_that_was_pulled_the_image_is_found_also_by_the_next_program(store: NodeStore) -> None:
    engine = Engine()
    engine.registry = {"a.example:5000/x/app:1": [FIRST], "app:latest": [SECOND]}

    async def run() -> None:
        made = pulls(engine, store)
        assert await made.digest_of("a.example:5000/x/app", "1", {}) == FIRST
        path = "/v1.41/images/a.example:5000/x/app:1/json"
        assert await made.path_of(path) == path, "it is on its way"
        engine.has = {f"a.example:5000/x/app@{FIRST}"}
        for one in (made, pulls(engine, store)):
            assert await one.path_of(path) == f"/v1.41/images/a.example:5000/x/app@{FIRST}/json"
        assert await made.digest_of("app", "latest", {}) == SECOND
        engine.has |= {f"app@{SECOND}", f"docker.io/library/app@{SECOND}"}
        assert await made.path_of("/images/app/json") == f"/images/app@{SECOND}/json"
        again = await made.path_of("/images/docker.io/library/app:latest/json")
        assert again == f"/images/docker.io/library/app@{SECOND}/json"
        for other in (
            f"/images/app@{SECOND}/json",
            "/images/other:1/json",
            "/containers/json",
            f"/images/{FIRST}/json",
        ):
            assert await made.path_of(other) == other

    asyncio.run(run())


def test_what_a_name_is_on_this_machine_goes_first_whenever_it_got_that(store: NodeStore) -> None:
    """A registry gave such an image a digest of its own, or held a pull back until somebody had built one."""
    engine = Engine("a.example/app:1", f"a.example/app@{FIRST}")
    engine.registry = {"a.example/app:1": [FIRST]}

    async def run() -> None:
        made = pulls(engine, store)
        with pytest.raises(RefusedCall, match="this machine's own: nothing else is pulled by that name"):
            await made.digest_of("a.example/app", "1", {})
        engine.has.clear()
        assert await made.digest_of("a.example/app", "1", {}) == FIRST
        engine.has = {"a.example/app:1", f"a.example/app@{FIRST}"}
        assert await made.path_of("/images/a.example/app:1/json") == "/images/a.example/app:1/json"

    asyncio.run(run())


def test_where_a_new_one_does_not_come_the_one_before_is_found(store: NodeStore) -> None:
    engine = Engine()

    async def run() -> None:
        made = pulls(engine, store)
        for digest in (FIRST, SECOND, FIRST, SECOND):
            engine.registry = {"a.example/app:1": [digest]}
            assert await made.digest_of("a.example/app", "1", {}) == digest
        engine.has = {f"a.example/app@{FIRST}"}
        assert await made.path_of("/images/a.example/app:1/json") == f"/images/a.example/app@{FIRST}/json"

    asyncio.run(run())
    assert store.names() == {"a.example/app:1": [SECOND, FIRST]}


@pytest.mark.parametrize(
    ("said", "words"),
    [
        ("manifest unknown", "a.example/app:1: manifest unknown"),
        (["latest"], "has an odd digest: latest"),
        ({}, "its engine does not say what a.example/app:1 is"),
    ],
)
def test_what_a_registry_does_not_have_is_told(store: NodeStore, said: Any, words: str) -> None:
    engine = Engine()
    engine.registry = {"a.example/app:1": said}
    with pytest.raises(RefusedCall, match=words):
        asyncio.run(pulls(engine, store).digest_of("a.example/app", "1", {}))
    assert store.names() == {}


def test_of_names_some_are_kept_and_of_a_damaged_file_none(store: NodeStore, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("skytether.node.pulls._MOST", 3)
    engine = Engine()
    engine.registry = {f"app:{number}": [FIRST] for number in range(5)}

    async def run() -> None:
        made = pulls(engine, store)
        for number in range(5):
            await made.digest_of("app", str(number), {})

    asyncio.run(run())
    assert list(store.names()) == ["app:2", "app:3", "app:4"]
    (store.folder / "images.json").write_text("{")
    assert store.names() == {}


def test_names_of_one_registry_push_out_none_of_another_nor_one_that_is_used(
    store: NodeStore, monkeypatch: pytest.MonkeyPatch
) -> None:
    """After four thousand pulls from a registry that has any tag, what others had pulled was not found again."""
    monkeypatch.setattr("skytether.node.pulls._MOST", 8)
    engine = Engine()
    engine.registry = {f"evil.example/x:{number}": [FIRST] for number in range(50)}
    engine.registry |= {"good.example/app:1": [FIRST], "mine:1": [FIRST], "mine:2": [FIRST]}

    async def run() -> None:
        made = pulls(engine, store)
        await made.digest_of("good.example/app", "1", {})
        for number in range(50):
            await made.digest_of("evil.example/x", str(number), {})
        assert "good.example/app:1" in store.names()
        for number in range(50):
            await made.path_of("/images/evil.example/x:45/json")
            await made.digest_of("evil.example/x", str(number % 40), {})
        assert {"good.example/app:1", "evil.example/x:45"} <= store.names().keys()

    asyncio.run(run())


def test_a_repository_of_the_hub_is_none_of_a_registry_that_it_is_named_as(store: NodeStore) -> None:
    engine = Engine()
    engine.registry = {"docker.io/reg.example/app:1": [FIRST], "reg.example/app:1": [SECOND]}

    async def run() -> None:
        made = pulls(engine, store)
        await made.digest_of("reg.example/app", "1", {})
        await made.digest_of("docker.io/reg.example/app", "1", {})

    asyncio.run(run())
    assert store.names() == {"reg.example/app:1": [SECOND], "docker.io/reg.example/app:1": [FIRST]}
