"""Which service runs where, and that it does: catalog, sites, placement, plan, and what carries them out.

Requests ask `Instances`; the reconciler does the rest. No HTTP, no provider of machines.
"""
