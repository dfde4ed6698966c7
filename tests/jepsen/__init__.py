"""Several real orchestrators under faults, and a checker that looks from outside; see docs/internals.md.

``history`` is what everybody writes and the checker reads, ``cluster`` the programs, ``workload`` the robots,
``nemesis`` the faults, ``watcher`` what looks at the machine meanwhile, ``checker`` pure, ``run`` all of it together.
"""
