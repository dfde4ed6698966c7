"""What runs under ROS 2's own Python: nodes that send, receive and note, for benchmarks.

That Python has ROS 2 (or Cyclone DDS) and need have nothing else, so these modules import the standard library and
each other only, relatively, and keep to Python 3.10. They are started by `skytether.lab.bench.ros2_node`.
"""
