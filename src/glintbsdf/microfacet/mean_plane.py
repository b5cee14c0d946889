r"""Masking and shadowing of facets by each other, over the mean plane of the facets in a footprint.

The facets under a footprint have slopes x = m_xy/m_z with the mean s̄. Seen from the direction ω
they cover, per unit of the geometric surface's area,

    P(ω) = mean of max(ω_z + x·ω_xy, 0)        all facets that face ω, each by itself
    P̄(ω) = max(ω_z + s̄·ω_xy, 0)               the plane of slope s̄, the visible area of all facets

and P ≥ P̄, by the convexity of max. Smith's masking is their quotient, G1 = P̄/P: the share of the
facing facets that no other one hides. Its usual form has ω_z for P̄, the geometric surface. That is
right for a patch which is level as a whole; one that leans, as the patch under a small footprint
does, would hide itself from one side, and from the other reflect more than it receives.

With D(m) the distribution of normals and F the reflectance of a facet,

    f_r cosθ_o = F D V/4,        V = G/P̄(ω_i)

and no more is reflected than is received, as ∫ D max(m·ω_i, 0) dω_m = P(ω_i) and V ≤ 1/P(ω_i). V
has a limit where ω_i sees the plane edge on, and keeps it where the plane turns away, since facets
of the patch may still be visible.

The rule is not reciprocal: a pixel sees the mean over the patch, as projected along ω_i. Where
importance is transported, the two directions have changed their roles.

Sources: Heitz, "Understanding the Masking-Shadowing Function in Microfacet-Based BRDFs", JCGT 2014;
Dupuy et al., "Linear Efficient Antialiased Displacement and Reflectance Mapping" (LEADR), SIGGRAPH
Asia 2013, whose rule this is, for a Gaussian lobe.
"""

from __future__ import annotations

from math import pi, sqrt

import drjit as dr
import mitsuba as mi

from glintbsdf.microfacet.slope_distribution import positive_part

#: Facets that cover less than this of the surface, seen from a direction, count as unseen: float32
#: would divide noise by noise.
UNSEEN = 1e-9

#: Lowest height of a normal that counts in a slope: of a vertical facet it would be infinite.
LOWEST = 1e-3

#: Standard deviations beyond which nothing of a Gaussian is left in float32.
FAR = 6.0

#: P of evenly distributed slopes around an edge-on plane, √3/4 of their standard deviation, over
#: that of Gaussian ones, 1/√(2π).
EVEN = sqrt(3) / 4 * sqrt(2 * pi)


def mean_plane_area(w: mi.Vector3f, mean_slope: mi.Vector2f) -> mi.Float:
    """P̄(ω) ≥ 0: area of the plane of slope ``mean_slope`` (m_xy/m_z) seen from the unit vector ω,
    per unit area of the geometric surface."""
    return dr.maximum(slope_along(w, mean_slope), 0)


def choose_areas(condition: mi.Bool, first: tuple, second: tuple) -> tuple[list, mi.Vector2f]:
    """``(areas, mean slope)`` of the first where the condition holds, of the second elsewhere."""
    areas = [dr.select(condition, *pair) for pair in zip(first[0], second[0], strict=True)]
    return areas, dr.select(condition, first[1], second[1])


def slope_along(w: mi.Vector3f, slope: mi.Vector2f) -> mi.Float:
    """``ω·m/m_z`` of a facet of this slope, which is linear in it."""
    return dr.fma(w.x, slope.x, dr.fma(w.y, slope.y, w.z))


def variance_along(w: mi.Vector3f, covariance: tuple) -> mi.Float:
    """Variance of ``ω·m/m_z``; ``covariance`` of the slopes: its entries (xx, xy, yy)."""
    xx, xy, yy = covariance
    return dr.maximum(w.x * w.x * xx + 2 * w.x * w.y * xy + w.y * w.y * yy, 0)


def slope_of(m: mi.Vector2f) -> mi.Vector2f:
    """Slope m_xy/m_z of a projected normal; finite for a vertical facet, and outside the disk."""
    return mi.Vector2f(m) / height_of(m)


def height_of(m: mi.Vector2f) -> mi.Float:
    """m_z of a projected normal, at least :data:`LOWEST`."""
    return dr.maximum(dr.safe_sqrt(1 - dr.squared_norm(m)), LOWEST)


