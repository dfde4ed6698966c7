"""`skytether doctor`: what is looked at on a robot, and what each finding means.

What a running agent says of itself is in `agent.status`.
"""
