"""Bytes: headers, frames, topic tables, ciphers and tags, compression, and which numbers came before.

Codecs come in pairs, `push_x` and `pull_x`. Nothing here knows paths or time, or keeps a message.
"""
