"""The P-NDF of the position-normal manifold, exact.

Wu, Luan, Hašan and Ramamoorthi, "Position-Normal Manifold for Efficient Glint Rendering on
High-Resolution Normal Maps" (2024), section 4.1. The map's texels are the vertices of a triangle
mesh in position × normal space; the P-NDF is that mesh seen along the position axes. The functions
stand in the paper's order and use its symbols.
"""

from __future__ import annotations

from math import sqrt

import drjit as dr
import mitsuba as mi
import numpy as np

from glintbsdf.core.cache import load_or_build
from glintbsdf.core.errors import check, check_choice
from glintbsdf.footprint.domain import Reach
from glintbsdf.footprint.kernels import KERNELS, TexelKernel
from glintbsdf.footprint.lattice import Lattice, floor_int
from glintbsdf.maps.normalmap import NormalMap
from glintbsdf.pndf.index.lists import QuadLists, Window, every_quad

#: Footprints that touch no more quads than this are summed quad by quad; larger ones use the lists.
FEW_QUADS = 25


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


def effective_triangle(a, b, c, diagonal, epsilon):
    """The normal triangle n(Δ) on which sampling, evaluation and all bounds agree.

    ``a``, ``b``, ``c`` (``mi.Vector2f``): projected normals at the vertices. ``diagonal``: those of
    the quad's (n1, n2), between which the replacement of a degenerate triangle is centred. Returns
    the first vertex and the edges ``e1``, ``e2`` from it to the second and third.
    """
    n1, n2 = diagonal
    e1, e2, centre = b - a, c - a, 0.5 * (n1 + n2)
    # To the last digit the determinant of quad_density, so that both find the same ones degenerate.
    tiny = dr.abs(cross(n2 - n1, a - n1)) < epsilon
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
    """As :func:`normal_in_quad`, and the columns of the Jacobian J(u): ``(n, ∂n/∂l1, ∂n/∂l2)``."""
    n0, n1, n2, n3 = normals
    upper = l1 + l2 < 1
    l1, l2 = dr.select(upper, l1, 1 - l1), dr.select(upper, l2, 1 - l2)
    a, e1, e2 = effective_triangle(
        dr.select(upper, n0, n3),
        dr.select(upper, n1, n2),
        dr.select(upper, n2, n1),
        (n1, n2),
        epsilon,
    )
    sign = dr.select(upper, mi.Float(1), -1)
    return a + e1 * l1 + e2 * l2, e1 * sign, e2 * sign


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
        owner (str): whom errors name, usually the plugin.

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
        self.build()

    def build(self) -> None:
        """Make everything that depends on ``self.data``."""
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
        """As :meth:`normal_at`, and the columns of the Jacobian J(u): ``(n, ∂n/∂u_x, ∂n/∂u_y)``."""
        column, row = floor_int(u.x), floor_int(u.y)
        l1, l2 = u.x - column, u.y - row
        n0, n1, n2, n3 = self.quad_normals(
            self.lattice.y.locate(row)[1], self.lattice.x.locate(column)[1], active
        )
        return frame_in_quad(l1, l2, (n0, n1, n2, n3), self.epsilon)

    def texel_kernel(self, footprint) -> TexelKernel:
        """k(u − x) of Eq. 2 for this map."""
        height, width, _ = self.data.shape
        return TexelKernel(self.kernel, footprint, height, width, self.normal_map.wrap_mode)

    def traverse(self, callback: mi.TraversalCallback) -> None:
        callback.put("data", self.data, mi.ParamFlags.Differentiable)

    def parameters_changed(self, keys: list[str] = ()) -> None:
        """Check new data, and rebuild. Derivatives keep flowing to them."""
        if keys and "data" not in keys:
            return
        self.normal_map = NormalMap(
            self.data.numpy(), wrap_mode=self.normal_map.wrap_mode, owner=self.owner
        )
        self.build()

    @property
    def parts(self) -> dict[str, int]:
        """Memory of each part of the structure, bytes."""
        return {"vertices": 4 * dr.width(self.vertices)}

    @property
    def nbytes(self) -> int:
        """Memory of the structure, bytes."""
        return sum(self.parts.values())

    def __repr__(self) -> str:
        height, width, _ = self.data.shape
        return (
            f"{type(self).__name__}[{width}×{height} texels, {self.normal_map.wrap_mode}, "
            f"kernel={self.kernel}, epsilon={self.epsilon:g}, {self.nbytes / 2**20:.1f} MiB]"
        )


