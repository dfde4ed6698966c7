"""The provider ``openstack`` against a cloud that speaks real HTTP, with its faults; nothing secret is told."""

from __future__ import annotations

import base64
import logging
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest
from openstack_cloud import PASSWORD, OpenstackCloud
from pydantic import ValidationError

from skytether.orchestrator.providers.base import (
    Condition,
    Invitation,
    Order,
    ProviderFailure,
    ProviderSilentError,
)
from skytether.orchestrator.providers.openstack import GROUP, MACHINE, OWNER, OpenstackOptions, OpenstackProvider

# openstacksdk warns of itself.
pytestmark = pytest.mark.filterwarnings("ignore::PendingDeprecationWarning")
TOKEN = "sky-join-secret"
ORDER = Order("cloud-1", {"team": "walkers"}, Invitation("https://orchestrator.example:8603", TOKEN))
TEMPLATE = "#cloud-config\nhostname: @SKYTETHER_NAME@\nruncmd: [join @SKYTETHER_URL@ --token @SKYTETHER_TOKEN@]\n"
Open = Callable[..., OpenstackProvider]


@pytest.fixture
def cloud() -> Iterator[OpenstackCloud]:
    with OpenstackCloud() as cloud:
        yield cloud


@pytest.fixture
def opened(cloud: OpenstackCloud, tmp_path: Path) -> Iterator[Open]:
    made = []
    (tmp_path / "machine.yaml").write_text(TEMPLATE)

    def make(**changes: Any) -> OpenstackProvider:
        given = {
            "cloud": "lab",
            "clouds_file": tmp_path / "clouds.yaml",
            "flavor": "m1.large",
            "image": "debian-12",
            "network": "robots",
            "user_data": tmp_path / "machine.yaml",
            "timeout_s": 5,
        }
        cloud.clouds_yaml(tmp_path, **changes.pop("auth", {}))
        provider = OpenstackProvider(
            "cloud", "00aa11bb22cc", tmp_path, OpenstackOptions.model_validate(given | changes)
        )
        made.append(provider)
        return provider

    yield make
    for one in made:
        one.close()


def test_a_machine_is_what_the_options_say(cloud: OpenstackCloud, opened: Open) -> None:
    provider = opened(key_name="ops", availability_zone="nova", security_groups=["robots", "default"])
    offer = provider.offer()
    assert (offer.cpu, offer.memory_mb, offer.architecture) == (4.0, 8192, "amd64")
    provider.make(ORDER)
    (asked,) = cloud.nova.created
    assert asked["flavorRef"] == "f-1"
    assert asked["imageRef"] == next(iter(cloud.nova.images))
    assert asked["networks"] == [{"uuid": next(iter(cloud.nova.networks))}]
    assert (asked["key_name"], asked["availability_zone"]) == ("ops", "nova")
    assert asked["security_groups"] == [{"name": "robots"}, {"name": "default"}]
    assert asked["metadata"] == {"team": "walkers", OWNER: "00aa11bb22cc", MACHINE: "cloud-1", GROUP: "cloud"}
    data = base64.b64decode(asked["user_data"]).decode()
    assert data == (
        f"#cloud-config\nhostname: cloud-1\nruncmd: [join https://orchestrator.example:8603 --token {TOKEN}]\n"
    )


def test_a_root_disk_of_its_own_goes_with_the_machine(cloud: OpenstackCloud, opened: Open) -> None:
    opened(volume_gb=50).make(ORDER)
    (asked,) = cloud.nova.created
    (volume,) = asked["block_device_mapping_v2"]
    assert (volume["volume_size"], volume["delete_on_termination"]) == (50, True)
    assert "imageRef" not in asked or not asked["imageRef"]


def test_an_answer_that_was_lost_makes_no_second_machine(cloud: OpenstackCloud, opened: Open) -> None:
    provider = opened()
    cloud.nova.lose.add("POST /servers")
    with pytest.raises(ProviderSilentError, match="cloud 'lab' does not answer"):
        provider.make(ORDER)
    cloud.nova.lose.clear()
    (found,) = provider.machines()
    assert found.name == "cloud-1"
    assert opened().make(ORDER) == found.id
    assert len(cloud.nova.created) == 1


def test_who_renames_a_machine_loses_nothing(cloud: OpenstackCloud, opened: Open) -> None:
    provider = opened()
    id_ = provider.make(ORDER)
    cloud.nova.servers[id_]["name"] = "something else"
    assert [(found.id, found.name) for found in provider.machines()] == [(id_, "cloud-1")]


def test_a_quota_that_is_used_up_is_named(cloud: OpenstackCloud, opened: Open) -> None:
    provider = opened()
    cloud.nova.quota = 0
    with pytest.raises(ProviderFailure) as caught:
        provider.make(ORDER)
    assert not isinstance(caught.value, ProviderSilentError), "nothing was made, and that is known"
    assert "Quota exceeded for instances: Requested 1, but already used 0 of 0 instances" in str(caught.value)
    assert "ask for a larger quota, or lower the group's max" in str(caught.value)


@pytest.mark.parametrize("what", ["flavor", "image", "network"])
def test_what_is_not_there_is_named(opened: Open, what: str) -> None:
    provider = opened(**{what: "m9.huge"})
    with pytest.raises(ProviderFailure, match=rf"options\.{what}: there is no {what} 'm9\.huge' for cloud 'lab'"):
        provider.offer()
    with pytest.raises(ProviderFailure, match=f"there is no {what}"):
        provider.make(ORDER)


