"""Running the service elsewhere: whether and where (task manager), the lease of its instance, shared topics.

What speaks to the orchestrator on the robot's behalf is here. What it sends back never reaches the wheels from here.
"""
