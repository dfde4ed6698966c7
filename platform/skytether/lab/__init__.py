"""Experiments: simulated robots and people, emulated links, scenarios, measures, plots, benchmarks.

What is here may use everything below it; nothing below may use it.
"""
