"""The orchestrator: which service runs where, for which robot, and what has become of it.

It is not on the way of a message: robot and service talk directly over the bridge, and go on talking while
the orchestrator is down. Decisions (placement, plan) are pure; runtimes, store and HTTP are shells around them.

Rooms, each of which imports from those below only (contract "Rooms of the orchestrator")::

    http                          server, routes, the port of nodes
    core | backup                 the parts put together | a copy of what cannot be made anew
    groups | nodes                how many machines | machines that joined
    providers                     how a cloud is asked for machines
    scheduling                    what runs where, and that it does
    robots | telemetry            gates, stops, what robots share | metrics, reports, log, audit
    access                        who may what, and how much
    store                         the database, and who leads
    config                        what an operator sets
    domain                        records, errors, secrets, checks
    runtimes                      how instances are started, stopped and observed
"""
