"""REST schemas and the thin client that robots, command line and lab use. No server code."""
