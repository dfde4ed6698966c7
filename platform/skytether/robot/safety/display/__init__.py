"""What the gate knows, so that a person can see it: zones, stopping way, what is in the way, who drives.

The gate sends a `snapshot` a few times a second and waits for nobody; a process of its own makes a `picture` of it, by
the functions by which the gate decided, and publishes it as `markers`. Nothing here decides anything.
"""
