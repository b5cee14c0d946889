"""Lists of things whose normals lie in ellipses: elements, flakes."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi

from glintbsdf.pndf.index.lists import BlocksOfQuads, Window


class BlocksOfEllipses(BlocksOfQuads):
    """Quads, each bounded by ``shapes_each`` ellipses.

    An ellipse is its centre and two conjugate radii: the points c + p cos φ + q sin φ.
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
        """Whether an octagon about an ellipse meets a rectangle (separating axes).

        ``centre``, ``half`` (``mi.Vector2f``): centre and half extents of the rectangle. The
        octagon, regular if the ellipse is round, is a twentieth larger than the ellipse. Nothing
        cancels, however thin the ellipse.
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
