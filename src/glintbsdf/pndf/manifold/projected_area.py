r"""The projected area P(ω) of the facets under a footprint.

Wu, Luan, Hašan and Ramamoorthi, "Position-Normal Manifold for Efficient Glint Rendering on
High-Resolution Normal Maps" (2024), section 4.3 and its supplement. The projected area of a P-NDF

    P(ω) = ∫ D(m̃) max(m̃·ω, 0) dm̃                                                         (Eq. 9)
         = Σ_Δ k(Δ)/2 · mean over n(Δ) of max(m̃·ω, 0)/m_z                                  (Eq. 10)

is a sum over the triangles of the manifold, once the kernel is taken as constant on each of them.

**One triangle.** The paper turns the mean into integrals along the boundary of the triangle's
visible part (Eq. 11, 12, Algorithm 1). They are exact, and useless in float32: terms of the size of
the triangle's edges cancel to its area, and near the horizon to much less. Here the visible part is
the same, a polygon of at most six corners and, beyond those of its sides that are chords of the
ellipse, lenses up to the ellipse; but each piece is integrated by terms that are all positive, from
``q = m̃·ω`` at the corners alone:

* between corners the unit normal bulges over the flat triangle. With barycentric coordinates λ,
  squared chords c_ij² = \|ñ_i − ñ_j\|² of the *unit* normals, and V = Σ λ_i λ_j c_ij² (i < j),

      m_z = √((Σ λ_i z_i)² + V),      q = Σ λ_i q_i + ω_z V / (m_z + Σ λ_i z_i),

  and q/m_z is averaged by a product rule of Gauss, in coordinates in which m_z varies smoothly
  through the disk's rim (:func:`mean_facing`);
* a lens has a one-dimensional integral whose cancellation can be carried out by hand
  (:func:`lens`).

Nothing is divided by the triangle's area but the lens, which is smaller than the area by
construction: triangles may be as thin as they like.

**All triangles under the footprint** count, whatever their normals: the lists of the P-NDF, which
are sorted by normal, do not apply. See :class:`ProjectedArea`.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial

import drjit as dr
import mitsuba as mi
import numpy as np

from glintbsdf.core.hashing import pcg3d
from glintbsdf.core.loops import symbolic_loop
from glintbsdf.footprint.domain import Domain
from glintbsdf.footprint.gaussian import Footprint
from glintbsdf.footprint.kernels import TexelKernel, difference_of_products
from glintbsdf.footprint.lattice import Lattice, floor_int
from glintbsdf.footprint.query import Query
from glintbsdf.microfacet.masking import SmithMasking
from glintbsdf.pndf.filters.moments import MomentPyramid
from glintbsdf.pndf.manifold.mesh import TexelMesh, add_where, cross, triangles_of_quad

#: |q| below which a corner counts as lying on the horizon: products of two must not underflow.
HORIZON = 1e-15

#: Lowest height of a normal that counts in a slope: of a vertical facet it would be infinite.
LOWEST = 1e-3

# ------------------------------------------------------------------------------------------------
#  A triangle that is visible as a whole
# ------------------------------------------------------------------------------------------------


def gauss(order: int) -> list[tuple[float, float]]:
    """Nodes and weights of Gauss and Legendre's rule on [0, 1]."""
    nodes, weights = np.polynomial.legendre.leggauss(order)
    return [(float(0.5 * x + 0.5), float(0.5 * w)) for x, w in zip(nodes, weights, strict=True)]