def gradient_along(w: mi.Vector3f, m: mi.Vector2f, z: mi.Float) -> mi.Vector2f:
    """The derivative of ω·m/m_z by the projected normal m; ``z``: m_z."""
    flat = mi.Vector2f(w.x, w.y)
    return (flat + m * (dr.dot(flat, m) / (z * z))) / z


def ggx_area(mean: mi.Float, variance: mi.Float) -> mi.Float:
    """½ (w̄ + √(w̄² + σ²)); 0 for w̄ < 0 and σ = 0.

    It is P of GGX slopes with ω_xyᵀ Ω ω_xy = σ² (Wu24, Eq. 13, around any mean), and the largest P
    that any distribution of ω·m/m_z with the mean w̄ and the variance σ² may have: that of two
    facets (Scarf, "A Min-Max Solution of an Inventory Problem", 1958).
    """
    root = dr.sqrt(dr.maximum(dr.fma(mean, mean, variance), 1e-20))
    return 0.5 * dr.select(mean >= 0, mean + root, variance / dr.select(mean >= 0, 1, root - mean))


def gaussian_area(mean: mi.Float, variance: mi.Float) -> mi.Float:
    """P where ω·m/m_z is a Gaussian with the mean w̄ and the variance σ² ≥ 0; 0 from −6 σ on."""
    partly = mean * mean < FAR**2 * variance
    sigma = dr.sqrt(dr.select(partly, variance, 1))
    part = sigma * positive_part(dr.select(partly, mean, 0) / sigma)
    return dr.select(partly, part, dr.maximum(mean, 0))


def lobe_area(w: mi.Vector3f, m: mi.Vector2f, vectors: tuple, variance: mi.Float) -> mi.Float:
    """P of a Gaussian of projected normals around m, over which slopes count as linear.

    Its covariance is ``variance`` I + Σ v vᵀ.
    """
    z = height_of(m)
    turn = gradient_along(w, m, z)
    spread = variance * dr.squared_norm(turn)
    for v in vectors:
        spread = spread + dr.square(dr.dot(turn, v))
    return gaussian_area(slope_along(w, m / z), spread)


def visibility(p_i, plane_i, p_o, plane_o, height_correlated: bool = True) -> mi.Float:
    """V = G/P̄(ω_i), such that ``f_r cosθ_o = F D V/4``; at most 1/P(ω_i).

    With 1 + Λ = max(P/P̄, 1), G is 1/(1 + Λ(ω_i) + Λ(ω_o)), or the product of both 1/(1 + Λ).

    Args:
        p_i, p_o: P of the direction of view and of the light; below P̄ they count as P̄.
        plane_i, plane_o: P̄ of both. Light from behind the plane does not reach it: V is 0 then.
        height_correlated: whether masking and shadowing count a facet's height once.
    """
    p_i, p_o = dr.maximum(p_i, plane_i), dr.maximum(p_o, plane_o)
    if height_correlated:
        divisor = dr.fma(p_i, plane_o, plane_i * (p_o - plane_o))
    else:
        divisor = p_i * p_o
    seen = (p_i > UNSEEN) & (plane_o > 0) & (divisor > 0)
    return dr.select(seen, plane_o / dr.select(seen, divisor, 1), 0)


def area_of_moments(mean: mi.Float, variance: mi.Float) -> mi.Float:
    """P of facets of which no more is known than mean and variance of ω·m/m_z.

    The largest that it may be, :func:`ggx_area`, is too large by several percent for the facets of
    a map, which are nearer to a Gaussian. So it is taken, with ¾ σ², where the mean plane is seen
    from behind, and in front of it that of a Gaussian with a standard deviation greater by
    :data:`EVEN`, which gives evenly distributed slopes their due. Both meet with the same slope.

    Args:
        mean: w̄ = ω_z + s̄·ω_xy, of either sign.
        variance: σ² ≥ 0.
    """
    gaussian = gaussian_area(dr.maximum(mean, 0), EVEN**2 * variance)
    return dr.select(mean > 0, gaussian, ggx_area(dr.minimum(mean, 0), 0.75 * variance))
