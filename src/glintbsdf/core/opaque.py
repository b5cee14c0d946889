"""Numbers of a map in kernels.

Dr.Jit writes a Python number into the kernel that it records: a kernel that knows the size of a
map, or the range of its normals, is compiled anew for the next map. Numbers that belong to a map
are therefore handed to kernels as variables. Addresses count as well: memory that Dr.Jit takes over
from NumPy must begin at a cache line, or kernels differ by that.
"""

from __future__ import annotations

import drjit as dr
import numpy as np

_LINE = 64  # bytes


def opaque(kind: type, value):
    """``value`` as a variable of the type ``kind``; Dr.Jit arrays stay as they are."""
    return kind(value) if dr.is_array_v(value) else dr.opaque(kind, value)


def aligned(values: np.ndarray) -> np.ndarray:
    """``values``, or a copy of them that begins at a cache line."""
    values = np.ascontiguousarray(values)
    if values.ctypes.data % _LINE == 0:
        return values
    memory = np.empty(values.nbytes + _LINE, np.uint8)
    begin = -memory.ctypes.data % _LINE
    copy = memory[begin : begin + values.nbytes].view(values.dtype).reshape(values.shape)
    copy[...] = values
    return copy
