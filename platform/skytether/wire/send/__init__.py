"""From messages to packets: what waits, what goes first, what goes by which path and when.

Why something is sent (a ping, an acknowledgement, a report) is decided elsewhere.
"""
