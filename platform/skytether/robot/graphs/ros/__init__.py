"""What robots of ROS 1 and ROS 2 have in common, for the agent and for the gate.

How a generation publishes, subscribes and finds others is in `ros1` and `ros2`; what any graph has, beside this folder.
"""
