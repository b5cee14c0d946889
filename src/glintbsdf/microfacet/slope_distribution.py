"""A smooth lobe of microfacet normals: a Beckmann or GGX distribution with any mean slope.

The slope of a unit normal m is ``x = m_xy / m_z``; its density P₂₂ over the plane of slopes gives
the density over the disk of projected normals, ``D(m) = P₂₂(x) / cosθ_m⁴``. A lobe has a mean
slope b and a roughness matrix Ω, ``[[α_u², α_uv], [α_uv, α_v²]]``; with d = x − b

    Beckmann   P₂₂ = exp(−dᵀ Ω⁻¹ d) / (π √|Ω|)             a Gaussian of covariance Ω/2
    GGX        P₂₂ = 1 / (π √|Ω| (1 + dᵀ Ω⁻¹ d)²)

Seen from the direction w, ``w·m = m_z t`` with ``t = w_z + w_xy·x``: everything that depends on a
direction depends on the distribution of this one linear function of the slope, with the mean
``A = w_z + w_xy·b`` and the width ``Z = √(w_xyᵀ Ω w_xy)``.

Sources: Olano and Baker, "LEAN Mapping", I3D 2010 (off-centred slope distributions); Dupuy et al.,
"Linear Efficient Antialiased Displacement and Reflectance Mapping" (LEADR), SIGGRAPH Asia 2013
(their masking and projection); Heitz, "Understanding the Masking-Shadowing Function in
Microfacet-Based BRDFs", JCGT 2014; Heitz and d'Eon, "Importance Sampling Microfacet-Based BSDFs
using the Distribution of Visible Normals", EGSR 2014; Dupuy and Benyoub, "Sampling Visible GGX
Normals with Spherical Caps", HPG 2023.
"""

from __future__ import annotations

from math import pi, sqrt

import drjit as dr
import mitsuba as mi

from glintbsdf.core.loops import symbolic_loop
from glintbsdf.footprint.kernels import difference_of_products

DISTRIBUTIONS = ("beckmann", "ggx")

#: A Gaussian this many standard deviations away from zero counts as on one side of it: facets of a
#: lobe that leans away so far are not seen (their share is below 1e-10).
FAR = 6.0

#: Newton steps of the sampler, at most, where the mean normal faces away; it needs nine.
NEWTON_STEPS = 16


# ------------------------------------------------------------------------------------------------
#  The normal distribution
# ------------------------------------------------------------------------------------------------


def normal_density(z):
    """φ(z), the density of the standard normal distribution."""
    return dr.exp(-0.5 * z * z) * (1 / sqrt(2 * pi))


#: Coefficients of :func:`mills_ratio`, fitted to a relative error of 3e-8 (2.4e-7 in float32).
MILLS = (
    0.24999999064974185, 0.25000222202760297, 0.23428412818061245, 0.20456041564682154,
    0.1477711435874511, 0.1598338345715867, -0.07978229548198329, 0.23990432793241678,
    -0.20287985031542105, 0.04962017810047932,
)  # fmt: skip


def mills_ratio(x):
    """R(x) = (1 − Φ(x)) / φ(x) for x ≥ 0: the normal distribution's tail, without underflow."""
    t = dr.rcp(dr.fma(0.25, x, 1))
    value = mi.Float(MILLS[-1])
    for coefficient in MILLS[-2::-1]:
        value = dr.fma(value, t, coefficient)
    return value * t


def positive_part(a):
    """h(a) = E[max(0, a + z)] of a standard normal z, to a relative 1e-6 for a ≥ −6."""
    x = dr.abs(a)
    tail = normal_density(x) * dr.fma(-x, mills_ratio(x), 1)  # h(−x); h(x) = x + h(−x)
    return dr.maximum(a, 0) + tail


