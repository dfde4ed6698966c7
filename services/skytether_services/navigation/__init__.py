"""Autonomous navigation as a service (thesis 4.3 and 5.6): localisation, mapping, costmaps, planner and controller.

Pure algorithms, a file each, that know nothing of the bridge. Needs the extra ``navigation``.
"""
