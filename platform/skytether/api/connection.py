"""Requests to one orchestrator or several, and what can be wrong with the answers."""

from __future__ import annotations

import ssl
from collections.abc import Iterator
from contextlib import closing, contextmanager
from datetime import UTC, datetime
from pathlib import Path
from types import TracebackType
from typing import Any, Self, TypeVar

import httpx
from pydantic import BaseModel, TypeAdapter, ValidationError

from .bounded import WHOLE, BoundedTransport, EndlessError
from .plain_http import is_readable_on_the_way
from .printable import printable
from .rest import Problem

_Model = TypeVar("_Model", bound=BaseModel)
_PREFIX = "/api/v1"
_GIVE_TOKEN = "give the operator's or a robot's with --token-file or SKYTETHER_TOKEN"  # noqa: S105 (no token)
_STEPS = 4
"""An answer may take so many times as long as one step of its request: connect, send, and two to receive."""
_LARGEST = 1 << 26
"""Bytes of an answer: the instances of ten thousand robots are less."""
_LONGEST = 4096
"""Characters of what an orchestrator says is wrong; some are lists of what a manifest lacks."""
AWAY = (502, 503, 504)
"""Statuses of an orchestrator, or of a proxy before it, that cannot serve now; another one may."""
_REPEATABLE = ("/renew", "/migrate", "/session", "/drain", "/resume")
"""Ends of paths to which a request that comes twice does what it would do once."""


def addresses(base_url: str) -> list[str]:
    """Each of the addresses that are given with commas between them; one that is empty stays, to be complained of."""
    return [url.strip().rstrip("/") for url in base_url.split(",") if url.strip()] or [""]


class ApiError(Exception):
    """The orchestrator answered that it will not; ``str()`` is its one sentence."""

    def __init__(self, problem: Problem) -> None:
        self.problem = problem
        super().__init__(problem.detail or problem.title)


class Unreachable(Exception):  # noqa: N818 (a state of affairs, not a mistake)
    """No orchestrator answers; ``str()`` says what to do."""