class SlopeLobe:
    """A distribution of normals.

    Args:
        mean (mi.Vector2f): mean slope b.
        uu, vv, uv (mi.Float): entries of the roughness matrix Ω, the squares of roughnesses.
        determinant (mi.Float): |Ω| > 0; the caller knows how to compute it without cancellation.
        distribution (str): ``beckmann`` or ``ggx``.
    """

    def __init__(
        self,
        mean: mi.Vector2f,
        uu: mi.Float,
        vv: mi.Float,
        uv: mi.Float,
        determinant: mi.Float,
        distribution: str = "beckmann",
    ) -> None:
        self.mean, self.determinant, self.distribution = mean, determinant, distribution
        self.uu, self.vv, self.uv = uu, vv, uv
        # Ω = f fᵀ + g gᵀ, Cholesky's factors with the larger diagonal entry first: quadratic forms
        # are sums of squares, which stay positive, and as precise as |Ω|, however thin the lobe.
        u_first = uu >= vv
        first = dr.sqrt(dr.select(u_first, uu, vv))
        second, third = uv / first, dr.sqrt(determinant) / first
        self.f = dr.select(u_first, mi.Vector2f(first, second), mi.Vector2f(second, first))
        self.g = dr.select(u_first, mi.Vector2f(0, third), mi.Vector2f(third, 0))

    def eval(self, s: mi.Vector2f) -> mi.Float:
        """D of the projected normal s: density over the disk; 0 outside."""
        z_squared = 1 - dr.squared_norm(s)
        inside = z_squared > 0
        z_squared = dr.select(inside, z_squared, 1)
        d = s * dr.rsqrt(z_squared) - self.mean
        # d = t f + τ g, and dᵀ Ω⁻¹ d = t² + τ².
        t, tau = (difference_of_products(d.x, v.y, d.y, v.x) for v in (self.g, self.f))
        distance = dr.fma(t, t, tau * tau) / self.determinant
        if self.distribution == "beckmann":
            shape = dr.exp(-distance)
        else:
            shape = dr.rcp(dr.square(1 + distance))
        return dr.select(
            inside, shape * dr.rsqrt(self.determinant) / (pi * dr.square(z_squared)), 0
        )

    def mean_cosine(self, w: mi.Vector3f) -> mi.Float:
        """A: the area of the mean facets seen from w, per unit area of the geometric surface."""
        return w.z + w.x * self.mean.x + w.y * self.mean.y

    def width_squared(self, w: mi.Vector3f) -> mi.Float:
        """Z²."""
        along_f, along_g = (dr.fma(w.x, v.x, w.y * v.y) for v in (self.f, self.g))
        return dr.fma(along_f, along_f, along_g * along_g)

    # --------------------------------------------------------------------------------------------
    #  Visible normals
    # --------------------------------------------------------------------------------------------

    def visible_area(self, w: mi.Vector3f) -> mi.Float:
        """``P(w) = ∫ max(0, w·m) D(m) dω_m``: area of the facets that face w, masking left out.

        It is 0 where practically no facet does, see :data:`FAR`.
        """
        mean, width_squared = self.mean_cosine(w), self.width_squared(w)
        if self.distribution == "ggx":
            root = dr.sqrt(dr.fma(mean, mean, width_squared))
            return 0.5 * dr.select(mean > 0, root + mean, width_squared / (root - mean))
        # A Gaussian of standard deviation Z/√2, part of which may lie below zero.
        partly = dr.square(mean) < 0.5 * FAR**2 * width_squared
        sigma = dr.sqrt(0.5 * dr.select(partly, width_squared, 1))
        part = sigma * positive_part(dr.select(partly, mean, 0) / sigma)
        return dr.select(partly, part, dr.maximum(mean, 0))

    def visible_pdf(self, w: mi.Vector3f, m: mi.Vector3f, density: mi.Float) -> mi.Float:
        """Density of :meth:`sample_visible` per solid angle, given ``density`` = D(m)."""
        area = self.visible_area(w)
        seen = area > 0
        return dr.select(seen, dr.maximum(dr.dot(w, m), 0) * density / dr.select(seen, area, 1), 0)

    def sample_visible(self, w: mi.Vector3f, sample1: mi.Float, sample2: mi.Point2f) -> mi.Vector3f:
        """A unit normal with density ``max(0, w·m) D(m) / P(w)`` per solid angle."""
        if self.distribution == "ggx":
            return self.sample_visible_ggx(w, sample2)
        # Along the direction e of w the slope is weighted by t; across it, given the slope along e,
        # its distribution is a Gaussian.
        plane = mi.Vector2f(w.x, w.y)
        length = dr.norm(plane)
        tilted = length > 0
        e = dr.select(tilted, plane / dr.select(tilted, length, 1), mi.Vector2f(1, 0))
        across = mi.Vector2f(-e.y, e.x)
        variance = 0.5 * self.width_squared(mi.Vector3f(e.x, e.y, 0))
        covariance = 0.5 * sum(dr.dot(e, v) * dr.dot(across, v) for v in (self.f, self.g))
        sigma = dr.sqrt(variance)
        a = self.mean_cosine(w) / dr.maximum(length * sigma, 1e-6)
        z = sample_positive_part(dr.clip(a, -FAR, 1e6), sample1, sample2.x)
        z_across = sqrt(2) * dr.erfinv(dr.clip(dr.fma(2, sample2.y, -1), -ALMOST_ONE, ALMOST_ONE))
        slope = (
            self.mean
            + e * (sigma * z)
            + across * (covariance / sigma * z + 0.5 * dr.sqrt(self.determinant) / sigma * z_across)
        )
        return dr.normalize(mi.Vector3f(slope.x, slope.y, 1))

    def sample_visible_ggx(self, w: mi.Vector3f, sample: mi.Point2f) -> mi.Vector3f:
        """A hemisphere of mirrors, seen from above or below, reflects evenly into a cap."""
        # Ω = [f g] [f g]ᵀ takes the slopes of the hemisphere to those of the lobe.
        along_f, along_g = (dr.fma(w.x, v.x, w.y * v.y) for v in (self.f, self.g))
        wi = dr.normalize(mi.Vector3f(along_f, along_g, self.mean_cosine(w)))
        sin_phi, cos_phi = dr.sincos(2 * pi * sample.x)
        z = dr.fma(1 - sample.y, 1 + wi.z, -wi.z)
        sin_theta = dr.safe_sqrt(1 - z * z)
        h = wi + mi.Vector3f(sin_theta * cos_phi, sin_theta * sin_phi, z)
        slope = self.mean * h.z + self.f * h.x + self.g * h.y
        return dr.normalize(mi.Vector3f(slope.x, slope.y, h.z))


