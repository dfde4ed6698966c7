"""What ROS 2 starts of Skytether: nodes that have the programs of `skytether` as their children.

They run under ROS 2's Python, with rclpy and the standard library alone; `skytether` itself may live in any other.
"""
