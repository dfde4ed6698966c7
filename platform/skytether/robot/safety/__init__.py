"""What stands between every command and the wheels, and stays when everything else is gone (thesis section 5.1).

What decides is pure and takes the time as an argument: `footprint`, `ranges`, `zones`, `joystick`, `estop`
and `rules`, which puts them in order. What does is thin: `gate` (the process with the loop), `guard` (the process that
owns the wheels and starts the gate), `hardware`, `client`. Nothing here knows of a network, a service or the cloud.
"""
