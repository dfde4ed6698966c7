"""Runs under ROS 2's own Python: nothing but ``rclpy``, message packages and the standard library."""
