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
