"""What each number of the section ``safety`` may plausibly be, and why. Pure.

A number beyond its bounds is more often a slip (milliseconds for seconds, degrees for radians, a test's value) than a
robot. A file that means it says so: ``beyond: {limits.linear_braking: "lab robot on rubber"}``. Then it is taken, and
named wherever people look: when the gate starts, in ``skytether robot run --check`` and in the gate's status.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

LONGEST_REASON = 200
"""Characters of a reason: it is shown in tables and status lines."""


@dataclass(frozen=True, slots=True)
class Bound:
    """One row.

    Attributes:
        key: Dotted, below ``safety``; ``*`` stands for any one name.
        low: Smallest plausible value.
        high: Largest plausible value.
        unit: Of both.
        why: The reason.
        special: A value that means something else, and is always taken.
    """

    key: str
    low: float
    high: float
    unit: str
    why: str
    special: float | None = None


BOUNDS: tuple[Bound, ...] = (
    Bound("footprint.radius", 0.05, 5, "m", "from a toy to a lorry"),
    Bound("footprint.polygon", 0.05, 5, "m", "the corner that is farthest from the origin: from a toy to a lorry"),
    Bound("limits.linear_max", 0.01, 3, "m/s", "people run so fast; beyond it a laser of 10 m is too short to stop"),
    Bound("limits.linear_min", -1.5, 0, "m/s", "backwards a robot sees less"),
    Bound("limits.angular_max", 0.01, 3.5, "rad/s", "half a turn a second"),
    Bound("limits.linear_acceleration", 0.02, 4, "m/s^2", "wheels slip beyond it"),
    Bound("limits.angular_acceleration", 0.05, 20, "rad/s^2", "wheels slip beyond it"),
    Bound("limits.linear_braking", 0.1, 5, "m/s^2", "half of what rubber holds on a dry floor"),
    Bound("limits.angular_braking", 0.1, 20, "rad/s^2", "wheels slip beyond it"),
    Bound("limits.max_gap_s", 0.02, 1, "s", "the robot drives blindly on an old command for this long"),
    Bound("limits.max_local_age_s", 0.01, 1, "s", "the fallback drives by readings of this age"),
    Bound("limits.clock_tolerance_s", 0.001, 0.1, "s", "readers of one clock in several threads"),
    Bound("limits.period_s", 0.001, 0.2, "s", "a control loop turns 5 to 1,000 times a second"),
    Bound("limits.max_step_s", 0.005, 0.5, "s", "a stall is no step"),
    Bound("limits.watchdog_s", 0.02, 1, "s", "a loop that stood still for longer was no delay"),
    Bound("zones.stop_m", 0.02, 2, "m", "more than a laser's error, less than a room"),
    Bound("zones.slow_m", 0.05, 10, "m", "less than a laser sees"),
    Bound("zones.slow_speed", 0.01, 0.5, "m/s", "somebody near can step aside from it"),
    Bound("zones.hysteresis_m", 0.005, 1, "m", "more than a laser's noise, less than the zones"),
    Bound("zones.sensing_s", 0.001, 0.5, "s", "a laser turns 5 times a second or more"),
    Bound("zones.reaction_s", 0.005, 1, "s", "no drive answers at once; one that takes a second cannot be stopped"),
    Bound("sensors.*.x", -5, 5, "m", "on the robot"),
    Bound("sensors.*.y", -5, 5, "m", "on the robot"),
    Bound("sensors.*.yaw_deg", -360, 360, "degrees", "a turn"),
    Bound("sensors.*.z", 0.02, 3, "m", "on the robot", special=0),
    Bound("sensors.*.pitch_deg", -45, 80, "degrees", "it must see the floor before the robot"),
    Bound("sensors.*.roll_deg", -180, 180, "degrees", "a turn"),
    Bound("sensors.*.min_z_m", 0.01, 0.3, "m", "wheels roll over less; more is a foot"),
    Bound("sensors.*.max_z_m", 0.1, 3, "m", "the height of a robot that fits through doors", special=0),
    Bound("sensors.*.slope_deg", 0, 10, "degrees", "ramps for wheelchairs have 3 to 5"),
    Bound("sensors.*.range_min", 0, 1, "m", "what is nearer is not seen"),
    Bound("sensors.*.range_max", 0.1, 100, "m", "outdoor lasers end there", special=0),
    Bound("sensors.*.ignore_deg", 0, 270, "degrees", "all sectors together: it must see something", special=0),
    Bound("sensors.*.max_gap_deg", 0, 30, "degrees", "a person 1 m away is 30 degrees wide"),
    Bound("sensors.*.max_step_deg", 0.01, 5, "degrees", "a table's leg 1 m away is 3 degrees wide"),
    Bound("sensors.*.max_age_s", 0.02, 1, "s", "the robot drives by what it saw so long ago"),
    Bound("unseen.near_m", 0.01, 0.2, "m", "the gate remembers nothing: what leaves the sight is gone"),
    Bound("contacts.*.below_m", 0.005, 1, "m", "farther away it is a matter for the zones"),
    Bound("contacts.*.above_m", 0.01, 1, "m", "wheels fall into less"),
    Bound("contacts.*.max_age_s", 0.05, 2, "s", "a bumper that is cut off stops nothing for so long"),
    Bound("joystick.linear", -3, 3, "m/s", "as `limits.linear_max`"),
    Bound("joystick.angular", -3.5, 3.5, "rad/s", "as `limits.angular_max`"),
    Bound("joystick.deadzone", 0, 0.3, "of the axis", "beyond it half of the way of the stick is lost"),
    Bound("joystick.max_age_s", 0.05, 1, "s", "a robot whose joystick is lost drives on for so long"),
    Bound("joystick.max_still_s", 0.2, 5, "s", "a robot whose joystick is lost drives on for so long"),
    Bound("estop.max_age_s", 0.05, 2, "s", "a button that is cut off stops nothing for so long"),
    Bound("sources.*.timeout_s", 0.05, 1, "s", "the robot drives on an old command for this long"),
    Bound("locks.*.max_age_s", 0.05, 5, "s", "a lock that is cut off locks nothing for so long"),
    Bound("odometry.latency_s", 0, 0.5, "s", "a runaway is found so much later"),
    Bound("odometry.lag_s", 0, 0.5, "s", "a runaway is found four times as much later"),
    Bound("odometry.linear_tolerance", 0.005, 0.3, "m/s", "a robot that creeps by less is not found"),
    Bound("odometry.angular_tolerance", 0.01, 0.6, "rad/s", "a robot that turns by less is not found"),
    Bound("odometry.tolerance_share", 0, 0.3, "of the velocity", "worn wheels and a load"),
    Bound("odometry.confirm_s", 0.05, 1, "s", "a runaway is found so much later"),
    Bound("odometry.blocked_s", 0.2, 10, "s", "a blocked motor burns"),
    Bound("odometry.max_age_s", 0.02, 1, "s", "the real motion is not known for so long"),
    Bound("enable.after_s", 0, 3, "s", "power goes so late after a stop"),
    Bound("display.rate_hz", 0.2, 20, "Hz", "slower nobody follows it, faster nobody sees it"),
    Bound("mode.max_age_s", 0.05, 10, "s", "a load that was taken up is not known of for so long"),
    Bound("rate_hz", 10, 500, "Hz", "slower it reacts late, faster Python does not turn"),
    Bound("guard_s", 0.02, 0.5, "s", "the wheels go on as they were told for so long when the gate hangs"),
)


def bound_of(path: Sequence[str]) -> Bound | None:
    """The row of a number; None: it has none. A mode's numbers have the rows of what they tighten."""
    if len(path) > 2 and path[0] == "modes":
        path = path[2:]
    for bound in BOUNDS:
        parts = bound.key.split(".")
        if len(parts) == len(path) and all(p in ("*", name) for p, name in zip(parts, path, strict=True)):
            return bound
    return None


