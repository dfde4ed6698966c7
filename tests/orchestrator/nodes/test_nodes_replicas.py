"""A node of several orchestrators over one PostgreSQL database: whichever leads has its engine. Real programs."""

from __future__ import annotations

import signal
import tempfile
from collections.abc import Iterator
from pathlib import Path
from threading import Barrier, Thread
from typing import Any

import pytest
from node_scene import MadeUpEngine, program
from orchestrator_program import Program, until

from skytether.api.client import Client
from skytether.api.node import Issued, Join
from skytether.api.rest import Invite
from skytether.node.calls import RefusedError, call, first_call, trusting
from skytether.node.join import JoinOptions, join
from skytether.node.store import NodeStore, new_key, request_for

pytestmark = [pytest.mark.slow, pytest.mark.postgres]
ANSWERS = ("ready", "blocked")


@pytest.fixture
def two(tmp_path: Path, postgres: str) -> Iterator[list[Program]]:
    secrets = tmp_path / "secrets"
    secrets.mkdir(mode=0o700)
    made = []
    for name in ("one", "two"):
        (tmp_path / name).mkdir()
        one = Program(tmp_path / name / "state", "--database", postgres, "--secrets-dir", str(secrets))
        one.environment = {"SKYTETHER_NODES_PORT": "0", "SKYTETHER_LOCAL_SITE": "false"}
        made.append(one)
    yield made
    for one in made:
        one.clean_up()


def client_of(one: Program, secrets: Path) -> Client:
    one.spawn()
    until(lambda: (one.folder / "nodes.address").exists() and (one.folder / "address").exists(), one)
    return one.client((secrets / "operator.token").read_text().strip())


def test_when_the_leader_is_killed_the_next_one_has_the_nodes_engine_at_once(
    two: list[Program], tmp_path: Path
) -> None:
    one, other = two
    with (
        client_of(one, tmp_path / "secrets") as first,
        client_of(other, tmp_path / "secrets") as second,
        tempfile.TemporaryDirectory(prefix="sky-") as short,
    ):
        engine, store = MadeUpEngine(Path(short) / "e.sock"), NodeStore(tmp_path / "node")
        urls = tuple((program_.folder / "nodes.address").read_text().strip() for program_ in two)
        try:
            token = second.invite(Invite(name="ward")).token  # at one, and joined at the other
            options = JoinOptions(
                urls, token, f"unix://{engine.path}", "127.0.0.1", echo=None, folder=store.folder, unit=False
            )
            assert join(options).stands.state in ANSWERS
            with program(store) as linked:
                until(lambda: set(linked) >= set(urls))
                for client in (first, second):
                    until(lambda client=client: client.get_site("ward").state in ANSWERS)  # type: ignore[misc]
                links = other.log.count("is linked from")
                one.end(signal.SIGKILL)
                until(lambda: 'skytether_site_up{site="ward"} 1.0' in second.metrics())
                until(lambda: second.get_site("ward").state in ANSWERS)
                assert other.log.count("is linked from") == links, "by the link that it had"
        finally:
            engine.stop()


def test_of_many_joins_with_one_token_at_several_orchestrators_one_is_done(two: list[Program], tmp_path: Path) -> None:
    one, other = two
    with client_of(one, tmp_path / "secrets"), client_of(other, tmp_path / "secrets") as second:
        urls = [(program_.folder / "nodes.address").read_text().strip() for program_ in two]
        for name in ("ward", "hall", "attic"):
            token = second.invite(Invite(name=name)).token
            trust = trusting(first_call(urls[0], token.partition(".")[2]).authority)
            together, said = Barrier(6), []

            def ask(
                url: str, token: str = token, trust: Any = trust, together: Any = together, said: Any = said
            ) -> None:
                asked = Join(token=token, request=request_for(new_key()), address="127.0.0.1")
                together.wait(60)
                try:
                    said.append(call(url, trust, asked, Issued).name)
                except RefusedError as error:
                    said.append(str(error))

            threads = [Thread(target=ask, args=(urls[number % 2],)) for number in range(6)]
            for thread in threads:
                thread.start()
            for thread in threads:
                thread.join()
            assert said.count(name) == 1
            assert [text for text in said if "was used at" not in text] == [name]
            # The other orchestrator may have done it: this one looks from time to time.
            until(lambda name=name: [site.name for site in second.sites()].count(name) == 1)  # type: ignore[misc]
