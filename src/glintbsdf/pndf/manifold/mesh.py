"""The position-normal manifold: its triangles, and the P-NDF of one quad of them.

Wu, Luan, Hašan and Ramamoorthi, "Position-Normal Manifold for Efficient Glint Rendering on
High-Resolution Normal Maps" (2024), section 4.1. The map's texels are the vertices of a triangle
mesh in position × normal space. The P-NDF is the projection of this mesh to normals, weighted by
the kernel k (Eq. 2). The functions follow the paper's order, from Eq. 3 to Eq. 6, and use its
symbols.
"""

from __future__ import annotations

from collections.abc import Sequence
from math import sqrt

import drjit as dr
import mitsuba as mi

from glintbsdf.core.errors import check, check_choice
from glintbsdf.core.loops import add_where
from glintbsdf.core.opaque import stored
from glintbsdf.footprint.gaussian import Footprint
from glintbsdf.footprint.kernels import KERNELS, TexelKernel
from glintbsdf.footprint.lattice import Lattice, floor_int
from glintbsdf.footprint.query import Query
from glintbsdf.maps.normalmap import NormalMap, map_bytes
from glintbsdf.pndf.base import changed_map


def cross(a, b):
    """The cross product a_x b_y − a_y b_x of two plane vectors."""
    return dr.fma(a.x, b.y, -(a.y * b.x))


# ------------------------------------------------------------------------------------------------
#  Eq. 3, Eq. 4 and "Preventing Jacobian singularity": the effective triangles
# ------------------------------------------------------------------------------------------------


def equilateral(epsilon):
    """The equilateral triangle that replaces one with |det J| < ε; its own |det J| is exactly ε.

    Returns three pairs of Python floats ``(a, e1, e2)``: the first vertex relative to the
    triangle's centre, and the edges from it.
    """
    r = sqrt(2 * epsilon / (3 * sqrt(3)))  # circumradius of an equilateral triangle of area ε/2
    return (0, r), (-sqrt(0.75) * r, -1.5 * r), (sqrt(0.75) * r, -1.5 * r)


def is_degenerate(a, diagonal, epsilon):
    """Whether a triangle has |det J| < ε (Eq. 4); arguments as in :func:`effective_triangle`."""
    n1, n2 = diagonal
    # The same expression as in quad_density, to the last digit: both find the same triangles.
    return dr.abs(cross(n2 - n1, a - n1)) < epsilon


def effective_triangle(a, b, c, diagonal, epsilon):
    """The normal triangle n(Δ), which is the same for sampling, for evaluation and for all bounds.

    ``a``, ``b``, ``c`` (``mi.Vector2f``) are the projected normals at the vertices. ``diagonal`` is
    the pair (n1, n2) of the quad's normals; midway between them is the centre of the triangle that
    replaces a degenerate one. Returns the first vertex, and the edges ``e1``, ``e2`` from it to the
    second and the third.
    """
    n1, n2 = diagonal
    e1, e2, centre = b - a, c - a, 0.5 * (n1 + n2)
    tiny = is_degenerate(a, diagonal, epsilon)
    small_a, small_e1, small_e2 = (mi.Vector2f(*v) for v in equilateral(epsilon))
    return (
        dr.select(tiny, centre + small_a, a),
        dr.select(tiny, small_e1, e1),
        dr.select(tiny, small_e2, e2),
    )


def triangles_of_quad(normals, epsilon):
    """The two effective triangles of a quad with the normals n0…n3."""
    n0, n1, n2, n3 = normals
    return (
        effective_triangle(n0, n1, n2, (n1, n2), epsilon),
        effective_triangle(n3, n2, n1, (n1, n2), epsilon),
    )


def normal_in_quad(l1, l2, normals, epsilon):
    """The normal n(u) of a quad's effective triangles (Eq. 3) at (``l1``, ``l2``) ∈ [0, 1]²."""
    return frame_in_quad(l1, l2, normals, epsilon)[0]


