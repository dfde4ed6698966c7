"""Folders that others have filled, perhaps to make trouble: how much is in them, and their end."""

from __future__ import annotations

import os
import subprocess
from pathlib import Path

from skytether.api.manifest import NAME

MOST_FILES = 50_000
"""Files and folders that are counted at most; a folder with more counts as too full, for to look takes too long."""


def folders_in(parent: Path) -> list[str]:
    """Folders of what has a name as robots have; what else is there (``lost+found`` of a file system) is nobody's."""
    if not parent.is_dir():
        return []
    with os.scandir(parent) as entries:
        return sorted(one.name for one in entries if NAME.fullmatch(one.name) and one.is_dir(follow_symlinks=False))


def size_of(folder: str, enough: int) -> int | None:
    """Bytes on disk of all files below a folder. Stops beyond ``enough`` bytes.

    None: it holds too many, or folders that cannot be looked into, which are too deep for a path or closed to us.

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
                    except FileNotFoundError:
                        continue
                    except OSError:
                        return None
                    if size > enough:
                        return size
        except (FileNotFoundError, NotADirectoryError):
            continue
        except OSError:
            return None
    return size


def remove_tree(folder: str) -> None:
    """Remove a folder with all that is in it, as far as that can be done; one that is not there is removed already.

    However deep: Python's own way ends at a thousand folders, with an error that is none of the system's.
    """
    subprocess.run(["rm", "-rf", "--", folder], stderr=subprocess.DEVNULL, check=False)  # noqa: S607 (the system's)
