"""UDP endpoints of a session: sockets, the clock, the thread around `skytether.wire`, and the seam to graphs.

Here is what touches the system. Rules of the protocol belong into `skytether.wire`; graphs of ROS into
`skytether.ros`.
"""
