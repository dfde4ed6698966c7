"""Graphs of ROS as ports of the bridge. The rest of the platform knows ROS by its bytes only (`skytether.messages`).

``ros1`` speaks to a ROS 1 master and its nodes with code of its own: no ROS need be installed, and any Python will do.
``ros2`` is a client of a ROS 2 graph's Zenoh router (extra ``ros2``), with no ROS installed either.
What both generations have in common is here: names, what turns the bytes of one into the other's, and what the two ends
of a session tell each other of their graphs.
"""