def rim_steps(z0, z_half, z1, order: int):
    """Nodes s and weights on [0, 1] for functions of s that have m_z in the denominator.

    ds/dτ is the parabola through the heights ``z0``, ``z_half``, ``z1`` at both ends and between,
    so that 1/m_z, which is singular where an end lies on the rim of the disk, is smooth in τ.
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
    """Mean over a triangle of projected normals of m̃·ω/m_z, where it is positive at all corners.

    Args:
        q, z: m̃·ω and m_z at the three corners.
        chords: squared chords (c01², c02², c12²) between the unit normals of the corners.
        w_z: ω_z.
        order (int): nodes of the rule along either of its two axes.
    """
    c01, c02, c12 = chords

    def height(flat, bulge):
        return dr.safe_sqrt(dr.fma(flat, flat, bulge))

    total, weights = mi.Float(0), mi.Float(0)
    # Rays from corner 0 to the places t of the opposite side.
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
#  Clipping at the horizon m̃·ω = 0
# ------------------------------------------------------------------------------------------------


def visible_interval(q_u, q_v, z_u, z_v, chord, w_z):
    """The part of the edge from u to v in which m̃·ω ≥ 0 (Algorithm 1, for all its cases).

    m̃·ω is concave along the edge, so this is one interval; its ends are roots of the quadratic of
    the supplement. Written in q, which is small near the horizon, instead of in positions, its
    discriminant is a sum of two terms that do not cancel, and each root is a quotient of sums of
    one sign.

    Returns ``(low, 1 − low, high, 1 − high, exists)``.
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

    Seen along ω the lens lies between two arcs over a common chord of length c: that of the great
    circle m̃·ω = 0, and the projection of the circle, of radius r = √(1 − d²), that stands over the
    line at a distance d from the origin. The difference of their heights over the chord at
    x = y c/2 is, with h = 1 − c²/4 and κ = √((r² − c²/4)/h) the cosine between the planes,

        (c²/4)² (1 − y²)² d² / (h D_1 D_r (√(r² − x²) + κ √(1 − x²))),

    where D_ρ = √(ρ² − x²) + √(ρ² − c²/4).

    Args:
        position, side (mi.Vector2f): first end of the chord in the disk, and the way to the second.
        chord: squared length c² of the chord between the unit normals.
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
    # Twice, as y runs from −1 to 1; the chord's half length is one more factor.
    return 2 * total * quarter * quarter * dr.sqrt(quarter) * d2 / h


class Corners:
    """Unit normals at the three corners of a triangle of projected normals, and their m̃·ω.

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

        Between the corners m_z rises above the flat triangle by √(z² + V) − z at most, where z is
        the lowest corner and V is not above a third of the longest squared chord.
        """
        lowest = dr.minimum(dr.minimum(self.z[0], self.z[1]), self.z[2])
        bulge = dr.maximum(dr.maximum(self.chords[0], self.chords[1]), self.chords[2]) / 3
        rise = bulge / dr.maximum(dr.sqrt(dr.fma(lowest, lowest, bulge)) + lowest, 1e-20)
        return self.highest + w_z * rise > 0


def facing(m, z, w):
    """m̃·ω, to the last digit where ω is horizontal; zero where it is lost in rounding."""
    q = dr.fma(w.z, z, difference_of_products(w.x, m.x, -w.y, m.y))
    return dr.select(dr.abs(q) > HORIZON, q, 0)


def squared_chord(side, sum_of_ends, sum_of_heights):
    """Squared distance of two unit normals, from the difference and the sum of their projections.

    Their heights differ by −side·sum/(sum of heights), without cancellation.
    """
    rise = dr.dot(side, sum_of_ends) / dr.maximum(sum_of_heights, 1e-20)
    # Both ends on the rim, where heights carry no digits: they differ by no more than their sum.
    rise = dr.minimum(dr.abs(rise), sum_of_heights)
    return dr.fma(rise, rise, dr.squared_norm(side))


def clipped_mean(corners: Corners, w_z, order: int):
    """Mean over a triangle of max(m̃·ω, 0)/m_z, for any position of the horizon."""
    # The corner that faces ω most comes first, so that what is small is measured from it.
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

    # An edge that is not seen shrinks to the point where the boundary passes it by.
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
#  All triangles under a footprint (Eq. 12)
# ------------------------------------------------------------------------------------------------

#: Footprints that touch no more quads than this are smaller than what is constant on a triangle:
#: the mean is taken over points of the kernel instead.
FEW_QUADS = 25

#: Footprints that touch more quads than this see one quad of each square of 2×2, 4×4, … instead,
#: at a place that differs from square to square, which bounds a footprint's cost. The error of P is
#: about 0.001 for maps of roughness 0.15, and 0.005 for 0.6 (``benchmarks projected_area areas``).
MANY_QUADS = 4096

