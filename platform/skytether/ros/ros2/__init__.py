"""A ROS 2 graph joined as a client of its Zenoh router; no ROS 2 installation is needed.

Two kinds of graph: nodes that run ``rmw_zenoh_cpp``, and nodes on DDS behind ``zenoh-bridge-ros2dds``. What either
puts on the wire is told by pure functions (`names`, `qos`, `tokens`, `attachment`, `dialect`), what is known of the
graph by `graph`; `client` holds the Zenoh session and `port` joins it to a bridge. Needs the extra ``ros2``.
"""
