"""Calls to a cluster's API server: JSON in, JSON out, errors as sentences."""

from __future__ import annotations

import json
import logging
import os
import re
import socket
import threading
import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager, suppress
from functools import partial
from http import HTTPStatus
from math import inf
from pathlib import Path
from typing import Any

import urllib3
import yaml
from kubernetes import client, config
from kubernetes.config.config_exception import ConfigException

from ..base import RuntimeFailure, SiteSilentError
from ..whole_answer import hurried, original
from .credentials import expired
from .options import KubernetesOptions
from .pace import Pace

log = logging.getLogger(__name__)

_MOST = 32 << 20
"""Bytes of an answer."""
_MOST_REFUSAL = 64 << 10
_PIECE = 1 << 16
OLDEST = 1, 20
"""Version of Kubernetes: startup probes, immutable Secrets and server-side apply are there."""
_POOL = 16
"""Connections that are kept."""
_PER_S, _BURST = 300.0, 100
"""Calls: never more than 400 in a second, however many instances there are."""
_AGAIN_S = 1.0
"""Until the next call, where the API server has too much to do and does not say for how long."""
_MERGE = "application/merge-patch+json"
_STRATEGIC = "application/strategic-merge-patch+json"
_APPLY = "application/apply-patch+yaml"
_MANAGER = {"fieldManager": "skytether"}
"""Who has written what we write, as every object says (``managedFields``)."""
_JSON = "application/json"
_STRANGER = 'User "system:anonymous"'
"""Whom API servers take us for that know none of what we show."""
_LACKS = re.compile(r'User ".*" cannot \S+ (resource|path)')
_WEBHOOK = "failed calling webhook"
"""Says an API server of an admission webhook that does not answer: it refuses, and is not unwell itself."""
RENEW_S = 1.0
"""Seconds between two looks for other credentials, while those that we have are refused."""
Document = Mapping[str, Any]


class ClusterGoneError(SiteSilentError):
    """The API server does not answer, or says that it cannot at present."""


class ClusterSilentError(ClusterGoneError):
    """It does not answer at all."""


class RefusedError(RuntimeFailure):
    """The API server has refused, in its own words."""

    def __init__(self, text: str, status: int, reason: str) -> None:
        super().__init__(text)
        self.status = status
        self.reason = reason
        """In one word, ``AlreadyExists``."""


