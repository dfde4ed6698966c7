"""The robot's side: who drives, the last gate before the wheels, and the agent that asks for services.

Everything here runs on the robot and works with the cable pulled. No simulation, no service, no server code belongs
here. Rooms import from those below only (contract "Rooms of the robot")::

    config | replay               robot.yaml | recordings sent as a robot would
    agent | diagnosis             the program on the robot | what the doctor looks at
    safety                        the gate: the last thing before the wheels
    graphs                        the kinds of robot graph: ROS 1, ROS 2, and others
    control | offload             who drives, how fast | whether and where the service runs
    session                       one bridge session
    config_base | log_throttle
"""
