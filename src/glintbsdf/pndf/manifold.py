"""The P-NDF of the position-normal manifold (Wu et al. 2024), exact.

The map's texels are the vertices of a triangle mesh in position × normal space; the P-NDF is the mesh seen
along the position axes. Functions stand in the paper's order, with its symbols.
"""

from __future__ import annotations

from math import sqrt

import drjit as dr
import mitsuba as mi

from ..errors import check, check_choice
from ..kernels import KERNELS, TexelKernel


# ----------------------------------------------------------------------------------------------------------------
#  Section 4.1: the mesh
# ----------------------------------------------------------------------------------------------------------------


def floor_int(x):
    """The largest integer ≤ x, as ``mi.Int``."""
    return mi.Int(dr.floor(x))


def cross(a, b):
    """z component of the cross product of two vectors of the plane."""
    return dr.fma(a.x, b.y, -(a.y * b.x))


def effective_triangle(a, b, c, centre, epsilon):
    """The normal triangle n(Δ) that evaluation, sampling and all bounds agree on: (first vertex, edges, |det J|).

    ``a``, ``b``, ``c`` (``mi.Vector2f``): projected normals at the vertices. A triangle with |det J| < ε is replaced
    by an equilateral one around ``centre`` whose Jacobian is exactly ε (paragraph "Preventing Jacobian
    singularity"), barycentric order kept.

    Returns ``(a, e1, e2, det)``, signed det J = e1 × e2 (Eq. 4).
    """
    e1, e2 = b - a, c - a
    det = cross(e1, e2)
    tiny = dr.abs(det) < epsilon
    r = sqrt(2 * epsilon / (3 * sqrt(3)))  # circumradius of an equilateral triangle of area ε/2
    a = dr.select(tiny, mi.Vector2f(centre.x, centre.y + r), a)
    e1 = dr.select(tiny, mi.Vector2f(-sqrt(0.75) * r, -1.5 * r), e1)
    e2 = dr.select(tiny, mi.Vector2f(sqrt(0.75) * r, -1.5 * r), e2)
    return a, e1, e2, dr.select(tiny, epsilon, det)


def quad_triangles(n0, n1, n2, n3, epsilon):
    """The two effective triangles of a quad, (n0, n1, n2) and (n3, n2, n1) (Fig. 3)."""
    centre = 0.5 * (n1 + n2)
    return (
        effective_triangle(n0, n1, n2, centre, epsilon),
        effective_triangle(n3, n2, n1, centre, epsilon),
    )


def intersect(m, triangle):
    """Barycentric coordinates (λ1, λ2) of ``m`` in a triangle, and whether it lies inside (Eq. 5)."""
    a, e1, e2, det = triangle
    q = m - a
    inverse = dr.rcp(det)
    l1, l2 = cross(q, e2) * inverse, cross(e1, q) * inverse
    return l1, l2, (l1 >= 0) & (l2 >= 0) & (l1 + l2 <= 1)


def quad_density(m, corner, kernel, normals, epsilon):
    """Contribution of one quad to D(m) (Eq. 5).

    ``corner`` (``mi.Vector2f``): position of n0 relative to the footprint's mean, texels. ``normals``: (n0, n1, n2, n3).
    """
    upper, lower = quad_triangles(*normals, epsilon)
    l1, l2, hit = intersect(m, upper)
    density = dr.select(hit, kernel.value(corner + mi.Vector2f(l1, l2)) / dr.abs(upper[3]), 0)
    l1, l2, hit = intersect(m, lower)
    return density + dr.select(
        hit, kernel.value(corner + mi.Vector2f(1 - l1, 1 - l2)) / dr.abs(lower[3]), 0
    )


class Manifold:
    """Exact P-NDF of a normal map (Wu24, Eq. 5), with its exact sampler (Eq. 6).

    Args:
        normal_map (NormalMap): the map.
        kernel (str): footprint kernel, ``gaussian``, ``disk`` or ``box``.
        epsilon (float): smallest Jacobian |det J|, > 0.
    """

    def __init__(self, normal_map, kernel: str = "gaussian", epsilon: float = 1e-6, owner="Manifold"):
        check_choice(owner, "kernel", kernel, KERNELS)
        check(0 < epsilon < 1, owner, "epsilon", "between 0 and 1, both excluded", epsilon)
        self.kernel, self.epsilon = kernel, float(epsilon)
        self.normal_map = normal_map
        self.data = mi.TensorXf(normal_map.normals)

    def texel_kernel(self, footprint) -> TexelKernel:
        m = self.normal_map
        return TexelKernel(self.kernel, footprint, m.width, m.height, m.wrap_mode)

    def wrap(self, i, n):
        if self.normal_map.wrap_mode == "clamp":
            return dr.clip(i, 0, n - 1)
        if self.normal_map.wrap_mode == "mirror":
            i = i - mi.Int(dr.floor(mi.Float(i) / (2 * n))) * (2 * n)
            return dr.minimum(i, 2 * n - 1 - i)
        i = i % n
        return dr.select(i < 0, i + n, i)

    def quad_normals(self, i, j, active):
        w, h = self.normal_map.width, self.normal_map.height
        i0, i1 = self.wrap(i, h) * w, self.wrap(i + 1, h) * w
        j0, j1 = self.wrap(j, w), self.wrap(j + 1, w)
        return [
            dr.gather(mi.Vector2f, self.data.array, mi.UInt32(k), active)
            for k in (i0 + j0, i0 + j1, i1 + j0, i1 + j1)
        ]

    @dr.syntax
    def eval(self, m, footprint, active=True):
        kernel = self.texel_kernel(footprint)
        active = mi.Bool(active)
        density = mi.Float(0)
        i = floor_int(kernel.mean.y - kernel.reach_v)
        i_end = floor_int(kernel.mean.y + kernel.reach_v)
        j_first = floor_int(kernel.mean.x - kernel.reach_u)
        j_end = floor_int(kernel.mean.x + kernel.reach_u)
        j = mi.Int(j_first)
        while dr.hint(active & (i <= i_end), max_iterations=-1, exclude=[self, kernel]):
            n = self.quad_normals(i, j, active)
            corner = mi.Vector2f(j, i) - kernel.mean
            density += quad_density(m, corner, kernel, n, self.epsilon)
            j += 1
            last = j > j_end
            j = dr.select(last, j_first, j)
            i = dr.select(last, i + 1, i)
        return dr.select(active & (dr.squared_norm(m) < 1), density, 0)

    def sample(self, footprint, sample1, sample2, active=True):
        kernel = self.texel_kernel(footprint)
        u = kernel.mean + kernel.sample(sample2)
        j, i = floor_int(u.x), floor_int(u.y)
        l1, l2 = u.x - j, u.y - i
        upper, lower = quad_triangles(*self.quad_normals(i, j, active), self.epsilon)
        in_upper = l1 + l2 < 1
        a, e1, e2 = (dr.select(in_upper, p, q) for p, q in zip(upper[:3], lower[:3], strict=True))
        l1, l2 = dr.select(in_upper, l1, 1 - l1), dr.select(in_upper, l2, 1 - l2)
        return a + e1 * l1 + e2 * l2

    def traverse(self, callback):
        callback.put("data", self.data, mi.ParamFlags.Differentiable)

    def parameters_changed(self, keys=()):
        pass

    @property
    def nbytes(self):
        return self.data.array.size * 4 if hasattr(self.data.array, "size") else 0
