"""The cells of half vectors that a light covers, for microdetails on grids.

Microdetails are counted cell by cell of the half vectors (Zirr and Kaplanyan 2016, section 4.3). A
light of some extent covers an ellipse of half vectors, which lies in one cell or in several. The
paper widens the microdetails, so that other ones are seen under a light than under its points. Here
the density is averaged over the ellipse, cell by cell. So all that sampling finds is a point of the
same average.

A cell counts by its share of the ellipse. The ellipse is cut in columns of cells, whose shares and
moments have closed forms; in a column, its profile is that of an ellipse with the same variance.

An ellipse over more than :data:`MOST` columns or rows is cut in as many parts instead, each with
the cell at its centre. This cell stands for k others. It counts with the weight β = 1/√k, and the
mean of all with 1 − β, which keeps the mean and the variance.
"""

from __future__ import annotations

from collections.abc import Callable
from math import pi
from typing import NamedTuple

import drjit as dr
import mitsuba as mi

from glintbsdf.core.loops import symbolic_loop
from glintbsdf.footprint.lattice import floor_int
from glintbsdf.pndf.gaussian_elements import Gaussian

#: Largest number of parts of an ellipse along either axis.
MOST = 4

#: Height of a normal below which the paraboloid map counts as linear.
LOWEST = 0.05

#: Least radius of an ellipse, in cells.
MIN_RADIUS = 1e-5


class Part(NamedTuple):
    """The part of a uniform unit disk between two vertical lines.

    Attributes:
        share (mi.Float): of the disk's area.
        mean, mean_square (mi.Float): of the abscissa in this part; 0 in an empty one.
    """

    share: mi.Float
    mean: mi.Float
    mean_square: mi.Float

    @staticmethod
    def between(a: mi.Float, b: mi.Float) -> Part:
        """The part with the abscissa from ``a`` to ``b``."""
        (share_a, first_a, second_a), (share_b, first_b, second_b) = map(disk_moments, (a, b))
        share = share_b - share_a
        inverse = dr.rcp(dr.maximum(share, 1e-6))
        middle = 0.5 * (dr.clip(a, -1, 1) + dr.clip(b, -1, 1))
        thin = share <= 1e-3  # where differences lose all digits
        return Part(
            dr.maximum(share, 0),
            mi.Float(dr.select(thin, middle, inverse * (first_b - first_a))),
            mi.Float(dr.select(thin, middle * middle, inverse * (second_b - second_a))),
        )


def disk_moments(x: mi.Float) -> tuple[mi.Float, mi.Float, mi.Float]:
    """The integrals of 1, t and t² over the part t < x of a uniform unit disk, each up to a
    constant."""
    x = dr.clip(x, -1, 1)
    height = dr.safe_sqrt(1 - x * x)
    angle, area = dr.safe_asin(x), x * height
    return (
        (area + angle) * (1 / pi),
        (-2 / (3 * pi)) * (height * height * height),
        (angle - area * (1 - 2 * x * x)) * (1 / (4 * pi)),
    )


def to_paraboloid(m: mi.Vector2f, z: mi.Float, v: mi.Vector2f) -> mi.Vector2f:
    """The change of m/(1 + m_z) with the projected normal, for its change ``v``; ``z``: m_z."""
    inverse = dr.rcp(1 + z)
    return inverse * (v + m * (dr.dot(m, v) * inverse / z))


def from_paraboloid(m: mi.Vector2f, z: mi.Float, r: mi.Vector2f) -> mi.Vector2f:
    """The change of the projected normal, for the change ``r`` of m/(1 + m_z)."""
    return (1 + z) * r - m * dr.dot(m, r)


