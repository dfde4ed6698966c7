"""What robots tell and are told beside their instances: gates, orders to stop, words that they share in a group.

What runs for a robot is for `scheduling` to know; what it reports of that, for `telemetry`.
"""
