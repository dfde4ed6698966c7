"""The robot's hardware as a graph: readings from topics, velocities to one. ROS 1 and ROS 2, and whatever is added.

`registry` is the table of kinds, `kind` what a kind is: a file or folder here, and a row of the table. How a graph of
ROS is spoken to is in `skytether.ros`; what the wheels may do is decided in `control` and `safety`.
"""