class EllipseOfCells:
    """An ellipse of half vectors on the grid of their cells.

    Args:
        m (mi.Vector2f): projected half vector at its centre.
        vectors: ``mi.Vector2f`` v of projected normals, with Σ v vᵀ the ellipse's covariance.
        cells_per_unit (mi.Vector2f): cells along u and v per unit of m/(1 + m_z); 0 along an axis
            with a single cell.

    Attributes:
        beta (mi.Float): β of a cell, in (0, 1].
    """

    def __init__(self, m: mi.Vector2f, vectors: tuple, cells_per_unit: mi.Vector2f) -> None:
        z = dr.maximum(dr.safe_sqrt(1 - dr.squared_norm(m)), LOWEST)
        self.cells_per_unit = cells_per_unit
        roots = Gaussian(tuple(to_paraboloid(m, z, v) for v in vectors)).root()
        # Radii of a uniform disk are twice its standard deviation.
        self.steps = tuple(2 * from_paraboloid(m, z, root) for root in roots)
        (self.first_x, self.first_y), (_, self.second_y) = (
            2 * cells_per_unit * root for root in roots
        )
        self.radius = mi.Vector2f(
            self.first_x, dr.sqrt(dr.square(self.first_y) + dr.square(self.second_y))
        )
        self.width = dr.maximum(2 / MOST * self.radius, 1)
        self.beta = dr.rsqrt(self.width.x * self.width.y)
        inverse = dr.rcp(dr.maximum(self.second_y, MIN_RADIUS))
        self.inverse_second = dr.select(self.second_y > MIN_RADIUS, inverse, 0)

    def parts_along(self, centre: mi.Float, radius: mi.Float, width: mi.Float):
        """The parts along one axis: where the first one begins, their number, and a function that
        returns the :class:`Part` of a unit disk and the cell of the k-th one."""
        low, whole = centre - radius, width == 1
        first = dr.select(whole, dr.floor(low), low)
        count = mi.Int(dr.ceil((centre + radius - first) / width))
        inverse = dr.rcp(dr.maximum(radius, MIN_RADIUS))

        def part(k):
            begin = first + mi.Float(k) * width
            found = Part.between((begin - centre) * inverse, (begin + width - centre) * inverse)
            middle = dr.select(whole, begin + 0.5, dr.fma(found.mean, radius, centre))
            return found, floor_int(middle)

        return dr.maximum(count, 1), part

    def sum(self, m: mi.Vector2f, shift: mi.Vector2f, term: Callable, zero, active: mi.Bool):
        """Σ share · term(x, y, n, active) over all parts, each with the cell (x, y) and the mean n
        of its projected half vectors.

        Args:
            m: projected half vector at the centre.
            shift: of the grid, in cells.
            zero: the empty sum; ``term`` must return a value of its type.
        """
        z = dr.safe_sqrt(1 - dr.squared_norm(m))
        centre = self.cells_per_unit * m / (1 + z) + shift
        columns, column = self.parts_along(centre.x, self.radius.x, self.width.x)

        def add_column(i, total):
            part, x = column(i)
            # A column leans by the shear, and is as high as the disk is there.
            lean = self.first_y * part.mean
            spread = dr.maximum(part.mean_square - dr.square(part.mean), 0)
            height = dr.square(self.second_y) * (4 / 3) * dr.maximum(1 - part.mean_square, 0)
            height = dr.sqrt(height + 4 * dr.square(self.first_y) * spread)
            rows, row = self.parts_along(centre.y + lean, height, self.width.y)
            along = self.steps[0] * part.mean

            def add_row(j, total):
                inner, y = row(j)
                across = dr.clip(inner.mean * height * self.inverse_second, -1, 1)
                share = part.share * inner.share
                seen = active & (share > 0)
                value = term(x, y, m + along + self.steps[1] * across, seen)
                return j + 1, total + dr.select(seen, share, 0) * value

            state = mi.Int(0), total
            more = lambda j, total: active & (j < rows)  # noqa: E731
            return i + 1, symbolic_loop(state, more, add_row, "rows of half vectors")[1]

        state = mi.Int(0), zero
        more = lambda i, total: active & (i < columns)  # noqa: E731
        return symbolic_loop(state, more, add_column, "columns of half vectors")[1]
