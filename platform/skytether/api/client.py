"""The thin client that robots, command line and lab use: one method for each thing one can ask."""

from __future__ import annotations

import json
import math
import time
import uuid
from collections.abc import Callable, Iterator
from http import HTTPStatus
from typing import Any

import httpx

from .connection import AWAY, ApiError, Connection, Unreachable, addresses, json_of, parse, strange
from .groups import Group, GroupCreate
from .manifest import Manifest
from .rest import (
    CHANGE,
    PATH_NAME,
    Change,
    GateReport,
    Instance,
    InstanceCreate,
    InstanceEvent,
    Invitation,
    Invite,
    Migrate,
    Neighbours,
    Problem,
    Renew,
    Resize,
    Robot,
    RobotCreate,
    RobotCreated,
    RobotGroup,
    SessionClaim,
    SessionKey,
    Share,
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

__all__ = ["ApiError", "Client", "NotRunning", "Unreachable", "addresses"]

_PING_LIMIT = 45.0
"""Seconds without a sign of life after which an event stream counts as dead; the server pings every 15."""
_EMPTY_S = 120.0
"""Seconds for a site's engine to remove what ended instances left there: a slow machine takes its time."""
_RESUME_S = 30.0
"""How long an event stream that was lost is tried again [s]: an orchestrator is restarted in less."""
_RESUME_PAUSE_S = 0.2
END_SEEN_S = 1.0
"""By when an orchestrator has seen that a run has ended [s]."""


class NotRunning(Exception):  # noqa: N818
    """An instance ended, or did not get ready in time; ``str()`` says why."""


class Client(Connection):
    """An orchestrator, as the owner of one token sees it. Safe from any thread; use it as a context manager.

    Every method raises :class:`ApiError` or :class:`Unreachable`, and nothing else.
    """

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

    def resize_instance(self, instance_id: str, resize: Resize) -> Instance:
        """Give it more or less while it runs; ``resize`` of the answer says so until it has it.

        Where its site cannot, its robot changes to its ``successor``.
        """
        return self._one(Instance, "PATCH", _at("instances", instance_id), resize)

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
                time.sleep(END_SEEN_S)
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
        away = not isinstance(error, ApiError) or error.problem.status in AWAY
        if not (reached and away) or time.monotonic() - silent_since > _RESUME_S:
            if isinstance(error, httpx.TransportError | httpx.InvalidURL):
                raise self.unreachable(error) from error
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
                    yield parse(InstanceEvent, json.loads(line.removeprefix("data:")))
                if time.monotonic() >= deadline:
                    return

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

    # Catalog

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
            raise ApiError(strange(f"no {CHANGE}")) from error
        return parse(Manifest, json_of(response)), change

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

    def invite(self, request: Invite) -> Invitation:
        """Make a token with which one machine may join as a site."""
        return self._one(Invitation, "POST", "/invitations", request)

    def drain_site(self, name: str) -> Site:
        """Have a site take no more instances, and move those that are there elsewhere."""
        return self._one(Site, "POST", _at("sites", name, "drain"))

    def resume_site(self, name: str) -> Site:
        """Have a site that was drained take instances again."""
        return self._one(Site, "POST", _at("sites", name, "resume"))

    def delete_site(self, name: str, *, drain: bool = False, force: bool = False) -> bool:
        """Forget a site that has no instances.

        Args:
            name: Its name.
            drain: It takes no more, and goes with its last one.
            force: With all that is there, for a machine that is gone for good.

        Returns:
            Whether it is gone by now.
        """
        query = "?force=true" if force else "?drain=true" if drain else ""
        answer = self._request("DELETE", _at("sites", name) + query, patience=_EMPTY_S)
        return answer.status_code != HTTPStatus.ACCEPTED

    def probe(self, site: str) -> float:
        """One round trip to where a site answers, in seconds; the first one also opens the connection."""
        before = time.perf_counter()
        self._request("GET", _at("sites", site, "probe"))
        return time.perf_counter() - before

    # Groups of sites

    def groups(self) -> list[Group]:
        """Those whose machines are made as they are needed."""
        return self._many(Group, "/groups")

    def get_group(self, name: str) -> Group:
        """One group, with its machines and what was done last."""
        return self._one(Group, "GET", _at("groups", name))

    def create_group(self, group: GroupCreate) -> Group:
        """Add a group; with the token in the orchestrator's state folder only."""
        return self._one(Group, "POST", "/groups", group)

    def delete_group(self, name: str, *, drain: bool = False) -> bool:
        """Forget a group without machines; with ``drain`` it gives them back, and goes with its last one.

        Returns:
            Whether it is gone by now.
        """
        return self._request("DELETE", _at("groups", name) + "?drain=true" * drain).status_code != HTTPStatus.ACCEPTED

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
        return [parse(StopOrder, document) for document in json_of(response)]

    def stop_order(self, name: str) -> StopOrder | None:
        """The last order to a robot to stop."""
        document = json_of(self._request("GET", _at("robots", name, "stop")))
        return None if document is None else parse(StopOrder, document)

    def acknowledge_stop(self, name: str, order: str) -> StopOrder:
        """A robot says that it stands; with its own token only."""
        return self._one(StopOrder, "POST", _at("robots", name, _at("stop", order, "acknowledge").removeprefix("/")))

    def report_gate(self, name: str, report: GateReport) -> None:
        """A robot says how the gate before its wheels is; with its own token only."""
        self._request("PUT", _at("robots", name, "gate"), report)

    def set_group(self, name: str, group: str | None) -> None:
        """With whom a robot's services share what they see; None: with nobody."""
        self._request("PUT", _at("robots", name, "group"), RobotGroup(group=group))

    def share(self, instance_id: str, share: Share) -> Neighbours:
        """Tell what an instance's service shares, and hear what others of the group do; with the robot's token only."""
        return self._one(Neighbours, "POST", _at("instances", instance_id, "share"), share)

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


def _at(kind: str, name: str, what: str = "") -> str:
    """The path of something by its name, which is a word; anything else would lead to something else.

    Raises:
        ApiError: It is none.
    """
    if not PATH_NAME.fullmatch(name):
        detail = f"{name!r} is not a valid name: names are letters, digits, '-' and '_'"
        raise ApiError(Problem(title="Not found", status=404, detail=detail))
    return f"/{kind}/{name}/{what}" if what else f"/{kind}/{name}"
