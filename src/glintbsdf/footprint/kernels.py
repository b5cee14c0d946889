"""Footprint kernels k(u − x) on the texel lattice.

A footprint is a Gaussian in UV (``footprint.py``); a P-NDF weighs the texels it covers with one of
three kernels, all defined in the whitened footprint, where ρ is the Mahalanobis distance, and all
of unit integral:

* ``gaussian``: exp(−ρ²/2), cut at ρ ≤ 3 and renormalised;
* ``disk``: uniform over ρ ≤ 1.5;
* ``box``: uniform over |Δu| ≤ 1.5 σ_u, |Δv| ≤ 1.5 σ_v, with σ_u, σ_v the standard deviations along
  the axes.

All three end at an edge, which moves with the footprint. What a footprint loses and gains there is
part of the derivative of every average under it, though no value shows it: without it, the integral
of a Gaussian kernel would seem to fall by a tenth as its standard deviation grows by one. So
derivatives see an edge of some width (:data:`EDGE`), centred on the true one; then the derivatives
of the kernel's integral and of its mean are exact. Values see the sharp edge.

Positions are in texels: texel (row i, column j) has its centre at (j, i).
"""

from __future__ import annotations

from math import exp, pi, sqrt

import drjit as dr
import mitsuba as mi
import numpy as np

from glintbsdf.core.errors import check_choice
from glintbsdf.core.opaque import opaque
from glintbsdf.footprint.gaussian import Footprint

KERNELS = ("gaussian", "disk", "box")

#: Reach of each kernel in standard deviations.
REACH = {"gaussian": 3.0, "disk": 1.5, "box": 1.5}

#: Variance of each kernel for a footprint of unit variance: they are cut off.
VARIANCE = {
    "gaussian": 1 - 4.5 * exp(-4.5) / (1 - exp(-4.5)),
    "disk": 1.5**2 / 4,
    "box": 1.5**2 / 3,
}

#: Width of the edge that derivatives see: in ρ², for the box as a share of its half extents. The
#: derivative of the kernel's variance is off by the square of it, 1 % for the disk.
EDGE = {"gaussian": 1.0, "disk": 0.5, "box": 0.1}

#: Standard deviation (texels) of the isotropic Gaussian added to every footprint, so that one of no
#: extent still has a density, the "finest answer". A footprint of half a texel widens by 0.01 %.
SIGMA_MIN = 1 / 128

#: Largest standard deviation (maps) of a footprint. Repeated over the map, a Gaussian one map wide
#: is uniform to 5e-9 (Poisson summation); cut at ρ = 3, to 2e-3. A wider one only costs more.
SIGMA_MAX = 1.0

#: Rows at which :meth:`TexelKernel.masses_in_quad` looks.
ROWS_OF_QUAD = 8

#: Keeps square roots, and their derivatives, of a round footprint finite.
TINY = 1e-20


def difference_of_products(a, b, c, d):
    """a b − c d without cancellation (Kahan: a fused multiply-add recovers the rounding error)."""
    cd = c * d
    return dr.fma(a, b, -cd) + dr.fma(-c, d, cd)


