"""How much is in a folder: looked at again and again, so bounded."""

from __future__ import annotations

import os

MOST_FILES = 50_000
"""Files and folders that are counted at most; a folder with more counts as too full, for to look takes too long."""


def size_of(folder: str, enough: int) -> int | None:
    """Bytes on disk of all files below a folder; None: it holds too many. Stops beyond ``enough`` bytes.

    Links are not followed, and what vanishes meanwhile does not count.
    """
    size, seen, folders = 0, 0, [folder]
    while folders:
        try:
            with os.scandir(folders.pop()) as entries:
                for entry in entries:
                    seen += 1
                    if seen > MOST_FILES:
                        return None
                    try:
                        size += entry.stat(follow_symlinks=False).st_blocks * 512
                        if entry.is_dir(follow_symlinks=False):
                            folders.append(entry.path)
                    except OSError:
                        continue
                    if size > enough:
                        return size
        except OSError:
            continue
    return size
