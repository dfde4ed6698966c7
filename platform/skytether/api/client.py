"""The thin client that robots, command line and lab use: one method for each thing one can ask."""

from __future__ import annotations

import json
import math
import ssl
import time
import uuid
from collections.abc import Callable, Iterator
from contextlib import closing, contextmanager
from datetime import UTC, datetime
from pathlib import Path
from types import TracebackType
from typing import Any, TypeVar

import httpx
from pydantic import BaseModel, TypeAdapter, ValidationError

from .bounded import WHOLE, BoundedTransport, EndlessError
from .manifest import Manifest
from .plain_http import is_readable_on_the_way
from .printable import printable
from .rest import (
    CHANGE,
    PATH_NAME,
    Change,
    GateReport,
    Instance,
    InstanceCreate,
    InstanceEvent,
    Migrate,
    Problem,
    Renew,
    Robot,
    RobotCreate,
    RobotCreated,
    SessionClaim,
    SessionKey,
    Site,
    SiteCreate,
    State,
    StopOrder,
    StopRobot,
    Token,
    TokenCreate,
    TokenCreated,
    TokenRotate,
)

_Model = TypeVar("_Model", bound=BaseModel)
_PREFIX = "/api/v1"
_GIVE_TOKEN = "give the operator's or a robot's with --token-file or SKYTETHER_TOKEN"  # noqa: S105 (no token)
_PING_LIMIT = 45.0
"""Seconds without a sign of life after which an event stream counts as dead; the server pings every 15."""


_RESUME_S = 30.0
"""How long an event stream that was lost is tried again [s]: an orchestrator is restarted in less."""
_RESUME_PAUSE_S = 0.2
_END_SEEN_S = 1.0
"""By when an orchestrator has seen that a run has ended [s]."""
_STEPS = 4
"""An answer may take so many times as long as one step of its request: connect, send, and two to receive."""
_LARGEST = 1 << 26
"""Bytes of an answer: the instances of ten thousand robots are less."""
_LONGEST = 4096
"""Characters of what an orchestrator says is wrong; some are lists of what a manifest lacks."""
_AWAY = (502, 503, 504)
"""Statuses of an orchestrator, or of a proxy before it, that cannot serve now; another one may."""
_REPEATABLE = ("/renew", "/migrate", "/session")
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


class NotRunning(Exception):  # noqa: N818
    """An instance ended, or did not get ready in time; ``str()`` says why."""


