"""4D Gaussian lobes in 32 bytes each, and what a footprint sees of them.

A lobe is a Gaussian in (x, y, n_x, n_y). Its covariance is kept as the factors

    S = L Lᵀ        cross-covariance B Lᵀ        normals B Bᵀ + Q Qᵀ

of the positions' covariance S and the normals' covariance. B says how normals change over the lobe,
whose Jacobian is B L⁻¹; Q says how much they vary in one place. With the footprint's centre d and
covariance Σ = V Vᵀ seen from the lobe's mean and scaled by L⁻¹, so that S becomes the unit matrix,

    T = I + Σ      |T| = 1 + tr Σ + |Σ|      T⁻¹ = (I + adj Σ) / |T|      Σ T⁻¹ = (Σ + |Σ| I) / |T|
    mass N(d; 0, T)      normals N(· ; s + B T⁻¹ d, B Σ T⁻¹ Bᵀ + Q Qᵀ + σ_r² I)

which is :mod:`glintbsdf.pndf.gaussian_elements` in units where S = I: nothing large is inverted,
and all sums are of terms of one sign. Where the half vector turns by H over the footprint, normals
are seen relative to it: B becomes B − H L, and s becomes s + H L d.
"""

from __future__ import annotations

from math import pi

import drjit as dr
import mitsuba as mi
import numpy as np

from glintbsdf.pndf.elements.elements import FADE
from glintbsdf.pndf.gaussian_elements import AveragedGaussian, Gaussian
from glintbsdf.pndf.manifold.mesh import cross

#: Standard deviations of a lobe's normals beyond which they are left out. This loses 1.5e-4 of the
#: mass at most, whether all lobes spread normals alike in both directions, or a footprint sees each
#: lobe at its rim, where its mean is as far off as the footprint is.
NORMAL_CUT = 4.2


