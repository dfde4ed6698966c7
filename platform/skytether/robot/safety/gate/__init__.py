"""The processes that drive: the gate with its loop, its end of the socket to the guard, the writer, and their start.

They put together what other rooms hold; nothing about a velocity is decided here.
"""
