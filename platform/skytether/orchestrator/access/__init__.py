"""Who asks, what they may, and how much they may have; secrets that change while everything runs.

How a request arrives is for `http` to know; what becomes of it, for `scheduling`.
"""
