"""The service ``recorder``: writes everything that a robot sends to MCAP files, which Foxglove and ROS tools open.

`recording` writes the files, `service` is the shell around it. Messages are never decoded.
"""
