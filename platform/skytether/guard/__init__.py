"""The process that owns the wheels: small, so that there is little in it to fail.

Standard library only, and nothing else of ours: an import contract says so. It reads no YAML, no message of a
sensor and no command of the agent. `skytether robot gate` checks the configuration and hands over what is needed.

What decides is pure and takes the time as an argument: `kinematics`, `watch`, `estop`, `protocol`. What does is thin.
Gate, agent and tools import `velocity`, `clock` and `protocol` from here, never the other way round.
"""
