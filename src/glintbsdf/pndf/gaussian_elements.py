"""4D Gaussians in position × normal space, seen through a Gaussian footprint.

Yan, Hašan, Marschner and Ramamoorthi, "Position-Normal Distributions for Efficient Rendering of
Specular Microstructure" (2016), section 5.1 and appendix. A lobe G_i has its mean at the position
u_i and the normal s_i, and the positional covariance S. At u = u_i + δu its normals have the mean
s_i + J δu and the covariance R. The paper's elements (Eq. 12 to 14) have S = σ_h² I and R = σ_r² I;
J is 0 for a flat one. The paper's appendix integrates a lobe under the footprint G_p (Eq. 11):

* Eq. 15 to 18 fix s and rewrite G_i as a 2D Gaussian in u, from blocks of the inverse of its 4×4
  covariance;
* Eq. 19 and 20 multiply it by G_p;
* Eq. 21 integrates the product.

Here the same steps have another order, which is stable: first the product over positions (Eq. 19
and 20), then the integral (Eq. 21), and the slice at s last. With G_p = N(u_0, Σ_p), d = u_0 − u_i
and T = Σ_p + S,

    N(u; u_0, Σ_p) N(u; u_i, S) = N(d; 0, T) N(u; u_i + μ, C)        μ = S T⁻¹ d,  C = Σ_p T⁻¹ S
    ∫ N(u; u_0, Σ_p) G_i(u, s) du = N(d; 0, T) N(s; s_i + J μ, R + J C Jᵀ)

:class:`Overlap` has the first line, :meth:`Overlap.normals` the second. The paper's order inverts
matrices with entries like 1/σ_r² (Eq. 14) and then subtracts (Eq. 18). In float32 this leaves no
correct digit for small σ_r. Here nothing large is inverted and nothing is subtracted. All
covariances are sums of outer products v vᵀ, as the footprint's is. Their determinants and quadratic
forms are then sums of squares (Cauchy and Binet: |Σ v vᵀ| = Σ_{k<l} (v_k × v_l)²).
"""

from __future__ import annotations

from itertools import combinations
from math import log, pi, sqrt

import drjit as dr
import mitsuba as mi

from glintbsdf.footprint.kernels import difference_of_products

#: Standard deviation σ_h of an element's position, in steps of the lattice: neighbours have half
#: their height midway between them (Yan et al. 2016, section 4.1).
SIGMA_H = 1 / sqrt(8 * log(2))


def exact_cross(a: mi.Vector2f, b: mi.Vector2f) -> mi.Float:
    """The cross product a_x b_y − a_y b_x of two plane vectors, without cancellation."""
    return difference_of_products(a.x, b.y, a.y, b.x)


