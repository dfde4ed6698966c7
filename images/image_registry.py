"""A registry of images, as much of the OCI distribution specification 1.1 as a push needs.

What is pushed here goes by its digest; no tag points at it until the caller says so with ``put_tag``.
"""

from __future__ import annotations

import hashlib
import ipaddress
import json
import re
import ssl
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any
from urllib.parse import urlsplit

import httpx
from docker import auth

INDEX = "application/vnd.oci.image.index.v1+json"
MANIFEST = "application/vnd.oci.image.manifest.v1+json"
_ACCEPTED = ", ".join((INDEX, MANIFEST, "application/vnd.docker.distribution.manifest.list.v2+json"))
_CERTIFICATES = Path("/etc/docker/certs.d")
_TIMEOUT_S = 60.0
_CHUNK = 1 << 20


class RegistryError(Exception):
    """One sentence that says what to do."""


def digest_of(content: bytes) -> str:
    """The name of these bytes in a registry."""
    return f"sha256:{hashlib.sha256(content).hexdigest()}"


def split(where: str) -> tuple[str, str]:
    """The host of ``HOST[:PORT][/FOLDER]``, and the folder or ''.

    Raises:
        RegistryError: It is none.
    """
    host, _, folder = where.strip("/").partition("/")
    name = r"[a-z0-9]+(?:(?:[._]|__|-+)[a-z0-9]+)*"
    if not re.fullmatch(r"(\[[0-9a-fA-F:]+\]|[A-Za-z0-9.-]+)(:\d{1,5})?", host) or not (
        host == "localhost" or "." in host or ":" in host
    ):
        raise RegistryError(f"'{where}' names no registry: give HOST[:PORT]/FOLDER, as registry.example/skytether")
    if folder and not re.fullmatch(rf"{name}(/{name})*", folder):
        raise RegistryError(f"'{folder}' cannot be a folder of a registry: small letters, digits, '.', '_', '-', '/'")
    return host, folder


