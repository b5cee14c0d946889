"""The classic filters of normal maps: one smooth lobe in place of the P-NDF.

Akenine-Möller et al., "Real-Time Rendering" (RTR), 4th edition, 2018, section 9.13.1. Each filter
averages some moments of the normals under the footprint (:mod:`glintbsdf.pndf.filters.moments`).
From the averages, and the base roughness α of the material, it makes a lobe
(:mod:`glintbsdf.microfacet.slope_distribution`). Where a paper uses the variance σ² of slopes, here
α² = 2σ².
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from math import inf, sqrt

import drjit as dr
import mitsuba as mi
import numpy as np

from glintbsdf.core.errors import check, check_choice
from glintbsdf.core.hashing import pcg3d, uniform
from glintbsdf.core.opaque import stored
from glintbsdf.footprint.domain import Domain
from glintbsdf.footprint.gaussian import Footprint
from glintbsdf.footprint.kernels import difference_of_products
from glintbsdf.footprint.query import Query
from glintbsdf.maps.normalmap import MAX_SLOPE, NormalMap, check_texels, map_bytes
from glintbsdf.microfacet.masking import SmithMasking
from glintbsdf.microfacet.mean_plane import mean_plane_area, visibility
from glintbsdf.microfacet.slope_distribution import DISTRIBUTIONS, SlopeLobe
from glintbsdf.pndf.base import PNDF, changed_map, register
from glintbsdf.pndf.filters.moments import MomentPyramid, Spread
from glintbsdf.pndf.gaussian_elements import AveragedGaussian, Gaussian, point_of_ellipse
from glintbsdf.pndf.sharing import shared

# ------------------------------------------------------------------------------------------------
#  Moments: functions of projected normals, and products of deviations from the averages of these
# ------------------------------------------------------------------------------------------------


def slope(s) -> list:
    """The slope ``m_xy / m_z`` of the projected normal s."""
    return list(s * dr.rsqrt(1 - dr.squared_norm(s)))


def unit_normal(s) -> list:
    """The unit normal of the projected normal s, as (x, y, 1 − z): near z = 1 no digit is lost."""
    squared = dr.squared_norm(s)
    return [s.x, s.y, squared / (1 + dr.sqrt(1 - squared))]


#: Variances of slopes along u and v.
VARIANCES: Spread = (((0, 0),), ((1, 1),))

#: Variances of slopes along u and v, and their covariance; LEAN keeps these (Olano and Baker 2010).
COVARIANCE: Spread = (*VARIANCES, ((0, 1),))

#: Sum of the variances of slopes; CLEAN keeps half of it (Baker, "Spectacular Specular: LEAN and
#: CLEAN Specular Highlights", GDC 2011).
TOTAL: Spread = (((0, 0), (1, 1)),)

#: Sum of the variances of the components of unit normals. It is ``1 − l²``, where l is the length
#: of their mean.
TOTAL_3D: Spread = (((0, 0), (1, 1), (2, 2)),)


# ------------------------------------------------------------------------------------------------
#  Lobes: functions of the averages of moments, of α² and of the name of the distribution
# ------------------------------------------------------------------------------------------------


def lean_lobe(averages: list, alpha_squared: mi.Float, distribution: str) -> SlopeLobe:
    """LEAN (Olano and Baker 2010): ``Ω/2 = E[x xᵀ] − b bᵀ + (α²/2) I``.

    Ω is the lobe's squared roughness, a 2×2 matrix; x a slope, b the mean slope. In float32 |Ω| is
    accurate to some 1e-7 of the product of both variances. So lobes with α < 1e-3 are too wide or
    too narrow where all slopes lie on one oblique line.
    """
    x, y, variance_u, variance_v, cross = averages
    variance_u, variance_v = positive(variance_u), positive(variance_v)
    uu, vv, uv = alpha_squared + 2 * variance_u, alpha_squared + 2 * variance_v, 2 * cross
    # |Ω|; rounding must not make the covariance's determinant negative.
    determinant = alpha_squared * (alpha_squared + 2 * (variance_u + variance_v)) + 4 * positive(
        variance_u * variance_v - cross * cross
    )
    return SlopeLobe(mi.Vector2f(x, y), uu, vv, uv, determinant, distribution)


def clean_lobe(averages: list, alpha_squared: mi.Float, distribution: str) -> SlopeLobe:
    """CLEAN (Baker 2011): as LEAN, with the mean of both variances in every direction."""
    x, y, total = averages
    return round_lobe(mi.Vector2f(x, y), alpha_squared + positive(total), distribution)


def variance_lobe(averages: list, alpha_squared: mi.Float, distribution: str) -> SlopeLobe:
    """Variance mapping (RTR 9.13.1; Hill, SIGGRAPH course 2012): ``α'² = α² + 2 variance`` along u
    and v.

    The variances are those in the map's MIP levels. The variance that means add from one sample to
    the next, and from one lookup to the next, is not counted.
    """
    x, y, variance_u, variance_v = averages
    uu, vv = alpha_squared + 2 * positive(variance_u), alpha_squared + 2 * positive(variance_v)
    return SlopeLobe(mi.Vector2f(x, y), uu, vv, mi.Float(0), uu * vv, distribution)


def toksvig_lobe(averages: list, alpha_squared: mi.Float, distribution: str) -> SlopeLobe:
    """Toksvig (2005), RTR Eq. 9.76: the shorter the mean normal, the rougher the lobe.

    The mean normal has the length l. RTR gives ``α_p' = l α_p / (l + α_p (1 − l))`` for the
    exponent of Blinn and Phong. The exponent of a roughness is ``α_p = 2/α² − 2`` (Walter et al.
    2007); RTR uses the same for GGX. With k = (1 − l)/l this is ``α'² = (α² + 2k (1 − α²)) / (1 +
    2k (1 − α²))``.
    """
    x, y, shortfall, variance = averages  # shortfall: mean of 1 − z; variance: 1 − l²
    length = dr.sqrt(x * x + y * y + dr.square(1 - shortfall))
    k = positive(variance) / ((1 + length) * length)
    widened = 2 * k * (1 - alpha_squared)
    alpha_squared = (alpha_squared + widened) / (1 + widened)
    return lobe_about_normal(mi.Vector2f(x, y) / (1 - shortfall), alpha_squared, distribution)


def lobe_about_normal(mean: mi.Vector2f, alpha_squared: mi.Float, distribution: str) -> SlopeLobe:
    """The lobe of an isotropic roughness about a normal of slope b = ``mean``.

    The roughness α is that of slopes over the plane across this normal. The derivative of the
    rotation to the vertical takes it to slopes over the surface:
    ``Ω = α² (1 + |b|²) (I + b bᵀ)``, which is wider along b than across.
    """
    stretch = 1 + dr.squared_norm(mean)
    scale = alpha_squared * stretch
    uu, vv = scale * (1 + mean.x * mean.x), scale * (1 + mean.y * mean.y)
    return SlopeLobe(mean, uu, vv, scale * mean.x * mean.y, scale * scale * stretch, distribution)


def round_lobe(mean: mi.Vector2f, alpha_squared: mi.Float, distribution: str) -> SlopeLobe:
    """The lobe of an isotropic roughness in the plane of slopes."""
    zero = mi.Float(0)
    return SlopeLobe(
        mean, alpha_squared, alpha_squared, zero, dr.square(alpha_squared), distribution
    )


def slope_change(slope: mi.Vector2f, v: mi.Vector2f) -> mi.Vector2f:
    """The change of a slope x where its projected normal changes by a small ``v``:
    √(1 + |x|²) (I + x xᵀ) v."""
    return (v + slope * dr.dot(slope, v)) * dr.sqrt(1 + dr.squared_norm(slope))


def widened(lobe: SlopeLobe, vectors: tuple) -> SlopeLobe:
    """The lobe with twice the products v vᵀ added to its matrix Ω."""
    added = [
        sum((2 * v[a] * v[b] for v in vectors), mi.Float(0)) for a, b in ((0, 0), (1, 1), (0, 1))
    ]
    return enlarged(lobe, *added)


def enlarged(lobe: SlopeLobe, uu: mi.Float, vv: mi.Float, uv: mi.Float) -> SlopeLobe:
    """The lobe with a symmetric matrix added to Ω, which stays positive: at least 1e-3 of its
    smaller eigenvalue is left."""
    least = 1e-3 * lobe.determinant / (lobe.uu + lobe.vv)
    uu, vv = dr.maximum(lobe.uu + uu, least), dr.maximum(lobe.vv + vv, least)
    uv = lobe.uv + uv
    determinant = dr.maximum(difference_of_products(uu, vv, uv, uv), least * (uu + vv))
    return SlopeLobe(lobe.mean, uu, vv, uv, determinant, lobe.distribution)


def positive(x):
    """``x``, or 0 where rounding has made it negative."""
    return dr.maximum(x, 0)


# ------------------------------------------------------------------------------------------------
#  The methods
# ------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Method:
    """A filter: the moments and products that it averages, and the lobe that it makes of them.

    Attributes:
        moments, spread, between: as the arguments of :class:`~.MomentPyramid`.
        lobe: function of the averages, α² and the name of the distribution.
        distributions: the distributions that the filter is defined for.
    """

    moments: Callable
    spread: Spread
    lobe: Callable
    distributions: tuple[str, ...] = ("beckmann",)
    between: bool = True


#: The filters by name. Their distributions are the ones that their authors, or RTR, define.
METHODS = {
    "toksvig": Method(unit_normal, TOTAL_3D, toksvig_lobe, DISTRIBUTIONS),
    "lean": Method(slope, COVARIANCE, lean_lobe),
    "clean": Method(slope, TOTAL, clean_lobe),
    "leadr": Method(slope, COVARIANCE, lean_lobe),  # LEAN with masking and projection
    "variance": Method(slope, VARIANCES, variance_lobe, DISTRIBUTIONS, between=False),
}


@register("filters", title="filters", plugin="glint_filtered")
class Filtered(PNDF):
    """A P-NDF that is a single lobe, by one of the filters of RTR 9.13.1.

    It belongs to the variant of Mitsuba that is active when it is made.

    Args:
        normal_map (NormalMap): the map, with slopes up to 1000.
        method (str): one of :data:`METHODS`.
        alpha (float): base roughness of the material, > 0, and ≤ 1 for ``toksvig``. None where
            every query gives it, as a parameter of the surface point.
        distribution (str): ``beckmann``, or ``ggx`` for ``toksvig`` and ``variance``.
        max_anisotropy (float): ≥ 1, see :class:`~.MomentPyramid`.
        owner (str): the name that errors give, usually the plugin's.
        domain (Domain): the queries to expect; None for any. MIP levels that none of them needs are
            left out. Lobes within the domain are the same to the last bit.

    Attributes:
        data (mi.TensorXf): the projected normals, H×W×2. Derivatives flow through it; after a
            change of its values, :meth:`parameters_changed` rebuilds the MIP chain.
        alpha (mi.Float): the base roughness; None where queries give it.

    Raises:
        ParameterError: an argument is out of range, or the map is too steep.
    """

    normal_map: NormalMap

    maskings = ("footprint", "smith", "none")
    bytes_per_texel = 100.0
    integrates_lights = True

    def __init__(
        self,
        normal_map: NormalMap,
        method: str = "lean",
        alpha: float | None = 0.05,
        distribution: str = "beckmann",
        max_anisotropy: float = 16.0,
        owner: str = "Filtered",
        domain: Domain | None = None,
    ) -> None:
        check_choice(owner, "method", method, tuple(METHODS))
        check_choice(owner, "distribution", distribution, DISTRIBUTIONS)
        self.method = METHODS[method]
        check(
            distribution in self.method.distributions,
            owner,
            "distribution",
            f"{' or '.join(self.method.distributions)}, for which alone {method} is defined",
            distribution,
        )
        check(max_anisotropy >= 1, owner, "max_anisotropy", "a number ≥ 1", max_anisotropy)
        self.name, self.distribution, self.owner = method, distribution, owner
        self.max_anisotropy, self.wrap_mode = float(max_anisotropy), normal_map.wrap_mode
        self.alpha = None if alpha is None else mi.Float(alpha)
        self.max_alpha = 1.0 if method == "toksvig" else inf
        self.check_alpha()
        self.check_room(normal_map, owner, domain)
        self.data = stored(mi.TensorXf, normal_map.normals)
        self.normal_map = normal_map
        self.build(domain)

    def build(self, domain: Domain | None = None) -> None:
        """Check the slopes of ``self.data``, and build its MIP chain."""
        self.domain = domain
        normals = self.normal_map.normals
        squared = np.einsum("ijk,ijk->ij", normals, normals, dtype=np.float64)
        check_texels(
            self.owner,
            "data",
            f"a map with slopes up to {MAX_SLOPE}",
            {"steeper": squared > MAX_SLOPE**2 / (1 + MAX_SLOPE**2)},
        )

        def make() -> MomentPyramid:
            return MomentPyramid(
                self.data,
                self.wrap_mode,
                self.method.moments,
                max_anisotropy=self.max_anisotropy,
                domain=self.domain,
                spread=self.method.spread,
                between=self.method.between,
            )

        self.pyramid = shared(self, make, self.name, self.max_anisotropy, self.domain)

    def check_alpha(self) -> None:
        """Raise :class:`~.ParameterError` unless the roughness is in the method's range."""
        if self.alpha is None:
            return
        check(
            dr.all(dr.isfinite(self.alpha) & (self.alpha > 0) & (self.alpha <= self.max_alpha)),
            self.owner,
            "alpha",
            "a finite number > 0" + (" and ≤ 1" if self.max_alpha == 1 else ""),
            self.alpha[0],
        )

    def lobe(self, query: Query | Footprint) -> SlopeLobe:
        """The lobe of a query, or of a footprint in the UV space of the map."""
        query = Query.of(query)
        return query.once((self, "lobe"), lambda: self.make_lobe(query))

    def make_lobe(self, query: Query) -> SlopeLobe:
        """Compute what :meth:`lobe` returns."""
        averages = self.pyramid.average(query)
        alpha = self.alpha
        if alpha is None:
            alpha = dr.minimum(query.parameters["alpha"], self.max_alpha)
        return self.method.lobe(averages, dr.square(alpha), self.distribution)

    def lit_lobe(self, query: Query) -> tuple[SlopeLobe, tuple[mi.Vector2f, ...]]:
        """The lobe of a query with the half vector's turn, and the light's spread of slopes.

        Masking needs neither of them: it depends on the facets alone. They are taken from projected
        normals to slopes at the lobe's mean.
        """
        lobe = self.lobe(query)
        if query.turn is not None:
            lobe = query.once((self, "turned lobe"), lambda: self.turned(lobe, query))
        spread = tuple(slope_change(lobe.mean, v) for v in query.spread)
        if spread and self.distribution != "beckmann":  # a GGX lobe has no variance
            lobe = widened(lobe, spread)
            spread = ()
        return lobe, spread

    def turned(self, lobe: SlopeLobe, query: Query) -> SlopeLobe:
        """The lobe of the slopes x(u) − A H (u − u₀): H is the half vector's turn, A takes it to
        slopes.

        The footprint's axes a add up to Σ_p = Σ a aᵀ. With J Σ_p the covariance of slopes and
        positions, the covariance C of slopes becomes C + Σ (h hᵀ − j hᵀ − h jᵀ), j = J a and
        h = A H a. Under a Gaussian J is the derivative of the mean slope with respect to the
        footprint's centre. It is taken as a difference.
        """
        turn, footprint = query.turn, query.footprint
        assert turn is not None
        added = [mi.Float(0) for _ in range(3)]
        for axis in (footprint.du, footprint.dv):
            before, after = (
                self.make_lobe(
                    query.at(Footprint(footprint.uv + s * axis, footprint.du, footprint.dv))
                ).mean
                for s in (-0.5, 0.5)
            )
            j, h = after - before, slope_change(lobe.mean, turn @ axis)
            for k, (a, b) in enumerate(((0, 0), (1, 1), (0, 1))):
                added[k] = added[k] + 2 * (h[a] * h[b] - j[a] * h[b] - h[a] * j[b])
        return enlarged(lobe, *added)

    def _eval(self, m: mi.Vector2f, query: Query, active: mi.Bool) -> mi.Float:
        """D(m), the density of projected normals over the unit disk; 0 outside of it."""
        lobe, spread = self.lit_lobe(query)
        if not spread:
            return dr.select(active, lobe.eval(m), 0)
        z_squared = 1 - dr.squared_norm(m)
        active = active & (z_squared > 0)
        z_squared = dr.select(active, z_squared, 1)
        facets = Gaussian(tuple(v * sqrt(0.5) for v in (lobe.f, lobe.g)))
        density = AveragedGaussian(facets, spread).eval(m * dr.rsqrt(z_squared) - lobe.mean)
        return dr.select(active, dr.maximum(density, 0) / dr.square(z_squared), 0)

    def _sample(
        self, query: Query, sample1: mi.Float, sample2: mi.Point2f, active: mi.Bool
    ) -> mi.Vector2f:
        """Draw a projected normal with density D: one that is visible from the vertical."""
        above = mi.Vector3f(0, 0, 1)
        lobe, spread = self.lit_lobe(query)
        normal = lobe.sample_visible(above, sample1, sample2)
        if not spread:
            return mi.Vector2f(normal.x, normal.y)
        # The lobe's sample uses up the numbers; the point of the light comes from a hash of them.
        bits = [dr.reinterpret_array(mi.UInt32, mi.Float(v)) for v in (sample1, *sample2)]
        point = mi.Point2f(*(uniform(b) for b in pcg3d(*bits)[:2]))
        x = mi.Vector2f(normal.x, normal.y) / normal.z + point_of_ellipse(spread, point)
        return x * dr.rsqrt(1 + dr.squared_norm(x))

    def sample_visible(self, wi, query, sample1, sample2, active):
        """Draw one of the lobe's normals that are visible from ``wi``."""
        return self.lobe(query).sample_visible(wi, sample1, sample2)

    def visible_pdf(self, wi, m, density, query, active):
        return self.lobe(query).visible_pdf(wi, m, density)

    def projected_areas(self, directions, query, active):
        """The projected areas and the mean slope of the lobe."""
        lobe = self.lobe(query)
        return [lobe.visible_area(w) for w in directions], lobe.mean

    def masking(self, name: str, height_correlated: bool = True) -> SmithMasking | None:
        """``footprint`` is LEADR's masking, for every filter. ``smith`` is the same without LEADR's
        projection factor; LEADR itself always has the factor."""
        if name == "smith" and self.name != "leadr":
            return LobeMasking(self, height_correlated)
        return super().masking("footprint" if name == "smith" else name, height_correlated)

    def traverse(self, callback: mi.TraversalCallback) -> None:
        callback.put("data", self.data, mi.ParamFlags.Differentiable)
        if self.alpha is not None:
            callback.put("alpha", self.alpha, mi.ParamFlags.Differentiable)

    def parameters_changed(self, keys: Sequence[str] = ()) -> None:
        """Check what has changed, and rebuild. Derivatives keep flowing to the parameters."""
        self.check_alpha()
        if not keys or "data" in keys:
            self.normal_map = changed_map(self.data, self.wrap_mode, self.owner)
            self.changed = True
            self.build(self.domain)

    def parts(self) -> dict[str, int]:
        """Memory of each part of the structure, bytes."""
        levels = f"MIP levels {self.pyramid.first} to {self.pyramid.top}"
        return {
            "map": map_bytes(self.normal_map),
            levels: self.pyramid.nbytes,
        }

    def __repr__(self) -> str:
        height, width, _ = self.data.shape
        alpha = "textured" if self.alpha is None else f"{self.alpha[0]:g}"
        return (
            f"Filtered[{self.name}, {self.distribution}, alpha={alpha}, "
            f"{width}×{height} texels, {self.wrap_mode}, {self.nbytes / 2**20:.1f} MiB]"
        )


