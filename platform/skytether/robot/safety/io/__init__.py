"""How sensors and wheels are reached: by sockets, or as the robot's kind of graph does it; the log that never waits.

What others say to the gate is in `client` and `protocol`; what a kind of graph does, in `skytether.robot.graphs`.
"""
