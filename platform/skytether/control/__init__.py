"""Control laws that both a service and a robot's fallback use: pure functions of numbers, SI units.

What belongs to one service only (trails, followers, odometry) lives with that service.
"""
