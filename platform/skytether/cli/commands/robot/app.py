"""``skytether robot``: all of its commands."""

from __future__ import annotations

from . import commission, gate, run, status
from .registry import app

app.command("status")(status.status)
app.command("run")(run.run)
app.command("gate")(gate.gate)
app.command("mode")(gate.mode)
app.command("gate-status")(gate.gate_status)
app.command("safety-log")(gate.safety_log)
app.command("stop")(gate.stop)
app.command("reset")(gate.reset)
app.command("start")(gate.start)
app.command("commission")(commission.commission)
