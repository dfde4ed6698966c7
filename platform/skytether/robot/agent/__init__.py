"""The program on the robot: threads around the pure parts, its status page, what it says of itself.

What can be decided without a thread, a socket or a clock belongs in a room below.
"""
