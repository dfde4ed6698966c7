import numpy as np
import pytest

from skytether.control.admittance import STANDSTILL, AdmittanceParams, Velocity, step
from skytether.lab.measures import Measures, measure
from skytether.lab.simulate import simulate
from skytether.lab.trail import Trail
from skytether.lab.walk import STEP, World
from skytether.lab.walker import WalkerParams
from skytether.messages import Message, Twist, Vector3, WrenchStamped, yaw_of

TRAIL = Trail()
SLOWLY = Twist(Vector3(x=0.1))


class Unguided:
    """Admittance alone, the person's own torque: what the robot's fallback does (thesis section 3.3)."""

    def __init__(self) -> None:
        self._velocity: Velocity = STANDSTILL
        self._force = WrenchStamped()

    def receive(self, topic: str, message: Message, now: float) -> None:
        if isinstance(message, WrenchStamped):
            self._force = message

    def step(self, now: float) -> Twist:
        wrench = self._force.wrench
        self._velocity = step(AdmittanceParams(), self._velocity, wrench.force.x / 2, wrench.torque.z, STEP)
        return Twist(Vector3(x=self._velocity.linear), Vector3(z=self._velocity.angular))


def test_same_seed_same_world_another_seed_another() -> None:
    def run(seed: int) -> list[object]:
        world = World(TRAIL, seed=seed)
        return [world.step(i * STEP, SLOWLY).messages() for i in range(60)]

    assert run(1) == run(1)
    assert run(1) != run(2)


def test_the_same_person_whatever_the_walker() -> None:
    quiet = World(TRAIL, seed=1, walker=WalkerParams(force_noise=0.0))
    noisy = World(TRAIL, seed=1, walker=WalkerParams(force_noise=2.0))
    read = np.array([[w.step(i * STEP, Twist()).force.wrench.force.x for w in (quiet, noisy)] for i in range(800)])
    # Two sensors of 2 N each: the difference is noise of 2 * sqrt(2) N around nothing.
    difference = read[:, 1] - read[:, 0]
    assert abs(difference.mean()) < 0.4
    assert difference.std() == pytest.approx(2 * 2**0.5, rel=0.1)


def test_sensors_are_stamped_named_and_odometry_comes_at_10_hz() -> None:
    world = World(TRAIL, seed=1)
    sensors = [world.step(100 + i * STEP, SLOWLY) for i in range(100)]
    assert world.elapsed == pytest.approx(1.0)
    last = sensors[-1]
    assert last.force.header.stamp.seconds() == pytest.approx(100.99)
    assert list(last.wheels.name) == ["left_wheel", "right_wheel"]
    assert [i for i, s in enumerate(sensors) if s.odom is not None] == list(range(0, 100, 10))
    assert [topic for topic, _ in sensors[0].messages()] == ["force", "wheels", "odom"]
    assert [topic for topic, _ in last.messages()] == ["force", "wheels"]


def test_odometry_message_says_where_the_walker_is_and_how_fast() -> None:
    world = World(TRAIL, seed=1, walker=WalkerParams(turn_give=0.0, give=0.0))
    sensors = [world.step(i * STEP, Twist(Vector3(x=0.2), Vector3(z=0.1))) for i in range(201)][-1]
    assert sensors.odom is not None
    pose, twist = sensors.odom.pose.pose, sensors.odom.twist.twist
    assert (pose.position.x, pose.position.y) == pytest.approx(world.pose[:2], abs=2e-3)
    assert yaw_of(pose.orientation) == pytest.approx(world.pose.heading, abs=5e-3)
    assert twist.linear.x == pytest.approx(0.2, abs=0.02)


def unguided(seed: int) -> Measures:
    return measure(simulate(World(TRAIL, seed=seed), Unguided(), duration=60.0), TRAIL)


@pytest.mark.slow
@pytest.mark.parametrize("seed", [1, 2])
def test_a_person_finishes_without_guidance_but_less_exactly(seed: int) -> None:
    result = unguided(seed)
    assert result.completed
    # Guided, the same people keep below 0.03 (tests of the virtual trail).
    assert 0.03 < result.kte_m < 0.2


def test_messages_and_commands_take_half_the_round_trip_each_and_losses_are_repeated_over() -> None:
    class Far:
        arrived: list[float]

        def __init__(self) -> None:
            self.arrived = []

        def receive(self, topic: str, message: Message, now: float) -> None:
            self.arrived.append(now)

        def step(self, now: float) -> Twist | None:
            return SLOWLY if now == 0 else None

    far = Far()
    samples = simulate(World(TRAIL, seed=1), far, rtt=0.2, duration=0.5)
    assert far.arrived[0] == pytest.approx(0.1)
    moved = next(s.time for s in samples if s.x > 1e-6)
    assert moved == pytest.approx(0.11)  # the command of 0.0 arrives at 0.1 and acts on the step after
    assert samples[-1].x == pytest.approx(0.1 * (0.39 - 0.1), rel=0.15)  # it goes on with the only command


def test_loss_needs_a_generator() -> None:
    with pytest.raises(ValueError, match="needs a random generator"):
        simulate(World(TRAIL, seed=1), Unguided(), loss=0.1)


def test_loses_the_share_asked_for() -> None:
    class Counting(Unguided):
        received = 0

        def receive(self, topic: str, message: Message, now: float) -> None:
            self.received += 1

    counting = Counting()
    simulate(World(TRAIL, seed=1), counting, loss=0.3, duration=20.0, random=np.random.default_rng(1))
    assert counting.received / (2000 * 2.1) == pytest.approx(0.7, abs=0.03)