#: Order of the rule of Gauss by the map's longest chord between unit normals of one triangle: the
#: relative error over random triangles is then below 1e-3 (tests/test_projected_area.py).
ORDERS = ((0.05, 2), (0.5, 3), (2.1, 6))


class FootprintArea:
    """P(ω) of the facets under a footprint; what the two estimates of it share.

    Attributes:
        mesh (TexelMesh): the manifold.
        few (int): footprints that touch no more quads than this see :func:`mean_over_points`.
    """

    mesh: TexelMesh
    few: int

    def eval(
        self, w: mi.Vector3f, query: Query | Footprint, active: bool | mi.Bool = True
    ) -> mi.Float:
        """P(ω) ≥ 0 for a unit vector with ω_z ≥ 0; at most ω_z + the mean slope's length.

        ``query``: a query, or just a footprint in the UV space of the map.
        """
        return self.areas([w], Query.of(query), mi.Bool(active))[0]

    def areas(self, directions: list, query: Query, active: mi.Bool) -> list:
        """As :meth:`eval` for several directions, which share what is found under the footprint."""
        raise NotImplementedError

    def parts(self) -> dict[str, int]:
        """Memory of each part, besides the mesh, bytes."""
        return {}


class ProjectedArea(FootprintArea):
    """P(ω) of the facets under a footprint, by the sum of Eq. 12.

    The kernel is constant on each triangle. What the box weighs of a quad between four texels is
    known exactly, and both triangles of the quad have half of it: P is exact where the box's edges
    lie on those of quads. The other kernels are taken at the triangle's centroid. The weights are
    divided by their sum, so that the projected area of flat facets is exact, and P(z) = 1.

    Footprints of a few texels would see the triangles' size in this: for them see
    :func:`mean_over_points`.

    Args:
        mesh (TexelMesh): the manifold. Derivatives flow through its ``data``.
    """

    few = FEW_QUADS

    def __init__(self, mesh: TexelMesh) -> None:
        self.mesh = mesh
        self.parameters_changed()

    def parameters_changed(self) -> None:
        """Choose the quadrature for the data of the mesh."""
        with dr.suspend_grad():
            lattice = self.mesh.lattice
            index = dr.arange(mi.UInt32, lattice.x.quads * lattice.y.quads)
            columns = mi.UInt32(lattice.x.count)
            row = index // columns
            column = index - row * columns
            longest = mi.Float(0)
            for triangle in self.triangles(mi.Int(row), mi.Int(column), True):
                first, e1, e2 = triangle
                for chord in Corners(first, e1, e2, mi.Vector3f(0, 0, 1)).chords:
                    longest = dr.maximum(longest, chord)
            longest = float(dr.max(longest)[0]) ** 0.5
        self.order = next(order for limit, order in ORDERS if longest <= limit)

    def triangles(self, row, column, active):
        """The effective triangles of a stored quad, each as first corner and two edges."""
        return triangles_of_quad(self.mesh.quad_normals(row, column, active), self.mesh.epsilon)

    def areas(self, directions: list, query: Query, active: mi.Bool) -> list:
        kernel = self.mesh.texel_kernel(query)
        few = kernel.touched_quads() <= self.few
        by_points = mean_over_points(self.mesh, kernel, directions, active & few)
        by_triangles = self.mean_over_triangles(directions, kernel, active & ~few)
        return [dr.select(few, *pair) for pair in zip(by_points, by_triangles, strict=True)]

    def __repr__(self) -> str:
        return "analytic"

    def mean_over_triangles(self, directions, kernel, active):
        """The weighted mean over the triangles of Eq. 12, for each direction."""
        mean = mi.Vector2f(kernel.mean)

        def add(x, y, row, column, active, mass, *areas):
            corner = mi.Vector2f(x, y) - mean
            triangles = self.triangles(row, column, active)
            for triangle, centroid in zip(triangles, (1 / 3, 2 / 3), strict=True):
                weight = dr.select(active, triangle_weight(kernel, corner, centroid), 0)
                counts = active & (weight > 0)
                seen = [self.triangle(triangle, w, counts) for w in directions]
                areas = [dr.fma(weight, x, area) for x, area in zip(seen, areas, strict=True)]
                mass += weight
            return mass, *areas

        sums = [mi.Float(0) for _ in range(1 + len(directions))]
        mass, *areas = every_stratum(self.mesh.lattice, kernel, add, sums, active)
        mass = dr.select(mass > 0, mass, 1)
        return [area / mass for area in areas]

    def triangle(self, triangle, w, active):
        """Mean over one effective triangle of max(m̃·ω, 0)/m_z."""
        corners = Corners(*triangle, w)
        whole = mean_facing(
            [dr.maximum(q, 0) for q in corners.q],
            corners.z,
            (corners.chords[0], corners.chords[2], corners.chords[1]),
            w.z,
            self.order,
        )
        seen = corners.lowest >= 0
        return add_where(
            dr.select(seen, whole, 0),
            ~seen & corners.may_be_seen(w.z),
            lambda: clipped_mean(corners, w.z, self.order),
            active,
        )


