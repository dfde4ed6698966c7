"""Finding the peer, and finding it again: handshakes, when to speak first, several paths and the choice among them.

Messages of topics do not come through here.
"""
