"""A service that is the enemy: it publishes made-up readings, a held joystick and velocities wherever it can."""
