"""Recordings sent to a service as a robot would send them.

Nothing here drives: there are no wheels and no supervisor.
"""
