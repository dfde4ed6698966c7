"""What an operator sets: settings with their defaults, where they are read from, sites and groups that a file declares.

What robots, sites and services are is in the database, not here. Nothing here acts on a setting.
"""
