"""A ROS 1 node without ROS: XML-RPC to master and nodes, TCPROS for topics and services, all payloads raw bytes."""
