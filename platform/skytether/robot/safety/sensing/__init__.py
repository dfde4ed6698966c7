"""From messages of range sensors to where obstacles are, where nobody looks, and how old all that is. Pure.

How fast the robot may go among what is seen is decided in `rules`. Bumpers and cliff sensors, which stop it, are there.
"""
