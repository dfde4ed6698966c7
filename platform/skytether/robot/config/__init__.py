"""robot.yaml: what people write, checked, and what follows from it for the agent and for the gate.

The section ``safety`` is in `skytether.robot.safety.config`. Nothing here starts anything.
"""