def frame_in_quad(l1, l2, normals, epsilon):
    """The normal as in :func:`normal_in_quad`, its Jacobian, and whether the triangle was replaced:
    ``(n, ∂n/∂l1, ∂n/∂l2, degenerate)``."""
    n0, n1, n2, n3 = normals
    upper = l1 + l2 < 1
    l1, l2 = dr.select(upper, l1, 1 - l1), dr.select(upper, l2, 1 - l2)
    first = dr.select(upper, n0, n3)
    a, e1, e2 = effective_triangle(
        first, dr.select(upper, n1, n2), dr.select(upper, n2, n1), (n1, n2), epsilon
    )
    sign = dr.select(upper, mi.Float(1), -1)
    degenerate = is_degenerate(first, (n1, n2), epsilon)
    return a + e1 * l1 + e2 * l2, e1 * sign, e2 * sign, degenerate


# ------------------------------------------------------------------------------------------------
#  Eq. 5: evaluation
# ------------------------------------------------------------------------------------------------


def quad_density(m, corner, kernel, normals, epsilon, active):
    """The terms of one quad in D(m) (Eq. 5): k(u* − x) / |det J| for each triangle that contains m.

    The triangles (n0, n1, n2) and (n3, n2, n1) share the diagonal e = n2 − n1, so both have
    barycentric coordinates about n1. In the first, m − n1 = λ0 (n0 − n1) + λ2 e, in the second,
    m − n1 = λ3 (n3 − n1) + λ2' e. There are branches for the cases that are rare: that m hits a
    triangle, that it hits both, as the mesh folds over along the diagonal, and degenerate
    triangles.

    Args:
        m (mi.Vector2f): projected normal.
        corner (mi.Vector2f): position of n0 relative to the footprint's centre, texels.
        kernel (TexelKernel): k.
        normals: projected normals (n0, n1, n2, n3), ``mi.Vector2f``.
        epsilon (float): smallest |det J|, ε.
        active (mi.Bool): mask of the lanes.
    """
    n0, n1, n2, n3 = normals
    e, a0, a3, q = n2 - n1, n0 - n1, n3 - n1, m - n1
    det_upper, det_lower, across = cross(e, a0), cross(e, a3), cross(e, q)
    tiny_upper, tiny_lower = dr.abs(det_upper) < epsilon, dr.abs(det_lower) < epsilon
    inverse_upper, inverse_lower = dr.rcp(det_upper), dr.rcp(det_lower)

    l0, l2 = across * inverse_upper, cross(q, a0) * inverse_upper
    in_upper = (l0 >= 0) & (l2 >= 0) & (l0 + l2 <= 1) & ~tiny_upper
    u_upper = corner + mi.Vector2f(1 - l0 - l2, l2)

    l3, l2 = across * inverse_lower, cross(q, a3) * inverse_lower
    in_lower = (l3 >= 0) & (l2 >= 0) & (l3 + l2 <= 1) & ~tiny_lower
    u_lower = corner + mi.Vector2f(1 - l2, l2 + l3)

    def term(inside, u, inverse):
        # Values outside of the triangle must stay finite: 0 · ∞ would be NaN in derivatives.
        u, inverse = dr.select(inside, u, corner), dr.select(inside, inverse, 0)
        return kernel.value(u) * dr.abs(inverse)

    def hit():
        return term(
            in_upper | in_lower,
            dr.select(in_upper, u_upper, u_lower),
            dr.select(in_upper, inverse_upper, inverse_lower),
        )

    density = add_where(mi.Float(0), in_upper | in_lower, hit, active)
    density = add_where(
        density, in_upper & in_lower, lambda: term(in_lower, u_lower, inverse_lower), active
    )

    def degenerate():
        a, e1, e2 = equilateral(epsilon)
        p = m - 0.5 * (n1 + n2) - mi.Vector2f(*a)
        l1, l2 = (p.x * e2[1] - p.y * e2[0]) / epsilon, (e1[0] * p.y - e1[1] * p.x) / epsilon
        inside = (l1 >= 0) & (l2 >= 0) & (l1 + l2 <= 1)
        upper = kernel.value(corner + mi.Vector2f(l1, l2)) / epsilon
        lower = kernel.value(corner + mi.Vector2f(1 - l1, 1 - l2)) / epsilon
        return dr.select(inside & tiny_upper, upper, 0) + dr.select(inside & tiny_lower, lower, 0)

    return add_where(density, tiny_upper | tiny_lower, degenerate, active)


