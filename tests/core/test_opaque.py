"""Arrays of structures: kernels do not depend on where NumPy has put them."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest

from glintbsdf.core.alignment import aligned
from glintbsdf.core.opaque import stored


def at(offset: int, count: int = 1000) -> np.ndarray:
    """Numbers in memory that begins ``offset`` bytes after a cache line."""
    memory = np.zeros(4 * count + 128, np.uint8)
    begin = -memory.ctypes.data % 64 + offset
    values = memory[begin : begin + 4 * count].view(np.float32)
    values[:] = np.arange(count)
    return values


@pytest.mark.parametrize("offset", [0, 4, 16, 60])
def test_arrays_begin_at_a_cache_line(offset):
    values = at(offset)
    assert aligned(values).ctypes.data % 64 == 0
    assert np.array_equal(aligned(values), np.arange(len(values)))
    assert np.shares_memory(aligned(values), values) == (offset == 0)


def test_one_kernel_reads_all(variant):
    compiled = []
    for offset in (0, 4, 16):
        array = stored(mi.Float, at(offset))
        dr.kernel_history_clear()
        with dr.scoped_set_flag(dr.JitFlag.KernelHistory, True):
            dr.eval(dr.fma(array, array, dr.opaque(mi.Float, 0.7315)))
        compiled.append([entry["hash"] for entry in dr.kernel_history([dr.KernelType.JIT])])
    assert compiled[0] == compiled[1] == compiled[2] and len(compiled[0]) == 1
