"""Forward error correction (rule 5): messages as shards with parity, how much of it, and shards back into messages.

When shards are sent, and what is sent again because the peer asks for it, is decided in `send` and `reliable`.
"""