def limit_extent(du, dv):
    """Limit the principal standard deviations of Σ = du duᵀ + dv dvᵀ to :data:`SIGMA_MAX`.

    ``du``, ``dv`` are in UV (``mi.Vector2f``). Returns two vectors with the limited covariance:
    ``du`` and ``dv`` where nothing is to be limited, principal axes elsewhere. It works on the
    factor, never on Σ, so that a footprint 10⁸ times longer than the map is limited, and keeps its
    width.
    """
    longer = dr.squared_norm(du) >= dr.squared_norm(dv)
    a, b = dr.select(longer, du, dv), dr.select(longer, dv, du)
    length = dr.norm(a)
    found = length > 0
    along = dr.select(found, a / dr.select(found, length, 1), mi.Vector2f(1, 0))
    # In axes along and across a, and in units of its length, a is (1, 0) and b is (p, q).
    per_length = dr.rcp(dr.select(found, length, 1))
    p = dr.dot(along, b) * per_length
    q = difference_of_products(along.x, b.y, along.y, b.x) * per_length
    half = 0.5 * (1 + (p - q) * (p + q))  # of the difference of the variances, ≥ p² ≥ 0
    radius = dr.sqrt(dr.fma(half, half, p * p * q * q) + TINY)
    larger = half + radius + q * q  # eigenvalue, in [1, 2]; the smaller one is q²/larger
    across, tilt = mi.Vector2f(-along.y, along.x), mi.Vector2f(half + radius, p * q)
    tilt = tilt * dr.rsqrt(dr.squared_norm(tilt))
    major = along * tilt.x + across * tilt.y
    minor = across * tilt.x - along * tilt.y

    root = dr.sqrt(larger)
    sigma_major, sigma_minor = length * root, length * dr.abs(q) / root
    above = sigma_major > SIGMA_MAX
    return (
        dr.select(above, major * dr.minimum(sigma_major, SIGMA_MAX), du),
        dr.select(above, minor * dr.minimum(sigma_minor, SIGMA_MAX), dv),
    )


def ramp(x):
    """Rises from 0 to 1 as ``x`` goes from −½ to ½."""
    return dr.clip(x + 0.5, 0, 1)


def without_value(x):
    """Zero, with the derivative of ``x``."""
    return x - dr.detach(x)


