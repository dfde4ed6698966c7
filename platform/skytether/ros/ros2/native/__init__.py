"""A ROS 2 graph joined as the robot's own nodes join it: through ROS 2's rclpy, under ROS 2's Python.

That Python need not be ours. So the node itself is a small program (`side`, nothing but rclpy and the standard
library), and `node` is what the rest of the platform sees of it: messages pass between the two over a socket, as
bytes. What is here may import `side`'s pure modules; `side` imports nothing of ours.
"""
