"""All that listens: the server, who may hold a connection, the routes, errors as HTTP, and the port of nodes.

No rule of what may be placed, started or stored: routes call `core` and `scheduling`, and turn their answers into JSON.
"""
