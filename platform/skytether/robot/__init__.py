"""The robot's side: who drives, the last gate before the wheels, and the agent that asks for services.

What decides is pure and takes the time as an argument (`supervisor`, `arbiter`, `fallback`, `link`, `table`);
what does is thin (`agent`, `asker`, `replay`). Everything here runs on the robot and works with the cable pulled.
No simulation, no service, no server code belongs here.
"""
