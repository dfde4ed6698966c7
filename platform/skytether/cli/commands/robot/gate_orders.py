"""``skytether robot stop, reset, start, mode, gate-status``: what a person tells the gate, and asks of it.

Of the robot this imports what speaks to the gate, no more: a stop is not to wait.
"""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any

import typer

from skytether.robot.safety.client import GateError, ask
from skytether.robot.safety.protocol import default_folder

from ...output import console, fail, print_foreign, print_json

Folder = Annotated[
    Path | None, typer.Option(help="The gate's folder (safety.folder in robot.yaml), if it is not the usual one.")
]
Json = Annotated[bool, typer.Option("--json", help="One JSON document on standard output.")]


def stop(
    reason: Annotated[str, typer.Argument(help="For whoever finds the robot stopped.")] = "",
    folder: Folder = None,
) -> None:
    """Emergency stop, until `skytether robot reset`.

    Goes to guard and gate at once: one of them that hangs does not hold it up.
    """
    answer = _ask(folder, {"do": "stop", "reason": reason})
    console.print("the robot is stopped; `skytether robot reset` lets it go again", markup=False)
    if "note" in answer:
        console.print("warning: ", style="yellow", end="")
        console.print(str(answer["note"]), markup=False, soft_wrap=True)


def reset(folder: Folder = None) -> None:
    """End the emergency stop, after a look at the robot. Nothing moves by that alone."""
    _ask(folder, {"do": "reset"})
    sentence = (
        "the emergency stop is over; whoever drives begins from a standstill, or goes on after: skytether robot start"
    )
    console.print(sentence, markup=False, soft_wrap=True)


def start(folder: Folder = None) -> None:
    """After a reset: let whoever wants to drive now go on."""
    started = _ask(folder, {"do": "start"})["started"]
    sentence = f"may drive: {', '.join(started)}" if started else "nobody wants to drive now; begin from a standstill"
    console.print(sentence, markup=False, soft_wrap=True)


def mode(
    names: Annotated[str, typer.Argument(help="Those that hold, with commas between; none: none of them.")],
    folder: Folder = None,
) -> None:
    """Say which modes of the gate hold (safety.modes): with a load, with people near."""
    holding = _ask(folder, {"do": "mode", "modes": names})["modes"]
    console.print(f"modes that hold: {', '.join(holding) or 'none'}", markup=False, soft_wrap=True)


def gate_status(folder: Folder = None, json: Json = False) -> None:
    """Say who drives, what lies ahead, and what stands in the way."""
    answer = _ask(folder, {"do": "status"})
    if json:
        print_json(answer)
        return
    nothing = "not all of it is seen" if answer["zone"] == "unknown" else "nothing near"
    way = nothing if answer["way_m"] is None else f"{answer['way_m']:.2f} m to the stop zone"
    _print(f"drives    {answer['hand']}: {answer['linear_m_s']:.3f} m/s, {answer['angular_rad_s']:.3f} rad/s")
    _print(f"ahead     {answer['zone']}: {way}")
    _print(f"stopped   {answer['stopped'] or 'no'}")
    enabled = (answer.get("guard") or {}).get("enabled")
    if enabled is not None:
        _print(f"power     {'the enable signal changes' if enabled else 'off: the enable signal stands still'}")
    if answer.get("modes"):
        _print(f"modes     {', '.join(answer['modes'])}")
    for source, why in answer["waiting"].items():
        _print(f"waiting   {source}: must want a standstill first, after {why}; or: skytether robot start")
    for sentence in answer["beyond"]:
        _print(f"beyond    {sentence}")
    guard = answer["guard"]
    if guard is None:
        _print("guard     does not answer; the gate stops the wheels itself")
    else:
        restarts = f", after {guard['gate_restarts']} deaths of the gate" if guard["gate_restarts"] else ""
        _print(f"guard     process {guard['pid']}, gate {answer['pid']}{restarts}")
    if answer["stopped"] and answer["kept"] is False:
        _print("trouble   the emergency stop is not on disk: it would not outlive the guard")
    troubles = [*answer["troubles"], *(guard["troubles"] if guard else [])]
    for sentence in dict.fromkeys(troubles):
        _print(f"trouble   {sentence}")
    notes = [*answer["not_permitted"], *(guard["not_permitted"] + guard["notes"] if guard else [])]
    for sentence in dict.fromkeys(notes):
        _print(f"note      {sentence}")


def _ask(folder: Path | None, request: dict[str, Any]) -> dict[str, Any]:

    try:
        return ask(folder or default_folder(), request)
    except GateError as error:
        fail(str(error))


def _print(line: str) -> None:
    """A line, some of which others may have written: the reason of a stop, say."""
    print_foreign(f"{line}\n")