class Client:
    """An orchestrator, as the owner of one token sees it. Safe from any thread; use it as a context manager.

    Of several over one database the one that answered last is asked first, and the others when that is away. A request
    whose connection was lost is sent again, if that can do no harm: it looks only, or does the same once more. So an
    orchestrator that is being restarted is not noticed where there is another one.

    Every method raises :class:`ApiError` or :class:`Unreachable`, and nothing else.
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
        self._whole = {WHOLE: _STEPS * timeout}
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

    def __enter__(self) -> Client:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    # Instances

    def create_instance(self, request: InstanceCreate, *, idempotency_key: str | None = None) -> Instance:
        """Ask for a service; with the same key as before, the instance made then is answered."""
        headers = {"Idempotency-Key": idempotency_key or str(uuid.uuid4())}
        return self._one(Instance, "POST", "/instances", request, headers)

    def instances(self) -> list[Instance]:
        """Newest first, without their sessions."""
        return self._many(Instance, "/instances")

    def get_instance(self, instance_id: str) -> Instance:
        """One instance, with its session."""
        return self._one(Instance, "GET", _at("instances", instance_id))

    def renew_instance(self, instance_id: str, renew: Renew | None = None) -> Instance:
        """Keep the lease. What has ended is not revived: look at the state."""
        return self._one(Instance, "POST", _at("instances", instance_id, "renew"), renew or Renew())

    def migrate_instance(self, instance_id: str, site: str | None = None) -> Instance:
        """Move it; the answer is the instance that its robot changes to."""
        return self._one(Instance, "POST", _at("instances", instance_id, "migrate"), Migrate(site=site))

    def claim_session(self, instance_id: str, claim: str) -> str:
        """The key of its session [base64], which one claim gets and no other; may be called again with the same."""
        return self._one(SessionKey, "POST", _at("instances", instance_id, "session"), SessionClaim(claim=claim)).key

    def delete_instance(self, instance_id: str) -> None:
        """End it; may be called again."""
        self._request("DELETE", _at("instances", instance_id))

    def logs(self, instance_id: str, tail: int = 200) -> str:
        """The last lines that it wrote."""
        return self._request("GET", f"{_at('instances', instance_id, 'logs')}?tail={tail}").text

    def follow_logs(
        self, instance_id: str, tail: int = 200, on_resume: Callable[[], None] = lambda: None
    ) -> Iterator[str]:
        """The last lines of its present run, then what that writes as it comes, until it ends.

        An orchestrator that ends meanwhile is waited for, or another one asked. The last lines come once more then.

        Args:
            instance_id: Which.
            tail: How many lines.
            on_resume: Called before what another connection brings.
        """
        path = f"{_at('instances', instance_id, 'logs')}?tail={tail}&follow=true"
        run = self._run(instance_id)
        reached, silent_since = False, None
        while True:
            try:
                with self._stream(path, None) as response:
                    if reached:
                        on_resume()
                    reached, silent_since = True, None
                    yield from response.iter_text()
                    if "content-length" in response.headers:
                        return  # nothing runs, or it cannot be followed: that was all there is
                # The stream has ended with the run, or with the orchestrator; which, is known a moment later.
                time.sleep(_END_SEEN_S)
                if self._run(instance_id) != run:
                    return
            except (httpx.TransportError, httpx.InvalidURL, Unreachable, ApiError) as error:
                silent_since = silent_since or time.monotonic()
                self._must_return(error, reached, silent_since)
                time.sleep(_RESUME_PAUSE_S)

    def _run(self, instance_id: str) -> int | None:
        """Which run of an instance is the present one; None: it has ended."""
        instance = self.get_instance(instance_id)
        return None if instance.state.final else instance.restarts

    def _must_return(self, error: Exception, reached: bool, silent_since: float) -> None:
        """After an error of a stream: return, if whoever sent it can be expected back.

        Raises:
            ApiError: It said that it will not.
            Unreachable: It was never there, or has been away for too long.
        """
        away = not isinstance(error, ApiError) or error.problem.status in _AWAY
        if not (reached and away) or time.monotonic() - silent_since > _RESUME_S:
            if isinstance(error, httpx.TransportError | httpx.InvalidURL):
                raise self._unreachable(error) from error
            raise error

    def watch(self, instance_id: str, after: int = 0, *, timeout: float | None = None) -> Iterator[InstanceEvent]:
        """Every change so far after event ``after``, then each as it comes, until the instance has ended.

        An orchestrator that ends meanwhile is waited for, or another one asked.

        Args:
            instance_id: Which.
            after: Id of the last event that is known already.
            timeout: Seconds after which to stop watching; None: never.
        """
        deadline = math.inf if timeout is None else time.monotonic() + timeout
        reached, ended, silent_since = False, False, None
        while True:
            try:
                for event in self._watch(instance_id, after, deadline):
                    after, reached = event.id, True
                    yield event
                    if event.state.final:
                        return
                if ended or time.monotonic() >= deadline:
                    return
                # The stream has ended with the instance, or with the orchestrator; its last event may be missing yet.
                ended = self.get_instance(instance_id).state.final
                reached, silent_since = True, None
            except (httpx.TransportError, httpx.InvalidURL, Unreachable, ApiError) as error:
                now = time.monotonic()
                if now >= deadline:
                    return
                silent_since = silent_since or now
                self._must_return(error, reached, silent_since)
                time.sleep(min(_RESUME_PAUSE_S, max(0.0, deadline - now)))

    def _watch(self, instance_id: str, after: int, deadline: float) -> Iterator[InstanceEvent]:
        patience = max(0.001, min(_PING_LIMIT, deadline - time.monotonic()))
        path = _at("instances", instance_id, "events")
        with self._stream(path, patience, {"Last-Event-ID": str(after)}) as response:
            for line in response.iter_lines():
                if line.startswith("data:"):
                    yield _parse(InstanceEvent, json.loads(line.removeprefix("data:")))
                if time.monotonic() >= deadline:
                    return

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

    def wait_running(
        self, instance_id: str, timeout: float = 30.0, on_event: Callable[[InstanceEvent], None] = lambda _: None
    ) -> Instance:
        """Wait until an instance is running, and give it with its session.

        Args:
            instance_id: Which.
            timeout: Seconds.
            on_event: Called with each of its changes, the past ones first.

        Raises:
            NotRunning: It ended, or it took too long.
        """
        state, reason = State.PENDING, ""
        for event in self.watch(instance_id, timeout=timeout):
            state, reason = event.state, event.reason
            on_event(event)
            if state is State.RUNNING:
                instance = self.get_instance(instance_id)
                if instance.state is State.RUNNING:
                    return instance
        why = f": {reason}" if reason else ""
        waited = "" if state.final else f" after {timeout:g} s"
        raise NotRunning(f"instance {instance_id} is {state}{waited}{why}")

    # Catalogue

    def services(self) -> list[Manifest]:
        """What one may ask for."""
        return self._many(Manifest, "/catalog")

    def get_service(self, name: str) -> Manifest:
        """One service's manifest."""
        return self._one(Manifest, "GET", _at("catalog", name))

    def put_service(self, name: str, manifest: Manifest | dict[str, Any]) -> Manifest:
        """Add or change a service. A plain document is validated by the orchestrator."""
        return self._one(Manifest, "PUT", _at("catalog", name), manifest)

    def apply_service(
        self, name: str, manifest: Manifest | dict[str, Any], *, dry_run: bool = False
    ) -> tuple[Manifest, Change]:
        """The same, and what it did; with ``dry_run`` what it would do, and nothing is stored."""
        response = self._request("PUT", f"{_at('catalog', name)}?dry_run={str(dry_run).lower()}", manifest)
        try:
            change = Change(response.headers.get(CHANGE, ""))
        except ValueError as error:
            raise ApiError(_strange(f"no {CHANGE}")) from error
        return _parse(Manifest, _json(response)), change

    def delete_service(self, name: str) -> None:
        """Remove a service that was put."""
        self._request("DELETE", _at("catalog", name))

    # Sites

    def sites(self) -> list[Site]:
        """Where instances can run."""
        return self._many(Site, "/sites")

    def get_site(self, name: str) -> Site:
        """One site."""
        return self._one(Site, "GET", _at("sites", name))

    def create_site(self, site: SiteCreate) -> Site:
        """Add a site."""
        return self._one(Site, "POST", "/sites", site)

    def delete_site(self, name: str) -> None:
        """Forget a site that has no instances."""
        self._request("DELETE", _at("sites", name))

    def probe(self, site: str) -> float:
        """One round trip to where a site answers, in seconds; the first one also opens the connection."""
        before = time.perf_counter()
        self._request("GET", _at("sites", site, "probe"))
        return time.perf_counter() - before

    # Robots

    def robots(self) -> list[Robot]:
        """All registered robots."""
        return self._many(Robot, "/robots")

    def create_robot(self, robot: RobotCreate) -> RobotCreated:
        """Register a robot; its token is in the answer, and nowhere else."""
        return self._one(RobotCreated, "POST", "/robots", robot)

    def delete_robot(self, name: str) -> None:
        """Revoke a robot's token and end what it holds."""
        self._request("DELETE", _at("robots", name))

    def stop_robot(self, name: str, reason: str) -> StopOrder:
        """Order a robot to stop; the order that it has not acknowledged yet, if there is one."""
        return self._one(StopOrder, "POST", _at("robots", name, "stop"), StopRobot(reason=reason))

    def stop_robots(self, reason: str) -> list[StopOrder]:
        """Order all registered robots to stop."""
        response = self._request("POST", "/robots/stop", StopRobot(reason=reason))
        return [_parse(StopOrder, document) for document in _json(response)]

    def stop_order(self, name: str) -> StopOrder | None:
        """The last order to a robot to stop."""
        document = _json(self._request("GET", _at("robots", name, "stop")))
        return None if document is None else _parse(StopOrder, document)

    def acknowledge_stop(self, name: str, order: str) -> StopOrder:
        """A robot says that it stands; with its own token only."""
        return self._one(StopOrder, "POST", _at("robots", name, _at("stop", order, "acknowledge").removeprefix("/")))

    def report_gate(self, name: str, report: GateReport) -> None:
        """A robot says how the gate before its wheels is; with its own token only."""
        self._request("PUT", _at("robots", name, "gate"), report)

    # Everything

    # Tokens

    def tokens(self) -> list[Token]:
        """All but the one in the state folder."""
        return self._many(Token, "/tokens")

    def create_token(self, token: TokenCreate) -> TokenCreated:
        """Another token of a robot, or an operator's."""
        return self._one(TokenCreated, "POST", "/tokens", token)

    def rotate_token(self, token_id: str | None = None, rotate: TokenRotate | None = None) -> TokenCreated:
        """Another one with the same rights; None: instead of this client's own."""
        return self._one(
            TokenCreated,
            "POST",
            _at("tokens", "self" if token_id is None else token_id, "rotate"),
            rotate or TokenRotate(),
        )

    def delete_token(self, token_id: str) -> None:
        """Revoke a token, and those that it renewed or was renewed by; may be called again."""
        self._request("DELETE", _at("tokens", token_id))

    def metrics(self) -> str:
        """In Prometheus' text format."""
        return self._request("GET", "/metrics", prefix="").text

    def _one(
        self, model: type[_Model], method: str, path: str, body: Any = None, headers: dict[str, str] | None = None
    ) -> _Model:
        return _parse(model, _json(self._request(method, path, body, headers)))

    def _many(self, model: type[_Model], path: str) -> list[_Model]:
        document = _json(self._request("GET", path))
        try:
            return TypeAdapter(list[model]).validate_python(document)  # type: ignore[valid-type]
        except ValidationError as error:
            raise ApiError(_strange(str(error))) from error

    def _request(
        self, method: str, path: str, body: Any = None, headers: dict[str, str] | None = None, prefix: str = _PREFIX
    ) -> httpx.Response:
        document = body.model_dump(mode="json", by_alias=True) if isinstance(body, BaseModel) else body
        again = method != "POST" or "Idempotency-Key" in (headers or {}) or path.endswith(_REPEATABLE)
        try:
            response = self._send(method, prefix + path, again=again, json=document, headers=headers)
        except (httpx.TransportError, httpx.InvalidURL) as error:
            raise self._unreachable(error) from error
        if not response.is_success:
            raise ApiError(_problem(response))
        return response

    def _send(
        self, method: str, path: str, *, again: bool = True, stream: bool = False, **request: Any
    ) -> httpx.Response:
        """Ask the one that answered last; if it is away, each of the others, and that one once more.

        Args:
            method: Of the request.
            path: Below the address.
            again: Whether it does no harm if two get it.
            stream: Whether the answer's body is left to be read.
            request: All else, for httpx.

        Raises:
            httpx.TransportError: Nobody answers; the last one's.
        """
        first, count = self._at, len(self._urls)
        alone = count == 1
        for turn in range(count + 1):
            at, last = (first + turn) % count, turn == count
            try:
                asked = self._http.build_request(method, self._urls[at] + path, **request)
                asked.extensions |= {} if stream else self._whole
                response = self._http.send(asked, stream=stream)
            except (httpx.ConnectError, httpx.ConnectTimeout):
                if last or alone:
                    raise
            except httpx.TimeoutException:
                if last or alone or not again:
                    raise
            except httpx.TransportError:  # a connection that was kept open, and that the other end has closed
                if last or not again:
                    raise
            else:
                if last or alone or not again or response.status_code not in _AWAY:
                    self._at = at
                    return response
                response.close()
        raise AssertionError("the last turn returns or raises")

    def _unreachable(self, error: Exception | None = None) -> Unreachable:
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


