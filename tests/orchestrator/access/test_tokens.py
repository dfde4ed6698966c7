"""Tokens over REST: scopes, expiry, rotation, and that nobody makes one that may more than his own."""

from __future__ import annotations

import contextlib
import json
from collections.abc import Callable
from types import SimpleNamespace
from typing import Any

import pytest
from deep_size import deep_size

from skytether.api.client import ApiError, Client
from skytether.api.rest import SCOPES, InstanceCreate, RobotCreate, SiteCreate, TokenCreate, TokenRotate
from skytether.orchestrator.access import access as accesses
from skytether.orchestrator.access.access import Access
from skytether.orchestrator.domain.errors import TooManyError, UnauthenticatedError
from skytether.orchestrator.domain.rate_limit import RateLimiter
from skytether.orchestrator.domain.security import Secrets
from skytether.orchestrator.store.store import Store

ASK = InstanceCreate(robot="walker", service="toy", lease_s=1000)


def _allowed(client: Client) -> None:
    """It gets as far as that there is no such instance."""
    try:
        client.claim_session("none", "c" * 16)
    except ApiError as error:
        if error.problem.status != 404:
            raise


DOES: dict[str, Callable[[Client, Any], Any]] = {
    "read": lambda c, _: (c.sites(), c.instances(), c.services(), c.robots(), c.tokens()),
    "instances": lambda c, _: c.create_instance(ASK),
    "sessions": lambda c, _: _allowed(c),
    "catalog": lambda c, m: c.put_service("other", m),
    "sites": lambda c, _: c.create_site(SiteCreate(name="more", tier="edge", runtime="fake")),
    "robots": lambda c, _: c.create_robot(RobotCreate(name="another")),
    "tokens": lambda c, _: c.delete_token("none"),
    "metrics": lambda c, _: c.metrics(),
}
"""One thing that each scope is for."""


def test_a_scope_is_good_for_what_it_names_and_nothing_else(served: Any, manifest: Any) -> None:
    served.site("lab")
    body = manifest()
    body["metadata"]["name"] = "other"
    for scope in SCOPES:
        client = served.client(served.operator.create_token(TokenCreate(name=scope, scopes=(scope,))).token)
        for name, does in DOES.items():
            if name == scope:
                does(client, body)
            else:
                with pytest.raises(ApiError, match=f"it needs the scope '{name}'; its scopes are: {scope}") as caught:
                    does(client, body)
                assert caught.value.problem.status == 403


def test_what_is_told_of_tokens_is_never_the_token(served: Any) -> None:
    served.robot("walker")
    made = served.operator.create_token(TokenCreate(name="prometheus", scopes=("metrics", "read"), ttl_s=60))
    listed = served.operator.tokens()
    assert [(t.name, t.robot, t.scopes) for t in listed] == [
        ("walker", "walker", ()),
        ("prometheus", None, ("metrics", "read")),
    ]
    assert (made.expires_at - made.created_at).total_seconds() == 60
    assert listed[1].last_used_at is None
    assert made.token not in repr(made) + str(listed)


def test_a_robot_gets_another_token_before_its_own_ends(served: Any) -> None:
    robot = served.robot("walker")
    fresh = robot.rotate_token(rotate=TokenRotate(grace_s=0))
    with pytest.raises(ApiError, match="expired at"):
        robot.sites()
    other = served.client(fresh.token)
    other.sites()
    again = served.operator.rotate_token(fresh.id)
    assert again.robot == "walker"
    other.sites()  # still good, for the grace
    served.client(again.token).sites()
    served.operator.delete_token(again.id)
    with pytest.raises(ApiError, match="not known here"):
        served.client(again.token).sites()


def test_a_robot_may_have_several_and_all_end_with_it(served: Any) -> None:
    first = served.robot("walker")
    second = served.client(served.operator.create_token(TokenCreate(name="spare", robot="walker")).token)
    assert [client.instances() for client in (first, second)] == [[], []]
    served.operator.delete_robot("walker")
    for client in (first, second):
        with pytest.raises(ApiError):
            client.instances()
    assert served.operator.tokens() == []


