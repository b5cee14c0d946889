"""Records of moments in memory: means, and central second moments.

A record is packed into as few words as keep its digits. Of a mean, the 24 upper bits of a float are
stored, with an error of at most 1.6e-5 of its value. Central second moments are stored as their
roots, which are half floats. A covariance has a triangular root, so that its determinant keeps its
digits, too. The error of a variance is 1e-3 of its value; it counts as zero below 1e-12. Three
words then hold the mean and the covariance of slopes, where floats would take five.

Derivatives need floats: a sum of very many small derivatives has no room in a half float.
"""

from __future__ import annotations

import drjit as dr
import mitsuba as mi

#: Roots are stored times this: up to 1000, as slopes are.
SCALE = 64.0

#: The exponent of a half float is 112 less than that of a float.
EXPONENT = 112


class FloatRecords:
    """Records of single-precision floats, in groups of four, which are read at once, and one more
    where one is left. Derivatives flow to what has been put in.

    Args:
        total (int): number of records.
        values (int): number of values of each.
    """

    def __init__(self, total: int, values: int) -> None:
        groups, rest = divmod(values, 4)
        if rest > 1:
            groups, rest = groups + 1, 0
        self.values = values
        self.groups = [dr.zeros(mi.Float, 4 * total) for _ in range(groups)]
        self.single = dr.zeros(mi.Float, total) if rest else None
        self.nbytes = 4 * total * (4 * groups + rest)

    def put(self, index: mi.UInt32, record: list, active: bool | mi.Bool = True) -> None:
        """Store records at their indices, no two at the same one."""
        zero = mi.Float(0)
        for k, group in enumerate(self.groups):
            four = (record[4 * k : 4 * k + 4] + [zero] * 3)[:4]
            dr.scatter(group, mi.Vector4f(four), index, active, dr.ReduceMode.NoConflicts)
        if self.single is not None:
            dr.scatter(self.single, record[-1], index, active, dr.ReduceMode.NoConflicts)
        dr.eval(self.groups, self.single)

    def get(self, index: mi.UInt32) -> list:
        """The values of records."""
        values = [x for group in self.groups for x in dr.gather(mi.Vector4f, group, index)]
        if self.single is not None:
            values.append(dr.gather(mi.Float, self.single, index))
        return values[: self.values]


class PackedRecords:
    """Records in words: of each mean 24 bits, of each root of the second moments 16.

    The bytes of the roots fill the lowest byte of each mean's word, and then further words.

    Args:
        total (int): number of records.
        means (int): number of means.
        products (int): number of second moments: 3 are the variances of two means and their
            covariance, fewer are variances or sums of such.
    """

    def __init__(self, total: int, means: int, products: int) -> None:
        self.means, self.products = means, products
        self.words = means + max(0, -(-(2 * products - means) // 4))
        self.data = dr.empty(mi.UInt32, total * self.words)
        self.nbytes = 4 * total * self.words

    def put(self, index: mi.UInt32, record: list, active: bool | mi.Bool = True) -> None:
        """Store records at their indices, no two at the same one."""
        roots = roots_of(record[self.means :])
        tail = [(half >> shift) & 0xFF for half in map(to_half, roots) for shift in (0, 8)]
        words = [
            (dr.reinterpret_array(mi.UInt32, mean) + 0x80) & 0xFFFFFF00
            for mean in record[: self.means]
        ] + [mi.UInt32(0)] * (self.words - self.means)
        for k, byte in enumerate(tail):
            word, shift = self.place(k)
            words[word] = words[word] | (byte << shift)
        for k, word in enumerate(words):
            place = index * self.words + k
            dr.scatter(self.data, word, place, active, dr.ReduceMode.NoConflicts)
        dr.eval(self.data)

    def get(self, index: mi.UInt32) -> list:
        """The values of records."""
        words = [dr.gather(mi.UInt32, self.data, index * self.words + k) for k in range(self.words)]
        means = [dr.reinterpret_array(mi.Float, w & 0xFFFFFF00) for w in words[: self.means]]
        roots = []
        for k in range(self.products):
            low, high = (
                words[word] >> shift for word, shift in map(self.place, (2 * k, 2 * k + 1))
            )
            roots.append(from_half((low & 0xFF) | ((high & 0xFF) << 8)))
        return means + products_of(roots)

    def place(self, k: int) -> tuple[int, int]:
        """The word of the byte ``k`` of the roots, and the bits by which it is shifted there."""
        beyond = k - self.means
        return (k, 0) if beyond < 0 else (self.means + beyond // 4, 8 * (beyond % 4))


def roots_of(products: list) -> list:
    """The roots of second moments; of xx, yy and xy the a, b, c of the triangular root
    (a 0; b c)."""
    roots = [dr.sqrt(dr.maximum(x, 0)) for x in products[:2]]
    if len(products) < 3:
        return roots
    a, yy, xy = roots[0], products[1], products[2]
    b = dr.select(a > 0, xy / dr.select(a > 0, a, 1), 0)
    return [a, b, dr.sqrt(dr.maximum(dr.fma(-b, b, yy), 0))]


def products_of(roots: list) -> list:
    """The inverse of :func:`roots_of`."""
    if len(roots) < 3:
        return [dr.square(x) for x in roots]
    a, b, c = roots
    return [a * a, dr.fma(b, b, c * c), a * b]


def to_half(x: mi.Float) -> mi.UInt32:
    """The bits of ``SCALE`` times a number as a half float, rounded; 0 where it is below 6e-5."""
    bits = dr.reinterpret_array(mi.UInt32, dr.minimum(dr.abs(x) * SCALE, 65504.0)) + 0x1000
    half = dr.select(bits < (EXPONENT + 1) << 23, 0, (bits - (EXPONENT << 23)) >> 13)
    return half | dr.select(x < 0, mi.UInt32(0x8000), 0)


def from_half(half: mi.UInt32) -> mi.Float:
    """The inverse of :func:`to_half`."""
    magnitude = dr.reinterpret_array(mi.Float, (half & 0x7FFF) << 13) * (2.0**EXPONENT / SCALE)
    return dr.select((half & 0x8000) != 0, -magnitude, magnitude)
