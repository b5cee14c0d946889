"""4D Gaussian lobes in 32 bytes each, and what a footprint sees of them.

A lobe is a Gaussian in (x, y, n_x, n_y). Its covariance is kept as the factors

    S = L Lᵀ        cross-covariance B Lᵀ        normals B Bᵀ + Q Qᵀ

of the positions' covariance S and of those of the normals: B says how they change over the lobe,
its Jacobian being B L⁻¹, and Q how much they vary in one place. With the footprint's centre d and
covariance Σ = V Vᵀ seen from the lobe's mean and scaled by L⁻¹, so that S becomes the unit matrix,

    T = I + Σ      |T| = 1 + tr Σ + |Σ|      T⁻¹ = (I + adj Σ) / |T|      Σ T⁻¹ = (Σ + |Σ| I) / |T|
    mass N(d; 0, T)      normals N(· ; s + B T⁻¹ d, B Σ T⁻¹ Bᵀ + Q Qᵀ + σ_r² I)

which is :mod:`glintbsdf.gaussian_lobes` in units where S = I: nothing large is inverted, and all
sums are of terms of one sign.
"""

from __future__ import annotations

import drjit as dr
import mitsuba as mi
import numpy as np

from ..gaussian_lobes import Gaussian, cross

#: Version of the format, part of the keys of caches.
VERSION = 1


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
    2     L⁻¹_yx, L⁻¹_yy
    3     √ trace(B Bᵀ + Q Qᵀ), the spread of the normals, and Q_xx
    4     mean normal (x, y), 65535 for the range from −1 to 1
    5     Q_yx, Q_yy
    6, 7  B_xx, B_xy; B_yx, B_yy
    ====  =============================================================

    Args:
        mass: N, of which 0 stands for no lobe.
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
        (half(inverse[:, 1, 0]), half(inverse[:, 1, 1])),
        (half(spread), half(q[:, 0, 0])),
        (fixed(0.5 + 0.5 * mean[:, 2]), fixed(0.5 + 0.5 * mean[:, 3])),
        (half(q[:, 1, 0]), half(q[:, 1, 1])),
        (half(b[:, 0, 0]), half(b[:, 0, 1])),
        (half(b[:, 1, 0]), half(b[:, 1, 1])),
    )
    words = [low.astype(np.uint32) | (high.astype(np.uint32) << 16) for low, high in numbers]
    return np.stack(words, axis=1)


class Lobe:
    """One packed lobe per lane, under a footprint.

    Args:
        words (mi.UInt32): all packed lobes, flat.
        index (mi.UInt32): which one.
        extent (mi.Float): that of :func:`pack`.
        vectors: two ``mi.Vector2f``, whose outer products make up the footprint's covariance.
        cross_squared (mi.Float): its determinant.
        active (mi.Bool): which lanes have a lobe; weights are 0 in the others.
    """

    def __init__(self, words, index, extent, vectors, cross_squared, active) -> None:
        self.words, self.index, self.active = words, index, active
        packed = dr.gather(mi.Vector4u, words, 2 * index, active)
        self.position = extent * (1 / 65535) * mi.Vector2f(low(packed.x), high(packed.x))
        self.mass, xx = halves(packed.y)
        self.yx, yy = halves(packed.z)
        # Lanes without a lobe stay finite: their derivatives would be NaN
        self.xx, self.yy = dr.select(active, xx, 1), dr.select(active, yy, 1)
        self.spread, self.q_xx = halves(packed.w)
        self.vectors = tuple(self.scaled(v) for v in vectors)
        self.determinant = cross_squared * dr.square(self.xx * self.yy)
        first, second = self.vectors
        self.trace = dr.squared_norm(first) + dr.squared_norm(second)
        self.scale = dr.rcp(1 + self.trace + self.determinant)  # 1/|T|

    def scaled(self, v: mi.Vector2f) -> mi.Vector2f:
        """L⁻¹ v."""
        return mi.Vector2f(self.xx * v.x, dr.fma(self.yx, v.x, self.yy * v.y))

    def weight(self, d: mi.Vector2f) -> tuple[mi.Float, mi.Float]:
        """The lobe's mass under a footprint with the centre ``d``, but for a factor common to all
        lobes of a level, and the squared distance dᵀ T⁻¹ d."""
        d = self.scaled(d)
        distance = dr.squared_norm(d)
        for v in self.vectors:
            distance = distance + dr.square(cross(v, d))
        distance = distance * self.scale
        density = self.xx * self.yy * dr.sqrt(self.scale) * dr.exp(-0.5 * distance)
        return dr.select(self.active, self.mass * density, 0), distance

    def mean_normal(self) -> mi.Vector2f:
        """s, the mean normal, wherever the footprint."""
        return normal_of(dr.gather(mi.UInt32, self.words, 8 * self.index + 4, self.active))

    def normals(self, d: mi.Vector2f, variance: mi.Float) -> tuple[mi.Vector2f, Gaussian]:
        """Mean of the normals seen, and their distribution about it; ``variance``: σ_r²."""
        packed = dr.gather(mi.Vector4u, self.words, 2 * self.index + 1, self.active)
        q_yx, q_yy = halves(packed.y)
        b = mi.Matrix2f(*halves(packed.z), *halves(packed.w))

        d = self.scaled(d)
        shift = mi.Vector2f(d)  # T⁻¹ d |T|
        for v in self.vectors:
            shift = shift + mi.Vector2f(-v.y, v.x) * cross(v, d)
        # The Cholesky root of Σ T⁻¹, whose determinant is |Σ| / |T|
        first, second = self.vectors
        xx = dr.fma(first.x, first.x, second.x * second.x) + self.determinant
        xy = dr.fma(first.x, first.y, second.x * second.y)
        columns = (
            dr.sqrt(self.scale / xx) * mi.Vector2f(xx, xy),
            mi.Vector2f(0, dr.sqrt(self.determinant / xx)),
        )
        spread = (*(b @ c for c in columns), mi.Vector2f(self.q_xx, q_yx), mi.Vector2f(0, q_yy))
        return normal_of(packed.x) + self.scale * (b @ shift), Gaussian(spread, variance)


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
