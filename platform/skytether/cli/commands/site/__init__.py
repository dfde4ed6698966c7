"""``skytether site``: sites as the orchestrator knows them, and this machine as one."""