def triangle_weight(kernel: TexelKernel, corner, centroid: float):
    """Weight of a triangle of the quad at ``corner`` (texels from the footprint's centre).

    ``centroid``: of the triangle in the quad, along both axes.
    """
    if kernel.kernel != "box":
        return kernel.value(corner + centroid)

    def overlap(low, reach):
        return dr.maximum(dr.minimum(low + 1, reach) - dr.maximum(low, -reach), 0)

    return overlap(corner.x, kernel.half_u) * overlap(corner.y, kernel.half_v)


def every_stratum(lattice: Lattice, kernel: TexelKernel, add, sums, active):
    """Sum over the quads under the kernel, or one quad of each square of quads if they are many.

    Calls ``add(x, y, row, column, active, *sums)`` with the quad's position and where it is stored;
    it returns the new sums. Rows of squares are followed only as far as the kernel reaches,
    whatever the footprint's shape.
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
#  The smallest footprints
# ------------------------------------------------------------------------------------------------

#: Points of the kernel over which the mean is taken, Fibonacci numbers, for footprints that touch
#: no more quads than TINY_QUADS and for larger ones; and the fractional part of the golden ratio,
#: which spreads them evenly. With the numbers below these, a furnace reflects up to 1.2 and 8.6 of
#: what it receives on maps whose normals jump from texel to texel, with these 1.02; the rest is
#: for MISSED.
TINY_QUADS, POINTS_OF_TINY, POINTS = 4, 34, 55
GOLDEN = (5**0.5 - 1) / 2

#: Share by which masking raises Λ where it comes from points, which costs at most 1 % of a facet's
#: light. Without, a furnace reflects up to 1.014 of what it receives on maps of grooves and flakes,
#: whose degenerate triangles are missed; with it, 1.0015 (``python -m benchmarks projected_area``).
MISSED = 0.04

#: Ω of the GGX area (:func:`ggx_area`) over the variance of slopes which are uniformly distributed
#: over an interval: with it, both see the same at grazing angles.
UNIFORM = 0.75


def mean_over_points(mesh: TexelMesh, kernel: TexelKernel, directions: list, active) -> list:
    """P(ω) for each direction as the mean over points of the kernel, all of equal weight.

    A point stands for a cell of the kernel, of the area 1/(N k), over which the slopes vary by the
    triangle's Jacobian: it has the projected area of this spread, not of a single facet, so that
    what faces ω in a corner of the cell is not missed.
    """
    tiny = kernel.touched_quads() <= TINY_QUADS
    count, share = (
        dr.select(tiny, kind(few), kind(many))
        for kind, few, many in (
            (mi.UInt32, POINTS_OF_TINY, POINTS),
            (mi.Float, 1 / POINTS_OF_TINY, 1 / POINTS),
        )
    )

    def slope_along(w, m, z, e):
        """The derivative of ω·m̃/m_z along an edge of the normal triangle."""
        flat = mi.Vector2f(w.x, w.y)
        return dr.fma(dr.dot(flat, m), dr.dot(m, e) / (z * z), dr.dot(flat, e)) / z

    def body(k, *totals):
        x, y = ((mi.Float(k) + 0.5) * step for step in (share, GOLDEN))
        offset = kernel.sample(mi.Point2f(x, y - dr.floor(y)))
        m, e1, e2 = mesh.frame_at(kernel.mean + offset, active)
        z = dr.maximum(dr.safe_sqrt(1 - dr.squared_norm(m)), LOWEST)
        new = []
        for w, total in zip(directions, totals, strict=True):
            mean = dr.fma(w.x, m.x, w.y * m.y) / z + w.z
            d1, d2 = (slope_along(w, m, z, e) for e in (e1, e2))
            spread = UNIFORM * share * variance_of_cells(kernel, offset, d1, d2)
            new.append(total + dr.select(active, ggx_area(mean, spread), 0))
        return k + 1, *new

    state = (mi.UInt32(0), *[mi.Float(0) for _ in directions])
    totals = symbolic_loop(state, lambda k, *_: active & (k < count), body, "points")[1:]
    return [total * share for total in totals]


def variance_of_cells(kernel: TexelKernel, offset, d1, d2):
    """N times the variance, over the cell of a point, of what changes by ``d1``, ``d2`` per texel.

    The cell has the kernel's own shape and the area 1/(N k): once the kernel is round, a variance
    of area/12 along either axis.
    """
    if kernel.kernel == "box":
        return (dr.square(d1 * kernel.half_u) + dr.square(d2 * kernel.half_v)) / 3
    stretch = kernel.sigma_u_given_v / kernel.sigma_v
    across = dr.square(d1) * stretch + dr.square(dr.fma(d1, kernel.shear, d2)) / stretch
    return across / (12 * kernel.value(offset, edge=False))


# ------------------------------------------------------------------------------------------------
#  Approximation by a smooth P-NDF (Eq. 13)
# ------------------------------------------------------------------------------------------------

#: Directions of the half circle at which the fit is made.
AZIMUTHS = 8

#: Footprints that touch no more quads than this are no matter of averages over a texel or more:
#: the fit gives way to points of the kernel. A round one has a standard deviation of 1.2 texels.
FINE_QUADS = 64


def ggx_area(mean, rough):
    """P' of a GGX distribution of slopes, ½ (w̄ + √(w̄² + ω_xyᵀ Ω ω_xy)); 0 for w̄ < 0 and Ω = 0.

    ``mean``: w̄; ``rough``: the square ω_xyᵀ Ω ω_xy.
    """
    root = dr.sqrt(dr.maximum(dr.fma(mean, mean, rough), 1e-20))
    return 0.5 * dr.select(mean >= 0, mean + root, rough / dr.select(mean >= 0, 1, root - mean))


class GgxFit(FootprintArea):
    r"""P(ω) of the GGX distribution of slopes that fits the facets under a footprint.

    The paper's Eq. 13, with the bracket that its print lost, is
    ``P' = ½ (ω_z + √(ω_z² + ω_xyᵀ Ω ω_xy))``, that of slopes around zero. Facets under a footprint
    lean: around their mean slope s̄ (here −∇h, so that m̃·ω/m_z = ω_z + s·ω_xy) it is

        P' = ½ (w̄ + √(w̄² + ω_xyᵀ Ω ω_xy)),        w̄ = ω_z + s̄·ω_xy,

    for a distribution moved by s̄ sees ω_z moved by s̄·ω_xy (Dupuy et al., "Linear Efficient
    Antialiased Displacement and Reflectance Mapping", 2013). It is never below the projected area
    of a plane of slope s̄, as no distribution's is.

    At grazing angles, ω_z = 0, this is linear in Ω, ``4 P (P − w̄) = ω_xyᵀ Ω ω_xy``, which gives Ω
    by least squares over :data:`AZIMUTHS` directions, and no less than that in any of them
    (:func:`fit`); the other half of the circle says the same, as P(−ω) = P(ω) − w̄. Mean slope and
    P at grazing angles are averages over the footprint, taken by a
    :class:`~.MomentPyramid`: levels are Gaussians of growing width, so a round
    footprint mixes the two next in size, and a stretched one sums lookups along its axis. What is
    stored and interpolated is (s̄, Ω + s̄ s̄ᵀ), the raw moments of two facets ±√Ω: slopes that differ
    between the samples of a level then count as roughness, and as P' is a concave function of the
    raw moments, what was not below P at the samples is not below it between them.

    Footprints of little more than a texel (:data:`FINE_QUADS`) see :func:`mean_over_points`
    instead: there a distribution fitted to a wider place reflects more than it receives wherever a
    few facets face a grazing direction.

    What remains is the shape: GGX slopes have tails that Gaussian ones have not. Under large
    footprints of a map of Gaussian bumps of roughness 0.15, no masking at all is nearer to the
    exact one down to ω_z = 0.2, where the fit's G1 is off by 0.03; the fit is twice as near at 0.1,
    and twelve times at 0.05.

    Built in less time than a cache would take to read. Beyond a texel the footprint is Gaussian.

    Args:
        mesh (TexelMesh): the manifold. Derivatives flow through its ``data``.
        domain (Domain): what will be asked for; None for anything. Levels that no such footprint
            needs are left out.

    Attributes:
        pyramid (MomentPyramid): None where all footprints see :func:`mean_over_points`.
    """

    few = FINE_QUADS

    def __init__(self, mesh: TexelMesh, domain: Domain | None = None) -> None:
        self.mesh, self.domain = mesh, domain
        self.parameters_changed()

    def parts(self) -> dict[str, int]:
        if self.pyramid is None:
            return {}
        levels = f"{self.pyramid.first} to {self.pyramid.top}"
        return {f"masking, MIP levels {levels}": self.pyramid.nbytes}

    def parameters_changed(self) -> None:
        """Fit anew to the data of the mesh."""
        self.pyramid = None
        if self.domain is not None and self.domain.most_quads <= self.few:
            return
        self.pyramid = MomentPyramid(
            self.mesh.data,
            self.mesh.normal_map.wrap_mode,
            None,
            over_quad=partial(grazing_areas, epsilon=self.mesh.epsilon),
            finish=fit,
            domain=self.domain,
        )

    def areas(self, directions: list, query: Query, active: mi.Bool) -> list:
        kernel = self.mesh.texel_kernel(query)
        fine = kernel.touched_quads() <= self.few
        by_points = mean_over_points(self.mesh, kernel, directions, active & fine)
        if self.pyramid is None:
            return by_points
        slope_x, slope_y, xx, xy, yy = self.pyramid.average(query, active & ~fine)
        areas = []
        for w, mean_of_points in zip(directions, by_points, strict=True):
            leaning = dr.fma(slope_x, w.x, slope_y * w.y)
            raw = w.x * w.x * xx + 2 * w.x * w.y * xy + w.y * w.y * yy
            rough = dr.maximum(dr.fma(-leaning, leaning, raw), 0)
            areas.append(dr.select(fine, mean_of_points, ggx_area(w.z + leaning, rough)))
        return areas

    def __repr__(self) -> str:
        return f"ggx_fit[{sum(self.parts().values()) / 2**20:.1f} MiB]"


def azimuths() -> list[tuple[float, float]]:
    """Horizontal unit vectors, evenly over a half circle."""
    angles = (np.pi * (k + 0.5) / AZIMUTHS for k in range(AZIMUTHS))
    return [(float(np.cos(angle)), float(np.sin(angle))) for angle in angles]


def grazing_areas(normals, epsilon: float) -> list:
    """The mean slope of a quad's facets, and their projected area in every horizontal direction.

    ``normals``: n0…n3 at its corners. Over each of the effective triangles the slope counts as
    linear, so that only the corners' slopes matter.
    """
    totals = None
    for first, e1, e2 in triangles_of_quad(normals, epsilon):
        slopes = [
            m / dr.maximum(dr.safe_sqrt(1 - dr.squared_norm(m)), LOWEST)
            for m in (first, first + e1, first + e2)
        ]
        mean = (slopes[0] + slopes[1] + slopes[2]) / 3
        areas = [mean_positive([dr.fma(s.x, x, s.y * y) for s in slopes]) for x, y in azimuths()]
        values = [mean.x, mean.y, *areas]
        totals = (
            values
            if totals is None
            else [0.5 * (a + b) for a, b in zip(totals, values, strict=True)]
        )
    return totals


def mean_positive(corners: list):
    """Mean over a triangle of max(f, 0) for a linear f with these values at the corners.

    Where f changes its sign around one corner, of the value a, while b and c are the others, the
    part of a's sign is a triangle and adds a³/(3 (a − b)(a − c)).
    """
    x, y, z = corners
    low, high = dr.minimum(dr.minimum(x, y), z), dr.maximum(dr.maximum(x, y), z)
    middle = dr.maximum(dr.minimum(x, y), dr.minimum(dr.maximum(x, y), z))

    def cut_off(a, b, c):
        divisor = 3 * (a - b) * (a - c)
        return dr.select(divisor > 0, a * a * a / dr.select(divisor > 0, divisor, 1), 0)

    mean = (x + y + z) / 3
    alone_above = dr.select(high > 0, cut_off(high, middle, low), 0)
    alone_below = mean - dr.select(low < 0, cut_off(low, middle, high), 0)
    return dr.select(middle > 0, alone_below, alone_above)


def fit(averages: list) -> list:
    """The raw moments (s̄_x, s̄_y, R_xx, R_xy, R_yy) of averages of :func:`grazing_areas`.

    Least squares leave Ω too small in some directions, even negative, and a surface that shows too
    small an area reflects more than it receives. One after the other, the directions for which Ω
    falls short raise it, along themselves by what is missing.
    """
    slope_x, slope_y, *areas = averages
    directions = azimuths()
    squares = [
        4 * area * (area - slope_x * x - slope_y * y)
        for area, (x, y) in zip(areas, directions, strict=True)
    ]
    solve = np.linalg.pinv([[x * x, 2 * x * y, y * y] for x, y in directions])
    xx, xy, yy = (
        sum((float(c) * v for c, v in zip(row, squares, strict=True)), mi.Float(0)) for row in solve
    )
    for square, (x, y) in zip(squares, directions, strict=True):
        missing = dr.maximum(square - (x * x * xx + 2 * x * y * xy + y * y * yy), 0)
        xx, xy, yy = xx + missing * x * x, xy + missing * x * y, yy + missing * y * y
    return [slope_x, slope_y, xx + slope_x * slope_x, xy + slope_x * slope_y, yy + slope_y**2]


class ProjectedAreaMasking(SmithMasking):
    """Smith's masking from a projected area: Λ(ω) = P(ω)/ω_z − 1 (Wu24, section 4.3).

    Where the facets lean away from ω, P falls below the projected area ω_z of the whole surface:
    those that face ω then hide no other, Λ = 0.

    A surface whose P is too small reflects more than it receives, and :func:`mean_over_points` may
    miss facets where degenerate triangles make the normals jump: Λ is raised by :data:`MISSED`
    where P comes from points.

    Args:
        area (ProjectedArea | GgxFit): P.
        height_correlated (bool): see :class:`~.SmithMasking`.
    """

    def __init__(self, area: ProjectedArea | GgxFit, height_correlated: bool = True) -> None:
        super().__init__(height_correlated)
        self.area = area

    def parts(self) -> dict[str, int]:
        return self.area.parts()

    def parameters_changed(self, keys: Sequence[str] = ()) -> None:
        if not keys or "data" in keys:
            self.area.parameters_changed()

    def smith_lambdas(self, directions: list, query: Query, active: mi.Bool) -> list:
        areas = self.area.areas(directions, query, active)
        by_points = self.area.mesh.texel_kernel(query).touched_quads() <= self.area.few
        scale = dr.select(by_points, 1 + MISSED, 1)
        return [
            scale * dr.maximum(area / dr.maximum(w.z, 1e-12) - 1, 0)
            for w, area in zip(directions, areas, strict=True)
        ]

    def __repr__(self) -> str:
        return f"{self.area}, height_correlated = {self.height_correlated}"


def area(name: str, mesh: TexelMesh, domain: Domain | None) -> FootprintArea | None:
    """The estimate of P that a masking of this name uses; None for one that uses none."""
    if name == "ggx_fit":
        return GgxFit(mesh, domain)
    if name == "analytic":
        return ProjectedArea(mesh)
    return None
