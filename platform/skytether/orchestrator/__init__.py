"""The orchestrator: which service runs where, for which robot, and what has become of it.

It is not on the way of a message: robot and service talk directly over the bridge, and go on talking while
the orchestrator is down. Decisions (placement, plan) are pure; runtimes, store and HTTP are shells around them.
"""
