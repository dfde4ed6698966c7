"""Real nodes of ROS 1 in processes of their own: rospy under the system's Python, told and read as those of ROS 2."""

from __future__ import annotations

from ros1_graph import Ros1Graph
from ros2_nodes import Node

BEFORE = """
import json, sys, threading, time
import rospy

lock = threading.Lock()
def say(what):
    with lock:  # rospy's threads may say something at once
        print(json.dumps(what), flush=True)
"""
_AFTER = """
say("ready")
rospy.spin()
"""


def start_rospy(graph: Ros1Graph, code: str, name: str) -> Node:
    """A node; its code has ``say``, and is there to read what it is told."""
    text = f"{BEFORE}rospy.init_node({name!r}, disable_signals=True)\n{code}{_AFTER}"
    return Node(["/usr/bin/python3", "-c", text], graph.environment)