def factors(covariance: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """L, B and Q of the covariances N×4×4: N×2×2 each, L and Q lower triangular.

    Q Qᵀ is a Schur complement, which rounding may leave just below zero: its roots are then 0.
    """
    root = np.linalg.cholesky(covariance[:, :2, :2])
    b = np.linalg.solve(root, covariance[:, :2, 2:]).transpose(0, 2, 1)
    rest = covariance[:, 2:, 2:] - b @ b.transpose(0, 2, 1)
    q = np.zeros_like(rest)
    q[:, 0, 0] = np.sqrt(np.maximum(rest[:, 0, 0], 0))
    positive = q[:, 0, 0] > 0
    q[:, 1, 0] = np.where(positive, rest[:, 1, 0] / np.where(positive, q[:, 0, 0], 1), 0)
    q[:, 1, 1] = np.sqrt(np.maximum(rest[:, 1, 1] - q[:, 1, 0] ** 2, 0))
    return root, b, q


def pack(mass: np.ndarray, mean: np.ndarray, covariance: np.ndarray, extent: float) -> np.ndarray:
    """Lobes as N×8 words of two 16-bit numbers, the lower one first.

    ====  =============================================================
    0     mean position (x, y), 65535 for ``extent`` texels
    1     mass / extent², and as all that follow in half precision:
          L⁻¹_xx, in 1/texels
    2     mean normal (x, y), 65535 for the range from −1 to 1
    3     √ trace(B Bᵀ + Q Qᵀ), the spread of the normals, and Q_xx
    4     L⁻¹_yx, L⁻¹_yy
    5     Q_yx, Q_yy
    6, 7  B_xx, B_xy; B_yx, B_yy
    ====  =============================================================

    Args:
        mass: N; a mass of 0 stands for no lobe.
        mean, covariance: N×4 and N×4×4, in texels and units of projected normals.
        extent: largest coordinate of a position, texels.
    """
    covariance = np.where((mass > 0)[:, None, None], covariance, np.eye(4))
    root, b, q = factors(covariance)
    inverse = np.linalg.inv(root)
    spread = np.sqrt(np.trace(covariance[:, 2:, 2:], axis1=1, axis2=2))

    def fixed(value: np.ndarray) -> np.ndarray:
        return np.round(65535 * np.clip(value, 0, 1)).astype(np.uint16)

    def half(value: np.ndarray) -> np.ndarray:
        return value.astype(np.float16).view(np.uint16)

    numbers = (
        (fixed(mean[:, 0] / extent), fixed(mean[:, 1] / extent)),
        (half(mass / extent**2), half(inverse[:, 0, 0])),
        (fixed(0.5 + 0.5 * mean[:, 2]), fixed(0.5 + 0.5 * mean[:, 3])),
        (half(spread), half(q[:, 0, 0])),
        (half(inverse[:, 1, 0]), half(inverse[:, 1, 1])),
        (half(q[:, 1, 0]), half(q[:, 1, 1])),
        (half(b[:, 0, 0]), half(b[:, 0, 1])),
        (half(b[:, 1, 0]), half(b[:, 1, 1])),
    )
    words = [low.astype(np.uint32) | (high.astype(np.uint32) << 16) for low, high in numbers]
    return np.stack(words, axis=1)


class Lobe:
    """One packed lobe per lane: where its normals are. Most queries need not know more of it.

    Args:
        words (mi.UInt32): all packed lobes, flat.
        index (mi.UInt32): which one.
        active (mi.Bool): which lanes have a lobe.

    Attributes:
        mean_normal (mi.Vector2f): s, the mean normal, wherever the footprint.
        spread (mi.Float): standard deviation of the normals, the root of the covariance's trace.
    """

    def __init__(self, words, index, active) -> None:
        self.words, self.index, self.active = words, index, active
        self.packed = dr.gather(mi.Vector4u, words, 2 * index, active)
        self.mean_normal = normal_of(self.packed.z)
        self.spread = halves(self.packed.w)[0]

    def may_show(self, m: mi.Vector2f, variance: mi.Float, turned: mi.Float | None) -> mi.Bool:
        """Whether ``m`` is near the lobe's normals.

        ``variance``: σ_r² and what a light's spread adds. ``turned``: standard deviation of the
        half vector over the footprint; None where it does not turn.
        """
        variance = dr.fma(self.spread, self.spread, variance)
        if turned is not None:
            variance = dr.square(dr.sqrt(variance) + turned)
        return dr.squared_norm(m - self.mean_normal) < NORMAL_CUT**2 * variance

    def under(self, offset, extent, vectors, cross_squared) -> SeenLobe:
        """The lobe under a footprint.

        Args:
            offset (mi.Vector2f): the footprint's centre, from the origin of the lobe's positions,
                texels.
            extent (mi.Float): ``extent`` of :func:`pack`.
            vectors: two ``mi.Vector2f``, whose outer products make up the footprint's covariance.
            cross_squared (mi.Float): the determinant of that covariance.
        """
        return SeenLobe(self, offset, extent, vectors, cross_squared)


class SeenLobe:
    """A :class:`Lobe` under a footprint, see :meth:`Lobe.under`."""

    def __init__(self, lobe: Lobe, offset, extent, vectors, cross_squared) -> None:
        self.lobe, active = lobe, lobe.active
        self.mass, xx = halves(lobe.packed.y)
        self.yx, yy = halves(dr.gather(mi.UInt32, lobe.words, 8 * lobe.index + 4, active))
        # Lanes without a lobe stay finite: their derivatives would be NaN
        self.xx, self.yy = dr.select(active, xx, 1), dr.select(active, yy, 1)
        self.vectors = tuple(self.scaled(v) for v in vectors)
        self.determinant = cross_squared * dr.square(self.xx * self.yy)
        first, second = self.vectors
        trace = dr.squared_norm(first) + dr.squared_norm(second)
        self.root = dr.rsqrt(1 + trace + self.determinant)  # |T|^(−1/2)
        packed = lobe.packed.x
        position = extent * (1 / 65535) * mi.Vector2f(low(packed), high(packed))
        self.d = self.scaled(offset - position)

    def scaled(self, v: mi.Vector2f) -> mi.Vector2f:
        """L⁻¹ v."""
        return mi.Vector2f(self.xx * v.x, dr.fma(self.yx, v.x, self.yy * v.y))

    def weight(self, cut: mi.Float) -> mi.Float:
        """The lobe's mass under the footprint, but for a factor common to all lobes of a level.

        It fades to 0 up to the squared distance ``cut``, in standard deviations of footprint and
        lobe together.
        """
        distance = scaled_distance(self.vectors, self.d, self.root)
        density = self.xx * self.yy * self.root * dr.exp(-0.5 * distance)
        share = dr.clip((cut - distance) * (1 / FADE), 0, 1)
        return dr.select(self.lobe.active, self.mass * density * share, 0)

    def normals(self, turn: mi.Matrix2f | None = None) -> SeenNormals:
        """The normals that the footprint sees.

        ``turn``: H of the half vector, per texel of the lobe's positions; None for zero.
        """
        lobe, d, mean = self.lobe, self.d, self.lobe.mean_normal
        packed = dr.gather(mi.Vector4u, lobe.words, 2 * lobe.index + 1, lobe.active)
        q_xx = halves(lobe.packed.w)[1]
        q_yx, q_yy = halves(packed.y)
        b = mi.Matrix2f(*halves(packed.z), *halves(packed.w))
        if turn is not None:
            inverse_x, inverse_y = dr.rcp(self.xx), dr.rcp(self.yy)
            turned = turn @ mi.Matrix2f(
                inverse_x, 0, -self.yx * inverse_x * inverse_y, inverse_y
            )  # H L
            b, mean = b - turned, mean + turned @ d
        shift = mi.Vector2f(d)  # T⁻¹ d |T|
        for v in self.vectors:
            shift = shift + mi.Vector2f(-v.y, v.x) * cross(v, d)
        # The Cholesky root of Σ T⁻¹, whose determinant is |Σ| / |T|
        first, second = self.vectors
        xx = dr.fma(first.x, first.x, dr.fma(second.x, second.x, self.determinant))
        xy = dr.fma(first.x, first.y, second.x * second.y)
        inverse = dr.rsqrt(xx)
        column = self.root * inverse * mi.Vector2f(xx, xy)
        height = dr.sqrt(self.determinant) * inverse
        return SeenNormals(
            mean + dr.square(self.root) * (b @ shift),
            (b @ column, height * mi.Vector2f(b[0, 1], b[1, 1])),
            (q_xx, q_yx, q_yy),
        )


class SeenNormals:
    """A Gaussian of normals with the covariance U Uᵀ + Q Qᵀ + σ_r² I.

    Args:
        mean (mi.Vector2f): mean of the normals.
        vectors: the two columns of U, ``mi.Vector2f``: how much normals vary over the footprint.
        rest: Q_xx, Q_yx, Q_yy: how much they vary in one place.
    """

    def __init__(self, mean: mi.Vector2f, vectors: tuple, rest: tuple) -> None:
        self.mean, self.vectors, self.rest = mean, vectors, rest

    def eval(self, m: mi.Vector2f, variance: mi.Float, ellipse: tuple = ()) -> mi.Float:
        """The density at ``m``, averaged over an ``ellipse``, which may be empty; ``variance``:
        σ_r² > 0.

        As for positions: scaled by K⁻¹, K Kᵀ = Q Qᵀ + σ_r² I, the covariance is I + U Uᵀ, whose
        determinant and quadratic form are sums of squares.
        """
        q_xx, q_yx, q_yy = self.rest
        inverse_x = dr.rsqrt(dr.fma(q_xx, q_xx, variance))
        slope = q_xx * q_yx * dr.square(inverse_x)
        # q_yx² − slope² / inverse_x², without a difference
        tilt = q_yx * inverse_x
        inverse_y = dr.rsqrt(dr.fma(q_yy, q_yy, dr.fma(variance, dr.square(tilt), variance)))

        def scaled(v: mi.Vector2f) -> mi.Vector2f:
            return mi.Vector2f(v.x * inverse_x, dr.fma(-slope, v.x, v.y) * inverse_y)

        first, second = (scaled(v) for v in self.vectors)
        if ellipse:
            lobe = AveragedGaussian(Gaussian((first, second), 1.0), [scaled(v) for v in ellipse])
            return inverse_x * inverse_y * lobe.eval(scaled(m - self.mean))
        trace = dr.squared_norm(first) + dr.squared_norm(second)
        root = dr.rsqrt(1 + trace + dr.square(cross(first, second)))
        distance = scaled_distance((first, second), scaled(m - self.mean), root)
        return inverse_x * inverse_y * root * (0.5 / pi) * dr.exp(-0.5 * distance)

    def sample(self, normal: mi.Vector2f, variance: mi.Float) -> mi.Vector2f:
        """Draw from it, given two standard normal numbers."""
        q_xx, q_yx, q_yy = self.rest
        vectors = (*self.vectors, mi.Vector2f(q_xx, q_yx), mi.Vector2f(0, q_yy))
        return self.mean + Gaussian(vectors, variance).sample(normal)


def scaled_distance(vectors: tuple, d: mi.Vector2f, root: mi.Float) -> mi.Float:
    """dᵀ (I + V Vᵀ)⁻¹ d for the columns V; ``root`` is the determinant to the power −1/2."""
    distance = dr.squared_norm(d)
    for v in vectors:
        distance = dr.fma(cross(v, d), cross(v, d), distance)
    return distance * dr.square(root)


def low(word: mi.UInt32) -> mi.Float:
    """The lower sixteen bits as a number."""
    return mi.Float(word & 0xFFFF)


def high(word: mi.UInt32) -> mi.Float:
    """The upper sixteen bits as a number."""
    return mi.Float(word >> 16)


def halves(word: mi.UInt32) -> tuple[mi.Float, mi.Float]:
    """The two half-precision numbers in a word; a half's exponent is 112 less than a float's."""
    return tuple(
        dr.reinterpret_array(mi.Float, ((half & 0x7FFF) << 13) | ((half & 0x8000) << 16)) * 2.0**112
        for half in (word & 0xFFFF, word >> 16)
    )


def normal_of(word: mi.UInt32) -> mi.Vector2f:
    """A packed normal."""
    return mi.Vector2f(low(word), high(word)) * (2 / 65535) - 1
