"""Virtual machines of an OpenStack cloud, by openstacksdk. Credentials are in its clouds.yaml, and nowhere here.

A machine has the group's owner, and its name, among its metadata: whoever renames it loses nothing.
"""

from __future__ import annotations

import base64
import contextlib
import math
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Annotated, Any

from keystoneauth1.exceptions import ClientException, HttpError, MissingRequiredOptions, Unauthorized
from openstack.config import OpenStackConfig
from openstack.connection import Connection
from openstack.exceptions import ConfigException, DuplicateResource, HttpException, NotFoundException, SDKException
from pydantic import AfterValidator, Field
from typing_extensions import override

from skytether.api.manifest import Strict

from ..runtimes.base import ARCHITECTURES, Capacity
from .base import Condition, Found, Order, Provider, ProviderFailure, ProviderSilentError
from .user_data import read_template, render

OWNER, MACHINE, GROUP = "skytether-owner", "skytether-machine", "skytether-group"
_LARGEST_USER_DATA = 65_535
"""Bytes in base64 that Nova takes."""
_LOOK_AGAIN = 60.0
"""Seconds for which flavor, image and network are taken to be as they were."""
_CONDITIONS = {
    "BUILD": Condition.COMING,
    "ERROR": Condition.FAILED,
    "DELETED": Condition.GOING,
    "SOFT_DELETED": Condition.GOING,
}
"""By Nova's status; with any other a machine is there."""
_MANY, _TOO_LARGE = 429, 413
_Name = Annotated[str, Field(min_length=1, max_length=255)]


def _absolute(path: Path) -> Path:
    if not path.is_absolute():
        raise ValueError(f"must be an absolute path such as /etc/skytether/machine.yaml, not '{path}'")
    return path


_Path = Annotated[Path, AfterValidator(_absolute)]


class OpenstackOptions(Strict):
    """Options of a group of OpenStack machines."""

    cloud: _Name
    """Name in clouds.yaml."""
    clouds_file: _Path | None = None
    """The clouds.yaml, mode 0600; None: where openstacksdk looks (``~/.config/openstack``, ``/etc/openstack``)."""
    region: _Name | None = None
    flavor: _Name
    """Name or id, as of image and network."""
    image: _Name
    network: _Name
    user_data: _Path
    """File with what each machine does at its first start, with ``@SKYTETHER_TOKEN@`` where its join token goes,
    ``@SKYTETHER_URL@`` and ``@SKYTETHER_NAME@``."""
    key_name: _Name | None = None
    security_groups: tuple[_Name, ...] = ()
    """None: the project's ``default``. Sessions with robots need their UDP ports open."""
    availability_zone: _Name | None = None
    volume_gb: Annotated[int, Field(ge=1, le=65_536)] | None = None
    """Root disk as a volume of so many GiB, which goes with the machine; None: the flavor's own disk."""
    site: dict[str, Any] = {}
    """Options of the machines' sites, as of a Docker site."""
    timeout_s: Annotated[float, Field(gt=0, le=300)] = 30.0
    """A service of the cloud that has not answered for this long is silent."""


