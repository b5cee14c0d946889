r"""The projected area P(ω) of the facets under a footprint.

Wu, Luan, Hašan and Ramamoorthi, "Position-Normal Manifold for Efficient Glint Rendering on
High-Resolution Normal Maps" (2024), section 4.3 and its supplement. The projected area of a P-NDF

    P(ω) = ∫ D(m̃) max(m̃·ω, 0) dm̃                                                         (Eq. 9)
         = Σ_Δ k(Δ)/2 · mean over n(Δ) of max(m̃·ω, 0)/m_z                                  (Eq. 10)

is a sum over the triangles of the manifold, if the kernel is constant on each of them.

**One triangle.** The paper turns the mean into integrals along the boundary of the triangle's
visible part (Eq. 11, 12, Algorithm 1). They are exact, but useless in float32: terms of the size of
the triangle's edges cancel to its area, and near the horizon to much less. Here the visible part is
the same. It is a polygon of at most six corners. Where one of its sides is a chord of the horizon's
ellipse, there is also a lens between this chord and the ellipse. Each of these pieces is integrated
by terms that are all positive, from ``q = m̃·ω`` at the corners alone:

* Between corners, the unit normal bulges over the flat triangle. With barycentric coordinates λ,
  squared chords c_ij² = \|ñ_i − ñ_j\|² of the *unit* normals, and V = Σ λ_i λ_j c_ij² (i < j),

      m_z = √((Σ λ_i z_i)² + V),      q = Σ λ_i q_i + ω_z V / (m_z + Σ λ_i z_i).

  A product rule of Gauss averages q/m_z. Its coordinates are such that m_z varies smoothly up to
  the rim of the disk (:func:`mean_facing`).
* A lens has a one-dimensional integral, whose cancellation is resolved on paper (:func:`lens`).

Only the area of a lens is divided by the triangle's area, and the lens is the smaller of the two.
So triangles may be arbitrarily thin.

**All triangles under the footprint** count, whatever their normals. So the lists of the P-NDF,
which are sorted by normal, are of no use here; see :class:`ProjectedArea`.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import cache, partial
from math import inf, sqrt

import drjit as dr
import mitsuba as mi
import numpy as np

from glintbsdf.core.hashing import pcg3d
from glintbsdf.core.loops import add_where, symbolic_loop, where_needed
from glintbsdf.core.opaque import opaque
from glintbsdf.footprint.domain import Domain
from glintbsdf.footprint.gaussian import Footprint
from glintbsdf.footprint.kernels import TexelKernel, difference_of_products, gaussian_like
from glintbsdf.footprint.lattice import Lattice, floor_int
from glintbsdf.footprint.query import Query
from glintbsdf.microfacet.masking import MeanPlaneMasking
from glintbsdf.microfacet.mean_plane import (
    area_of_moments,
    choose_areas,
    ggx_area,
    gradient_along,
    height_of,
    slope_along,
    slope_of,
    variance_along,
)
from glintbsdf.pndf.filters.filters import COVARIANCE
from glintbsdf.pndf.filters.moments import COARSE, MomentPyramid
from glintbsdf.pndf.index.lists import every_quad
from glintbsdf.pndf.manifold.mesh import (
    TexelMesh,
    cross,
    is_degenerate,
    normal_in_quad,
    triangles_of_quad,
)
from glintbsdf.pndf.sharing import shared

#: A corner with |q| below this counts as being on the horizon: the product of two must not
#: underflow.
HORIZON = 1e-15

# ------------------------------------------------------------------------------------------------
#  A triangle that is visible as a whole (Eq. 10)
# ------------------------------------------------------------------------------------------------


@cache
def gauss(order: int) -> list[tuple[float, float]]:
    """Nodes and weights of the Gauss-Legendre rule on [0, 1]."""
    nodes, weights = np.polynomial.legendre.leggauss(order)
    return [(float(0.5 * x + 0.5), float(0.5 * w)) for x, w in zip(nodes, weights, strict=True)]


def rim_steps(z0, z_half, z1, order: int):
    """Nodes s and weights on [0, 1] for functions of s that have m_z in the denominator.

    ds/dτ is the parabola through the heights ``z0``, ``z_half``, ``z1`` at s = 0, ½ and 1. So 1/m_z
    is smooth in τ, although it is singular in s where an end lies on the rim of the disk.
    """
    scale = 6 / dr.maximum(z0 + 4 * z_half + z1, 1e-20)
    steps = []
    for t, weight in gauss(order):
        s = scale * (
            z0 * (t - 1.5 * t**2 + 2 / 3 * t**3)
            + z_half * (2 * t**2 - 4 / 3 * t**3)
            + z1 * (2 / 3 * t**3 - 0.5 * t**2)
        )
        density = scale * (
            z0 * ((1 - t) * (1 - 2 * t)) + z_half * (4 * t * (1 - t)) + z1 * (t * (2 * t - 1))
        )
        steps.append((s, weight * density))
    return steps


def mean_facing(q, z, chords, w_z, order: int):
    """Mean of m̃·ω/m_z over a triangle of projected normals, if m̃·ω ≥ 0 at all corners.

    Args:
        q, z: m̃·ω and m_z at the three corners.
        chords: squared chords (c01², c02², c12²) between the unit normals of the corners.
        w_z: ω_z.
        order (int): number of nodes along each of the two axes.
    """
    c01, c02, c12 = chords

    def height(flat, bulge):
        return dr.safe_sqrt(dr.fma(flat, flat, bulge))

    total, weights = mi.Float(0), mi.Float(0)
    # Rays from corner 0 to the points t of the opposite side.
    for t, weight_t in rim_steps(z[1], height(0.5 * (z[1] + z[2]), 0.25 * c12), z[2], order):
        # At s = 1, and at s < 1: λ = (1 − s, s (1 − t), s t).
        q_side, z_side = dr.lerp(q[1], q[2], t), dr.lerp(z[1], z[2], t)
        bulge_side = t * (1 - t) * c12
        chord = dr.lerp(c01, c02, t)
        half = height(0.5 * (z[0] + z_side), 0.25 * (chord + bulge_side))
        for s, weight_s in rim_steps(z[0], half, height(z_side, bulge_side), order):
            flat = dr.lerp(z[0], z_side, s)
            bulge = s * dr.fma(s, bulge_side, (1 - s) * chord)
            m_z = height(flat, bulge)
            safe = dr.maximum(m_z, 1e-20)
            facing = dr.lerp(q[0], q_side, s) + w_z * bulge / (safe + flat)
            weight = weight_t * weight_s * s
            total = dr.fma(weight, facing / safe, total)
            weights += weight
    return total / weights


# ------------------------------------------------------------------------------------------------
#  Clipping at the horizon m̃·ω = 0 (Eq. 11, 12, Algorithm 1)
# ------------------------------------------------------------------------------------------------


def visible_interval(q_u, q_v, z_u, z_v, chord, w_z):
    """The part of the edge from u to v in which m̃·ω ≥ 0 (Algorithm 1, all its cases).

    m̃·ω is concave along the edge, so this part is one interval. Its ends are roots of the quadratic
    equation in the supplement. Here the equation is written in q, which is small near the horizon,
    instead of in positions. Its discriminant is then a sum of two terms that do not cancel, and
    each root is a quotient of sums of one sign.

    Returns ``(low, 1 − low, high, 1 − high, exists)``, fractions of the edge.
    """
    a, b, k = w_z * z_u, w_z * z_v, 0.5 * w_z * w_z * chord
    f0, f1 = q_u * (q_u - 2 * a), q_v * (q_v - 2 * b)
    tangent = q_u * q_v - a * q_v - b * q_u
    middle = tangent - k
    skew = difference_of_products(q_u, z_v, q_v, z_u)
    discriminant = dr.fma(skew, skew, 0.5 * chord * (k - 2 * tangent))
    root = w_z * dr.safe_sqrt(discriminant)

    def cut(f_near, f_far):
        """Fraction of the edge from its near end to the farther root, and the remainder."""
        n = dr.select(middle <= 0, root - middle, -f_near)
        d = dr.select(middle <= 0, f_far, root + middle)
        total = n + d
        total = dr.select(total == 0, 1, total)
        return dr.clip(n / total, 0, 1), dr.clip(d / total, 0, 1)

    visible_u, visible_v = q_u >= 0, q_v >= 0
    high, above = cut(f0, f1)
    low_from_v, low = cut(f1, f0)
    exists = visible_u | visible_v | ((discriminant > 0) & (middle < 0))
    return (
        dr.select(visible_u, 0, low),
        dr.select(visible_u, 1, low_from_v),
        dr.select(visible_v, 1, high),
        dr.select(visible_v, 0, above),
        exists,
    )


def lens(position, side, chord, order: int):
    """∫ m̃·ω/m_z dm over the lens between a chord of the horizon's ellipse and its arc.

    Seen along ω, the lens lies between two arcs over a common chord of length c. One arc is part of
    the great circle m̃·ω = 0. The other is the projection of the circle of radius r = √(1 − d²) that
    stands over the chord's line, at a distance d from the origin. At x = y c/2 on the chord, the
    difference of their heights is

        (c²/4)² (1 − y²)² d² / (h D_1 D_r (√(r² − x²) + κ √(1 − x²))),

    where h = 1 − c²/4, D_ρ = √(ρ² − x²) + √(ρ² − c²/4), and κ = √((r² − c²/4)/h) is the cosine of
    the angle between the planes of the two circles.

    Args:
        position, side (mi.Vector2f): first end of the chord in the disk, and the vector from it to
            the second end.
        chord: squared length c² of the chord between the unit normals.
        order (int): number of nodes.
    """
    quarter = 0.25 * chord
    length = dr.squared_norm(side)
    offset = difference_of_products(position.x, side.y, position.y, side.x)
    d2 = offset * offset / dr.select(length > 0, length, 1)
    r2, h = dr.maximum(1 - d2, 0), dr.maximum(1 - quarter, 1e-12)
    end_1, end_r = dr.sqrt(h), dr.safe_sqrt(r2 - quarter)
    cosine = end_r / end_1
    total = mi.Float(0)
    for y, weight in gauss(order):
        x2 = quarter * (y * y)
        top_1, top_r = dr.safe_sqrt(1 - x2), dr.safe_sqrt(r2 - x2)
        divisor = (top_1 + end_1) * (top_r + end_r) * dr.fma(cosine, top_1, top_r)
        total += weight * (1 - y * y) ** 2 / dr.maximum(divisor, 1e-20)
    # The factor 2: y runs from −1 to 1, and the rule from 0 to 1. √(c²/4) is half the chord's
    # length.
    return 2 * total * quarter * quarter * dr.sqrt(quarter) * d2 / h


class Corners:
    """A triangle of projected normals: unit normals and m̃·ω at its three corners.

    Args:
        first, e1, e2 (mi.Vector2f): first corner, and edges from it to the second and third.
        w (mi.Vector3f): the direction ω, a unit vector with ω_z ≥ 0.
    """

    def __init__(self, first, e1, e2, w) -> None:
        self.m, self.edges = (first, first + e1, first + e2), (e1, e2 - e1, -e2)
        self.z = [dr.safe_sqrt(1 - dr.squared_norm(m)) for m in self.m]
        self.q = [facing(m, z, w) for m, z in zip(self.m, self.z, strict=True)]
        self.chords = [
            squared_chord(self.edges[i], self.m[i] + self.m[j], self.z[i] + self.z[j])
            for i, j in ((0, 1), (1, 2), (2, 0))
        ]
        self.highest = dr.maximum(dr.maximum(self.q[0], self.q[1]), self.q[2])
        self.lowest = dr.minimum(dr.minimum(self.q[0], self.q[1]), self.q[2])

    def may_be_seen(self, w_z):
        """False only if m̃·ω < 0 on all of the triangle.

        Between the corners, m_z exceeds the flat triangle by at most √(z² + V) − z, where z is the
        m_z of the lowest corner, and V is at most a third of the longest squared chord.
        """
        lowest = dr.minimum(dr.minimum(self.z[0], self.z[1]), self.z[2])
        bulge = dr.maximum(dr.maximum(self.chords[0], self.chords[1]), self.chords[2]) / 3
        rise = bulge / dr.maximum(dr.sqrt(dr.fma(lowest, lowest, bulge)) + lowest, 1e-20)
        return self.highest + w_z * rise > 0


def facing(m, z, w):
    """m̃·ω, accurate to the last digit where ω is horizontal; 0 where it is below the rounding."""
    q = dr.fma(w.z, z, difference_of_products(w.x, m.x, -w.y, m.y))
    return dr.select(dr.abs(q) > HORIZON, q, 0)


def squared_chord(side, sum_of_ends, sum_of_heights):
    """Squared distance of two unit normals.

    ``side`` is the difference of their projections, ``sum_of_ends`` their sum. The heights differ
    by −side·sum/(sum of heights), an expression without cancellation.
    """
    rise = dr.dot(side, sum_of_ends) / dr.maximum(sum_of_heights, 1e-20)
    # On the rim heights have no correct digits, but they never differ by more than their sum.
    rise = dr.minimum(dr.abs(rise), sum_of_heights)
    return dr.fma(rise, rise, dr.squared_norm(side))


def clipped_mean(corners: Corners, w_z, order: int):
    """Mean over a triangle of max(m̃·ω, 0)/m_z, for any position of the horizon."""
    # The corner that faces ω most comes first: distances from it are small, and so are their
    # errors.
    first = corners.q[0] >= corners.highest
    second = ~first & (corners.q[1] >= corners.highest)

    def turn(values, shift=0):
        x = [values[(i + shift) % 3] for i in range(3)]
        return dr.select(first, x[0], dr.select(second, x[1], x[2]))

    def turned(values):
        return [turn(values, shift) for shift in range(3)]

    m, q, z, chords = turn(corners.m), *map(turned, (corners.q, corners.z, corners.chords))
    edges = turned(corners.edges)
    e1, e2 = edges[0], -edges[2]

    # The visible part of edge i runs from starts[i] to ends[i]: corners (λ1, λ2, m_z, q).
    starts: list[tuple] = []
    ends: list[tuple] = []
    exist = []
    for i, j in ((0, 1), (1, 2), (2, 0)):
        low, after_low, high, after_high, exists = visible_interval(
            q[i], q[j], z[i], z[j], chords[i], w_z
        )
        for points, t, rest, corner in ((starts, low, after_low, i), (ends, high, after_high, j)):
            flat = dr.fma(rest, z[i], t * z[j])
            height = dr.safe_sqrt(dr.fma(flat, flat, t * rest * chords[i]))
            barycentric = ((t, mi.Float(0)), (rest, t), (mi.Float(0), rest))[i]
            points.append((*barycentric, height, dr.maximum(q[corner], 0)))
        exist.append(exists)

    # An edge that is not visible shrinks to the point at which the boundary passes it.
    def choose(condition, x, y):
        return tuple(dr.select(condition, a, b) for a, b in zip(x, y, strict=True))

    before = choose(exist[2], ends[2], ends[1])
    for i in range(3):
        starts[i], ends[i] = (choose(exist[i], x, before) for x in (starts[i], ends[i]))
        before = ends[i]

    def side(x, y):
        return e1 * (y[0] - x[0]) + e2 * (y[1] - x[1])

    def place(x):
        return m + e1 * x[0] + e2 * x[1]

    def chord(x, y):
        return squared_chord(side(x, y), place(x) + place(y), x[2] + y[2])

    apex, *others = [point for pair in zip(starts, ends, strict=True) for point in pair]
    mean = mi.Float(0)
    for x, y in zip(others[:-1], others[1:], strict=True):
        area = cross(
            mi.Vector2f(x[0] - apex[0], x[1] - apex[1]), mi.Vector2f(y[0] - apex[0], y[1] - apex[1])
        )
        three = (apex, x, y)
        mean += dr.maximum(area, 0) * mean_facing(
            [p[3] for p in three],
            [p[2] for p in three],
            (chord(apex, x), chord(apex, y), chord(x, y)),
            w_z,
            order,
        )
    lenses = mi.Float(0)
    for x, y in ((ends[0], starts[1]), (ends[1], starts[2]), (ends[2], starts[0])):
        lenses += lens(place(x), side(x, y), chord(x, y), order)
    det = dr.abs(difference_of_products(e1.x, e2.y, e1.y, e2.x))
    mean += 2 * lenses / dr.maximum(det, 1e-30)
    return dr.select(exist[0] | exist[1] | exist[2], mean, 0)


# ------------------------------------------------------------------------------------------------
#  All triangles under a footprint (Eq. 10)
# ------------------------------------------------------------------------------------------------

#: For footprints that touch at most this many quads, the kernel is not nearly constant on a
#: triangle: their mean is taken over points of the kernel.
FEW_QUADS = 25

#: For footprints that touch more quads than this, the sum has one random quad of each square of
#: 2×2, 4×4, … quads. This bounds the cost of a footprint (``benchmarks projected_area areas``
#: measures the error).
MANY_QUADS = 4096

#: Order of the Gauss rule. The relative error of any triangle is then below 1e-3
#: (tests/pndf/manifold/test_projected_area.py). It is the same for all maps, as they share kernels.
ORDER = 4


class FootprintArea:
    """P(ω) of the facets under a footprint: the base class of two estimates.

    Attributes:
        mesh (TexelMesh): the manifold.
        few (int): footprints that touch at most this many quads use :func:`mean_over_points`.
    """

    mesh: TexelMesh
    few: float

    def eval(
        self, w: mi.Vector3f, query: Query | Footprint, active: bool | mi.Bool = True
    ) -> mi.Float:
        """P(ω) ≥ 0 for a unit vector ``w`` with ω_z ≥ 0; at most ω_z + |mean slope|.

        ``query``: a query, or just a footprint in the UV space of the map.
        """
        return self.projected_areas([w], Query.of(query), mi.Bool(active))[0][0]

    def projected_areas(
        self, directions: list, query: Query, active: mi.Bool
    ) -> tuple[list, mi.Vector2f]:
        """``(areas, mean slope)``: P(ω) for several directions, for which the triangles under the
        footprint are visited once, and the mean of m_xy/m_z."""
        raise NotImplementedError

    def parts(self) -> dict[str, int]:
        """Memory of each part, besides the mesh, bytes."""
        return {}

    def parameters_changed(self, keys: Sequence[str] = ()) -> None:
        """Use new data of the mesh."""
        raise NotImplementedError


class ProjectedArea(FootprintArea):
    """P(ω) of the facets under a footprint, by the sum of Eq. 10.

    The kernel counts as constant on each triangle. The box kernel's mass in a quad is known
    exactly, and each triangle of the quad has half of it. So P is exact where the edges of the box
    coincide with edges of quads. The value of the other kernels is taken at the triangle's
    centroid. The weights are divided by their sum, so that P of flat facets is exact, and P(z) = 1.

    For footprints of a few texels this is too coarse: they use :func:`mean_over_points`.

    Args:
        mesh (TexelMesh): the manifold. Derivatives flow through its ``data``.
    """

    few = FEW_QUADS

    def __init__(self, mesh: TexelMesh) -> None:
        self.mesh = mesh
        self.parameters_changed()

    def parameters_changed(self, keys: Sequence[str] = ()) -> None:
        """Look for degenerate triangles in the data of the mesh."""
        if keys and "data" not in keys:
            return
        self.jumps = has_degenerate_triangles(self.mesh)

    def triangles(self, row, column, active):
        """The effective triangles of a stored quad, each as first corner and two edges."""
        return triangles_of_quad(self.mesh.quad_normals(row, column, active), self.mesh.epsilon)

    def projected_areas(self, directions, query, active):
        kernel = self.mesh.texel_kernel(query)
        small = kernel.touched_quads() <= self.few
        by_points = mean_over_points(self.mesh, kernel, directions, active & small, self.jumps)
        by_triangles = self.mean_over_triangles(directions, kernel, active & ~small)
        return choose_areas(small, by_points, by_triangles)

    def __repr__(self) -> str:
        return "analytic"

    def mean_over_triangles(self, directions, kernel, active):
        """The weighted mean over triangles (Eq. 10) for each direction, and the mean slope."""
        mean = mi.Vector2f(kernel.mean)

        def add(x, y, row, column, active, mass, slope, *areas):
            corner = mi.Vector2f(x, y) - mean
            triangles = self.triangles(row, column, active)
            for triangle, centroid in zip(triangles, (1 / 3, 2 / 3), strict=True):
                weight = dr.select(active, triangle_weight(kernel, corner, centroid), 0)
                counts = kernel.counts(weight, active)
                seen = [self.triangle(triangle, w, counts) for w in directions]
                areas = [dr.fma(weight, x, area) for x, area in zip(seen, areas, strict=True)]
                slope = slope + weight * mean_slope(*triangle)
                mass += weight
            return mass, slope, *areas

        sums = [mi.Float(0), mi.Vector2f(0), *(mi.Float(0) for _ in directions)]
        mass, slope, *areas = every_stratum(self.mesh.lattice, kernel, add, sums, active)
        mass = dr.select(mass > 0, mass, 1)
        return [area / mass for area in areas], slope / mass

    def triangle(self, triangle, w, active):
        """Mean over one effective triangle of max(m̃·ω, 0)/m_z."""
        corners = Corners(*triangle, w)
        whole = mean_facing(
            [dr.maximum(q, 0) for q in corners.q],
            corners.z,
            (corners.chords[0], corners.chords[2], corners.chords[1]),
            w.z,
            ORDER,
        )
        seen = corners.lowest >= 0
        return add_where(
            dr.select(seen, whole, 0),
            ~seen & corners.may_be_seen(w.z),
            lambda: clipped_mean(corners, w.z, ORDER),
            active,
        )


def mean_slope(first, e1, e2) -> mi.Vector2f:
    """Mean slope over a triangle of projected normals, by the midpoints of its edges."""
    middles = (first + 0.5 * e1, first + 0.5 * e2, first + 0.5 * (e1 + e2))
    return sum((slope_of(m) for m in middles), mi.Vector2f(0)) * (1 / 3)


def triangle_weight(kernel: TexelKernel, corner, centroid: float):
    """Weight of a triangle of the quad at ``corner`` (texels from the footprint's centre).

    ``centroid``: the coordinate of the triangle's centroid in the quad, the same along both axes.
    """
    if kernel.kernel != "box":
        return kernel.value(corner + centroid)

    def overlap(low, reach):
        return dr.maximum(dr.minimum(low + 1, reach) - dr.maximum(low, -reach), 0)

    return overlap(corner.x, kernel.half_u) * overlap(corner.y, kernel.half_v)


def every_stratum(lattice: Lattice, kernel: TexelKernel, add, sums, active):
    """Sum over the quads under the kernel, or over one quad of each square of quads.

    The side of the squares grows with the footprint, see :data:`MANY_QUADS`. Calls
    ``add(x, y, row, column, active, *sums)`` with the quad's position (texels), and the row and
    column at which it is stored; it returns the new sums. A row of squares is followed only as far
    as the kernel reaches, whatever the footprint's shape.
    """
    mean = mi.Vector2f(kernel.mean)
    squares = kernel.touched_quads() * (1 / MANY_QUADS)
    side = mi.Int(dr.exp2(dr.ceil(0.5 * dr.log2(dr.maximum(squares, 1)))))
    inverse = dr.rcp(mi.Float(side))

    def square(x):
        return floor_int(mi.Float(floor_int(x)) * inverse)

    bottom = square(mean.y + kernel.reach_v)

    def extent(row):
        top = mi.Float(row * side) - mean.y
        start, stop = kernel.row_extent(top, top + mi.Float(side))
        return square(mean.x + start), square(mean.x + stop)

    def body(i, j, last, active, *sums):
        shift_x, shift_y, _ = pcg3d(mi.UInt32(i), mi.UInt32(j), mi.UInt32(side))
        x = i * side + mi.Int(shift_x >> 8) % side
        y = j * side + mi.Int(shift_y >> 8) % side
        sums = add(x, y, lattice.y.locate(y)[1], lattice.x.locate(x)[1], active, *sums)
        new_row = i >= last
        j = dr.select(new_row, j + 1, j)
        first, new_last = extent(j)
        i, last = dr.select(new_row, first, i + 1), dr.select(new_row, new_last, last)
        return i, j, last, active & (j <= bottom), *sums

    top = square(mean.y - kernel.reach_v)
    first, last = extent(top)
    state = (first, top + 0, last, mi.Bool(active), *sums)
    return symbolic_loop(state, lambda *state: state[3], body, "every stratum")[4:]


# ------------------------------------------------------------------------------------------------
#  Small footprints
# ------------------------------------------------------------------------------------------------

#: Pairs (largest number of quads that a footprint touches, number of points of its kernel). The
#: numbers of points are Fibonacci numbers.
POINTS = ((4, 34), (64, 55), (256, 89), (inf, 144))

#: Fractional part of the golden ratio: the points are a Fibonacci lattice.
GOLDEN = (5**0.5 - 1) / 2

#: Ω of the GGX area (:func:`ggx_area`) over the variance of slopes that are uniform over an
#: interval. With this ratio both have the same projected area at grazing angles.
UNIFORM = 0.75


def mean_over_points(
    mesh: TexelMesh,
    kernel: TexelKernel,
    directions: list,
    active: mi.Bool,
    jumps: mi.Bool | None,
    roughness: mi.Float | float = 0.0,
) -> tuple[list, mi.Vector2f]:
    """P(ω) for each direction, and the mean slope, as means over N points of the kernel.

    All points have the same weight. A point stands for a cell of the kernel, of the area 1/(N k).
    The slopes vary over the cell by the triangle's Jacobian. The point has the projected area of
    these slopes, not of a single facet, so that facets in a corner of the cell count, too.

    A degenerate triangle is a single facet, and the Jacobian says nothing about its neighbours. So
    points in degenerate triangles are left out, and these triangles are added exactly, with their
    mass under the kernel.

    Args:
        mesh: the manifold; without jumps, any object with a method ``frame_at`` like its own.
        kernel: the footprint's kernel.
        directions: unit vectors ω.
        active: mask of the lanes.
        jumps (mi.Bool): whether the mesh has degenerate triangles, see
            :func:`has_degenerate_triangles`; None for an object that has no triangles.
        roughness: variance of the projected normals of every facet.
    """
    quads, count = kernel.touched_quads(), mi.UInt32(POINTS[-1][1])
    for most, points in POINTS[-2::-1]:
        count = dr.select(quads <= most, points, count)
    share = dr.rcp(mi.Float(count))

    def body(k, found, slope, *totals):
        x, y = ((mi.Float(k) + 0.5) * step for step in (share, GOLDEN))
        offset = kernel.sample(mi.Point2f(x, y - dr.floor(y)))
        m, e1, e2, degenerate = mesh.frame_at(kernel.mean + offset, active)
        counts = active if jumps is None else active & ~(degenerate & jumps)
        z = height_of(m)
        new = []
        for w, total in zip(directions, totals, strict=True):
            gradient = gradient_along(w, m, z)
            spread = variance_of_cells(kernel, offset, dr.dot(gradient, e1), dr.dot(gradient, e2))
            spread = dr.fma(UNIFORM * share, spread, roughness * dr.squared_norm(gradient))
            area = ggx_area(slope_along(w, m / z), spread)
            new.append(total + dr.select(counts, area, 0))
        found = found + dr.select(counts, mi.UInt32(1), 0)
        return k + 1, found, slope + dr.select(counts, m / z, 0), *new

    state = (mi.UInt32(0), mi.UInt32(0), mi.Vector2f(0), *[mi.Float(0) for _ in directions])
    _, found, slope, *areas = symbolic_loop(
        state, lambda k, *_: active & (k < count), body, "points"
    )
    share = dr.rcp(mi.Float(dr.maximum(found, 1)))
    areas, slope = [area * share for area in areas], slope * share
    if jumps is None:
        return areas, slope
    mass, single_slope, *single_areas = degenerate_triangles(
        mesh, kernel, directions, active & jumps
    )
    # The rest of the mass belongs to the points, if there are any.
    rest = dr.select(found > 0, dr.maximum(1 - mass, 0), 0)
    mass = dr.maximum(mass + rest, 1e-6)
    areas = [
        dr.fma(rest, area, single) / mass for area, single in zip(areas, single_areas, strict=True)
    ]
    return areas, (slope * rest + single_slope) / mass


def has_degenerate_triangles(mesh: TexelMesh) -> mi.Bool:
    """Whether any triangle of a mesh is replaced by an equilateral one; opaque, as kernels are the
    same for all maps."""
    with dr.suspend_grad():
        index = dr.arange(mi.UInt32, mesh.lattice.x.quads * mesh.lattice.y.quads)
        columns = mi.UInt32(mesh.lattice.x.count)
        row = index // columns
        n0, n1, n2, n3 = mesh.quad_normals(mi.Int(row), mi.Int(index - row * columns))
        any_of = is_degenerate(n0, (n1, n2), mesh.epsilon)
        any_of |= is_degenerate(n3, (n1, n2), mesh.epsilon)
        return opaque(mi.Bool, bool(dr.any(any_of)))


def degenerate_triangles(mesh: TexelMesh, kernel: TexelKernel, directions: list, active) -> tuple:
    """``(mass, slope, *areas)`` of the degenerate triangles under the kernel: their mass, and the
    integrals over them of the slope and, for each direction, of the projected area."""
    variance = 2 * mesh.epsilon / (3 * sqrt(3))  # squared circumradius: no normal is farther away
    # Position of the kernel's mean within a triangle, as if both were Gaussians. The variance of a
    # triangle along its legs is 1/18.
    pull = [dr.rcp(1 + 18 * dr.square(x)) for x in (kernel.sigma_u, kernel.sigma_v)]

    def inside(corner, centroid: float):
        return [dr.fma(-x - centroid, t, centroid) for x, t in zip(corner, pull, strict=True)]

    def add(sums, row, column, corner, active):
        normals = n0, n1, n2, n3 = mesh.quad_normals(row, column, active)
        degenerate = [is_degenerate(n, (n1, n2), mesh.epsilon) for n in (n0, n3)]

        def added(mass, slope, *areas):
            masses = kernel.masses_in_quad(corner)
            for k in (0, 1):
                weight = dr.select(degenerate[k], masses[k], 0)
                l1, l2 = (dr.clip(x, 0, 1) for x in inside(corner, (k + 1) / 3))
                l2 = dr.maximum(l2, 1 - l1) if k else dr.minimum(l2, 1 - l1 - 1e-6)
                m = normal_in_quad(l1, l2, normals, mesh.epsilon)
                z = height_of(m)
                mass, slope = mass + weight, slope + weight * m / z
                new = []
                for w, area in zip(directions, areas, strict=True):
                    spread = variance * dr.squared_norm(gradient_along(w, m, z))
                    new.append(dr.fma(weight, ggx_area(slope_along(w, m / z), spread), area))
                areas = new
            return mass, slope, *areas

        return where_needed(active & (degenerate[0] | degenerate[1]), added, sums)

    zero = (mi.Float(0), mi.Vector2f(0), *(mi.Float(0) for _ in directions))
    return every_quad(mesh.lattice, kernel, add, active, zero)


def variance_of_cells(kernel: TexelKernel, offset, d1, d2):
    """N times the variance, over a point's cell, of a value with the gradient (``d1``, ``d2``) per
    texel.

    The cell has the shape of the kernel and the area 1/(N k). Where the kernel is round, its
    variance along each axis is a twelfth of the area.
    """
    if kernel.kernel == "box":
        return (dr.square(d1 * kernel.half_u) + dr.square(d2 * kernel.half_v)) / 3
    stretch = kernel.sigma_u_given_v / kernel.sigma_v
    across = dr.square(d1) * stretch + dr.square(dr.fma(d1, kernel.shear, d2)) / stretch
    return across / (12 * kernel.value(offset, edge=False))


# ------------------------------------------------------------------------------------------------
#  Approximation by a smooth P-NDF (Eq. 13)
# ------------------------------------------------------------------------------------------------

#: Footprints that touch at most this many quads use points of the kernel in place of the fit, and
#: so do those that are narrower than the averages resolve. For a disk or a box the bound is 13
#: texels, as their mean slope differs too much from the mean slope under a Gaussian.
FINE_QUADS = {"gaussian": 64, "disk": 1600, "box": 1600}


class GgxFit(FootprintArea):
    r"""P(ω) of the smooth distribution of slopes that fits the facets under a footprint.

    The paper's Eq. 13, whose print lost a bracket, is the projected area of a GGX distribution of
    slopes around zero, ``P' = ½ (ω_z + √(ω_z² + ω_xyᵀ Ω ω_xy))``. The paper fits Ω to P at grazing
    angles. The facets under a footprint have a mean slope s̄, so that ``w̄ = ω_z + s̄·ω_xy`` takes
    the place of ω_z (Dupuy et al., "Linear Efficient Antialiased Displacement and Reflectance
    Mapping", 2013).

    Two things differ from the paper. The slopes of a map lack the long tails of GGX, with which
    facets would reflect too little at grazing angles. And a fit at the horizon says little about a
    footprint that leans away: facets that are visible from above are not visible from the horizon,
    and such places would reflect more than they receive. So here Ω follows from the covariance of
    slopes. The GGX form serves where the mean plane is seen from behind, and the area of a Gaussian
    distribution where it is seen from the front (:func:`~.area_of_moments`).

    Mean slope and covariance are averages over the footprint, by a :class:`~.MomentPyramid`. The
    Gaussian with the kernel's covariance replaces the kernel (:func:`~.gaussian_like`). Small
    footprints (:data:`FINE_QUADS`) use :func:`mean_over_points` instead.

    The pyramid is not cached on disk, as building it takes less time than reading it.

    Args:
        mesh (TexelMesh): the manifold. Derivatives flow through its ``data``.
        domain (Domain): the queries to expect; None for any. Levels that none of them needs are
            left out.

    Attributes:
        pyramid (MomentPyramid): None where all footprints use :func:`mean_over_points`.
    """

    def __init__(self, mesh: TexelMesh, domain: Domain | None = None) -> None:
        self.mesh, self.domain, self.few = mesh, domain, FINE_QUADS[mesh.kernel]
        self.parameters_changed()

    def parts(self) -> dict[str, int]:
        if self.pyramid is None:
            return {}
        levels = f"{self.pyramid.first} to {self.pyramid.top}"
        return {f"masking, MIP levels {levels}": self.pyramid.nbytes}

    def parameters_changed(self, keys: Sequence[str] = ()) -> None:
        """Recompute the averages from the data of the mesh."""
        if keys and "data" not in keys:
            return
        self.pyramid, self.jumps = None, has_degenerate_triangles(self.mesh)
        if self.domain is not None and self.domain.most_quads <= self.few:
            return

        def make() -> MomentPyramid:
            return MomentPyramid(
                self.mesh.data,
                self.mesh.normal_map.wrap_mode,
                None,
                over_quad=partial(slopes_of_quad, epsilon=self.mesh.epsilon),
                spread=COVARIANCE,
                domain=self.domain,
                scale=COARSE,
            )

        self.pyramid = shared(self.mesh, make, "slopes of quads", self.mesh.epsilon, self.domain)

    def projected_areas(self, directions, query, active):
        kernel = self.mesh.texel_kernel(query)
        fine = kernel.touched_quads() <= self.few
        fine |= kernel.minor_variance < COARSE.narrowest(1) ** 2
        by_points = mean_over_points(self.mesh, kernel, directions, active & fine, self.jumps)
        if self.pyramid is None:
            return by_points
        gaussian = gaussian_like(kernel.kernel, query.footprint)
        x, y, xx, yy, xy = self.pyramid.average(gaussian, active & ~fine)
        slope = mi.Vector2f(x, y)
        areas = [
            area_of_moments(slope_along(w, slope), variance_along(w, (xx, xy, yy)))
            for w in directions
        ]
        return choose_areas(fine, by_points, (areas, slope))

    def __repr__(self) -> str:
        return f"ggx_fit[{sum(self.parts().values()) / 2**20:.1f} MiB]"


def slopes_of_quad(normals, epsilon: float) -> list:
    """Mean and central second moments of the slopes of a quad's effective triangles.

    ``normals``: n0…n3 at its corners. The midpoints of the triangles' edges have equal weights, as
    in :func:`~.midpoint_rule`.
    """
    slopes = [
        slope_of(m)
        for first, e1, e2 in triangles_of_quad(normals, epsilon)
        for m in (first + 0.5 * e1, first + 0.5 * e2, first + 0.5 * (e1 + e2))
    ]
    mean = sum(slopes, mi.Vector2f(0)) * (1 / len(slopes))
    xx = yy = xy = mi.Float(0)
    for slope in slopes:
        x, y = slope - mean
        xx, yy, xy = dr.fma(x, x, xx), dr.fma(y, y, yy), dr.fma(x, y, xy)
    return [mean.x, mean.y, *(moment * (1 / len(slopes)) for moment in (xx, yy, xy))]


class ProjectedAreaMasking(MeanPlaneMasking):
    """Masking over the mean plane, by an estimate of P (Wu24, section 4.3), which it owns.

    Args:
        area (FootprintArea): the estimate.
        height_correlated (bool): see :class:`~.SmithMasking`.
    """

    def __init__(self, area: FootprintArea, height_correlated: bool = True) -> None:
        super().__init__(area, height_correlated, str(area))
        self.area = area

    def parts(self) -> dict[str, int]:
        return self.area.parts()

    def parameters_changed(self, keys: Sequence[str] = ()) -> None:
        self.area.parameters_changed(keys)


def area(name: str, mesh: TexelMesh, domain: Domain | None) -> FootprintArea | None:
    """The estimate of P for the masking of this name; None for one without such an estimate."""
    if name == "ggx_fit":
        return GgxFit(mesh, domain)
    if name == "analytic":
        return ProjectedArea(mesh)
    return None
