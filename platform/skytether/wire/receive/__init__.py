"""From packets to messages: which are authentic and new, what they make complete, in which order it is handed over.

What a message of the peer changes elsewhere is the business of `session`.
"""
