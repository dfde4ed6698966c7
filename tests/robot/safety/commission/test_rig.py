"""The commissioning rig on real sockets, in made-up time: a driver that pauses, and one that does not read any more."""

import socket
from collections.abc import Iterator
from pathlib import Path

import pytest

from skytether.guard.velocity import STANDSTILL, Velocity
from skytether.messages import Bool, Twist, Vector3, decode, encode
from skytether.robot.safety.commission.commission import CommissionError
from skytether.robot.safety.commission.rig import HardwareRig
from skytether.robot.safety.config.safety_config import SafetyConfig

SLOWLY = Velocity(0.15, 0.0)


class Driver:
    """Turns the wheels and switches their power: at each sleep of the rig it reads, if it is awake, and reports."""

    def __init__(self, folder: Path) -> None:
        self.folder, self.time = folder, 100.0
        self.pauses = {"wheels": False, "power": False}
        self.told: list[float] = []
        self.levels: list[bool] = []
        self.links = {name: self._listen(name) for name in self.pauses}
        self.out = socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM)

    def _listen(self, name: str) -> socket.socket:
        made = socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM)
        made.bind(str(self.folder / f"{name}.sock"))
        made.setblocking(False)
        return made

    def now(self) -> float:
        return self.time

    def sleep(self, seconds: float) -> None:
        self.time += seconds
        for name, link in self.links.items():
            while not self.pauses[name]:
                try:
                    data = link.recv(256)
                except BlockingIOError:
                    break
                if name == "wheels":
                    self.told.append(decode(Twist, data).linear.x)
                else:
                    self.levels.append(bool(decode(Bool, data).data))
        odom = encode(Twist(linear=Vector3(x=self.told[-1] if self.told else 0.0)))
        self.out.sendto(b"odom\0" + odom, str(self.folder / "sensors.sock"))

    def close(self) -> None:
        for link in (*self.links.values(), self.out):
            link.close()


@pytest.fixture
def driver(tmp_path: Path) -> Iterator[Driver]:
    made = Driver(tmp_path)
    yield made
    made.close()


@pytest.fixture
def rig(driver: Driver) -> Iterator[HardwareRig]:
    section = {
        "footprint": {"radius": 0.3},
        "sensors": {},
        "folder": str(driver.folder),
        "rate_hz": 500,  # a socket keeps 10 datagrams, or 512: this fills both in about a second
        "odometry": {"type": "geometry_msgs/msg/Twist"},
        "enable": {"socket": f"unix:{driver.folder}/power.sock"},
    }
    made = HardwareRig(SafetyConfig.model_validate(section), driver.now, driver.sleep)
    yield made
    made.close()


@pytest.mark.parametrize("paused", ["wheels", "power"])
def test_a_driver_that_pauses_for_half_a_second_goes_on(rig: HardwareRig, driver: Driver, paused: str) -> None:
    rig.write_velocity(SLOWLY, 0.1)
    driver.pauses[paused] = True
    rig.write_velocity(SLOWLY, 0.5)
    driver.pauses[paused] = False
    rig.write_velocity(STANDSTILL, 0.1)
    assert driver.told[-1] == 0.0
    assert driver.levels[-1] is not driver.levels[-2]  # it changes again


@pytest.mark.parametrize(
    ("paused", "what"), [("wheels", "the wheels cannot be told anything"), ("power", "the enable signal cannot be set")]
)
def test_one_that_does_not_read_any_more_is_named(rig: HardwareRig, driver: Driver, paused: str, what: str) -> None:
    driver.pauses[paused] = True
    began = driver.time
    with pytest.raises(CommissionError, match=f"{what}: whoever .* has read nothing for 1 s"):
        rig.write_velocity(SLOWLY, 3.0)
    assert driver.time - began > 1.0