class OpenstackProvider(Provider):
    """Servers of Nova."""

    Options = OpenstackOptions

    @override
    def __init__(self, group: str, owner: str, folder: Path, options: Strict) -> None:
        if not isinstance(options, OpenstackOptions):
            raise TypeError("options must be OpenstackOptions")
        self._group, self._owner, self._options = group, owner, options
        read_template(options.user_data)
        self._cloud = _connect(options)
        self._looked_at = -math.inf
        self._ids: Mapping[str, str] = {}
        self._offer = Capacity(0.0, 0)

    @property
    @override
    def site_options(self) -> Mapping[str, Any]:
        return self._options.site

    def offer(self) -> Capacity:
        if time.monotonic() - self._looked_at >= _LOOK_AGAIN:
            self._refresh()
        return self._offer

    def _refresh(self) -> None:
        options, cloud = self._options, self._cloud
        with self._translated():
            flavor = self._find("flavor", options.flavor, cloud.compute.find_flavor)
            image = self._find("image", options.image, cloud.image.find_image)
            network = self._find("network", options.network, cloud.network.find_network)
        self._ids = {"flavor": flavor.id, "image": image.id, "network": network.id}
        machine = str(image.architecture or "")
        self._offer = Capacity(float(flavor.vcpus), int(flavor.ram), 0, ARCHITECTURES.get(machine, machine))
        self._looked_at = time.monotonic()

    def _find(self, what: str, name: str, find: Callable[..., Any]) -> Any:
        try:
            return find(name, ignore_missing=False)
        except DuplicateResource as error:
            raise ProviderFailure(f"options.{what}: several are named '{name}': give the id of one") from error
        except NotFoundException as error:
            raise ProviderFailure(
                f"options.{what}: there is no {what} '{name}' for cloud '{self._options.cloud}': "
                f"`openstack {what} list` names those there are"
            ) from error

    def make(self, order: Order) -> str:
        for found in self.machines():
            if found.name == order.name and found.condition is not Condition.GOING:
                return found.id
        if not self._ids:
            self._refresh()
        with self._translated():
            made = self._cloud.compute.create_server(**self._asked(order))
        return str(made.id)

    def _asked(self, order: Order) -> dict[str, Any]:
        options = self._options
        data = base64.b64encode(render(options.user_data, order).encode()).decode()
        if len(data) > _LARGEST_USER_DATA:
            raise ProviderFailure(
                f"user_data: {options.user_data} is too large: {len(data)} bytes in base64, not {_LARGEST_USER_DATA}"
            )
        asked: dict[str, Any] = {
            "name": order.name,
            "flavor_id": self._ids["flavor"],
            "networks": [{"uuid": self._ids["network"]}],
            "user_data": data,
            "metadata": {**order.labels, OWNER: self._owner, MACHINE: order.name, GROUP: self._group},
        }
        if options.volume_gb is None:
            asked["image_id"] = self._ids["image"]
        else:
            volume = {"boot_index": 0, "source_type": "image", "destination_type": "volume"}
            size = {"uuid": self._ids["image"], "volume_size": options.volume_gb, "delete_on_termination": True}
            asked["block_device_mapping"] = [volume | size]
        if options.key_name is not None:
            asked["key_name"] = options.key_name
        if options.availability_zone is not None:
            asked["availability_zone"] = options.availability_zone
        if options.security_groups:
            asked["security_groups"] = [{"name": name} for name in options.security_groups]
        return asked

    def machines(self) -> Sequence[Found]:
        with self._translated():
            servers = [one for one in self._cloud.compute.servers() if (one.metadata or {}).get(OWNER) == self._owner]
        return [_found(server) for server in servers]

    def destroy(self, machine: str) -> None:
        with self._translated(), contextlib.suppress(NotFoundException):
            self._cloud.compute.delete_server(machine, ignore_missing=False)

    @override
    def close(self) -> None:
        self._cloud.close()

    @contextlib.contextmanager
    def _translated(self) -> Iterator[None]:
        """Whatever the cloud says, in a sentence."""
        cloud = f"cloud '{self._options.cloud}'"
        try:
            yield
        except Unauthorized as error:
            raise ProviderFailure(
                f"{cloud} does not take the credentials in clouds.yaml: correct them, or make new ones"
            ) from error
        except (HttpException, HttpError) as error:
            raise _refused(cloud, error) from error
        except (SDKException, ClientException) as error:
            raise ProviderSilentError(f"{cloud} does not answer: {_first_line(error)}") from error


def _connect(options: OpenstackOptions) -> Connection:
    files = [str(options.clouds_file)] if options.clouds_file else None
    if options.clouds_file is not None and not options.clouds_file.is_file():
        raise ProviderFailure(f"clouds_file: there is no {options.clouds_file}")
    try:
        config = OpenStackConfig(config_files=files, load_envvars=False, app_name="skytether")
        if options.cloud not in config.get_cloud_names():
            where = options.clouds_file or "clouds.yaml (in ~/.config/openstack or /etc/openstack)"
            raise ProviderFailure(f"options.cloud: there is no cloud '{options.cloud}' in {where}")
        more: dict[str, Any] = {"region_name": options.region} if options.region else {}
        cloud = config.get_one(cloud=options.cloud, api_timeout=options.timeout_s, **more)
        return Connection(config=cloud)
    except (ConfigException, MissingRequiredOptions) as error:
        raise ProviderFailure(f"options.cloud: clouds.yaml of '{options.cloud}': {_first_line(error)}") from error


def _refused(cloud: str, error: HttpException | HttpError) -> ProviderFailure:
    status = (error.status_code if isinstance(error, HttpException) else error.http_status) or 0
    said = str(error.details or error.message if isinstance(error, HttpException) else error.message).rstrip(".")
    said = " ".join(said.split())[:500]
    if status >= 500 or status == 0:
        return ProviderSilentError(f"{cloud} answered with an error of its own ({status}): {said}")
    if "quota" in said.lower():
        return ProviderFailure(f"{cloud} refuses: {said}: ask for a larger quota, or lower the group's max")
    if status in (_MANY, _TOO_LARGE):
        return ProviderFailure(f"{cloud} is asked too often ({status}): {said}")
    return ProviderFailure(f"{cloud} refuses ({status}): {said}")


def _first_line(error: Exception) -> str:
    return (str(error).strip().splitlines() or [type(error).__name__])[0][:300]


def _found(server: Any) -> Found:
    deleting = server.task_state == "deleting"
    condition = Condition.GOING if deleting else _CONDITIONS.get(server.status, Condition.THERE)
    fault = (server.fault or {}).get("message", "") if condition is Condition.FAILED else ""
    reason = f"OpenStack could not make it: {fault or 'it is in state ERROR'}" if condition is Condition.FAILED else ""
    return Found(server.id, server.metadata[MACHINE], condition, reason, str(server.created_at or ""))