def test_nobody_makes_renews_or_revokes_a_token_that_may_more_than_his_own(served: Any) -> None:
    served.robot("walker")
    strong = served.operator.create_token(TokenCreate(name="strong", scopes=("sites",)))
    walkers = served.operator.tokens()[0]
    weak = served.client(served.operator.create_token(TokenCreate(name="weak", scopes=("tokens",))).token)
    for attempt in (
        lambda: weak.create_token(TokenCreate(name="a", scopes=("sites",))),
        lambda: weak.create_token(TokenCreate(name="a", robot="walker")),
        lambda: weak.rotate_token(strong.id),
        lambda: weak.rotate_token(walkers.id),
        lambda: weak.delete_token(strong.id),
        lambda: weak.delete_token(walkers.id),
    ):
        with pytest.raises(ApiError, match=r"it needs the scope '(sites|robots)'"):
            attempt()
    assert weak.create_token(TokenCreate(name="a", scopes=("tokens",))).scopes == ("tokens",)


@pytest.mark.parametrize(
    ("asked", "status", "says"),
    [
        (TokenCreate(name="a"), 422, "an operator's token needs at least one; there are: read,"),
        (TokenCreate(name="a", robot="walker", scopes=("read",)), 422, "a robot's token has none"),
        (TokenCreate(name="a", robot="nobody"), 404, "there is no robot 'nobody'"),
    ],
)
def test_what_makes_no_sense_is_refused(served: Any, asked: TokenCreate, status: int, says: str) -> None:
    served.robot("walker")
    with pytest.raises(ApiError, match=says) as caught:
        served.operator.create_token(asked)
    assert caught.value.problem.status == status


def test_the_operators_own_token_is_renewed_at_the_machine(served: Any) -> None:
    with pytest.raises(ApiError, match="skytether orchestrator rotate operator-token"):
        served.operator.rotate_token()


def test_a_token_ends_at_its_time_and_use_is_noted(store: Store, tmp_path: Any) -> None:
    now = [1000.0]
    access = Access(store, Secrets(tmp_path), lambda: now[0], RateLimiter(100, 100, lambda: 0.0))
    _, token = access.register("walker", ("*",), ttl_s=60)
    assert access.authenticate(token).robot == "walker"
    now[0] += 59.9
    access.authenticate(token)
    now[0] += 0.1
    with pytest.raises(UnauthenticatedError, match="expired at 1970-01-01T00:17:40"):
        access.authenticate(token)
    assert store.tokens()[0].last_used_at == 1000.0


