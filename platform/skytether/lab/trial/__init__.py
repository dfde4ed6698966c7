"""What every experiment needs that drives a service as a robot does: the rig, what is kept of a trial, tables, figures.

All but robot, world and network is real: an orchestrator process, the service's process or container, the bridge, the
agent with its supervisor. What one experiment alone asks, measures or draws is beside this folder: `nine_goals`,
`follow_in_front`.
"""
