"""Following in front: a robot that stays ahead of the person who walks behind it (thesis 5.5). No service yet.

Pure, and without clocks: `clusters` cuts a scan into pieces, `legs` tells which look like legs, `background` what has
stood there all the time, `assignment` gives legs to people, `person` is one of them, and `tracker` all; `operator`
picks the one to follow, and `formation` is the control law. `bench_legs` runs the eyes on recordings.
"""