def test_of_two_networks_of_one_name_none_is_guessed(cloud: OpenstackCloud, opened: Open) -> None:
    cloud.nova.networks["1a2b3c4d-0000-4000-8000-000000000003"] = {"name": "robots", "status": "ACTIVE"}
    with pytest.raises(ProviderFailure, match=r"options\.network: several are named 'robots': give the id of one"):
        opened().offer()
    assert opened(network="1a2b3c4d-0000-4000-8000-000000000003").offer().cpu == 4


@pytest.mark.parametrize("status", [500, 502, 503, 504])
def test_an_error_of_the_clouds_own_leaves_open_what_was_done(cloud: OpenstackCloud, opened: Open, status: int) -> None:
    provider = opened()
    provider.offer()
    cloud.nova.fail["POST /servers"] = status
    with pytest.raises(ProviderSilentError, match=f"answered with an error of its own .{status}."):
        provider.make(ORDER)
    cloud.nova.fail = {"GET /servers/detail": status}
    with pytest.raises(ProviderSilentError):
        provider.machines()
    cloud.nova.fail.clear()
    id_ = provider.make(ORDER)
    cloud.nova.fail[f"DELETE /servers/{id_}"] = status
    with pytest.raises(ProviderSilentError):
        provider.destroy(id_)
    assert len(cloud.nova.servers) == 1


def test_who_asks_too_often_is_told(cloud: OpenstackCloud, opened: Open) -> None:
    provider = opened()
    provider.offer()
    cloud.nova.fail["POST /servers"] = 429
    with pytest.raises(ProviderFailure, match="cloud 'lab' is asked too often") as caught:
        provider.make(ORDER)
    assert not isinstance(caught.value, ProviderSilentError)


def test_a_machine_that_no_host_takes_has_failed_with_the_clouds_reason(cloud: OpenstackCloud, opened: Open) -> None:
    provider = opened()
    cloud.nova.no_host = True
    provider.make(ORDER)
    (found,) = provider.machines()
    assert found.condition is Condition.FAILED
    assert found.reason.startswith("OpenStack could not make it: No valid host was found.")


def test_states_of_a_machine(cloud: OpenstackCloud, opened: Open) -> None:
    provider = opened()
    cloud.nova.builds = cloud.nova.lingers = True
    id_ = provider.make(ORDER)
    assert provider.machines()[0].condition is Condition.COMING
    cloud.nova.servers[id_]["status"] = "ACTIVE"
    assert provider.machines()[0].condition is Condition.THERE
    provider.destroy(id_)
    assert provider.machines()[0].condition is Condition.GOING
    assert provider.make(Order("cloud-1", {}, ORDER.invitation)) != id_, "one that goes is none"


def test_one_that_somebody_else_deleted_is_not_listed_and_destroyed_without_an_error(
    cloud: OpenstackCloud, opened: Open
) -> None:
    provider = opened()
    id_ = provider.make(ORDER)
    cloud.nova.servers.clear()
    assert provider.machines() == []
    provider.destroy(id_)


def test_wrong_credentials_are_said_and_never_shown(
    cloud: OpenstackCloud, opened: Open, caplog: pytest.LogCaptureFixture
) -> None:
    caplog.set_level(logging.DEBUG)
    provider = opened(auth={"password": "wrong-and-secret"})
    with pytest.raises(ProviderFailure, match=r"does not take the credentials in clouds\.yaml") as caught:
        provider.offer()
    good = opened()
    good.make(ORDER)
    for secret in ("wrong-and-secret", PASSWORD, TOKEN, base64.b64encode(TOKEN.encode()).decode()):
        assert secret not in str(caught.value)
        assert secret not in caplog.text
        assert secret not in repr(good)


def test_a_cloud_that_is_not_there_does_not_answer(opened: Open) -> None:
    provider = opened(auth={"auth_url": "http://127.0.0.1:9/identity/v3"})
    with pytest.raises(ProviderSilentError, match="cloud 'lab' does not answer"):
        provider.offer()


def test_bad_options_are_refused_in_a_sentence(opened: Open, tmp_path: Path) -> None:
    with pytest.raises(ProviderFailure, match=r"clouds_file: there is no .*/nowhere\.yaml"):
        opened(clouds_file=tmp_path / "nowhere.yaml")
    with pytest.raises(ProviderFailure, match=r"options\.cloud: there is no cloud 'lap' in .*/clouds\.yaml"):
        opened(cloud="lap")
    with pytest.raises(ProviderFailure, match=r"user_data: .*/no\.yaml: No such file"):
        opened(user_data=tmp_path / "no.yaml")
    (tmp_path / "bare.yaml").write_text("#cloud-config\n")
    with pytest.raises(ProviderFailure, match="has no @SKYTETHER_TOKEN@: without a join token"):
        opened(user_data=tmp_path / "bare.yaml")
    (tmp_path / "large.yaml").write_text(TEMPLATE + "#" * 60_000)
    with pytest.raises(ProviderFailure, match="is too large"):
        opened(user_data=tmp_path / "large.yaml").make(ORDER)
    with pytest.raises(ValidationError, match="must be an absolute path"):
        opened(user_data="machine.yaml")


def test_without_any_clouds_yaml_that_is_said(opened: Open, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("HOME", str(tmp_path))
    monkeypatch.setenv("OS_CLOUD", "lab")  # the environment is not asked
    with pytest.raises(ProviderFailure, match=r"there is no cloud 'lab' in clouds\.yaml \(in ~/\.config/openstack"):
        opened(clouds_file=None)


def test_lookups_are_not_made_again_and_again(cloud: OpenstackCloud, opened: Open) -> None:
    provider = opened()
    provider.offer()
    before = len(cloud.nova.calls)
    for _ in range(5):
        provider.offer()
    assert len(cloud.nova.calls) == before
