"""A robot's own nodes in a ROS 1 graph."""

import threading

from skytether.messages import LaserScan, Twist, decode, encode, type_hash
from skytether.ros.ros1.node import Node
from skytether.ros.ros1.subscription import Listener

SCAN_MD5, TWIST_MD5 = type_hash(LaserScan, "ros1"), type_hash(Twist, "ros1")


class Walker:
    """The robot's own nodes: a laser at 20 Hz, and wheels that remember what they were told."""

    def __init__(self, graph):
        self.told = []
        self.scan = LaserScan(angle_min=-1.0, angle_increment=0.01, range_max=10.0, ranges=[3.0] * 200)
        self.node = Node("walker", graph.uri, look_s=0.2)
        self.node.start()
        self.laser = self.node.advertise("/scan", "sensor_msgs/LaserScan", SCAN_MD5)
        listener = Listener(lambda data, _: self.told.append(decode(Twist, data, "ros1").linear.x))
        self.node.subscribe("/cmd_vel", "geometry_msgs/Twist", TWIST_MD5, listener)
        self._ended = threading.Event()
        self._thread = threading.Thread(target=self._run)
        self._thread.start()

    def _run(self):
        while not self._ended.wait(0.05):
            self.laser.publish(encode(self.scan, "ros1"))

    @property
    def speed(self):
        return self.told[-1] if self.told else None

    def close(self):
        self._ended.set()
        self._thread.join()
        self.node.close()
