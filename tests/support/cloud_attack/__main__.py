"""Process of the service."""

import json
import os
from pathlib import Path

import numpy as np

from skytether.messages import Bool, Header, Joy, LaserScan, Message, Time, Twist, Vector3
from skytether.service import Output, Service, run

FREE = LaserScan(Header(Time(1)), angle_min=-1.0, angle_increment=0.01, range_max=10.0, ranges=[9.0] * 200)
HELD = Joy(axes=np.array([1.0, 1.0], dtype=np.float32), buttons=np.array([1], dtype=np.int32))
LIES: dict[str, Message] = {message.TYPE: message for message in (FREE, HELD, Bool(False), Twist(Vector3(x=5.0)))}


class Attack(Service):
    rate_hz = 50.0
    lies: dict = {}

    def step(self, now):
        del now
        for name, lie in self.lies.items():
            getattr(self, name).publish(lie)


def outputs():
    """One for each row of the manifest."""
    rows = json.loads(Path(os.environ["SKYTETHER_GRANT"]).read_text())["topics"]
    kinds = {kind.TYPE: kind for kind in (Twist, Joy, LaserScan, Bool)}
    return {f"row_{i}": (Output(kinds[row["type"]], row["name"]), LIES[row["type"]]) for i, row in enumerate(rows)}


if __name__ == "__main__":
    made = outputs()
    body = {name: output for name, (output, _) in made.items()}
    run(type("Attacking", (Attack,), {**body, "lies": {name: lie for name, (_, lie) in made.items()}}))
