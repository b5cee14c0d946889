"""Numbers of a map in kernels.

Dr.Jit writes a Python number into the kernel that it records: a kernel that knows the size of a
map, or the range of its normals, is compiled anew for the next map. Numbers that belong to a map
are therefore handed to kernels as variables. Addresses count as well: memory that Dr.Jit takes over
from NumPy must begin at a cache line, or kernels differ by that.
"""

from __future__ import annotations

import drjit as dr
import numpy as np

from glintbsdf.core.alignment import aligned


def opaque(kind: type, value):
    """``value`` as a variable of the type ``kind``; Dr.Jit arrays stay as they are."""
    return kind(value) if dr.is_array_v(value) else dr.opaque(kind, value)


def stored(kind: type, values: np.ndarray):
    """A Dr.Jit array of the type ``kind`` with the content of a NumPy array.

    Its memory begins at a cache line, so that kernels which read it do not depend on where NumPy
    happened to put the array.
    """
    return kind(aligned(values))


def joined(levels: list[list]) -> list:
    """The arrays of all levels one after the other, for each channel, with their derivatives.

    ``levels``: lists of one array per channel, all of a level having one size. Unlike
    ``dr.concat``, this writes no size into kernels; nor do kernels depend on which sizes are alike.
    """
    kind = type(levels[0][0])
    total = sum(dr.width(level[0]) for level in levels)
    channels = [dr.zeros(kind, total) for _ in levels[0]]
    dr.eval(channels)
    index_type, first = dr.uint32_array_t(kind), 0
    for level in levels:
        width = dr.width(level[0])
        index = dr.arange(index_type, width) + dr.opaque(index_type, first)
        for channel, values in zip(channels, level, strict=True):
            dr.scatter(channel, values, index, mode=dr.ReduceMode.Permute)
        dr.eval(channels)
        first += width
    return channels