class TexelKernel:
    """The kernel of one footprint per lane, over a map of ``width`` × ``height`` texels.

    Σ is factored row first: with σ_v the standard deviation over rows, ``shear`` = Σ_uv/Σ_vv and
    σ_{u|v} the standard deviation of u given v,

        ρ² = (Δv/σ_v)² + ((Δu − shear Δv)/σ_{u|v})².

    The determinant comes from the factor's cross product, so rank-one and 1000:1 footprints keep
    their digits.

    Args:
        added (texels²): variance added to Σ along u and v, :data:`SIGMA_MIN` squared by default.

    Attributes:
        du, dv (mi.Vector2f): the footprint's axes in texels, limited, before ``added``.
        minor_variance (mi.Float): smaller eigenvalue of Σ, texels².
        mean (mi.Point2f): centre in texels, reduced to the first period of a repeated map.
        half_u, half_v (mi.Float): half extents in texels of the kernel's support.
        reach_u, reach_v (mi.Float): half extents of what counts; a little more than the support
            where derivatives are taken.
    """

    def __init__(
        self,
        kernel: str,
        footprint: Footprint,
        height: int,
        width: int,
        wrap_mode: str,
        added: tuple = (SIGMA_MIN**2, SIGMA_MIN**2),
    ) -> None:
        check_choice("TexelKernel", "kernel", kernel, KERNELS)
        self.kernel = kernel
        uv = footprint.uv
        if wrap_mode == "clamp":
            # The strips beyond the edges are constant: six maps outside looks like any further.
            uv = dr.clip(uv, -6.0, 7.0)
        else:
            period = 2 if wrap_mode == "mirror" else 1
            uv = uv - period * dr.floor(uv * (1 / period))
        # Kernels are the same for maps of all sizes.
        size = mi.Vector2f(*(opaque(mi.Float, count) for count in (width, height)))
        self.mean = mi.Point2f(dr.fma(uv, size, -0.5))

        du, dv = limit_extent(footprint.du, footprint.dv)
        du, dv = self.du, self.dv = du * size, dv * size
        own_u, own_v = dr.fma(du.x, du.x, dv.x * dv.x), dr.fma(du.y, du.y, dv.y * dv.y)
        added_u, added_v = added
        variance_u, variance_v = own_u + added_u, own_v + added_v
        covariance = dr.fma(du.x, du.y, dv.x * dv.y)
        cross = difference_of_products(du.x, dv.y, du.y, dv.x)
        determinant = dr.fma(cross, cross, added_u * own_v + added_v * variance_u)

        # The smaller eigenvalue from the larger one, as their difference cancels.
        half = 0.5 * (variance_u - variance_v)
        radius = dr.sqrt(dr.fma(half, half, covariance * covariance + TINY))
        self.minor_variance = determinant / (0.5 * (variance_u + variance_v) + radius)

        self.sigma_u, self.sigma_v = dr.sqrt(variance_u), dr.sqrt(variance_v)
        self.shear = covariance / variance_v
        self.sigma_u_given_v = dr.sqrt(determinant / variance_v)
        self.inverse_u_given_v = dr.rcp(self.sigma_u_given_v)
        self.inverse_v = dr.rcp(self.sigma_v)
        self.cut_at(REACH[kernel], EDGE[kernel])

    def cut_at(self, reach: float | mi.Float, edge: float = 0.0) -> None:
        """Cut the kernel at this Mahalanobis distance (the box: so many standard deviations).

        ``edge`` is the width that derivatives see, see :data:`EDGE`.
        """
        self.edge = edge if dr.grad_enabled((self.mean, self.du, self.dv)) else 0.0
        self.reach = self.cut = reach
        self.half_u, self.half_v = reach * self.sigma_u, reach * self.sigma_v
        if self.edge:
            self.reach = (
                reach * (1 + 0.5 * edge) if self.kernel == "box" else sqrt(reach**2 + 0.5 * edge)
            )
        self.reach_u, self.reach_v = self.reach * self.sigma_u, self.reach * self.sigma_v
        if self.kernel == "box":
            self.peak = dr.rcp(4 * self.half_u * self.half_v)
            return
        gaussian = self.kernel == "gaussian"
        mass = 2 * pi * (1 - dr.exp(-0.5 * reach**2)) if gaussian else pi * reach**2
        self.peak = self.inverse_u_given_v * self.inverse_v / mass
        # Row at which the ellipse reaches furthest to the right.
        self.row_of_reach_u = self.reach * self.shear * dr.square(self.sigma_v) / self.sigma_u

    def whitened(self, offset):
        """The linear map of an offset (texels) to a vector of length ρ (not for the box)."""
        return mi.Vector2f(
            dr.fma(-self.shear, offset.y, offset.x) * self.inverse_u_given_v,
            offset.y * self.inverse_v,
        )

    def value(self, offset, edge: bool = True):
        """k(Δ) in 1/texel², for ``offset`` Δ = u − x in texels.

        ``edge``: whether the derivative includes the motion of the kernel's edge across ``offset``.
        """
        if self.kernel == "box":
            u, v = dr.abs(offset.x), dr.abs(offset.y)
            value = dr.select((u <= self.half_u) & (v <= self.half_v), self.peak, 0)
            if not edge or not self.edge:
                return value
            inside_u, inside_v = (
                ramp((1 - x / half) * (1 / self.edge))
                for x, half in ((u, self.half_u), (v, self.half_v))
            )
            return value + self.peak * without_value(inside_u * inside_v)
        rho2 = dr.squared_norm(self.whitened(offset))
        gaussian = self.kernel == "gaussian"
        value = self.peak * dr.exp(-0.5 * rho2) if gaussian else self.peak
        value = dr.select(rho2 <= self.cut**2, value, 0)
        if not edge or not self.edge:
            return value
        height = self.peak * exp(-0.5 * self.cut**2) if gaussian else self.peak
        return value + height * without_value(ramp((self.cut**2 - rho2) * (1 / self.edge)))

    def counts(self, weight, active):
        """Where ``active`` and a weight from :meth:`value`, or its derivative, is not 0: beyond the
        kernel's edge weights are 0, but the edge may move there."""
        return active if self.edge else active & (weight > 0)

    def sample(self, sample):
        """Draw an offset Δ (texels) with density k from ``sample`` in [0, 1)²."""
        reach = self.cut
        if self.kernel == "box":
            return mi.Vector2f(
                self.half_u * dr.fma(2, sample.x, -1), self.half_v * dr.fma(2, sample.y, -1)
            )
        if self.kernel == "disk":
            rho = reach * dr.sqrt(sample.x)
        else:
            rho = dr.sqrt(-2 * dr.log(1 - sample.x * (1 - dr.exp(-0.5 * reach**2))))
        sin_phi, cos_phi = dr.sincos(2 * pi * sample.y)
        v = self.sigma_v * rho * sin_phi
        return mi.Vector2f(dr.fma(self.shear, v, self.sigma_u_given_v * rho * cos_phi), v)

    def masses_in_quad(self, corner):
        """∫ k over both triangles of the unit square at ``corner``, texels from the mean.

        The square is cut along its diagonal from (1, 0) to (0, 1); the triangle at its corner
        (0, 0) comes first. Exact along rows, Gauss and Legendre's rule across them: to some 1e-3,
        unless a footprint much narrower than a texel lies askew.
        """
        top = dr.clip(corner.y, -self.half_v, self.half_v)
        bottom = dr.clip(corner.y + 1, -self.half_v, self.half_v)
        upper, lower = mi.Float(0), mi.Float(0)
        for node, weight in zip(*np.polynomial.legendre.leggauss(ROWS_OF_QUAD), strict=True):
            v = dr.lerp(top, bottom, float(0.5 * node + 0.5))
            middle, half = self.shear * v, self.half_u
            if self.kernel == "box":
                middle = mi.Float(0)
            else:
                z = v * self.inverse_v
                half = self.sigma_u_given_v * dr.safe_sqrt(self.cut**2 - z * z)
            diagonal = corner.x + 1 - (v - corner.y)
            ends = [
                dr.clip(u, middle - half, middle + half) for u in (corner.x, diagonal, corner.x + 1)
            ]
            row = float(0.5 * weight) * (bottom - top) * self.peak
            if self.kernel == "gaussian":
                scale = self.inverse_u_given_v * sqrt(0.5)
                ends = [dr.erf((u - middle) * scale) for u in ends]
                row = row * dr.exp(-0.5 * z * z)
                row = row * self.sigma_u_given_v * sqrt(0.5 * pi)
            upper = dr.fma(row, ends[1] - ends[0], upper)
            lower = dr.fma(row, ends[2] - ends[1], lower)
        return upper, lower

    def touched_quads(self):
        """Number of quads that the support's bounding box touches, on average over its place."""
        return dr.fma(2, self.half_u, 1) * dr.fma(2, self.half_v, 1)

    def row_at(self, v):
        """Extent (left, right) of the support at the height ``v``, all in texels from the mean."""
        if self.kernel == "box":
            return -self.reach_u, self.reach_u
        z = v * self.inverse_v
        half = self.sigma_u_given_v * dr.safe_sqrt(dr.fma(-z, z, self.reach**2))
        return dr.fma(self.shear, v, -half), dr.fma(self.shear, v, half)

    def row_extent(self, top, bottom):
        """Extent (left, right) of the support within the rows [``top``, ``bottom``].

        All in texels from the mean. Exact for the ellipse and for the box.
        """
        if self.kernel == "box":
            return -self.reach_u, self.reach_u

        def edge(sign):
            v = dr.clip(sign * self.row_of_reach_u, top, bottom)
            z = v * self.inverse_v
            half = self.sigma_u_given_v * dr.safe_sqrt(self.reach**2 - z * z)
            return dr.fma(self.shear, v, sign * half)

        return edge(-1), edge(1)


def gaussian_like(kernel: str, footprint: Footprint) -> Footprint:
    """The footprint whose Gaussian, without a cut, has the covariance of ``kernel`` under
    ``footprint``.

    The box has the footprint's variances along u and v, times its own, and no covariance.
    """
    width = sqrt(VARIANCE[kernel])
    if kernel == "box":
        u = dr.norm(mi.Vector2f(footprint.du.x, footprint.dv.x))
        v = dr.norm(mi.Vector2f(footprint.du.y, footprint.dv.y))
        return Footprint(footprint.uv, mi.Vector2f(width * u, 0), mi.Vector2f(0, width * v))
    return Footprint(footprint.uv, width * footprint.du, width * footprint.dv)
