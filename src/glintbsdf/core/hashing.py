"""Random numbers that depend on nothing but integers: the same for every batch size and backend.

The hash is PCG3D (Jarzynski and Olano, "Hash Functions for GPU Rendering", JCGT 9(3), 2020), three
integers in, three out: linear congruential steps and feedback from each component to the others,
in 32-bit arithmetic that wraps around. Multiplication, addition and shifts of integers are exact,
so LLVM and CUDA agree to the last bit.
"""

from __future__ import annotations

from math import sqrt

import drjit as dr
import mitsuba as mi

# The multiplier and increment of the congruential generator, as in Numerical Recipes.
MULTIPLIER, INCREMENT = 1664525, 1013904223

#: Steps of Roberts's two-dimensional low-discrepancy sequence: the powers of 1/ρ, ρ³ = ρ + 1
#: ("The Unreasonable Effectiveness of Quasirandom Sequences", 2018).
LATTICE_STEPS = 0.7548776662466927, 0.5698402909980532


def pcg3d(x: mi.UInt32, y: mi.UInt32, z: mi.UInt32) -> tuple[mi.UInt32, mi.UInt32, mi.UInt32]:
    """Three hashed integers, each of which depends on all bits of the three arguments."""
    x, y, z = (mi.UInt32(v) * MULTIPLIER + INCREMENT for v in (x, y, z))
    x = x + y * z
    y = y + z * x
    z = z + x * y
    x, y, z = (v ^ (v >> 16) for v in (x, y, z))
    x = x + y * z
    y = y + z * x
    z = z + x * y
    return x, y, z


def pcg(x: mi.UInt32) -> mi.UInt32:
    """A hashed integer of one, for numbers that are many and need be no better than this.

    The output permutation of PCG (RXS M XS) after one congruential step, a bijection (Jarzynski and
    Olano 2020, ``pcg``).
    """
    x = mi.UInt32(x) * 747796405 + 2891336453
    x = ((x >> ((x >> 28) + 4)) ^ x) * 277803737
    return (x >> 22) ^ x


def uniform_pair(bits: mi.UInt32) -> tuple[mi.Float, mi.Float]:
    """Two numbers in (0, 1) from one integer: centres of 2¹⁶ equal intervals."""
    halves = bits & 0xFFFF, bits >> 16
    return tuple(dr.fma(mi.Float(half), 2.0**-16, 2.0**-17) for half in halves)


def uniform(bits: mi.UInt32) -> mi.Float:
    """A number in (0, 1) from an integer: the centre of one of 2²³ equal intervals, exactly.

    The high bits count, which are the best of the hash.
    """
    return dr.fma(mi.Float(bits >> 9), 2.0**-23, 2.0**-24)


def gaussian(bits: mi.UInt32) -> mi.Float:
    """A number of mean 0 and variance 1 from an integer: the sum of its four bytes, scaled.

    By the central limit theorem this is nearly a standard normal number. It lies within ±3.45, and
    its distribution function is off by at most 0.9 %. An inverse error function would cost several
    times as much.
    """
    pairs = (bits & 0x00FF00FF) + ((bits >> 8) & 0x00FF00FF)
    total = (pairs & 0xFFFF) + (pairs >> 16)
    # Each byte has the mean 255/2 and the variance (256² − 1)/12.
    return (mi.Float(total) - 510) * sqrt(3 / (2**16 - 1))


def coherent_vertex(x: mi.Int, y: mi.Int, level: mi.Int) -> tuple[mi.UInt32, mi.UInt32, mi.UInt32]:
    """A name of the vertex (``x``, ``y``) of the grid ``level`` that is the same in all grids.

    The spacing of a grid is twice that of the level below, so the vertex (x, y) is at (2x, 2y)
    of the level below. Shifting out the zero bits at the end of both indices makes the name
    invariant under doubling (Zirr and Kaplanyan 2016, section 4.1, for both coordinates at once).
    Alone, this also gives (1, 1) and (2, 2) of one grid the same name; the paper blurs such
    recurring patterns by offsets. Here the level to which the indices were shifted, the coarsest
    that has this vertex, is part of the name: no two places share one.

    The origin is a vertex of every level, and has no lowest set bit to shift to: its level is 2³¹.
    """
    bits = mi.UInt32(x), mi.UInt32(y)
    either = bits[0] | bits[1]
    zeros = dr.select(either != 0, dr.tzcnt(either), 0)
    # The shift is arithmetic: it keeps the sign of negative indices.
    odd_x, odd_y = (mi.UInt32(mi.Int(v) >> mi.Int(zeros)) for v in bits)
    return odd_x, odd_y, dr.select(either != 0, mi.UInt32(level) + zeros, 1 << 31)