def test_tokens_that_a_robot_makes_and_uses_again_and_again_cost_no_memory(
    store: Store, tmp_path: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Fifteen a second were 250 MB a day: when each was used last was never forgotten."""
    now = [1000.0]
    monkeypatch.setattr(accesses, "time", SimpleNamespace(monotonic=lambda: now[0]))
    monkeypatch.setattr(accesses, "MOST_RECENT", 5)
    access = Access(store, Secrets(tmp_path), lambda: now[0], RateLimiter(100, 100, lambda: 0.0))
    _, token = access.register("walker", ("*",), ttl_s=None)
    sizes = []
    for _ in range(60):
        now[0] += 1.0
        token = access.rotate(access.authenticate(token), "self", 0.5)[1]
        sizes.append(deep_size(access, without=(store,)))
    assert max(sizes[20:]) <= max(sizes[:20])
    access.authenticate(token)
    now[0] += 5.0
    access.authenticate(token)
    assert store.tokens()[-1].last_used_at == 1060.0, "noted every ten seconds"
    now[0] += 5.0
    access.authenticate(token)
    assert store.tokens()[-1].last_used_at == 1070.0


def test_what_was_refused_a_moment_ago_is_refused_again_at_once_and_counted(store: Store, tmp_path: Any) -> None:
    throttle = RateLimiter(0.001, 3, lambda: 0.0)
    access = Access(store, Secrets(tmp_path), lambda: 1000.0, throttle)
    assert access.recent("made-up", "10.0.0.1") is None
    with pytest.raises(UnauthenticatedError, match="not known here"):
        access.authenticate("made-up", "10.0.0.1")
    with pytest.raises(UnauthenticatedError, match="not known here"):
        access.recent("made-up", "10.0.0.1")
    with pytest.raises(UnauthenticatedError, match="a token is needed"):
        access.recent(None, "10.0.0.1")
    with pytest.raises(TooManyError):
        access.recent("made-up", "10.0.0.1")
    with pytest.raises(UnauthenticatedError):
        access.recent("made-up", "10.0.0.2")
    _, token = access.register("walker", ("*",), ttl_s=None)
    assert access.authenticate(token, "10.0.0.1").robot == "walker"
    assert access.recent(token, "10.0.0.1").robot == "walker"


def test_a_token_that_expired_by_a_clock_set_wrong_is_good_as_soon_as_the_clock_is_right(
    store: Store, tmp_path: Any, clock: Any
) -> None:
    access = Access(store, Secrets(tmp_path), clock, RateLimiter(100, 100, lambda: 0.0))
    _, token = access.register("walker", ("*",), ttl_s=60)
    clock.set_by(3600)
    with pytest.raises(UnauthenticatedError, match="expired"):
        access.authenticate(token)
    assert access.recent(token) is None
    clock.set_by(-3600)
    assert access.authenticate(token).robot == "walker"


def refused(call: Callable[[], Any]) -> int:
    with pytest.raises(ApiError) as caught:
        call()
    return caught.value.problem.status


def test_a_token_has_one_successor_and_of_a_family_two_are_good(served: Any) -> None:
    """Self-rotation once made fifty valid tokens out of one, which outlived its revocation and its end."""
    first = served.operator.create_robot(RobotCreate(name="walker", token_ttl_s=1000)).token
    tokens = [first]
    for _ in range(15):
        for token in (tokens[-1], first):
            with contextlib.suppress(ApiError):
                tokens.append(served.client(token).rotate_token(rotate=TokenRotate(grace_s=30 * 86_400)).token)
    good = [token for token in tokens if _is_good(served.client(token))]
    assert len(tokens) > 15
    assert len(good) <= 2
    listed = served.operator.tokens()
    assert len(listed) <= 2
    assert len({token.family for token in listed}) == 1
    assert all((token.expires_at - listed[0].created_at).total_seconds() <= 1000 for token in listed)
    served.operator.delete_token(listed[0].id)
    assert served.operator.tokens() == []
    assert not any(_is_good(served.client(token)) for token in tokens)


def test_the_id_of_the_first_revokes_all_that_were_made_of_it_since(served: Any) -> None:
    first = served.operator.create_token(TokenCreate(name="watch", scopes=["read"]))
    stolen = first.token
    for _ in range(3):
        stolen = served.client(stolen).rotate_token().token
        assert _is_good(served.client(stolen))
    assert first.id not in {token.id for token in served.operator.tokens()}
    served.operator.delete_token(first.id)
    assert not _is_good(served.client(stolen))
    assert served.operator.tokens() == []


def _is_good(client: Client) -> bool:
    with contextlib.suppress(ApiError):
        return bool(client.sites()) or True
    return False


def test_an_answer_that_was_lost_costs_no_token_and_one_that_is_used_cannot_be_replaced(served: Any) -> None:
    robot = served.robot("walker")
    lost = robot.rotate_token()
    fresh = robot.rotate_token()
    assert not _is_good(served.client(lost.token))
    assert _is_good(served.client(fresh.token))
    with pytest.raises(ApiError, match="was renewed already, and the new one is in use"):
        robot.rotate_token()
    assert _is_good(served.client(fresh.token))
    assert _is_good(robot)
    served.client(fresh.token).rotate_token()
    assert not _is_good(robot)  # the new one's predecessor is fresh now


def test_nobody_puts_off_the_end_of_their_own_token_but_who_may_make_such_ones(served: Any) -> None:
    operator = served.operator
    made = operator.create_token(TokenCreate(name="on-duty", scopes=("read", "tokens"), ttl_s=100))
    weak = operator.create_token(TokenCreate(name="watcher", scopes=("read",), ttl_s=100))
    again = served.client(made.token).rotate_token()
    assert again.expires_at == made.expires_at
    longer = TokenRotate(ttl_s=1000)
    assert refused(lambda: served.client(weak.token).rotate_token(rotate=longer)) == 403
    assert refused(lambda: served.robot("walker").rotate_token(rotate=longer)) == 403
    other = operator.rotate_token(weak.id, longer)
    assert (other.expires_at - other.created_at).total_seconds() == 1000
    kept = next(token for token in operator.tokens() if token.id == weak.id)
    assert kept.expires_at <= weak.expires_at  # whatever the grace


def test_no_two_have_the_same_name(served: Any) -> None:
    operator = served.operator
    served.robot("walker")
    scoped = TokenCreate(name="walker", scopes=("read",))
    first = operator.create_token(scoped)
    for asked in (scoped, TokenCreate(name="walker", robot="walker")):
        with pytest.raises(ApiError, match="'walker' already: give another name, or delete it first") as caught:
            operator.create_token(asked)
        assert caught.value.problem.status == 409
    operator.rotate_token(first.id)
    assert refused(lambda: operator.create_token(scoped)) == 409
    operator.delete_token(first.id)
    assert operator.create_token(scoped).name == "walker"


@pytest.mark.parametrize(
    "options",
    [
        {"environment": {"PYTHONWARNINGS": "error::antigravity.x", "BROWSER": "sh -c 'cp operator.token /tmp' #%s"}},
        {"environment": {"LD_PRELOAD": "/tmp/evil.so"}},
        {"python_path": ["/tmp"]},
        {},
    ],
)
def test_no_scope_makes_a_site_that_runs_as_the_orchestrator(served: Any, options: dict[str, Any]) -> None:
    every = served.operator.create_token(TokenCreate(name="every", scopes=SCOPES)).token
    asked = SiteCreate(name="here", tier="edge", runtime="process", options=options)
    with pytest.raises(ApiError, match=r"own user.*operator\.token"):
        served.client(every).create_site(asked)
    assert [site.name for site in served.operator.sites()] == []
    served.client(every).create_site(SiteCreate(name="fake", tier="edge", runtime="fake"))
    served.operator.create_site(SiteCreate(name="here", tier="edge", runtime="process"))


@pytest.mark.parametrize(
    "option",
    [
        {"devices": ["/dev/sda"]},
        {"groups": [6]},
        {"guard_image": "evil:1"},
        {"network": "bridge"},
        {"egress": ["*"]},
        {"seccomp": "default"},
        {"registry_auth": "/root/.docker/config.json"},  # told to an engine that the same scope chooses
    ],
)
def test_no_scope_gives_a_site_of_containers_what_opens_the_machine(served: Any, option: dict[str, Any]) -> None:
    every = served.operator.create_token(TokenCreate(name="every", scopes=SCOPES)).token
    asked = SiteCreate(name="edge", tier="edge", runtime="docker", options=option)
    with pytest.raises(ApiError, match=rf"{next(iter(option))} may open up the whole machine.*operator\.token"):
        served.client(every).create_site(asked)
    assert served.operator.sites() == []


def test_scope_catalog_has_only_run_what_the_operator_allows(served_with: Any, manifest: Any) -> None:
    served = served_with(catalog={"modules": ["ours.walk"], "images": ["registry.example/*"]})
    token = served.operator.create_token(TokenCreate(name="cook", scopes=("catalog", "read"))).token
    cook = served.client(token)
    for spec, wrong in (
        ({"entrypoint": "http.server"}, "may not have the module 'http.server'"),
        ({"entrypoint": "ours.walk.more"}, "may not have the module"),
        ({"graph": "ros1", "launch": "/tmp/any.launch"}, "may not have the module 'skytether.service.ros1'"),
        ({"graph": "ros2", "launch": "/tmp/any.py"}, "may not have the module 'skytether.service.ros2'"),
        ({"entrypoint": None, "image": "evil:1"}, "may not have the image 'evil:1'"),
    ):
        document = manifest("mine", **spec)
        if "graph" in spec:
            del document["spec"]["entrypoint"]
        with pytest.raises(ApiError, match=wrong):
            cook.put_service("mine", document)
        served.operator.put_service("mine", document)
        served.operator.delete_service("mine")
    cook.put_service("mine", manifest("mine", entrypoint="ours.walk", image="registry.example/walk:1"))
    cook.put_service("mine", manifest("mine", entrypoint="skytether_services.virtual_trail"))


def test_a_graph_of_the_operators_gives_scope_catalog_no_other_launch_file(
    served_with: Any, manifest: Any, tmp_path: Any
) -> None:
    (tmp_path / "ours").mkdir()

    def graph(name: str, launch: str) -> dict[str, Any]:
        document: dict[str, Any] = manifest(name, graph="ros1", launch=launch)
        del document["spec"]["entrypoint"]
        return document

    (tmp_path / "ours/nav.yaml").write_text(json.dumps(graph("nav", "/srv/nav.launch")))
    served = served_with(catalog_dir=tmp_path / "ours")
    token = served.operator.create_token(TokenCreate(name="cook", scopes=("catalog", "read"))).token
    cook = served.client(token)
    cook.put_service("mine", graph("mine", "/srv/nav.launch"))
    with pytest.raises(
        ApiError, match=r"module 'skytether\.service\.ros1' run with the launch file '/tmp/any\.launch'"
    ):
        cook.put_service("mine", graph("mine", "/tmp/any.launch"))
