"""What starts, stops and observes instances: a file or a folder for each kind of site, found by entry point.

The contract is in ``base``. The other files are what several kinds use: confinement, ports, logs, reports. Nothing here
decides what runs where, or reads the database.
"""