class Registry:
    """One registry, with what ``docker login`` keeps for it.

    It is asked over HTTPS, with the system's certificates and those in ``/etc/docker/certs.d/HOST``; on this machine's
    loopback over plain HTTP, unless it wants HTTPS there, too.
    """

    def __init__(self, host: str) -> None:
        self.host = host
        self._loopback = _is_loopback(host)
        self._login = auth.load_config().resolve_authconfig(host) or {}
        self._tokens: dict[str, str] = {}
        context = ssl.create_default_context()
        for path in sorted((_CERTIFICATES / host).glob("*.crt")):
            context.load_verify_locations(path)
        self._client = httpx.Client(verify=context, timeout=_TIMEOUT_S, trust_env=not self._loopback)
        address = "registry-1.docker.io" if host in ("docker.io", "index.docker.io") else host
        self._base = f"{'http' if self._loopback else 'https'}://{address}"

    def close(self) -> None:
        """End its connections."""
        self._client.close()

    def check(self, repository: str) -> None:
        """Whether this may be pushed to; no image or tag is left there.

        Raises:
            RegistryError: Why not.
        """
        if self._loopback and self._send("GET", f"{self._base}/v2/").status_code == 400:
            self._base = self._base.replace("http://", "https://", 1)
        answer = self._request("GET", "/v2/", repository)
        if answer.status_code != 200:
            raise RegistryError(f"{self.host} answers, but as no registry does (status {answer.status_code} to /v2/)")
        begun = self._ask("POST", f"/v2/{repository}/blobs/uploads/", repository, 202)
        # Some take this only from who may delete; what is begun and not used they clear away themselves.
        self._send("DELETE", self._location(begun), repository)

    def put_blob(self, repository: str, digest: str, content: bytes | Path) -> None:
        """Have it there."""
        if self._request("HEAD", f"/v2/{repository}/blobs/{digest}", repository).status_code == 200:
            return
        begun = self._ask("POST", f"/v2/{repository}/blobs/uploads/", repository, 202)
        location = httpx.URL(self._location(begun)).copy_merge_params({"digest": digest})
        self._ask("PUT", str(location), repository, 201, content, {"Content-Type": "application/octet-stream"})

    def put_manifest(self, repository: str, content: bytes) -> None:
        """Have it there, under its digest; what it refers to is there. One with a subject is found from that one."""
        answer = self._put(repository, digest_of(content), content)
        told = json.loads(content)
        subject = told.get("subject")
        if subject is None or "OCI-Subject" in answer.headers:
            return
        # A registry that knows no subjects: the specification's way is a tag, whose index lists what refers to it.
        tag = subject["digest"].replace(":", "-")
        known = self.manifest(repository, tag) or {"schemaVersion": 2, "mediaType": INDEX, "manifests": []}
        row = {"mediaType": told["mediaType"], "digest": digest_of(content), "size": len(content)}
        row |= {key: told[key] for key in ("artifactType", "annotations") if key in told}
        if row["digest"] not in {one["digest"] for one in known["manifests"]}:
            known["manifests"].append(row)
            self.put_tag(repository, tag, json.dumps(known).encode())

    def put_tag(self, repository: str, tag: str, content: bytes) -> None:
        """Let a tag point at this index or manifest; what it refers to is there."""
        self._put(repository, tag, content)

    def manifest(self, repository: str, reference: str) -> dict[str, Any] | None:
        """What a tag or digest points at."""
        answer = self._request(
            "GET", f"/v2/{repository}/manifests/{reference}", repository, headers={"Accept": _ACCEPTED}
        )
        if answer.status_code != 200:
            return None
        found: dict[str, Any] = answer.json()
        return found

    def _put(self, repository: str, reference: str, content: bytes) -> httpx.Response:
        kind = {"Content-Type": json.loads(content)["mediaType"]}
        return self._ask("PUT", f"/v2/{repository}/manifests/{reference}", repository, 201, content, kind)

    def _ask(
        self,
        method: str,
        url: str,
        repository: str,
        expected: int,
        content: bytes | Path = b"",
        headers: Mapping[str, str] | None = None,
    ) -> httpx.Response:
        answer = self._request(method, url, repository, content, headers)
        if answer.status_code == expected:
            return answer
        if answer.status_code in (401, 403):
            raise RegistryError(f"{self._login_name} may not push to {self.host}/{repository}{_said(answer)}")
        raise RegistryError(
            f"{self.host} refused what was pushed to {repository}: status {answer.status_code}{_said(answer)}"
        )

    @property
    def _login_name(self) -> str:
        name = self._field("Username")
        return f"'{name}'" if name else "this login"

    def _request(
        self,
        method: str,
        url: str,
        repository: str,
        content: bytes | Path = b"",
        headers: Mapping[str, str] | None = None,
    ) -> httpx.Response:
        url = url if "://" in url else f"{self._base}{url}"
        for last in (False, True):
            answer = self._send(method, url, repository, content, headers)
            if answer.status_code != 401 or last:
                break
            self._authenticate(answer, repository)
        if answer.status_code == 401:
            raise RegistryError(self._refused(answer))
        return answer

    def _refused(self, answer: httpx.Response) -> str:
        """What to say of an answer that wants another login."""
        if not (self._field("Username") or self._field("IdentityToken")):
            return f"{self.host} wants a login: docker login {self.host}"
        return f"{self.host} does not take the login kept for it{_said(answer)}: docker login {self.host}"

    def _send(
        self,
        method: str,
        url: str,
        repository: str = "",
        content: bytes | Path = b"",
        headers: Mapping[str, str] | None = None,
    ) -> httpx.Response:
        size = content.stat().st_size if isinstance(content, Path) else len(content)
        sent = dict(headers or {})
        if method in ("PUT", "POST"):
            sent["Content-Length"] = str(size)
        # A storage elsewhere, to which a registry sends on, has its right in the address.
        if repository in self._tokens and urlsplit(url)[:2] == urlsplit(self._base)[:2]:
            sent["Authorization"] = self._tokens[repository]
        try:
            body = _read(content) if isinstance(content, Path) else content
            return self._client.request(method, url, content=body, headers=sent, follow_redirects=method != "PUT")
        except (httpx.HTTPError, httpx.InvalidURL) as error:
            raise RegistryError(self._trouble(error)) from error

    def _trouble(self, error: Exception) -> str:
        text = str(error) or type(error).__name__
        if "WRONG_VERSION_NUMBER" in text or "record layer failure" in text:
            return (
                f"{self.host} speaks plain HTTP, which anybody on the way can change: give it a certificate, "
                "or reach it at a port of this machine (ssh -L 5000:localhost:5000 HOST)"
            )
        if "CERTIFICATE_VERIFY_FAILED" in text:
            return f"{self.host} has no certificate that this machine trusts ({text}): put its CA's into " + str(
                _CERTIFICATES / self.host / "ca.crt"
            )
        return f"{self.host} does not answer as a registry: {text}"

    def _location(self, answer: httpx.Response) -> str:
        return str(answer.url.join(answer.headers.get("Location", "")))

    def _field(self, name: str) -> str:
        """Of the login; what it is called depends on where it is kept."""
        return str({key.lower(): value for key, value in self._login.items()}.get(name.lower()) or "")

    def _authenticate(self, refusal: httpx.Response, repository: str) -> None:
        """Get what the registry wants to see."""
        challenge = refusal.headers.get("WWW-Authenticate", "")
        scheme, wanted = challenge.partition(" ")[0].lower(), dict(re.findall(r'(\w+)="([^"]*)"', challenge))
        login = (self._field("Username"), self._field("Password"))
        if scheme == "basic":
            if not login[0]:
                raise RegistryError(self._refused(refusal))
            self._tokens[repository] = httpx.BasicAuth(*login)._auth_header  # noqa: SLF001 (it has no other name)
            return
        realm = wanted.get("realm", "")
        if scheme != "bearer" or not realm:
            raise RegistryError(f"{self.host} wants a login of a kind that is not known here: '{challenge}'")
        if not (realm.startswith("https://") or _is_loopback(urlsplit(realm).netloc)):
            raise RegistryError(f"{self.host} wants its login sent over plain HTTP, to {realm}")
        asked = {"service": wanted.get("service", ""), "scope": f"repository:{repository}:pull,push"}
        refresh = self._field("IdentityToken")
        try:
            if refresh:
                form = {"grant_type": "refresh_token", "client_id": "skytether", "refresh_token": refresh}
                answer = self._client.post(realm, data=form | asked)
            else:
                answer = self._client.get(realm, params=asked, auth=login if login[0] else None)
        except httpx.HTTPError as error:
            raise RegistryError(f"{realm}, which gives the rights for {self.host}, does not answer: {error}") from error
        if answer.status_code != 200:
            raise RegistryError(self._refused(answer))
        told = answer.json()
        self._tokens[repository] = f"Bearer {told.get('token') or told.get('access_token')}"


def _read(path: Path) -> Iterator[bytes]:
    with path.open("rb") as file:
        while chunk := file.read(_CHUNK):
            yield chunk


def _said(answer: httpx.Response) -> str:
    """A registry's own words."""
    try:
        rows = answer.json()["errors"]
        return "".join(f" ({row['code']}: {row.get('message', '')})" for row in rows[:1])
    except (ValueError, KeyError, TypeError):
        return ""


def _is_loopback(host: str) -> bool:
    name = urlsplit(f"//{host}").hostname or ""
    try:
        return ipaddress.ip_address(name).is_loopback
    except ValueError:
        return name == "localhost"