class Connection:
    """To orchestrators over one database, with one token. Safe from any thread; use it as a context manager.

    The one that answered last is asked first, and the others when that is away. A request whose connection was lost is
    sent again, if that can do no harm: it looks only, or does the same once more. So an orchestrator that is being
    restarted is not noticed where there is another one.
    """

    def __init__(
        self,
        base_url: str,
        token: str | None = None,
        *,
        timeout: float = 10.0,
        ca_file: Path | str | None = None,
        insecure_http: bool = False,
        largest: int = _LARGEST,
    ) -> None:
        """One orchestrator, or several.

        Args:
            base_url: ``https://host:port``; of several, with commas between them.
            token: An operator's or a robot's.
            timeout: Seconds for each step of a request: connect, send, receive; all of it takes four of them at most.
            ca_file: PEM file of the authority that the orchestrator's certificate is by; None: the system's.
            insecure_http: Use plain http beyond this machine too, where others can read token and keys on the way.
            largest: Bytes of an answer that is not followed as it comes.

        Raises:
            ApiError: The token holds characters that no token has, or the file holds no certificate.
            Unreachable: An address is plain http beyond this machine.
        """
        self._urls = addresses(base_url)
        self._at = 0
        """Which of them answered last."""
        if token and not (token.isascii() and token.isprintable()):
            raise ApiError(Problem(title="No valid token", status=401, detail="what was given as token is none"))
        readable = [url for url in self._urls if is_readable_on_the_way(url)]
        if readable and not insecure_http:
            raise Unreachable(
                f"{readable[0]} would be asked without TLS, and the token could be read on the way: write https:// "
                "(the orchestrator's tls.certificate, or a proxy before it); inside a network that is all yours, such "
                "as a VPN, allow it with SKYTETHER_INSECURE_HTTP=true, or insecure_http: true in robot.yaml"
            )
        self._timeout = timeout
        # Without TLS there is nothing to verify, and loading the authorities' certificates takes 20 ms.
        verify = None if all(url.startswith("http://") for url in self._urls) else _trust(ca_file)
        self._http = httpx.Client(
            headers={"Accept-Encoding": "identity"} | ({"Authorization": f"Bearer {token}"} if token else {}),
            timeout=timeout,
            transport=BoundedTransport(verify, largest),
            # No proxies from the environment: what keeps a robot driving must not take a way round by accident.
            trust_env=False,
        )

    def set_token(self, token: str) -> None:
        """Use another token from the next request on."""
        self._http.headers["Authorization"] = f"Bearer {token}"

    @property
    def _shown(self) -> str:
        return ", ".join(self._urls)

    def close(self) -> None:
        """Let go of the connections."""
        self._http.close()

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    def _one(
        self, model: type[_Model], method: str, path: str, body: Any = None, headers: dict[str, str] | None = None
    ) -> _Model:
        return parse(model, json_of(self._request(method, path, body, headers)))

    def _many(self, model: type[_Model], path: str) -> list[_Model]:
        document = json_of(self._request("GET", path))
        try:
            return TypeAdapter(list[model]).validate_python(document)  # type: ignore[valid-type]
        except ValidationError as error:
            raise ApiError(strange(str(error))) from error

    def _request(
        self,
        method: str,
        path: str,
        body: Any = None,
        headers: dict[str, str] | None = None,
        prefix: str = _PREFIX,
        *,
        patience: float | None = None,
    ) -> httpx.Response:
        """Ask, and wait for the answer so many seconds; None: as long as for any."""
        document = body.model_dump(mode="json", by_alias=True) if isinstance(body, BaseModel) else body
        again = method != "POST" or "Idempotency-Key" in (headers or {}) or path.endswith(_REPEATABLE)
        try:
            response = self._send(method, prefix + path, again=again, patience=patience, json=document, headers=headers)
        except (httpx.TransportError, httpx.InvalidURL) as error:
            raise self.unreachable(error) from error
        if not response.is_success:
            raise ApiError(_problem(response))
        return response

    def _send(
        self,
        method: str,
        path: str,
        *,
        again: bool = True,
        stream: bool = False,
        patience: float | None = None,
        **request: Any,
    ) -> httpx.Response:
        """Ask the one that answered last; if it is away, each of the others, and that one once more.

        Args:
            method: Of the request.
            path: Below the address.
            again: Whether it does no harm if two get it.
            stream: Whether the answer's body is left to be read.
            patience: For the answer, in seconds; None: as for any.
            request: All else, for httpx.

        Raises:
            httpx.TransportError: Nobody answers; the last one's.
        """
        if patience is not None:
            request["timeout"] = httpx.Timeout(self._http.timeout.connect, read=patience)
        first, count = self._at, len(self._urls)
        alone = count == 1
        for turn in range(count + 1):
            at, last = (first + turn) % count, turn == count
            try:
                asked = self._http.build_request(method, self._urls[at] + path, **request)
                asked.extensions |= {} if stream else {WHOLE: _STEPS * (patience or self._timeout)}
                response = self._http.send(asked, stream=stream)
            except (httpx.ConnectError, httpx.ConnectTimeout):
                if last or alone:
                    raise
            except httpx.TimeoutException:
                if last or alone or not again or patience is not None:  # it may be about it still
                    raise
            except httpx.TransportError:  # a connection that was kept open, and that the other end has closed
                if last or not again:
                    raise
            else:
                if last or alone or not again or response.status_code not in AWAY:
                    self._at = at
                    return response
                response.close()
        raise AssertionError("the last turn returns or raises")

    def unreachable(self, error: Exception | None = None) -> Unreachable:
        """What a failed request means, and what to do about it."""
        if "CERTIFICATE_VERIFY_FAILED" in str(error):
            why = str(error).partition("CERTIFICATE_VERIFY_FAILED] ")[2].partition(" (_ssl")[0]
            dated = "expired" in why or "not yet valid" in why
            advice = "give the file of its authority (SKYTETHER_CA_FILE), or correct the address"
            if dated:
                advice = f"correct this machine's clock ({datetime.now(UTC):%Y-%m-%d %H:%M} UTC), or renew it"
            return Unreachable(f"the certificate of {self._shown} is not trusted ({why}): {advice}")
        if isinstance(error, httpx.UnsupportedProtocol | httpx.InvalidURL):
            wrong = [url for url in self._urls if not url.startswith(("http://", "https://"))] or self._urls
            return Unreachable(
                f"'{', '.join(wrong)}' is no address of an orchestrator: write http://HOST:PORT or https://HOST:PORT "
                "(--url, SKYTETHER_URL, or orchestrator in robot.yaml)"
            )
        at = error.request.url if isinstance(error, httpx.TransportError) else httpx.URL()
        asked = f"{at.scheme}://{at.netloc.decode('ascii')}"
        if "WRONG_VERSION_NUMBER" in str(error):
            return Unreachable(f"{asked} does not speak TLS: write http:// instead of https://, or correct the port")
        if isinstance(error, EndlessError):
            return Unreachable(f"{asked} is no orchestrator: {error}")
        if isinstance(error, httpx.RemoteProtocolError) and at.scheme == "http":
            return Unreachable(
                f"{asked} closes the connection without an answer: if it has a certificate, write https:// instead of "
                "http://; if it is being restarted, try again"
            )
        return Unreachable(
            f"no orchestrator answers at {self._shown}: "
            "start one with `skytether orchestrator run`, or correct its address (--url, or orchestrator in robot.yaml)"
        )

    @contextmanager
    def _stream(
        self, path: str, patience: float | None, headers: dict[str, str] | None = None
    ) -> Iterator[httpx.Response]:
        """An answer that comes bit by bit; ``patience`` is for each bit, in seconds."""
        timeout = httpx.Timeout(self._http.timeout.connect, read=patience)
        response = self._send("GET", _PREFIX + path, headers=headers, timeout=timeout, stream=True)
        with closing(response):
            if response.is_error:
                response.read()
                raise ApiError(_problem(response))
            yield response


