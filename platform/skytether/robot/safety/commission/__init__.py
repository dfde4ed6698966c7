"""Commissioning: what wheels, watchdog, button and power really do, measured step by step while no gate runs.

What the gate makes of the numbers is in `rules` and `geometry`.
"""
