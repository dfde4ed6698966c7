"""The robot's outline on the floor, where it gets to, and the way it needs to stop. Pure.

What is seen around the robot is in `sensing`; what follows for its velocity, in `rules`.
"""
