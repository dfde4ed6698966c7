"""Selective repeat (rule 7): the two ends of one reliable topic, and the shards of its large messages.

What several topics share, and what outlives a handshake, is in `state`.
"""
