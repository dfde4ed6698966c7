"""Following in front: a robot that stays ahead of the person who walks behind it (thesis 5.5).

So far its eyes for legs, pure and without clocks: `clusters` cuts a scan into pieces, `legs` tells which look like
legs, `background` which have stood there all the time, `assignment` gives legs to people, `person` is one of them, and
`tracker` all; `operator` picks the one to follow. `bench_legs` runs them on recordings.
"""
