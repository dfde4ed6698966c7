"""Who drives, and how fast: source choice, supervisor, fallbacks, and one tick of the control loop.

All of it is pure: time, readings and commands are arguments. No socket, thread or clock belongs here.
"""