def _at(kind: str, name: str, what: str = "") -> str:
    """The path of something by its name, which is a word; anything else would lead to something else.

    Raises:
        ApiError: It is none.
    """
    if not PATH_NAME.fullmatch(name):
        detail = f"{name!r} is no name of anything: names are letters, digits, '-' and '_'"
        raise ApiError(Problem(title="Not found", status=404, detail=detail))
    return f"/{kind}/{name}/{what}" if what else f"/{kind}/{name}"


def _trust(ca_file: Path | str | None) -> ssl.SSLContext:
    try:
        return ssl.create_default_context(cafile=ca_file)
    except (OSError, ssl.SSLError) as error:
        detail = f"{ca_file} is no file of certificates: {getattr(error, 'strerror', None) or error}"
        raise ApiError(Problem(title="No certificate", status=495, detail=detail)) from error


def _json(response: httpx.Response) -> Any:
    try:
        return response.json()
    except (ValueError, RecursionError) as error:  # deeper than Python calls
        raise ApiError(_strange("no JSON")) from error


def _parse(model: type[_Model], document: Any) -> _Model:
    try:
        return model.model_validate(document)
    except ValidationError as error:
        raise ApiError(_strange(str(error))) from error


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


def _strange(what: str) -> Problem:
    detail = f"the orchestrator's answer is not understood: has it another version? ({what.splitlines()[0]})"
    return Problem(title="Strange answer", status=502, detail=detail)
