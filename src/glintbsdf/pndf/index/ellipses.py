"""Inverted lists of items whose normals lie in ellipses, which are elements and flakes."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi

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
    def meets(ellipse, centre, half):
        """Whether an octagon around an ellipse meets a rectangle, by the test of separating axes.

        ``centre``, ``half`` (``mi.Vector2f``): centre and half extents of the rectangle. The area
        of the octagon is a twentieth larger than that of the ellipse. It is regular if the ellipse
        is round. No digits cancel, however thin the ellipse is.
        """
        lower, upper = BlocksOfEllipses.extent(ellipse)
        meets = dr.all((lower <= centre + half) & (upper >= centre - half))
        middle, p, q = ellipse
        offset = middle - centre
        for tangent in (p, q, p + q, p - q):
            normal = mi.Vector2f(-tangent.y, tangent.x)
            a, b = dr.dot(normal, p), dr.dot(normal, q)
            reach = dr.sqrt(dr.fma(a, a, b * b)) + dr.dot(dr.abs(normal), half)
            meets &= dr.abs(dr.dot(normal, offset)) <= reach
        return meets
