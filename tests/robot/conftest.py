import base64
from collections.abc import Callable, Iterable
from datetime import UTC, datetime
from math import nan

import pytest

from skytether.api.client import ApiError
from skytether.api.manifest import Manifest, Tier
from skytether.api.rest import Instance, InstanceCreate, Placement, Problem, Renew, Session, Site, State
from skytether.messages import Message, Twist, Vector3, Wrench, WrenchStamped, encode
from skytether.robot.session.session import LiveSession
from skytether.wire.events import Connected, MessageReceived
from skytether.wire.stats import SessionStats


class PushedBase:
    """A base whose force sensor feels a constant push, and that remembers every velocity it was told."""

    topics = {"force": WrenchStamped}

    def __init__(self) -> None:
        self.push = 12.0
        self.written: list[tuple[float, float]] = []
        self.why: list[bool] = []
        """Of each velocity written: whether a standstill is what somebody wants."""
        self.on_read: Callable[[], None] = lambda: None
        self.on_write: Callable[[], None] = lambda: None

    def read(self, now: float) -> Iterable[tuple[str, Message]]:
        self.on_read()
        return [("force", WrenchStamped(wrench=Wrench(force=Vector3(x=self.push))))]

    def write(self, twist: Twist) -> None:
        self.on_write()
        self.written.append((twist.linear.x, twist.angular.z))

    def decided(self, decided: bool) -> None:
        self.why.append(decided)

    @property
    def velocity(self) -> tuple[float, float]:
        return self.written[-1]


class RecordingBridge:
    """The robot's end of a bridge without a network: keeps what it was told."""

    def __init__(self) -> None:
        self.published: list[tuple[str, bytes]] = []
        self.peers: list[tuple[str, int]] = []
        self.running = False
        self.snapshot = SessionStats(connected=True)

    def start(self) -> None:
        self.running = True

    def publish(self, topic: str, payload: bytes | memoryview) -> bool:
        self.published.append((topic, bytes(payload)))
        return True

    def set_peer(self, host: str, port: int) -> None:
        self.peers.append((host, port))

    def stats(self) -> SessionStats:
        return self.snapshot

    def stop(self) -> None:
        self.running = False


class Cloud:
    """The service's side of a `LiveSession`: connects and sends commands."""

    def __init__(self, session: LiveSession) -> None:
        self.session = session
        self.sequence = 0
        session.notify(Connected(()))

    def send(self, now: float, linear: float = 0.2, angular: float = 0.1, *, delay: float = 0.02) -> None:
        payload = encode(Twist(linear=Vector3(x=linear), angular=Vector3(z=angular)), "cdr")
        self.send_bytes(now, payload, delay=delay)

    def send_bytes(self, now: float, payload: bytes, *, delay: float = 0.02) -> None:
        self.session.deliver(MessageReceived("cmd_vel", payload, self.sequence, now - delay, 0.01, now))
        self.sequence += 1


@pytest.fixture
def base() -> PushedBase:
    return PushedBase()


NAN_TWIST = encode(Twist(linear=Vector3(x=nan)), "cdr")


@pytest.fixture
def nan_twist() -> bytes:
    return NAN_TWIST


@pytest.fixture
def bridge() -> RecordingBridge:
    return RecordingBridge()


@pytest.fixture
def make_cloud() -> type[Cloud]:
    return Cloud


class ObedientOrchestrator:
    """Gives every robot what it asks for, without a network; fails as it is told.

    Attributes:
        requests: All that it was asked for, also while it failed.
        rtt: Its sites, and how long a probe of each takes [s].
        changes: What is different of one instance, by its id.
    """

    KEY = base64.b64encode(bytes(32)).decode()

    def __init__(self) -> None:
        self.calls: list[tuple[str, object]] = []
        self.fail: Exception | None = None
        self.healthy = True
        self.states = [State.RUNNING]
        self.reason = ""
        self.session: Session | None = None
        self.successor: str | None = None
        self.placement: Placement | None = None
        self.key_taken = False
        self.requests: list[InstanceCreate] = []
        self.rtt: dict[Tier, float] = {}
        self.changes: dict[str, dict[str, object]] = {}
        self._number = 0

    def create_instance(self, request: InstanceCreate, *, idempotency_key: str) -> Instance:
        self.requests.append(request)
        self._number += self.fail is None
        return self._answer("create", idempotency_key)

    def get_instance(self, instance_id: str) -> Instance:
        return self._answer("get", instance_id, instance_id)

    def renew_instance(self, instance_id: str, renew: Renew) -> Instance:
        return self._answer("renew", renew, instance_id)

    def claim_session(self, instance_id: str, claim: str) -> str:
        self.calls.append(("claim", instance_id))
        if self.key_taken:
            problem = Problem(title="Not possible now", status=409, detail="was handed out already")
            raise ApiError(problem)
        return self.KEY

    def delete_instance(self, instance_id: str) -> Instance:
        return self._answer("delete", instance_id)

    def sites(self) -> list[Site]:
        return [Site(name=name, tier=name, runtime="process") for name in self.rtt]

    def get_service(self, name: str) -> Manifest:
        spec = {"entrypoint": name, "needs": {"max_rtt_ms": 100}}
        about = {"apiVersion": "skytether.io/v1", "kind": "Service", "metadata": {"name": name}}
        return Manifest.model_validate({**about, "spec": spec})

    def probe(self, site: Tier) -> float:
        return self.rtt[site]

    def _answer(self, name: str, what: object, instance_id: str = "") -> Instance:
        self.calls.append((name, what))
        if self.fail is not None:
            raise self.fail
        state = self.states.pop(0) if len(self.states) > 1 else self.states[0]
        epoch = datetime(2026, 1, 1, tzinfo=UTC)
        instance = Instance(
            id=instance_id or f"i{self._number}",
            robot="walker",
            service="virtual-trail",
            state=state,
            reason=self.reason,
            session=self.session,
            successor=self.successor,
            placement=self.placement,
            created_at=epoch,
            updated_at=epoch,
            lease_expires_at=epoch,
        )
        return instance.model_copy(update=self.changes.get(instance.id, {}))


@pytest.fixture
def orchestrator() -> ObedientOrchestrator:
    return ObedientOrchestrator()


@pytest.fixture
def make_bridge() -> type[RecordingBridge]:
    return RecordingBridge
