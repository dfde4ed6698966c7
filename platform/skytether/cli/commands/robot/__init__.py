"""``skytether robot``: the agent, the gate, and robots as the orchestrator knows them."""
