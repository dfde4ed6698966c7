"""One path, as one end sees it: its addresses, rate, round trip, losses, packet size, and whether it works.

Choosing among several paths is the business of `connect.paths`; what is sent by them, of `send`.
"""