#: The largest number below 1 in float32: keeps erfinv finite.
ALMOST_ONE = 1 - 2**-24


def sample_positive_part(a, sample1, sample2):
    """Draw z with the density ``max(0, a + z) φ(z) / h(a)``, for a in [−6, 1e6].

    For a ≥ 0 it is made of three parts. Within |z| ≤ a, the densities at z and −z add up to
    2 a φ(z): draw |z|, then the sign. Beyond, a φ(z) and z φ(z) have closed inverses. For a < 0 the
    survival function is inverted by Newton's method.
    """
    x = dr.abs(a)
    phi = normal_density(x)
    tail = phi * mills_ratio(x)  # 1 − Φ(x)
    middle = x * (1 - 2 * tail)
    u = sample1 * (middle + x * tail + phi)

    # |z| of the first two parts, then the third's.
    share = dr.select(u < middle, sample2 * (1 - 2 * tail), 1 - 2 * (1 - sample2) * tail)
    size = sqrt(2) * dr.erfinv(dr.minimum(share, ALMOST_ONE))
    z = dr.select((2 * x * u < middle * (x + size)) | (u >= middle), size, -size)
    z = dr.select(u < middle + x * tail, z, dr.sqrt(dr.fma(x, x, -2 * dr.log(1 - sample2))))
    return dr.select(a >= 0, z, sample_above(x, 1 - sample2, a < 0))


def sample_above(x, survival, active):
    """Draw z > x ≥ 0 with a density ∝ (z − x) φ(z): solve S(z) = ``survival`` S(x), where
    ``S(z) = φ(z) (1 − z R(z)) + (z − x) φ(z) R(z) = φ(z) (1 − x R(z))``.

    In q = (z − x)² the logarithm of S falls and is convex, so that Newton's method rises from q = 0
    to the solution without overshooting.
    """

    def step(q):
        z = x + dr.sqrt(q)
        rest = dr.fma(-x, mills_ratio(z), 1)
        excess = dr.log(rest / start) - 0.5 * (z * z - x * x) - log_survival
        return q + 2 * rest * excess

    def advance(q, count, active):
        improved = step(q)
        return improved, count + 1, active & (improved > q * (1 + 1e-6)) & (count < NEWTON_STEPS)

    start = dr.fma(-x, mills_ratio(x), 1)
    log_survival = dr.log(survival)
    with dr.suspend_grad():
        q, _, _ = symbolic_loop(
            (mi.Float(0), mi.UInt32(0), mi.Bool(active)),
            lambda q, count, active: active,
            advance,
            "visible slopes",
        )
    # One more step carries derivatives: at the solution, it has those of the inverse function.
    return x + dr.sqrt(dr.maximum(step(dr.maximum(q, 1e-12)), 1e-12))
