"""Images that orchestrators have this machine's engine pull: by digest alone, so that no name of an engine changes.

What somebody on this machine built or tagged stays what it was, whatever a registry says of that name, and whenever.
What orchestrators call an image the node keeps itself.
"""

from __future__ import annotations

import json
import re
from collections import Counter
from collections.abc import Callable, Mapping
from http import HTTPStatus

from .asking import Asking, RefusedCall
from .engine_rules import DIGEST
from .registries import DOCKER_HUB, Registries, registry_of

_IMAGE = re.compile(r"((?:/v[0-9.]+)?/images/)([^@]+)/json")
_MOST, _OLDER = 1 << 12, 2
"""Names that are kept, those that were used last at the end; for each so many digests, the newest first: a pull may
fail."""
_REGISTRY_S = 60.0
"""For a registry to say what is there [s]."""
AUTH = b"x-registry-auth"

Names = Mapping[str, list[str]]


class Pulls:
    """Of one engine.

    Args:
        asking: Asks it.
        registries: From which it may be asked to pull.
        names: Digests by name, as they were kept.
        keep: Keeps them; raises OSError.
    """

    def __init__(self, asking: Asking, registries: Registries, names: Names, keep: Callable[[Names], object]) -> None:
        self._asking = asking
        self._registries = registries
        self._names = dict(names)
        self._keep = keep

    async def may_come_from(self, image: str) -> None:
        """Raises `RefusedCall` unless an image of that name is pulled from a registry that is open."""
        if odd := await self._registries.refusal(image):
            raise RefusedCall(odd)

    async def digest_of(self, image: str, tag: str, headers: Mapping[bytes, bytes]) -> str:
        """By what it is pulled; raises `RefusedCall`.

        An engine that has an image by that name itself goes on having that, and nothing is pulled: whoever starts it by
        that name would start another one.

        Args:
            image: Its name.
            tag: Its tag, or digest.
            headers: Of the call.
        """
        if re.fullmatch(DIGEST, tag):
            return tag
        name = f"{image}:{tag}"
        if (await self._asking.ask(f"/images/{name}/json", most=1)).status != HTTPStatus.NOT_FOUND:
            raise RefusedCall(f"the image {name[:80]} is this machine's own: nothing else is pulled by that name")
        auth = {"X-Registry-Auth": headers[AUTH].decode()} if AUTH in headers else {}
        answer = await self._asking.ask(f"/distribution/{name}/json", patience=_REGISTRY_S, headers=auth)
        try:
            said = json.loads(answer.content)
            if answer.status != HTTPStatus.OK:
                raise RefusedCall(f"{name[:80]}: {str(said['message'])[:1000]}", HTTPStatus(answer.status))
            digest = str(said["Descriptor"]["digest"])
        except (ValueError, LookupError, TypeError) as error:
            raise RefusedCall(f"its engine does not say what {name[:80]} is", HTTPStatus.BAD_GATEWAY) from error
        if not re.fullmatch(DIGEST, digest):
            raise RefusedCall(f"{name[:80]} has an odd digest: {digest[:80]}")
        self._note(_familiar(name), digest)
        return digest

    def _note(self, name: str, digest: str) -> None:
        before = self._names.pop(name, [])
        self._names[name] = [digest, *(one for one in before if one != digest)][:_OLDER]
        while len(self._names) > _MOST:  # of the registry that has most the one that was used before all others
            most, _ = Counter(map(registry_of, self._names)).most_common(1)[0]
            del self._names[next(one for one in self._names if registry_of(one) == most)]
        try:
            self._keep(self._names)
        except OSError as error:
            raise RefusedCall(f"it cannot be kept what {name[:80]} is: {error.strerror}") from error

    async def path_of(self, path: str) -> str:
        """By what path an engine is asked for an image: its own by that name goes first."""
        found = _IMAGE.fullmatch(path)
        if found is None:
            return path
        repository, tag = _split(found[2])
        name = _familiar(f"{repository}:{tag or 'latest'}")
        digests = self._names.get(name)
        if not digests:
            return path
        self._names[name] = self._names.pop(name)
        if (await self._status(path)) != HTTPStatus.NOT_FOUND:
            return path
        for digest in digests:
            pinned = f"{found[1]}{repository}@{digest}/json"
            if (await self._status(pinned)) == HTTPStatus.OK:
                return pinned
        return path

    async def _status(self, path: str) -> int:
        return (await self._asking.ask(path, most=1)).status


def _split(name: str) -> tuple[str, str]:
    """Repository and tag; empty: it has none."""
    repository, colon, tag = name.rpartition(":")
    return (repository, tag) if colon and "/" not in tag else (name, "")


def _familiar(image: str) -> str:
    """A name as an engine shortens it."""
    short = re.sub(r"^(?:index\.)?docker\.io/", "", image)
    return short.removeprefix("library/") if registry_of(short) == DOCKER_HUB else image