class Gaussian:
    """A Gaussian of the plane with mean 0 and covariance ``variance`` I + Σ v vᵀ.

    Args:
        vectors: any number of ``mi.Vector2f``.
        variance (float or mi.Float): ≥ 0.

    Attributes:
        xx, xy, yy, determinant (mi.Float): entries and determinant of the covariance; the
            determinant must be > 0 wherever the Gaussian is evaluated.
        peak (mi.Float): the density at 0.
    """

    def __init__(self, vectors: tuple = (), variance: float | mi.Float = 0.0) -> None:
        self.vectors, self.variance = tuple(vectors), variance
        xx = yy = mi.Float(variance)
        xy, determinant = mi.Float(0), dr.square(mi.Float(variance))
        for v in self.vectors:
            xx, xy, yy = dr.fma(v.x, v.x, xx), dr.fma(v.x, v.y, xy), dr.fma(v.y, v.y, yy)
            determinant = dr.fma(variance, dr.squared_norm(v), determinant)
        for v, w in combinations(self.vectors, 2):
            determinant = determinant + dr.square(exact_cross(v, w))
        self.xx, self.xy, self.yy, self.determinant = xx, xy, yy, determinant
        self.inverse_root = dr.rsqrt(determinant)
        self.peak = self.inverse_root * (1 / (2 * pi))

    def distance_squared(self, d: mi.Vector2f) -> mi.Float:
        """The squared Mahalanobis distance of ``d``."""
        form = self.variance * dr.squared_norm(d)
        for v in self.vectors:
            form = form + dr.square(exact_cross(v, d))
        return form * dr.square(self.inverse_root)

    def eval(self, d: mi.Vector2f, beyond: float | mi.Float = 0.0) -> mi.Float:
        """The density at ``d``, times exp(−``beyond``/2)."""
        return self.peak * dr.exp(-0.5 * (self.distance_squared(d) + beyond))

    def root(self) -> tuple[mi.Vector2f, mi.Vector2f]:
        """Two vectors (a, b) and (0, c) whose outer products add up to the covariance."""
        extended = self.xx > 0
        inverse = mi.Float(dr.select(extended, dr.rsqrt(dr.select(extended, self.xx, 1)), 0))
        # If xx is zero, so is xy, and the determinant does not depend on yy.
        c = dr.select(extended, dr.sqrt(self.determinant) * inverse, dr.sqrt(self.yy))
        return mi.Vector2f(self.xx * inverse, self.xy * inverse), mi.Vector2f(0, c)

    def sample(self, normal: mi.Vector2f) -> mi.Vector2f:
        """A vector with this density, from two standard normal numbers."""
        first, second = self.root()
        return first * normal.x + second * normal.y


#: A uniform disk of radius R, as the real part of complex Gaussians Σ w N(·; 0, v R²/4 I), in pairs
#: (v, w). R²/4 is the variance of the disk along each axis. Mass and variance are exact, as
#: Re Σ w = 1 and Re Σ w v = 1. Of all such sums this one is the nearest to the disk once both are
#: averaged over Gaussians of 0.05 R to 0.5 R: the mean absolute difference is 0.1, 0.05 and 0.01 of
#: the disk for Gaussians of 0.05 R, 0.1 R and 0.2 R. With one pair it is two to ten times as large.
#: (A disk as complex Gaussians: Garcia, "Circular Separable Convolution Depth of Field", SIGGRAPH
#: Talks 2017.)
DISK = (
    (0.49184 + 0.31506j, 1.12056 - 1.55739j),
    (0.07194 + 0.30826j, -0.12056 + 0.10745j),
)


def averaged_over_ellipse(determinants: tuple, forms: tuple, beyond=0.0) -> mi.Float:
    """The density of a Gaussian N(·; 0, Σ) averaged over a uniform ellipse of covariance Λ, times
    exp(−``beyond``/2).

    The ellipse is the image of a disk: the result is Re Σ w N(d; 0, Σ + v Λ), with the pairs (v, w)
    of :data:`DISK`. Where the ellipse is much wider than the Gaussian, it falls below 0 just
    outside, by some hundredths of the largest value.

    Args:
        determinants: the real coefficients of |Σ + v Λ| = D₀ + D₁ v + D₂ v², all ≥ 0.
        forms: those of dᵀ adj(Σ + v Λ) d = F₀ + F₁ v.
    """
    # In units in which the determinant is about 1, no square of it leaves the range of floats.
    unit = dr.rsqrt(determinants[0] + determinants[1] + determinants[2])
    scale = dr.square(unit)
    determinants = tuple(part * scale for part in determinants)
    forms = tuple(part * scale for part in forms)
    total = sum((of_pair(v, w, determinants, forms, beyond) for v, w in DISK), start=mi.Float(0))
    return unit * (1 / (2 * pi)) * total


