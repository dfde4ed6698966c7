"""What stands between every command and the wheels, and stays when everything else is gone (thesis section 5.1).

What decides is pure and takes the time as an argument: `rules`, over `sensing` and `geometry`. What does is thin:
`gate` (the process with the loop), `io`, `display`, `client`. The guard, which owns the wheels and starts the gate, is
`skytether.guard`. Nothing here knows of a network, a service or the cloud.
"""
