"""A robot that is a ROS 1 graph: what is written of it, its way to the agent and to the gate, what --check looks at."""
