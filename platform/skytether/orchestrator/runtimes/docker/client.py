"""The SDK's client, for an engine that may be slow, broken or somebody else's: no answer is without an end."""

from __future__ import annotations

import json
import struct
import time
from collections.abc import Iterable, Iterator, Mapping
from functools import partial
from http import HTTPStatus
from math import inf
from typing import Any

import requests
from docker import APIClient
from docker.errors import create_api_error_from_http_exception
from typing_extensions import override

from ..whole_answer import hurried, original

MOST_BYTES = 32 << 20
"""Bytes of an answer: a container's whole log has 4 MiB, a list of a thousand containers some."""
_MOST_VALUES = 500_000
"""Of a document: each takes 30 times the memory of its bytes. A list of a thousand containers has a tenth."""
MOST_MESSAGE = 1 << 18
"""Bytes of one message of a stream. Those of use come by a stream for each container, a thousand at a time."""
_MOST_MESSAGE_VALUES = 20_000
MOST_REFUSAL = 1 << 20
"""Bytes of an answer that says no: whoever cannot tell its characters guesses them, which takes long."""
_PIECE = 1 << 16
_FRAME = struct.Struct(">4xL")
"""Before each piece of a log: which stream it is of, and how long."""


class Client(APIClient):
    """Reads no more than `MOST_BYTES` and for no longer than the call's time-out, whatever is sent; is led nowhere."""

    def __init__(self, *arguments: Any, **options: Any) -> None:
        """As the SDK's; ``timeout`` [s] of each call, and of the gaps in a stream."""
        super().__init__(*arguments, **options)
        # What the environment says of proxies and authorities is meant for the Internet, not for an engine.
        self.trust_env = False
        adapters: Iterable[Any] = self.adapters.values()
        for adapter in adapters:
            adapter.get_connection_with_tls_context = partial(hurried, adapter.get_connection_with_tls_context)

    @override
    def send(self, request: requests.PreparedRequest, **options: Any) -> requests.Response:
        # The SDK waits for events without end: one that says nothing for so long may be gone.
        patience = options.get("timeout") or self.timeout
        answer = super().send(request, **{**options, "timeout": patience, "stream": True})
        if answer.status_code >= HTTPStatus.BAD_REQUEST:
            _read(answer, MOST_REFUSAL)
            answer._content = _whole_characters(answer.content)  # noqa: SLF001 (as in `_read`)
        elif not options.get("stream"):
            _read(answer)
        else:
            original(answer.raw).until = inf
        return answer

    def fetch(self, url: str, most: int, **options: Any) -> requests.Response:
        """The answer to a GET, where no more than ``most`` bytes of it are wanted.

        Raises:
            requests.RequestException: It is larger, or not all of it is there within the call's time-out.
        """
        answer = self.get(url, stream=True, **options)
        if answer.status_code < HTTPStatus.BAD_REQUEST:  # else `send` has read it
            original(answer.raw).until = time.monotonic() + (options.get("timeout") or self.timeout)
            _read(answer, most)
        return answer

    def change(self, container: str, limits: Mapping[str, int]) -> None:
        """Change what a container may take; the SDK's ``update_container`` knows nothing of ``NanoCpus``.

        Raises:
            docker.errors.APIError: The engine refuses.
        """
        url = f"{self.base_url}/v{self.api_version}/containers/{container}/update"
        try:
            self.post(url, json=dict(limits), timeout=self.timeout).raise_for_status()
        except requests.HTTPError as error:
            create_api_error_from_http_exception(error)

    @override
    def get_redirect_target(self, resp: requests.Response) -> str | None:
        """An engine is where the site says; whom it names may be anybody."""
        return None

    def _result(self, response: requests.Response, json: bool = False, binary: bool = False) -> Any:
        self._raise_for_status(response)  # type: ignore[attr-defined]
        if json:
            return document(response.content)
        return super()._result(response, json, binary)  # type: ignore[misc]

    def _stream_helper(self, response: requests.Response, decode: bool = False) -> Iterator[Any]:
        if response.raw.chunked and decode:
            for line in _lines(response):
                yield document(line, _MOST_MESSAGE_VALUES)
            return
        if not response.raw.chunked:
            original(response.raw).until = time.monotonic() + self.timeout
            _read(response)
        yield from super()._stream_helper(response, decode)  # type: ignore[misc]

    def _multiplexed_response_stream_helper(self, response: requests.Response) -> Iterator[bytes]:
        # As the SDK's, which takes as much at once as is announced: up to 4 GiB.
        self._disable_socket_timeout(self._get_raw_response_socket(response))  # type: ignore[attr-defined]
        while header := response.raw.read(_FRAME.size):
            (left,) = _FRAME.unpack(header)
            while left:
                piece = response.raw.read(min(left, _PIECE))
                if not piece:
                    return
                left -= len(piece)
                yield piece


def _read(answer: requests.Response, most: int | None = None) -> None:
    """Take all of an answer, as the library does it.

    Args:
        answer: Of which nothing was read yet.
        most: Bytes; None: `MOST_BYTES`.

    Raises:
        requests.RequestException: It has no end.
    """
    most = MOST_BYTES if most is None else most
    pieces, size = [], 0
    for piece in answer.iter_content(_PIECE):
        pieces.append(piece)
        size += len(piece)
        if size > most:
            answer.close()
            raise requests.ConnectionError(f"an answer of more than {most / (1 << 20):g} MiB")
    answer._content = b"".join(pieces)  # noqa: SLF001 (it has no other way to be given it)


def _lines(answer: requests.Response) -> Iterator[bytes]:
    """Messages of a stream, one a line.

    Raises:
        requests.RequestException: One has no end.
    """
    rest = b""
    for piece in answer.raw.stream(_PIECE):
        *lines, rest = (rest + piece).split(b"\n")
        yield from (line for line in lines if line.strip())
        if len(rest) > MOST_MESSAGE:
            answer.close()
            raise requests.ConnectionError("a message without an end")
    if rest.strip():
        yield rest


def document(content: bytes, most: int = _MOST_VALUES) -> Any:
    """What a document of JSON says; as text of which all can be stored and sent on.

    Raises:
        requests.RequestException: It is none, or has more than ``most`` values, and would take a multiple of its size.
    """
    if sum(content.count(mark) for mark in (b",", b"[", b"{")) > most:
        raise requests.ConnectionError(f"an answer of more than {most} values")
    try:
        return json.loads(_whole_characters(content))
    except (ValueError, RecursionError) as error:
        raise requests.exceptions.InvalidJSONError(f"an answer that is no JSON ({error})") from error


def _whole_characters(content: bytes) -> bytes:
    """A document of JSON without halves of characters, which no database takes and no answer of ours can hold."""
    if b"\\ud" not in content and b"\\uD" not in content:
        return content
    try:
        return json.dumps(json.loads(content), ensure_ascii=False).encode(errors="replace")
    except (ValueError, RecursionError):
        return content