def of_pair(v: complex, w: complex, determinants: tuple, forms: tuple, beyond) -> mi.Float:
    """2π Re[w N(d; 0, Σ + v Λ)] exp(−``beyond``/2); see :func:`averaged_over_ellipse`."""
    square = v * v
    real = dr.fma(square.real, determinants[2], dr.fma(v.real, determinants[1], determinants[0]))
    imaginary = dr.fma(square.imag, determinants[2], v.imag * determinants[1])
    form, form_i = dr.fma(v.real, forms[1], forms[0]), v.imag * forms[1]
    # The determinant's argument is below two right angles. Here are its modulus and direction.
    inverse_modulus = dr.rsqrt(dr.fma(real, real, dr.square(imaginary)))
    real, imaginary = real * inverse_modulus, imaginary * inverse_modulus
    exponent = dr.fma(form, real, form_i * imaginary) * inverse_modulus + beyond
    phase = dr.fma(form_i, real, -form * imaginary) * inverse_modulus
    # p + i q is w over the root of the direction.
    half = dr.fma(0.5, real, 0.5)
    inverse_g = dr.rsqrt(half)
    g, h = half * inverse_g, 0.5 * imaginary * inverse_g
    p, q = dr.fma(w.imag, h, w.real * g), dr.fma(w.imag, g, -w.real * h)
    sine, cosine = dr.sincos(0.5 * phase)
    return dr.sqrt(inverse_modulus) * dr.exp(-0.5 * exponent) * dr.fma(p, cosine, q * sine)


class AveragedGaussian:
    """A Gaussian averaged over a uniform ellipse; see :func:`averaged_over_ellipse`.

    Args:
        gaussian (Gaussian): its determinant must be > 0 wherever it is evaluated.
        ellipse: vectors l with Σ l lᵀ = Λ, the covariance of the ellipse.
    """

    def __init__(self, gaussian: Gaussian, ellipse: tuple) -> None:
        self.gaussian, self.ellipse = gaussian, tuple(ellipse)
        mixed, own = mi.Float(0), mi.Float(0)
        for k in self.ellipse:
            mixed = dr.fma(gaussian.variance, dr.squared_norm(k), mixed)
            for v in gaussian.vectors:
                mixed = mixed + dr.square(exact_cross(v, k))
        for k, other in combinations(self.ellipse, 2):
            own = own + dr.square(exact_cross(k, other))
        self.determinants = gaussian.determinant, mixed, own

    def eval(self, d: mi.Vector2f, beyond: float | mi.Float = 0.0) -> mi.Float:
        """The density at ``d``, times exp(−``beyond``/2)."""
        form = self.gaussian.variance * dr.squared_norm(d)
        for v in self.gaussian.vectors:
            form = form + dr.square(exact_cross(v, d))
        of_ellipse = mi.Float(0)
        for k in self.ellipse:
            of_ellipse = of_ellipse + dr.square(exact_cross(k, d))
        return averaged_over_ellipse(self.determinants, (form, of_ellipse), beyond)


def point_of_ellipse(ellipse: tuple, sample: mi.Point2f) -> mi.Vector2f:
    """A uniform point of the ellipse whose covariance is Σ l lᵀ of two vectors l."""
    # The radius of a disk is twice its standard deviation along an axis.
    point = 2 * mi.warp.square_to_uniform_disk_concentric(sample)
    return ellipse[0] * point.x + ellipse[1] * point.y


def averaged(gaussian: Gaussian, ellipse: tuple) -> Gaussian | AveragedGaussian:
    """The Gaussian averaged over an ellipse, which may be empty."""
    return AveragedGaussian(gaussian, ellipse) if ellipse else gaussian