# ------------------------------------------------------------------------------------------------
#  Masking relative to the geometric surface
# ------------------------------------------------------------------------------------------------


class LobeMasking(SmithMasking):
    """Smith's masking by the facets of a lobe, without LEADR's projection factor.

    Λ = P/P̄ − 1 compares the facets with their mean facet, but the BRDF keeps ``cosθ_i`` of the
    geometric surface in its denominator. So a footprint that leans towards the viewer reflects more
    than it receives, and one that leans away reflects less. The masking is 0 where the mean facet
    faces away from the viewer or from the light.

    Args:
        pndf (Filtered): the P-NDF whose lobe gives the facets.
        height_correlated: see :class:`~.SmithMasking`.
    """

    def __init__(self, pndf: Filtered, height_correlated: bool = True) -> None:
        super().__init__(height_correlated)
        self.pndf = pndf

    def eval(self, wi, wo, query, mode, active):
        (p_i, p_o), slope = self.pndf.projected_areas([wi, wo], query, active)
        plane_i, plane_o = (mean_plane_area(w, slope) for w in (wi, wo))
        return plane_i * visibility(p_i, plane_i, p_o, plane_o, self.height_correlated)

    def __repr__(self) -> str:
        return f"smith[height_correlated = {self.height_correlated}]"
