"""One bridge session of the robot: its topics, what it counts, and how good its link is.

Who drives is decided in `control`; who asks for a service is in `offload`.
"""
