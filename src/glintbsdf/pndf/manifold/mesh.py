"""The position-normal manifold: its triangles, and what one quad of them adds to the P-NDF.

Wu, Luan, Hašan and Ramamoorthi, "Position-Normal Manifold for Efficient Glint Rendering on
High-Resolution Normal Maps" (2024), section 4.1. The map's texels are the vertices of a triangle
mesh in position × normal space; the P-NDF is that mesh seen along the position axes. The functions
stand in the paper's order and use its symbols.
"""

from __future__ import annotations

from collections.abc import Sequence
from math import sqrt

import drjit as dr
import mitsuba as mi

from glintbsdf.core.errors import check, check_choice
from glintbsdf.footprint.gaussian import Footprint
from glintbsdf.footprint.kernels import KERNELS, TexelKernel
from glintbsdf.footprint.lattice import Lattice, floor_int
from glintbsdf.footprint.query import Query
from glintbsdf.maps.normalmap import NormalMap, map_bytes


def cross(a, b):
    """z component of the cross product of two vectors of the plane."""
    return dr.fma(a.x, b.y, -(a.y * b.x))


# ------------------------------------------------------------------------------------------------
#  Eq. 4 and "Preventing Jacobian singularity": the effective triangles
# ------------------------------------------------------------------------------------------------


def equilateral(epsilon):
    """The triangle that replaces one with |det J| < ε: first vertex from its centre, and two edges.

    Its own Jacobian is exactly ε. Returns three pairs of Python floats ``(a, e1, e2)``.
    """
    r = sqrt(2 * epsilon / (3 * sqrt(3)))  # circumradius of an equilateral triangle of area ε/2
    return (0, r), (-sqrt(0.75) * r, -1.5 * r), (sqrt(0.75) * r, -1.5 * r)


def is_degenerate(a, diagonal, epsilon):
    """Whether a triangle has |det J| < ε; arguments are those of :func:`effective_triangle`."""
    n1, n2 = diagonal
    # To the last digit the determinant of quad_density, so that both find the same ones degenerate.
    return dr.abs(cross(n2 - n1, a - n1)) < epsilon


def effective_triangle(a, b, c, diagonal, epsilon):
    """The normal triangle n(Δ) on which sampling, evaluation and all bounds agree.

    ``a``, ``b``, ``c`` (``mi.Vector2f``): projected normals at the vertices. ``diagonal``: those of
    the quad's (n1, n2), between which the replacement of a degenerate triangle is centred. Returns
    the first vertex and the edges ``e1``, ``e2`` from it to the second and third.
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
    """The normal n(u) of a quad's effective triangles at the place (``l1``, ``l2``) ∈ [0, 1]²."""
    return frame_in_quad(l1, l2, normals, epsilon)[0]


def frame_in_quad(l1, l2, normals, epsilon):
    """As :func:`normal_in_quad`, the columns of the Jacobian J(u), and whether the triangle there
    is a replaced one: ``(n, ∂n/∂l1, ∂n/∂l2, degenerate)``."""
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


def add_where(density, condition, added, active):
    """``density + added()`` where the condition holds, in a branch skipped where it never does.

    Not with derivatives: Dr.Jit (1.5) cannot record them through a branch nested in a loop.
    """
    if dr.grad_enabled(added()):
        return density + dr.select(condition, added(), 0)
    return dr.if_stmt(
        (density,), active & condition, lambda density: density + added(), lambda density: density
    )


def where_needed(needed: mi.Bool, added, sums: tuple) -> tuple:
    """``added(*sums)`` in the lanes that need it, in a branch; with derivatives, in all, as
    :func:`add_where` does."""
    if dr.grad_enabled(added(*sums)):
        return tuple(dr.select(needed, a, b) for a, b in zip(added(*sums), sums, strict=True))
    return dr.if_stmt(sums, needed, added, lambda *sums: sums)


def quad_density(m, corner, kernel, normals, epsilon, active):
    """What one quad adds to D(m) (Eq. 5): k(u* − x) / |det J| for each triangle that contains m.

    The triangles (n0, n1, n2) and (n3, n2, n1) share the diagonal e = n2 − n1, so barycentric
    coordinates are taken from n1: m − n1 = λ0 (n0 − n1) + λ2 e in the one, λ3 (n3 − n1) + λ2' e in
    the other. What few quads need stands in branches: a hit at all, a hit of both triangles, which
    takes a mesh that folds over between them, and degenerate triangles.

    Args:
        m (mi.Vector2f): projected normal.
        corner (mi.Vector2f): position of n0 from the footprint's centre, texels.
        kernel (TexelKernel): k.
        normals: projected normals (n0, n1, n2, n3), ``mi.Vector2f``.
        epsilon (float): smallest |det J|.
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

    def weighed(inside, u, inverse):
        # Lanes outside must stay finite: 0 · ∞ would be NaN in the derivatives.
        u, inverse = dr.select(inside, u, corner), dr.select(inside, inverse, 0)
        return kernel.value(u) * dr.abs(inverse)

    def hit():
        density = weighed(
            in_upper | in_lower,
            dr.select(in_upper, u_upper, u_lower),
            dr.select(in_upper, inverse_upper, inverse_lower),
        )
        return add_where(
            density, in_upper & in_lower, lambda: weighed(in_lower, u_lower, inverse_lower), active
        )

    density = add_where(mi.Float(0), in_upper | in_lower, hit, active)

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
    """The position-normal manifold: texels as vertices of triangles, without any search structure.

    Belongs to the variant of Mitsuba that is active when it is made.

    Args:
        normal_map (NormalMap): the map.
        kernel (str): ``gaussian``, ``disk`` or ``box``, see :mod:`glintbsdf.footprint.kernels`.
        epsilon (float): smallest Jacobian determinant |det J| of a triangle, in (0, 1).
        owner (str): the name that errors give, usually the plugin's.

    Attributes:
        data (mi.TensorXf): the projected normals, H×W×2. Derivatives flow through it; after a
            change of its values, :meth:`parameters_changed` rebuilds what depends on them.

    Raises :class:`~.ParameterError`.
    """

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
        self.data = mi.TensorXf(normal_map.normals)
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
        """As :meth:`normal_at`, and what :func:`frame_in_quad` tells besides."""
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
        """Check new data, and take them up. Derivatives keep flowing to them."""
        if keys and "data" not in keys:
            return
        self.normal_map = NormalMap(
            self.data.numpy(), wrap_mode=self.normal_map.wrap_mode, owner=self.owner
        )
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
