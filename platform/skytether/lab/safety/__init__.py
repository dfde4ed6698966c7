"""A robot whose hardware is played, around the real guard, gate and agent, and a judge of what its wheels were told.

`robot` has the sockets and processes, `record` remembers what the wheels received, `checker` holds it against what is
promised. `attacks` and its neighbours hold the attacks; `skytether.lab.bench.safety` makes a benchmark of them.
"""