class Overlap:
    """The part of a lobe under a footprint.

    If all lobes have the same S, one object per footprint is enough for all.

    Args:
        footprint (Gaussian): Σ_p; may be zero.
        lobe (Gaussian): S, in the same units.

    Attributes:
        total (Gaussian): N(·; 0, T), whose value at d is the lobe's mass under the footprint.
        gain (mi.Matrix2f): S T⁻¹, which takes d to the mean offset μ from the lobe's centre.
        root: two ``mi.Vector2f`` c with Σ c cᵀ = C, the covariance about that mean.
    """

    def __init__(self, footprint: Gaussian, lobe: Gaussian) -> None:
        self.total = Gaussian(footprint.vectors + lobe.vectors, footprint.variance + lobe.variance)
        scale = dr.rcp(self.total.determinant)

        # S T⁻¹ = S adj(Σ_p + S) / |T| = (S adj(Σ_p) + |S| I) / |T|; adj(v vᵀ) = v⊥ v⊥ᵀ
        xx = yy = lobe.determinant + lobe.variance * footprint.variance
        xy = yx = mi.Float(0)
        for v in footprint.vectors:
            across = mi.Vector2f(-v.y, v.x)
            # S v⊥; here v⊥·s = v × s
            image = lobe.variance * across
            for s in lobe.vectors:
                image = image + exact_cross(v, s) * s
            xx, xy = dr.fma(image.x, across.x, xx), dr.fma(image.x, across.y, xy)
            yx, yy = dr.fma(image.y, across.x, yx), dr.fma(image.y, across.y, yy)
        for s in lobe.vectors:
            image = footprint.variance * s
            xx, xy = dr.fma(s.x, image.x, xx), dr.fma(s.x, image.y, xy)
            yx, yy = dr.fma(s.y, image.x, yx), dr.fma(s.y, image.y, yy)
        self.gain = mi.Matrix2f(xx * scale, xy * scale, yx * scale, yy * scale)

        # Σ_p T⁻¹ S = (|Σ_p| S + |S| Σ_p) / |T|, hence |C| = |Σ_p| |S| / |T|
        a, b = footprint.determinant * scale, lobe.determinant * scale
        offset = Gaussian()
        offset.xx = dr.fma(a, lobe.xx, b * footprint.xx)
        offset.xy = dr.fma(a, lobe.xy, b * footprint.xy)
        offset.yy = dr.fma(a, lobe.yy, b * footprint.yy)
        offset.determinant = a * lobe.determinant
        self.root = offset.root()

    def mass(self, d: mi.Vector2f) -> mi.Float:
        """N(d; 0, T): the lobe's mass under the footprint, for ``d`` = u_0 − u_i (Eq. 20)."""
        return self.total.eval(d)

    def mean(self, d: mi.Vector2f) -> mi.Vector2f:
        """μ: the mean offset from u_i under the footprint (Eq. 19)."""
        return self.gain @ d

    def normals(self, jacobian: mi.Matrix2f, roughness: Gaussian) -> Gaussian:
        """N(·; 0, R + J C Jᵀ): the distribution of the lobe's normals about s_i + J μ (Eq. 21).

        ``jacobian`` is J = ∂n/∂u in the units of the positions; ``roughness`` has the covariance R.
        """
        return Gaussian(
            tuple(jacobian @ c for c in self.root) + roughness.vectors, roughness.variance
        )


def lattice_mass(x: mi.Vector2f, xx: mi.Float, xy: mi.Float, yy: mi.Float) -> mi.Float:
    """W: the sum of N(x − k; 0, T) over all integer vectors k, by Poisson's summation formula.

    ``xx``, ``xy``, ``yy`` are the entries of T. Four frequencies are enough, to 3e-6, for every
    T = Σ_p + ``SIGMA_H``² I.
    """
    mass = mi.Float(1)
    # kᵀ T k and k·x for k = (1, 0), (0, 1), (1, 1), (1, −1)
    for form, phase in (
        (xx, x.x),
        (yy, x.y),
        (xx + 2 * xy + yy, x.x + x.y),
        (xx - 2 * xy + yy, x.x - x.y),
    ):
        phase = 2 * pi * (phase - dr.round(phase))
        mass = mass + 2 * dr.exp(-2 * pi**2 * form) * dr.cos(phase)
    return mass
