"""The program that is a node of a ROS 2 graph on our behalf; it runs under ROS 2's Python, 3.10 or newer.

`frames` is what goes over the socket, `outbox` what waits for it, `program` the node, `hearing`, `comers` and `stalls`
what it knows of wheels that do not hear, of who is back, and of velocities that are old. Nothing here imports anything
but rclpy and the standard library, and nothing decodes a message of a topic.
"""
