"""Alignment of arrays in memory.

Dr.Jit uses the memory of NumPy's arrays, and its kernels for memory that begins at a cache
line differ from those for other memory.
"""

from __future__ import annotations

import numpy as np

_LINE = 64  # bytes

#: Memory of this size, bytes, comes from the system in whole pages, and always begins at the same
#: place in a page. So no copy is needed.
_LARGE = 1 << 26


def aligned(values: np.ndarray) -> np.ndarray:
    """``values``, or a copy of them that begins at a cache line; large arrays as they are."""
    values = np.ascontiguousarray(values)
    if values.ctypes.data % _LINE == 0 or values.nbytes >= _LARGE:
        return values
    memory = np.empty(values.nbytes + _LINE, np.uint8)
    begin = -memory.ctypes.data % _LINE
    copy = memory[begin : begin + values.nbytes].view(values.dtype).reshape(values.shape)
    copy[...] = values
    return copy