class Cluster:
    """One cluster, one namespace. From any thread."""

    def __init__(self, options: KubernetesOptions) -> None:
        """Raises RuntimeFailure: it can never be reached with these options."""
        self._options = options
        self._lock = threading.Lock()
        self._client = _client(options)
        self._opened_at = time.monotonic()
        self._where = self._client.configuration.host
        self._pace = Pace(_PER_S, _BURST)
        if not self._client.configuration.verify_ssl:
            log.warning("kubeconfig %s: the API server's certificate is not checked, as it says", options.kubeconfig)
            urllib3.disable_warnings(urllib3.exceptions.InsecureRequestWarning)  # once is enough

    @property
    def namespace(self) -> str:
        return self._options.namespace

    def path(self, kind: str, name: str = "", *, group: str = "") -> str:
        """Of objects of the namespace; ``group``: API group and version, "" for the core's."""
        api = f"/apis/{group}" if group else "/api/v1"
        return f"{api}/namespaces/{self.namespace}/{kind}{f'/{name}' if name else ''}"

    def check_version(self) -> None:
        """Raises RuntimeFailure: it is too old for what is asked of it, or does not answer."""
        told = self.get("/version")
        version = told.get("major", "0"), str(told.get("minor", "0")).rstrip("+")
        if all(part.isdecimal() for part in version) and tuple(map(int, version)) < OLDEST:
            raise RuntimeFailure(
                f"the cluster has Kubernetes {'.'.join(version)}, and {'.'.join(map(str, OLDEST))} is the oldest that "
                "can be a site: upgrade it"
            )

    def get(self, path: str, **query: str | int) -> Any:
        return self._document("GET", path, query=query)

    def labelled(self, kind: str, selector: str, *, group: str = "") -> list[Any]:
        """Objects of the namespace with these labels."""
        found: list[Any] = self.get(self.path(kind, group=group), labelSelector=selector)["items"]
        return found

    def create(self, path: str, body: Document) -> Any:
        return self._document("POST", path, query=_MANAGER, body=body)

    def replace(self, path: str, body: Document) -> Any:
        return self._document("PUT", path, query=_MANAGER, body=body)

    def merge(self, path: str, body: Document) -> Any:
        """A JSON merge patch."""
        return self._document("PATCH", path, query=_MANAGER, body=body, kind=_MERGE)

    def merge_lists(self, path: str, body: Document) -> Any:
        """A strategic merge patch: of lists, what is named in it is changed, and the rest stays."""
        return self._document("PATCH", path, query=_MANAGER, body=body, kind=_STRATEGIC)

    def offers(self, resource: str) -> bool:
        """Whether the API server has it, of the core's group: ``pods/resize``."""
        return any(one.get("name") == resource for one in self.get("/api/v1").get("resources") or ())

    def apply(self, path: str, body: Document) -> Any:
        """Server-side apply: it is there afterwards, and has what ``body`` says; what others have added stays.

        Not for what only one may make, or may change only as it was read: then ``create`` and ``replace``.
        """
        return self._document("PATCH", path, query={**_MANAGER, "force": "true"}, body=body, kind=_APPLY)

    def delete(self, path: str, **options: Any) -> None:
        """What is not there any more is left so."""
        try:
            self._document("DELETE", path, body={"kind": "DeleteOptions", "apiVersion": "v1", **options})
        except RefusedError as error:
            if error.status != HTTPStatus.NOT_FOUND:
                raise

    def text(self, path: str, **query: str | int) -> str:
        """Of what answers with no JSON: logs."""
        with self._asked("GET", path, query, timeout=self._options.timeout_s) as answer:
            return _read(answer).decode(errors="replace")

    def small(self, path: str, most: int, timeout_s: float) -> bytes:
        """Of what somebody else answers: ``most`` bytes, whole within that time [s].

        Raises:
            RuntimeFailure: It is larger, or later.
        """
        with self._asked("GET", path, {}, timeout=min(timeout_s, self._options.timeout_s)) as answer:
            return _read(answer, most)

    @contextmanager
    def stream(self, path: str, silence_s: float, **query: str | int) -> Iterator[urllib3.HTTPResponse]:
        """An answer that goes on; ``silence_s``: for how long nothing may come."""
        timeout = (self._options.timeout_s, silence_s)
        with self._asked("GET", path, query, timeout=timeout) as answer:
            original(answer).until = inf
            yield answer

    def close(self) -> None:
        self._client.rest_client.close()

    def _document(
        self,
        method: str,
        path: str,
        *,
        query: Mapping[str, str | int] | None = None,
        body: Document | None = None,
        kind: str = _JSON,
    ) -> Any:
        with self._asked(method, path, query or {}, body, kind, self._options.timeout_s) as answer:
            try:
                return json.loads(_read(answer))
            except ValueError as error:
                raise RuntimeFailure(f"what the API server {self._where} answers is no JSON") from error

    @contextmanager
    def _asked(
        self,
        method: str,
        path: str,
        query: Mapping[str, str | int],
        body: Document | None = None,
        kind: str = _JSON,
        timeout: float | tuple[float, float] = 0,
    ) -> Iterator[urllib3.HTTPResponse]:
        used = self._client
        answer = self._answer(used, method, path, query, body, kind, timeout)
        ended = False
        try:
            said = _said(answer) if answer.status >= HTTPStatus.BAD_REQUEST else {}
            if _is_stranger(answer.status, said) and self._has_others(used):
                answer.close()
                answer = self._answer(self._client, method, path, query, body, kind, timeout)
                said = _said(answer) if answer.status >= HTTPStatus.BAD_REQUEST else {}
            if answer.status >= HTTPStatus.BAD_REQUEST:
                raise refusal(answer.status, said, f"{method} {path}", self._expired)
            yield answer
            ended = True
        except (urllib3.exceptions.HTTPError, OSError) as error:
            raise ClusterSilentError(self._silent(error)) from error
        finally:
            # What was not read to its end cannot be used again.
            answer.release_conn() if ended and answer.isclosed() else answer.close()

    def _expired(self) -> str:
        settings = self._client.configuration
        token = (settings.api_key or {}).get("authorization", "")
        return expired(settings.cert_file, token.removeprefix("Bearer "), time.time())

    def _answer(
        self,
        used: client.ApiClient,
        method: str,
        path: str,
        query: Mapping[str, str | int],
        body: Document | None,
        kind: str,
        timeout: float | tuple[float, float],
    ) -> urllib3.HTTPResponse:
        headers = {"Accept": f"{_JSON}, */*", **({"Content-Type": kind} if body is not None else {})}
        request = used.param_serialize(
            method,
            path,
            query_params=list(query.items()),
            header_params=headers,
            body=body,
            auth_settings=["BearerToken"],
        )
        patient_until = time.monotonic() + self._options.timeout_s
        while True:
            self._pace.wait()
            try:
                answer: urllib3.HTTPResponse = used.call_api(*request, _request_timeout=timeout).response
            except (client.ApiException, urllib3.exceptions.HTTPError, OSError) as error:
                raise ClusterSilentError(self._silent(error)) from error
            wanted = answer.headers.get("Retry-After", "")
            wait_s = float(wanted) if wanted.isdecimal() else _AGAIN_S
            if answer.status != HTTPStatus.TOO_MANY_REQUESTS or time.monotonic() + wait_s > patient_until:
                return answer
            answer.close()
            self._pace.hold(wait_s)  # it has too much to do: nobody asks meanwhile

    def _has_others(self, refused: client.ApiClient) -> bool:
        """Whether the files have other credentials, perhaps, than those that were just refused: they are read anew.

        Tokens of service accounts last for an hour, and new ones are put into the same file; so is a kubeconfig
        replaced whose certificate runs out.
        """
        with self._lock:
            if self._client is not refused:
                return True  # another thread was here
            if time.monotonic() - self._opened_at < RENEW_S:
                return False
            self._opened_at = time.monotonic()
            try:
                self._client = _client(self._options)
            except RuntimeFailure as error:
                log.warning("%s", error)
                return False
            return True

    def _silent(self, error: Exception) -> str:
        return f"the API server {self._where} does not answer: {_cause(error)}"


