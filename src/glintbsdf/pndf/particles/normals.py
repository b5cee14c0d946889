"""Where facets point: equal shares of a distribution of slopes, as cells of the unit square.

A map of the unit square to the plane of slopes takes equal areas to equal shares of the facets:

    square ──► disk, by Shirley and Chiu's concentric map ──► slopes, by the inverse of the
               distribution function over the squared radius r² = F(|x/α|)

    Beckmann  F = 1 − exp(−ρ)         x = p √(−log(1 − r²))/r
    GGX       F = ρ/(1 + ρ)           x = p/√(1 − r²)                  ρ = |x/α|²

for a point p of the disk, |p| = r. A GGX distribution is thus an evenly filled hemisphere, seen
from above and stretched (Walter et al. 2007).

A facet is not one slope but a small lobe of roughness α_m about its own. For all lobes together to
be the distribution of roughness α, their centres must be a little narrower. Two Beckmann
distributions make a third, of α² = α_c² + α_m². For GGX there is no such law; centres move to

    x = α p s^−½ (1 − κ s − κ² s² (½ + 2 s²)),    s = 1 − r²,  κ = (α_m/α)²

along each axis. The second term is exact to first order in κ, whatever the distribution: a centre
moves up the gradient of log D by half of the lobe's variance. The third is a fit. The mean is then
off by at most 0.1 % of D for α_m = 0.2 α, 0.4 % for 0.3 α, and 7 % for 0.5 α (at x = 0). As a lobe
is no Gaussian but a bell of its variance, Beckmann's is off as well: 0.4 % and 2 %, within 2 α.

Sources: Shirley and Chiu, "A Low Distortion Map Between Disk and Square", JGT 2(3), 1997; Walter et
al., "Microfacet Models for Refraction through Rough Surfaces", EGSR 2007.
"""

from __future__ import annotations

from math import factorial, pi, sqrt

import drjit as dr
import mitsuba as mi

#: The exponent of a facet's lobe, (1 − ρ²/R²)^3 at ρ standard deviations, and R², with which its
#: variance is that of the Gaussian it stands for.
EXPONENT, REACH_SQUARED = 3, 10.0

#: How far a step of length α on the plane of slopes may lead on the unit square, along either axis:
#: half the gradient of the concentric map, √(1 + 16/π²) ≤ 1.62.
STRETCH = 0.81


#: Taylor's coefficients of sin(πt/4)/t and cos(πt/4) in t²: to 4e-7 for |t| ≤ 1.
SINE = [(-1) ** k * (pi / 4) ** (2 * k + 1) / factorial(2 * k + 1) for k in range(4)]
COSINE = [(-1) ** k * (pi / 4) ** (2 * k) / factorial(2 * k) for k in range(5)]


def polynomial(coefficients: list[float], x: mi.Float) -> mi.Float:
    """Σ c_k x^k, by Horner's rule."""
    value = mi.Float(coefficients[-1])
    for c in coefficients[-2::-1]:
        value = dr.fma(value, x, c)
    return value


def square_to_disk(q: mi.Vector2f) -> tuple[mi.Vector2f, mi.Float]:
    """The point p of the unit disk, and 1 − |p|²; ``q`` in (0, 1)²."""
    a, b = dr.fma(2, q.x, -1), dr.fma(2, q.y, -1)
    swap = dr.abs(b) > dr.abs(a)
    r, other = dr.select(swap, b, a), dr.select(swap, a, b)
    t = other / dr.select(r != 0, r, 1)
    squared = dr.square(t)
    along = r * polynomial(COSINE, squared)
    across = other * polynomial(SINE, squared)  # r t = other
    p = mi.Vector2f(dr.select(swap, across, along), dr.select(swap, along, across))
    return p, dr.maximum(dr.fma(-r, r, 1), 2.0**-22)


