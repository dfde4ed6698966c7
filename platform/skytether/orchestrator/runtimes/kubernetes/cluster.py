"""Calls to a cluster's API server: JSON in, JSON out, errors as sentences."""

from __future__ import annotations

import json
import logging
import os
import socket
from collections.abc import Iterator, Mapping
from contextlib import contextmanager, suppress
from functools import partial
from http import HTTPStatus
from math import inf
from pathlib import Path
from typing import Any

import urllib3
from kubernetes import client, config
from kubernetes.config.config_exception import ConfigException

from ..base import RuntimeFailure, SiteSilentError
from ..whole_answer import hurried, original
from .options import KubernetesOptions

log = logging.getLogger(__name__)

_MOST = 32 << 20
"""Bytes of an answer."""
_MOST_REFUSAL = 64 << 10
_PIECE = 1 << 16
_POOL = 16
"""Connections that are kept."""
_MERGE = "application/merge-patch+json"
_APPLY = "application/apply-patch+yaml"
_MANAGER = {"fieldManager": "skytether"}
"""Who has written what we write, as every object says (``managedFields``)."""
_JSON = "application/json"
Document = Mapping[str, Any]


class ClusterGoneError(SiteSilentError):
    """The API server does not answer."""


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
        self._settings = _settings(options)
        self._settings.connection_pool_maxsize = _POOL
        self._settings.retries = False
        if not self._settings.verify_ssl:
            log.warning("kubeconfig %s: the API server's certificate is not checked, as it says", options.kubeconfig)
            urllib3.disable_warnings(urllib3.exceptions.InsecureRequestWarning)  # once is enough
        self._client = client.ApiClient(self._settings)
        manager: Any = self._client.rest_client.pool_manager
        manager.connection_from_host = partial(hurried, manager.connection_from_host)
        self._where = self._settings.host

    @property
    def namespace(self) -> str:
        return self._options.namespace

    def path(self, kind: str, name: str = "", *, group: str = "") -> str:
        """Of objects of the namespace; ``group``: API group and version, "" for the core's."""
        api = f"/apis/{group}" if group else "/api/v1"
        return f"{api}/namespaces/{self.namespace}/{kind}{f'/{name}' if name else ''}"

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
        headers = {"Accept": f"{_JSON}, */*", **({"Content-Type": kind} if body is not None else {})}
        request = self._client.param_serialize(
            method,
            path,
            query_params=list(query.items()),
            header_params=headers,
            body=body,
            auth_settings=["BearerToken"],
        )
        try:
            answer = self._client.call_api(*request, _request_timeout=timeout).response
        except (client.ApiException, urllib3.exceptions.HTTPError, OSError) as error:
            raise ClusterGoneError(self._silent(error)) from error
        ended = False
        try:
            if answer.status >= HTTPStatus.BAD_REQUEST:
                raise _refusal(answer, method, path)
            yield answer
            ended = True
        except (urllib3.exceptions.HTTPError, OSError) as error:
            raise ClusterGoneError(self._silent(error)) from error
        finally:
            # What was not read to its end cannot be used again.
            answer.release_conn() if ended and answer.isclosed() else answer.close()

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


def _refusal(answer: urllib3.HTTPResponse, method: str, path: str) -> RuntimeFailure:
    status = answer.status
    try:
        said = json.loads(_read(answer, _MOST_REFUSAL))
        message, reason = str(said.get("message", "")), str(said.get("reason", ""))
    except (ValueError, AttributeError, RecursionError, RuntimeFailure):
        message, reason = "", ""
    message = message or f"{method} {path}: HTTP {status}"
    if status == HTTPStatus.UNAUTHORIZED:
        return RefusedError(
            "the API server does not know us: the token or certificate is wrong or expired", status, reason
        )
    if status == HTTPStatus.FORBIDDEN and "cannot" in message:
        return RefusedError(f"the site's account lacks a right: {message}", status, reason)
    if status == HTTPStatus.TOO_MANY_REQUESTS or status >= HTTPStatus.INTERNAL_SERVER_ERROR:
        return ClusterGoneError(f"the API server is busy or unwell: {message}")
    return RefusedError(message, status, reason)


def _read(answer: urllib3.HTTPResponse, most: int = _MOST) -> bytes:
    data = bytearray()
    for piece in answer.stream(_PIECE, decode_content=False):  # nobody was asked to pack it: it may grow to anything
        data += piece
        if len(data) > most:
            raise RuntimeFailure(f"an answer of more than {most / (1 << 20):g} MiB")
    return bytes(data)


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
    except (OSError, ValueError) as error:
        raise RuntimeFailure(f"kubeconfig {options.kubeconfig}: {error}") from error
    return settings
