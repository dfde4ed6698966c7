"""The section ``safety`` of robot.yaml: what people write, checked, what is plausible, and the rules that follow.

Nothing here decides while the robot drives, and nothing opens a socket.
"""
