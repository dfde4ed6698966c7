"""A real Zenoh router and played nodes of ROS 2 for all tests of this folder."""

from ros2_graph import own_stage, shared_router, stage

__all__ = ["own_stage", "shared_router", "stage"]