def cut(answer: urllib3.HTTPResponse) -> None:
    """End an answer that another thread reads; that sees its end.

    Below TLS: after the TLS socket's own ``shutdown`` a reader would take what is encrypted for text.
    """
    sock = getattr(answer.connection, "sock", None)
    if sock is not None:
        with suppress(OSError), socket.socket(fileno=os.dup(sock.fileno())) as same:
            same.shutdown(socket.SHUT_RDWR)


def _cause(error: Exception) -> str:
    """The last of what led to an error, in a few words."""
    reason = getattr(error, "reason", None) or error
    text = str(reason)
    if "certificate verify failed" in text:
        return f"{text}; is the certificate of the kubeconfig (certificate-authority) this cluster's?"
    return text[:300] or type(error).__name__


def _is_stranger(status: int, said: Document) -> bool:
    """Whether the API server does not know us."""
    anonymous = status == HTTPStatus.FORBIDDEN and _STRANGER in str(said.get("message"))
    return status == HTTPStatus.UNAUTHORIZED or anonymous


def refusal(status: int, said: Document, asked: str, expired: Callable[[], str]) -> RuntimeFailure:
    """What an answer means that is no success.

    Args:
        status: Of HTTP.
        said: The document in it.
        asked: What was asked for: told where the document says nothing.
        expired: What of our credentials has expired; empty: nothing.
    """
    message, reason = str(said.get("message") or f"{asked}: HTTP {status}"), str(said.get("reason", ""))
    if _is_stranger(status, said):
        why = expired() or "the token or certificate is wrong or expired"
        return RefusedError(f"the API server does not know us: {why}", status, reason)
    if status == HTTPStatus.FORBIDDEN and _LACKS.search(message):
        return RefusedError(f"the site's account lacks a right: {message}", status, reason)
    busy = status == HTTPStatus.TOO_MANY_REQUESTS or status >= HTTPStatus.INTERNAL_SERVER_ERROR
    if busy and _WEBHOOK not in message:
        return ClusterGoneError(f"the API server is busy or unwell: {message}")
    return RefusedError(message, status, reason)


def _said(answer: urllib3.HTTPResponse) -> Document:
    try:
        said = json.loads(_read(answer, _MOST_REFUSAL))
    except (ValueError, RecursionError, RuntimeFailure):
        return {}
    return said if isinstance(said, dict) else {}


def _read(answer: urllib3.HTTPResponse, most: int = _MOST) -> bytes:
    data = bytearray()
    for piece in answer.stream(_PIECE, decode_content=False):  # nobody was asked to pack it: it may grow to anything
        data += piece
        if len(data) > most:
            raise RuntimeFailure(f"an answer of more than {most / (1 << 20):g} MiB")
    return bytes(data)


def _client(options: KubernetesOptions) -> client.ApiClient:
    """With the credentials that the files have now."""
    settings = _settings(options)
    settings.connection_pool_maxsize = _POOL
    settings.retries = False
    made = client.ApiClient(settings)
    manager: Any = made.rest_client.pool_manager
    manager.connection_from_host = partial(hurried, manager.connection_from_host)
    return made


def _settings(options: KubernetesOptions) -> Any:
    settings = client.Configuration()
    try:
        if options.kubeconfig is None:
            config.load_incluster_config(client_configuration=settings)
        else:
            if not Path(options.kubeconfig).is_file():
                raise RuntimeFailure(f"kubeconfig: there is no file {options.kubeconfig}")
            config.load_kube_config(
                options.kubeconfig, options.context, client_configuration=settings, persist_config=False
            )
    except ConfigException as error:
        if options.kubeconfig is None:
            raise RuntimeFailure(
                "the orchestrator runs in no cluster: name a file in the option 'kubeconfig'"
            ) from error
        raise RuntimeFailure(f"kubeconfig {options.kubeconfig}: {error}") from error
    except (OSError, ValueError, TypeError, LookupError, AttributeError, yaml.YAMLError) as error:
        # The last four: what the client's loader makes of a file that is no kubeconfig.
        said = " ".join(str(error).split())
        raise RuntimeFailure(f"kubeconfig {options.kubeconfig} is none, or not complete: {said}") from error
    return settings
