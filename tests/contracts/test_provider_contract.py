"""What every provider must do: the words of ``skytether.orchestrator.providers.base``, as tests."""

from __future__ import annotations

import time
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest
from openstack_cloud import OpenstackCloud

from skytether.api.manifest import ServiceSpec
from skytether.orchestrator.providers.base import Condition, Found, Invitation, Order, Provider
from skytether.orchestrator.providers.local import LocalOptions, LocalProvider
from skytether.orchestrator.providers.openstack import OpenstackOptions, OpenstackProvider
from skytether.testing.providers import FakeCloud, FakeProvider, FakeProviderOptions

OWNER, OTHER = "00aa11bb22cc", "ffffffffffff"
INVITATION = Invitation("https://orchestrator.example:8443", "sky-join-secret")


class Kit(ABC):
    """One kind of provider."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder

    @abstractmethod
    def open(self, owner: str = OWNER) -> Provider:
        """A provider over the same machines each time."""

    def order(self, name: str = "cloud-1") -> Order:
        return Order(name, {"team": "walkers"}, INVITATION)

    def close(self) -> None:  # noqa: B027 (most need none)
        """Leave nothing behind; no machine is there by now."""

    def until(self, provider: Provider, seen: Callable[[list[Found]], bool]) -> list[Found]:
        deadline = time.monotonic() + 30.0
        while not seen(there := list(provider.machines())):
            assert time.monotonic() < deadline, there
            time.sleep(0.01)
        return there


class FakeKit(Kit):
    def __init__(self, folder: Path) -> None:
        super().__init__(folder)
        self.cloud = FakeCloud()

    def open(self, owner: str = OWNER) -> Provider:
        return FakeProvider("cloud", owner, self.folder, FakeProviderOptions(), self.cloud)


class LocalKit(Kit):
    def open(self, owner: str = OWNER) -> Provider:
        return LocalProvider("cloud", owner, self.folder, LocalOptions(options={"confined": False}))


class OpenstackKit(Kit):
    def __init__(self, folder: Path) -> None:
        super().__init__(folder)
        self.cloud = OpenstackCloud()
        self.cloud.__enter__()
        (folder / "machine.yaml").write_text("#!/bin/sh\njoin @SKYTETHER_TOKEN@\n")
        self.opened: list[Provider] = []

    def open(self, owner: str = OWNER) -> Provider:
        options = OpenstackOptions(
            cloud="lab",
            clouds_file=self.cloud.clouds_yaml(self.folder),
            flavor="m1.large",
            image="debian-12",
            network="robots",
            user_data=self.folder / "machine.yaml",
        )
        self.opened.append(OpenstackProvider("cloud", owner, self.folder, options))
        return self.opened[-1]

    def close(self) -> None:
        for provider in self.opened:
            provider.close()
        self.cloud.__exit__()


@pytest.fixture(
    params=[
        pytest.param(FakeKit, id="fake"),
        pytest.param(LocalKit, id="local"),
        pytest.param(
            OpenstackKit,
            id="openstack",
            # openstacksdk warns of itself.
            marks=pytest.mark.filterwarnings("ignore::PendingDeprecationWarning"),
        ),
    ]
)
def kit(request: pytest.FixtureRequest, tmp_path: Path) -> Iterator[Kit]:
    kit = request.param(tmp_path)
    yield kit
    for owner in (OWNER, OTHER):
        provider = kit.open(owner)
        for found in provider.machines():
            provider.destroy(found.id)
        provider.close()
    kit.close()


def test_a_machine_offers_something(kit: Kit) -> None:
    offer = kit.open().offer()
    assert offer.cpu > 0
    assert offer.memory_mb > 0


def test_there_is_none_at_first(kit: Kit) -> None:
    assert list(kit.open().machines()) == []


def test_what_was_made_is_there_under_its_name(kit: Kit) -> None:
    provider = kit.open()
    id_ = provider.make(kit.order())
    (found,) = kit.until(provider, lambda there: there[0].condition is Condition.THERE)
    assert (found.id, found.name, found.reason) == (id_, "cloud-1", "")


def test_whoever_comes_next_finds_it(kit: Kit) -> None:
    id_ = kit.open().make(kit.order())
    assert [(found.id, found.name) for found in kit.open().machines()] == [(id_, "cloud-1")]


def test_one_of_that_name_is_not_made_twice(kit: Kit) -> None:
    first, second = kit.open(), kit.open()
    assert first.make(kit.order()) == first.make(kit.order()) == second.make(kit.order())
    assert len(first.machines()) == 1


def test_those_of_another_group_are_not_listed(kit: Kit) -> None:
    mine, other = kit.open(), kit.open(OTHER)
    mine.make(kit.order("cloud-1"))
    other.make(kit.order("cloud-2"))
    assert [found.name for found in mine.machines()] == ["cloud-1"]
    assert [found.name for found in other.machines()] == ["cloud-2"]


def test_what_is_destroyed_goes_and_the_others_stay(kit: Kit) -> None:
    provider = kit.open()
    one, two = provider.make(kit.order("cloud-1")), provider.make(kit.order("cloud-2"))
    provider.destroy(one)
    there = kit.until(provider, lambda there: len(there) == 1)
    assert there[0].id == two


def test_to_destroy_again_or_what_never_was_is_no_error(kit: Kit) -> None:
    provider = kit.open()
    id_ = provider.make(kit.order())
    provider.destroy(id_)
    kit.until(provider, lambda there: not there)
    provider.destroy(id_)
    kit.open().destroy(id_)


def test_it_says_what_its_machines_cannot_run(kit: Kit) -> None:
    provider = kit.open()
    both = [provider.refuses(ServiceSpec(image="x")), provider.refuses(ServiceSpec(entrypoint="x"))]
    assert None in both
    assert any(both)


def test_who_joins_has_no_site_and_who_does_not_has_one(kit: Kit) -> None:
    provider = kit.open()
    assert (provider.site("cloud-1") is None) == provider.joins


def test_an_invitation_is_not_shown(kit: Kit) -> None:
    assert INVITATION.token not in repr(kit.order())


def test_a_closed_one_leaves_the_machines(kit: Kit) -> None:
    provider = kit.open()
    provider.make(kit.order())
    provider.close()
    assert len(kit.open().machines()) == 1
