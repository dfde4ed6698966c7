"""What an end remembers of its topics: of one handshake (`epoch`), and beyond it (counters, reliable topics).

No packet is made or read here.
"""
