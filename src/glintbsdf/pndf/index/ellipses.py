"""Inverted lists of items whose normals lie in ellipses, which are elements and flakes."""

from __future__ import annotations

from collections.abc import Callable
from math import inf

import drjit as dr
import mitsuba as mi

from glintbsdf.footprint.kernels import difference_of_products
from glintbsdf.pndf.index.lists import BlocksOfQuads, Window


class BlocksOfEllipses(BlocksOfQuads):
    """Quads whose normals are bounded by ``shapes_each`` ellipses.

    An ellipse is given by its centre c and two conjugate radii p, q: its points are
    c + p cos φ + q sin φ.
    """

    def __init__(self, lattice, ellipses, shapes_each: int) -> None:
        """``ellipses(row, column, active)`` returns the ellipses of a stored quad."""
        super().__init__(lattice, ellipses, Window.whole(lattice))
        self.shapes_each = shapes_each

    @staticmethod
    def extent(ellipse):
        """Lower and upper corner of an ellipse's bounding box."""
        centre, p, q = ellipse
        half = mi.Vector2f(*(dr.sqrt(dr.fma(a, a, b * b)) for a, b in zip(p, q, strict=True)))
        return centre - half, centre + half

    @staticmethod
    def span(ellipse) -> Callable:
        """As for triangles. No digits cancel, however thin the ellipse is."""
        centre, p, q = ellipse
        xx, yy = (dr.fma(a, a, b * b) for a, b in zip(p, q, strict=True))
        xy, half = dr.fma(p.x, p.y, q.x * q.y), dr.sqrt(xx)
        # x of the highest point from the centre; the lowest is opposite.
        summit, slope, inverse = xy * dr.rsqrt(yy), xy / xx, 1 / half
        height = dr.abs(difference_of_products(p.x, q.y, p.y, q.x)) * inverse

        def between(left, right):
            first, last = dr.maximum(left - centre.x, -half), dr.minimum(right - centre.x, half)

            def y(x, sign):
                x = dr.clip(x, first, last)
                rise = height * dr.safe_sqrt(1 - dr.square(x * inverse))
                return dr.fma(slope, x, dr.fma(sign, rise, centre.y))

            within = first <= last
            lowest, highest = y(-summit, -1), y(summit, 1)
            return dr.select(within, lowest, inf), dr.select(within, highest, -inf)

        return between