class TexelMesh:
    """The position-normal manifold: a mesh whose vertices are the texels, without a structure for
    search.

    It belongs to the variant of Mitsuba that is active when it is made.

    Args:
        normal_map (NormalMap): the map.
        kernel (str): ``gaussian``, ``disk`` or ``box``, see :mod:`glintbsdf.footprint.kernels`.
        epsilon (float): smallest Jacobian determinant |det J| of a triangle, in (0, 1).
        owner (str): the name that errors give, usually the plugin's.

    Attributes:
        data (mi.TensorXf): the projected normals, H×W×2. Derivatives flow through it; after a
            change of its values, :meth:`parameters_changed` rebuilds what depends on them.

    Raises:
        ParameterError: ``kernel`` or ``epsilon`` is not allowed.
    """

    #: Whether ``data`` has been changed since the construction.
    changed: bool = False

    def __init__(
        self,
        normal_map: NormalMap,
        kernel: str = "gaussian",
        epsilon: float = 1e-6,
        owner: str = "TexelMesh",
    ) -> None:
        check_choice(owner, "kernel", kernel, KERNELS)
        check(0 < epsilon < 1, owner, "epsilon", "a number in (0, 1)", epsilon)
        self.normal_map, self.kernel, self.epsilon = normal_map, kernel, float(epsilon)
        self.owner = owner
        self.data = stored(mi.TensorXf, normal_map.normals)
        self.make_vertices()

    def make_vertices(self) -> None:
        """Store the vertices of ``self.data`` in the order of the lattice."""
        height, width, _ = self.data.shape
        self.lattice = Lattice(height, width, self.normal_map.wrap_mode)
        texel = mi.UInt32(self.lattice.source)
        vertices = dr.gather(mi.Vector2f, self.data.array, texel)
        self.vertices = dr.ravel(vertices)
        dr.eval(self.vertices)

    def quad_normals(self, row, column, active=True):
        """Projected normals n0…n3 of a stored quad (Eq. 3)."""
        return self.lattice.corner_values(self.vertices, row, column, active)

    def effective_triangles(self, row, column, active=True):
        """The two effective triangles of a stored quad, without derivatives."""
        with dr.suspend_grad():
            return triangles_of_quad(self.quad_normals(row, column, active), self.epsilon)

    def normal_at(self, u: mi.Point2f, active: bool | mi.Bool = True) -> mi.Vector2f:
        """The projected normal n(u) of the effective triangles at the position ``u``, in texels."""
        return self.frame_at(u, active)[0]

    def frame_at(self, u: mi.Point2f, active: bool | mi.Bool = True) -> tuple:
        """The normal n(u) at the position ``u`` (texels), its Jacobian, and whether the triangle
        was replaced; see :func:`frame_in_quad`."""
        column, row = floor_int(u.x), floor_int(u.y)
        l1, l2 = u.x - column, u.y - row
        n0, n1, n2, n3 = self.quad_normals(
            self.lattice.y.locate(row)[1], self.lattice.x.locate(column)[1], active
        )
        return frame_in_quad(l1, l2, (n0, n1, n2, n3), self.epsilon)

    def texel_kernel(self, query: Query | Footprint) -> TexelKernel:
        """k(u − x) of Eq. 2 for this map."""
        height, width, _ = self.data.shape
        return Query.of(query).texel_kernel(self.kernel, height, width, self.normal_map.wrap_mode)

    def traverse(self, callback: mi.TraversalCallback) -> None:
        callback.put("data", self.data, mi.ParamFlags.Differentiable)

    def parameters_changed(self, keys: Sequence[str] = ()) -> None:
        """Check new data, and use them. Derivatives keep flowing to the data."""
        if keys and "data" not in keys:
            return
        self.changed = True
        wrap_mode = self.normal_map.wrap_mode
        self.normal_map = changed_map(self.data, wrap_mode, self.owner)
        self.make_vertices()

    def parts(self) -> dict[str, int]:
        """Memory of each part of the structure, bytes."""
        return {
            "map": map_bytes(self.normal_map),
            "vertices": 4 * dr.width(self.vertices),
        }

    def __repr__(self) -> str:
        height, width, _ = self.data.shape
        return (
            f"{type(self).__name__}[{width}×{height} texels, {self.normal_map.wrap_mode}, "
            f"kernel={self.kernel}, epsilon={self.epsilon:g}, "
            f"{sum(self.parts().values()) / 2**20:.1f} MiB]"
        )