def _trust(ca_file: Path | str | None) -> ssl.SSLContext:
    try:
        return ssl.create_default_context(cafile=ca_file)
    except (OSError, ssl.SSLError) as error:
        detail = f"{ca_file} is no file of certificates: {getattr(error, 'strerror', None) or error}"
        raise ApiError(Problem(title="No certificate", status=495, detail=detail)) from error


def json_of(response: httpx.Response) -> Any:
    """An answer's document.

    Raises:
        ApiError: It is no JSON.
    """
    try:
        return response.json()
    except (ValueError, RecursionError) as error:  # deeper than Python calls
        raise ApiError(strange("no JSON")) from error


def parse(model: type[_Model], document: Any) -> _Model:
    """A document as what it should be.

    Raises:
        ApiError: It is something else.
    """
    try:
        return model.model_validate(document)
    except ValidationError as error:
        raise ApiError(strange(str(error))) from error


def _problem(response: httpx.Response) -> Problem:
    try:
        problem = Problem.model_validate_json(response.content)
        problem = problem.model_copy(update={"title": _shown(problem.title), "detail": _shown(problem.detail)})
        if problem.status != 401:
            return problem
        # The orchestrator speaks of headers; who uses this client gave a token, or forgot to.
        refused = problem.detail if "authorization" in response.request.headers else "the orchestrator wants a token"
        return problem.model_copy(update={"detail": f"{refused}; {_GIVE_TOKEN}"})
    except ValidationError:
        detail = f"the answer was HTTP {response.status_code}: is this the address of an orchestrator?"
        return Problem(title=response.reason_phrase, status=response.status_code, detail=detail)


def _shown(text: str) -> str:
    """What may be shown: no codes that a terminal obeys, and no more than somebody reads."""
    return printable(text[:_LONGEST])


def strange(what: str) -> Problem:
    """What is wrong with an answer that is not understood."""
    detail = f"the orchestrator's answer is not understood: has it another version? ({what.splitlines()[0]})"
    return Problem(title="Strange answer", status=502, detail=detail)
