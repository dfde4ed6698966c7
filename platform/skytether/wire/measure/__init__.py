"""What is measured of topics and of the peer: its clock, round trips, counters, quantiles, gaps in sequences.

What is measured of a path (losses, queues, its rate) is in `path`; whom it is reported to is the business of `state`.
"""
