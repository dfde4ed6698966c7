"""How much memory something keeps, whatever it keeps it in: for bounds that no answer or counter shows."""

import gc
import sys
import types
from collections.abc import Iterable

_SHARED = (type, types.ModuleType, types.FunctionType, types.BuiltinFunctionType, types.CodeType)
"""What belongs to the program, not to one object of it."""


def deep_size(*roots: object, without: Iterable[object] = ()) -> int:
    """Bytes of these and of all that can be reached from them, each object once.

    Args:
        roots: Where to begin.
        without: What belongs to others: neither it nor what only it leads to is counted.
    """
    seen = {id(one) for one in without}
    ahead: list[object] = list(roots)
    size = 0
    while ahead:
        one = ahead.pop()
        if id(one) in seen or isinstance(one, _SHARED):
            continue
        seen.add(id(one))
        size += sys.getsizeof(one)
        ahead += gc.get_referents(one)
    return size