def check_plausible(
    section: Mapping[str, Any], beyond: Mapping[str, str], where: str = "safety.beyond"
) -> tuple[str, ...]:
    """Look at all numbers of the section.

    Args:
        section: Keys and values, as nested mappings.
        beyond: Reasons of the numbers that are meant to be beyond their bounds, by dotted key.
        where: The key of these in the file.

    Returns:
        A sentence for each of these.

    Raises:
        ValueError: A number is beyond its bounds and not among them, or one among them is not beyond.
    """
    notes, unused = [], dict(beyond)
    for path, value in _numbers(section, ()):
        bound, key = bound_of(path), ".".join(path)
        if bound is None or value == bound.special or bound.low <= value <= bound.high:
            continue
        range_ = f"{bound.low:g} to {bound.high:g} {bound.unit}"
        reason = unused.pop(key, "").strip()
        if not reason:
            raise ValueError(
                f"{key} must be {range_}, not {value:g} ({bound.why}); if this robot needs it, say why in "
                f'{where}: {{{key}: "reason"}}'
            )
        notes.append(f"{key} is {value:g}, beyond {range_} ({bound.why}): {reason}")
    for key in unused:
        raise ValueError(f"beyond.{key}: no number of that key is beyond its bounds; take it out")
    return tuple(notes)


def _numbers(value: Any, path: tuple[str, ...]) -> Iterator[tuple[tuple[str, ...], float]]:
    """Every number with its path; an outline is its farthest corner, sectors are how wide they are together."""
    if isinstance(value, Mapping):
        for key, part in value.items():
            yield from _numbers(part, (*path, str(key)))
    elif path[-1:] == ("polygon",) and value is not None:
        yield path, max((x**2 + y**2) ** 0.5 for x, y in value)
    elif path[-1:] == ("ignore_deg",):
        yield path, sum(last - first if last >= first else (last - first) % 360 for first, last in value)
    elif isinstance(value, int | float) and not isinstance(value, bool):
        yield path, float(value)


def table() -> str:
    """All rows as a table in Markdown; docs/safety-numbers.md has it."""
    rows = [f"| `{b.key}` | {b.low:g} to {b.high:g} {b.unit} | {b.why} |" for b in BOUNDS]
    return "\n".join(("| key | plausible | because |", "| --- | --- | --- |", *rows))
