"""The robot's hardware as a graph of ROS 1 or ROS 2: readings from topics, velocities to one.

How such a graph is spoken to is in `skytether.ros`; what the wheels may do is decided in `control`.
"""