def disk_to_square(p: mi.Vector2f) -> mi.Vector2f:
    """The inverse of :func:`square_to_disk`."""
    swap = dr.abs(p.y) > dr.abs(p.x)
    along, across = dr.select(swap, p.y, p.x), dr.select(swap, p.x, p.y)
    nonzero = along != 0
    angle = dr.atan(across / dr.select(nonzero, along, 1))
    r = dr.mulsign(dr.norm(p), along)
    other = r * angle * (4 / pi)
    q = mi.Vector2f(dr.select(swap, other, r), dr.select(swap, r, other))
    return dr.fma(0.5, q, 0.5)


class EqualShares:
    """The map between the unit square and the centres of facets.

    Args:
        distribution (str): ``beckmann`` or ``ggx``.
        alpha (mi.Vector2f): α along u and v, of all facets together.
        micro_alpha (mi.Float): α_m of a facet, at most α/2.
    """

    def __init__(self, distribution: str, alpha: mi.Vector2f, micro_alpha: mi.Float) -> None:
        self.distribution, self.alpha = distribution, alpha
        if distribution == "beckmann":
            self.centres = dr.sqrt(dr.maximum((alpha - micro_alpha) * (alpha + micro_alpha), 0))
        else:
            self.kappa = dr.square(micro_alpha / alpha)

    def slope(self, q: mi.Vector2f) -> mi.Vector2f:
        """The slope of the facet at ``q`` in (0, 1)²."""
        p, s = square_to_disk(q)
        if self.distribution == "beckmann":
            r_squared = dr.squared_norm(p)
            few = r_squared < 1e-6
            factor = -dr.log(s) / dr.select(few, 1, r_squared)
            return self.centres * p * dr.sqrt(dr.select(few, 1, factor))
        squared, root = dr.square(s), dr.rsqrt(s)
        second = squared * dr.fma(2, squared, 0.5)
        return mi.Vector2f(
            [
                a * x * root * dr.fma(-k, dr.fma(k, second, s), 1)
                for a, x, k in zip(self.alpha, p, self.kappa, strict=True)
            ]
        )

    def place(self, slope: mi.Vector2f) -> mi.Vector2f:
        """The point of the square around which facets of about this slope lie.

        For GGX, whose centres are moved by less than a tenth of a lobe's width where cells are
        small, the map of the whole distribution takes the place of the centres'.
        """
        if self.distribution == "beckmann":
            x = slope / dr.maximum(self.centres, 1e-8)
            rho = dr.squared_norm(x)
            small = rho < 1e-3
            # √((1 − e^−ρ)/ρ)
            factor = dr.select(small, 1 - 0.5 * rho, (1 - dr.exp(-rho)) / dr.select(small, 1, rho))
            return disk_to_square(x * dr.sqrt(factor))
        x = slope / self.alpha
        return disk_to_square(x * dr.rsqrt(1 + dr.squared_norm(x)))


def lobe(squared_distance: mi.Float) -> mi.Float:
    """A facet's density of slopes, over that of the Gaussian's peak, at ρ² standard deviations."""
    inside = dr.maximum(dr.fma(-1 / REACH_SQUARED, squared_distance, 1), 0)
    return (2 * (EXPONENT + 1) / REACH_SQUARED) * inside * dr.square(inside)


def sample_lobe(sample: mi.Vector2f) -> mi.Vector2f:
    """A vector of standard deviations with the density :func:`lobe`; ``sample`` in [0, 1)²."""
    left = dr.sqrt(dr.sqrt(1 - sample.x))  # (1 − u)^(1/4), 1 − ρ²/R²
    sine, cosine = dr.sincos(2 * pi * sample.y)
    return mi.Vector2f(cosine, sine) * (sqrt(REACH_SQUARED) * dr.sqrt(dr.maximum(1 - left, 0)))


def finest_level(reach: mi.Float, alpha: mi.Vector2f) -> mi.Int:
    """The level m whose 4^m cells of normals are the smallest that hold half a lobe.

    All lobes that reach a point of the square then belong to one of the four nearest cells. Up to
    level 1 there are no more than four.

    Args:
        reach: radius of a lobe, slopes.
    """
    widest = reach / dr.minimum(alpha.x, alpha.y)
    cells = dr.rcp(dr.maximum(2 * STRETCH * widest, 1e-7))
    return dr.clip(mi.Int(dr.floor(dr.log2(cells))), 1, 20)
