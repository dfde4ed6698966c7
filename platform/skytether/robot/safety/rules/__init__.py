"""What decides before the wheels: who drives, who stops, whether the wheels follow, how near and how fast. Pure.

`rules` puts the others in their order. What people write in robot.yaml is in `config`; what waits, reads or sends
anything, in `io` and `gate`.
"""
