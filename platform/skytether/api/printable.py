"""Text that others wrote, for a terminal or a log: it obeys no code of theirs."""

from __future__ import annotations


def printable(text: str, *, lines: bool = True) -> str:
    """The text with escapes in the place of what cannot be printed.

    Args:
        text: By anybody.
        lines: Ends of lines stay; else the text is one line.
    """
    return "".join(c if c.isprintable() or (lines and c == "\n") else ascii(c)[1:-1] for c in text)