class Manifold(TexelMesh):
    """Exact P-NDF of a normal map (Eq. 5) and its exact sampler (Eq. 6).

    Arguments, attributes and errors are those of :class:`TexelMesh`.

    Args:
        reach (Reach): what will be asked; None for anything. Lists are then made of the part of the
            map that it touches, or none where all footprints are summed quad by quad. Evaluation
            within the reach is the same to the last bit.
    """

    def __init__(
        self,
        normal_map: NormalMap,
        kernel: str = "gaussian",
        epsilon: float = 1e-6,
        owner: str = "Manifold",
        reach: Reach | None = None,
    ) -> None:
        self.reach = reach
        self.key = f"manifold {QuadLists.VERSION} {normal_map.content_hash} {epsilon!r}"
        self.cached = load_or_build
        super().__init__(normal_map, kernel, epsilon, owner)
        self.cached = lambda key, build: build()  # of data that change, nothing is kept

    def build(self) -> None:
        """Make everything that depends on ``self.data``; the cache may know the lists already."""
        super().build()
        self.lists = None
        if self.reach is not None and self.reach.most_quads <= FEW_QUADS:
            return
        window = Window.whole(self.lattice)
        if self.reach is not None:
            window = Window.touched(self.lattice, self.reach)
        arrays = self.cached(
            self.key if window == Window.whole(self.lattice) else f"{self.key} {window}",
            lambda: QuadLists.build(
                self.lattice,
                self.effective_triangles,
                self.data.numpy().reshape(-1, 2),
                self.bounds(),
                window,
            ),
        )
        self.lists = QuadLists(self.lattice, arrays, window)

    def bounds(self) -> tuple[np.ndarray, np.ndarray]:
        """Smallest rectangle (lower, upper) of projected normals that holds all triangles."""
        normals = self.data.numpy().reshape(-1, 2)
        reach = equilateral(self.epsilon)[0][1] * 1.001
        return normals.min(0) - reach, normals.max(0) + reach

    def eval(self, m: mi.Vector2f, footprint, active: bool | mi.Bool = True) -> mi.Float:
        """D(m), the density of projected normals over the unit disk (Eq. 5); 0 outside of it.

        ``footprint``: a :class:`~.Footprint`, in the UV space of the map.
        """
        kernel = self.texel_kernel(footprint)
        active = mi.Bool(active) & (dr.squared_norm(m) < 1)
        if self.lists is not None:
            active &= self.lists.covers(m)
        few = kernel.touched_quads() <= FEW_QUADS

        def add(density, row, column, corner, active):
            normals = self.quad_normals(row, column, active)
            added = quad_density(m, corner, kernel, normals, self.epsilon, active)
            return density + dr.select(active, added, 0)

        # In the other order, the lists take a tenth longer on LLVM, even where no footprint is few.
        density = mi.Float(0)
        if self.lists is not None:
            density = self.lists.visit(m, kernel, add, active & ~few)
        return density + every_quad(self.lattice, kernel, add, active & few)

    def sample(
        self, footprint, sample1, sample2: mi.Point2f, active: bool | mi.Bool = True
    ) -> mi.Vector2f:
        """Draw a projected normal with density D (Eq. 6): the normal at a place drawn from k.

        One that falls outside the disk is an invalid sample, as D is 0 there. ``sample1`` is not
        needed.
        """
        kernel = self.texel_kernel(footprint)
        return self.normal_at(kernel.mean + kernel.sample(sample2), active)

    @property
    def parts(self) -> dict[str, int]:
        """Memory of each part of the structure, bytes."""
        lists = 0 if self.lists is None else self.lists.nbytes
        return {**super().parts, "lists of quads": lists}
