"""A simulated building for wheeled robots (MuJoCo): walls, people, lasers, odometry, and a judge of contacts.

`plan` reads the building, `simulation` moves it, `agent` joins it to a robot agent as if it were a real robot.
`cluttered` makes fields of obstacles. The walker and the person who pushes it are in `skytether.lab.walk`.
"""
