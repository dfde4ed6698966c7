"""Systematic Reed-Solomon over GF(256): k data shards, and parity of which any k with them give the data back.

Row r of the code (r from k up to 255) weighs data shard i by (k + i) / (r + i), sums and quotients in GF(256) with
x^8 + x^4 + x^3 + x^2 + 1: a Cauchy matrix (Blömer et al., An XOR-based erasure-resilient coding scheme, 1995) with its
columns scaled so that the first row is all ones, a plain sum. A weight depends on k, the row and the shard only, so
that the receiver need not know how many rows there are. Each square part of such a matrix has an inverse, in closed
form.

A shard is weighed by one `bytes.translate`, and sums are numpy's: a block is encoded nearly as fast as by a library in
C (zfec), whose licence (GPL or TGPPL) is not for what others build on.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from functools import lru_cache

import numpy as np
import numpy.typing as npt

Bytes = npt.NDArray[np.uint8]

_POLYNOMIAL = 0x11D
_ORDER = 255
"""Of the field's multiplicative group: logarithms are modulo it."""


def _powers() -> tuple[bytes, bytes]:
    """The field's logarithms (of 0: none, 0 here), and the powers that undo them."""
    logs, powers, value = bytearray(256), bytearray(_ORDER), 1
    for exponent in range(_ORDER):
        powers[exponent], logs[value] = value, exponent
        value = value << 1 ^ (_POLYNOMIAL if value & 0x80 else 0)
    return bytes(logs), bytes(powers)


_LOG, _POWER = _powers()


@lru_cache(maxsize=256)
def _times(weight: int) -> bytes:
    """All products with a weight that is not 0, by the other factor."""
    return bytes([0, *(_POWER[(_LOG[weight] + _LOG[value]) % _ORDER] for value in range(1, 256))])


@lru_cache(maxsize=1024)
def _weights(k: int, row: int) -> tuple[int, ...]:
    return tuple(_POWER[(_LOG[k ^ i] - _LOG[row ^ i]) % _ORDER] for i in range(k))


def _weighed_sum(weights: Iterable[int], shards: Sequence[bytes]) -> bytes:
    """Shards of equal size, a multiple of 4."""
    products = b"".join(
        [
            shard if weight == 1 else shard.translate(_times(weight))
            for weight, shard in zip(weights, shards, strict=True)
        ]
    )
    words = np.frombuffer(products, np.uint32).reshape(len(shards), -1)
    result: bytes = np.bitwise_xor.reduce(words, axis=0).tobytes()
    return result


def encode(data: Bytes, rows: Iterable[int]) -> list[bytes]:
    """Parity shards of one block.

    Args:
        data: k by size, the size a multiple of 4.
        rows: Their indices in the block, from k to 255.
    """
    shards = [shard.tobytes() for shard in data]
    return [_weighed_sum(_weights(len(shards), row), shards) for row in rows]


def recover(data: Bytes, missing: Sequence[int], parity: Mapping[int, Bytes]) -> None:
    """Fill in the data shards that are missing.

    Args:
        data: k by size; what it has at ``missing`` is written over.
        missing: Indices of data shards.
        parity: By index in the block, at least as many as are missing.
    """
    k, rows = len(data), list(parity)[: len(missing)]
    here = [i for i in range(k) if i not in missing]
    shards = [data[i].tobytes() for i in here]
    sums = []
    for row in rows:
        weights = _weights(k, row)
        sums.append(_weighed_sum([*(weights[i] for i in here), 1], [*shards, parity[row].tobytes()]))
    for i, solved in zip(missing, _inverse(k, rows, missing), strict=True):
        data[i] = np.frombuffer(_weighed_sum(solved, sums), np.uint8)


def _inverse(k: int, rows: Sequence[int], columns: Sequence[int]) -> list[list[int]]:
    """Of the code's part with these rows and columns, as many of each (Cauchy's determinants, in logarithms)."""
    of_rows = [
        sum(_LOG[row ^ i] for i in columns) - sum(_LOG[row ^ other] for other in rows if other != row) for row in rows
    ]
    of_columns = [
        sum(_LOG[row ^ i] for row in rows) - sum(_LOG[i ^ other] for other in columns if other != i) - _LOG[k ^ i]
        for i in columns
    ]
    return [
        [_POWER[(of_row + of_column - _LOG[row ^ i]) % _ORDER] for row, of_row in zip(rows, of_rows, strict=True)]
        for i, of_column in zip(columns, of_columns, strict=True)
    ]
