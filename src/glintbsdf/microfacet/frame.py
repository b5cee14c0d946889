"""The microfacet frame around a P-NDF: half vectors, Fresnel reflectance, masking.

With ``m`` the half vector of the directions ``wi`` and ``wo`` and ``D`` a density over the disk of
projected normals (``∫ D d(m_x, m_y) = 1``, hence ``∫ D cosθ_m dω_m = 1``)

    f_r cosθ_o = F D G / (4 cosθ_i)                         (Walter et al. 2007: BRDF)
    pdf(wo)    = D cosθ_m / (4 |wo·m|)                      (Walter et al. 2007: sampling)

Directions are unit vectors in the local shading frame, pointing away from the surface.

Sources: Walter et al., "Microfacet Models for Refraction through Rough Surfaces", EGSR 2007;
Heitz, "Understanding the Masking-Shadowing Function in Microfacet-Based BRDFs", JCGT 2014.
"""

from __future__ import annotations

from math import pi, sqrt
from typing import TYPE_CHECKING

import drjit as dr
import mitsuba as mi

if TYPE_CHECKING:
    from glintbsdf.footprint.gaussian import Footprint

# --------------------------------------------------------------------------------------------------
#  Directions and half vectors
# --------------------------------------------------------------------------------------------------


def above_horizon(active: mi.Bool, *directions: mi.Vector3f) -> tuple:
    """``(active, *directions)``, of the lanes alone in which all directions are above the horizon.

    Elsewhere all of them become the vertical, for which everything is a number: a NaN in a lane
    that is masked away would still reach its derivatives. The ``bumpmap`` of Mitsuba 3.9 hands over
    NaN where its relief is level and dp_du the z axis; z need not be among them.
    """
    active = mi.Bool(active)
    for direction in directions:
        active &= (mi.Frame3f.cos_theta(direction) > 0) & dr.isfinite(direction.x)
    return active, *(dr.select(active, d, mi.Vector3f(0, 0, 1)) for d in directions)


def half_vector(wi: mi.Vector3f, wo: mi.Vector3f) -> mi.Vector3f:
    """The microfacet normal that reflects ``wi`` to ``wo``; not finite where they are opposite."""
    return dr.normalize(wi + wo)


def normal_from_projection(s: mi.Vector2f) -> mi.Vector3f:
    """The unit normal whose projection on the disk is ``s``; z = 0 on the rim and outside."""
    return mi.Vector3f(s.x, s.y, dr.safe_sqrt(1 - dr.squared_norm(s)))


def reflected_value(
    density: mi.Float | mi.UnpolarizedSpectrum, cos_theta_i: mi.Float
) -> mi.Float | mi.UnpolarizedSpectrum:
    """``f_r cosθ_o`` of a perfect mirror without masking: ``D / (4 cosθ_i)``, 1/steradian."""
    return density / (4 * cos_theta_i)


def reflected_pdf(pdf: mi.Float, wo: mi.Vector3f, m: mi.Vector3f) -> mi.Float:
    """Density of ``wo`` (1/steradian) when the normal ``m`` is drawn with density ``pdf``.

    ``1 / (4 |wo·m|)`` is the Jacobian of the half vector.
    """
    return pdf / (4 * dr.abs(dr.dot(wo, m)))


class PndfNormals:
    """Draws normals with exactly the density of a P-NDF; the pattern for other samplers.

    Args:
        pndf: a P-NDF with ``sample``.
    """

    def __init__(self, pndf: object) -> None:
        self.pndf = pndf

    def sample(
        self,
        wi: mi.Vector3f,
        footprint: Footprint,
        sample1: mi.Float,
        sample2: mi.Point2f,
        active: mi.Bool,
    ) -> mi.Vector3f:
        """A unit normal for the view from ``wi``; one with z ≤ 0 is an invalid sample."""
        return normal_from_projection(self.pndf.sample(footprint, sample1, sample2, active))

    def pdf(
        self,
        wi: mi.Vector3f,
        m: mi.Vector3f,
        density: mi.Float,
        footprint: Footprint,
        active: mi.Bool,
    ) -> mi.Float:
        """Density of ``m`` per solid angle, given ``density``, which is D(m)."""
        return density * m.z


class VisibleBeckmannNormals:
    """Draws the normals that a smooth Beckmann surface shows to the view (Heitz and d'Eon 2014).

    Args:
        alpha: ``mi.Vector2f``, roughness along u and v.
    """

    def __init__(self, alpha: mi.Vector2f) -> None:
        self.distribution = mi.MicrofacetDistribution(
            mi.MicrofacetType.Beckmann, alpha.x, alpha.y, sample_visible=True
        )

    def sample(
        self,
        wi: mi.Vector3f,
        footprint: Footprint,
        sample1: mi.Float,
        sample2: mi.Point2f,
        active: mi.Bool,
    ) -> mi.Vector3f:
        """As :meth:`PndfNormals.sample`."""
        return mi.Vector3f(self.distribution.sample(wi, sample2)[0])

    def pdf(
        self,
        wi: mi.Vector3f,
        m: mi.Vector3f,
        density: mi.Float,
        footprint: Footprint,
        active: mi.Bool,
    ) -> mi.Float:
        """As :meth:`PndfNormals.pdf`; ``density`` plays no part."""
        return self.distribution.pdf(wi, m)


# --------------------------------------------------------------------------------------------------
#  Fresnel reflectance
# --------------------------------------------------------------------------------------------------


class Conductor:
    """Reflectance of a metal.

    Args:
        eta, k: ``mi.Texture``, real and imaginary part of the index of refraction relative to the
            outside, ≥ 0.
    """

    def __init__(self, eta: mi.Texture, k: mi.Texture) -> None:
        self.eta, self.k = eta, k

    def index(self, si: mi.SurfaceInteraction3f, active: mi.Bool) -> list[mi.Complex2f]:
        """The complex index of refraction at ``si``, one entry per channel of a spectrum."""
        return [
            mi.Complex2f(eta, k)
            for eta, k in zip(self.eta.eval(si, active), self.k.eval(si, active), strict=True)
        ]

    def reflectance(
        self, cos_theta: mi.Float, si: mi.SurfaceInteraction3f, active: mi.Bool
    ) -> mi.UnpolarizedSpectrum:
        """Unpolarised reflectance at the angle of incidence ``cos_theta`` (> 0)."""
        return mi.UnpolarizedSpectrum(
            [mi.fresnel_conductor(cos_theta, index) for index in self.index(si, active)]
        )

    def traverse(self, callback: mi.TraversalCallback) -> None:
        flags = mi.ParamFlags.Differentiable | mi.ParamFlags.Discontinuous
        callback.put("eta", self.eta, flags)
        callback.put("k", self.k, flags)

    def __repr__(self) -> str:
        return f"Conductor[eta = {self.eta}, k = {self.k}]"


class Dielectric:
    """Reflectance of a smooth dielectric surface; what it transmits is absorbed.

    Args:
        eta: index of refraction inside over outside, > 0.
    """

    def __init__(self, eta: float) -> None:
        self.eta = mi.Float(eta)

    def index(self, si: mi.SurfaceInteraction3f, active: mi.Bool) -> list[mi.Complex2f]:
        """As :meth:`Conductor.index`; the same for every channel."""
        return [mi.Complex2f(self.eta, 0)] * dr.size_v(mi.UnpolarizedSpectrum)

    def reflectance(
        self, cos_theta: mi.Float, si: mi.SurfaceInteraction3f, active: mi.Bool
    ) -> mi.UnpolarizedSpectrum:
        """As :meth:`Conductor.reflectance`."""
        return mi.UnpolarizedSpectrum(mi.fresnel(cos_theta, self.eta)[0])

    def traverse(self, callback: mi.TraversalCallback) -> None:
        callback.put("eta", self.eta, mi.ParamFlags.Differentiable | mi.ParamFlags.Discontinuous)

    def __repr__(self) -> str:
        return f"Dielectric[eta = {self.eta[0]:g}]"


def mueller_reflection(
    index: list[mi.Complex2f],
    tint: mi.UnpolarizedSpectrum,
    mode: mi.TransportMode,
    wi: mi.Vector3f,
    wo: mi.Vector3f,
    m: mi.Vector3f,
) -> mi.Spectrum:
    """Mueller matrix (4×4 of spectra) of the reflection from a facet with normal ``m``.

    It acts on Stokes vectors in Mitsuba's implicit bases of the light's directions of propagation:
    arriving along ``-wo`` and leaving along ``wi`` when radiance is transported, the reverse for
    importance. Every entry is multiplied by ``tint``.
    """
    if mode == mi.TransportMode.Importance:
        wi, wo = wo, wi
    cos_theta = dr.dot(wo, m)
    channels = [mi.mueller.specular_reflection(cos_theta, n) for n in index]
    reflection = mi.Spectrum(
        [
            [
                mi.UnpolarizedSpectrum(
                    [t * channel[row][column] for t, channel in zip(tint, channels, strict=True)]
                )
                for column in range(4)
            ]
            for row in range(4)
        ]
    )

    # The matrix refers to the s axes, normal to the plane of incidence; at normal incidence, where
    # there is no such plane, any axis will do.
    s_in, s_out = dr.cross(m, -wo), dr.cross(m, wi)
    collinear = dr.squared_norm(s_in) == 0
    s_in = dr.select(collinear, mi.Vector3f(1, 0, 0), dr.normalize(s_in))
    s_out = dr.select(collinear, mi.Vector3f(1, 0, 0), dr.normalize(s_out))
    return mi.mueller.rotate_mueller_basis(
        reflection, -wo, s_in, mi.mueller.stokes_basis(-wo), wi, s_out, mi.mueller.stokes_basis(wi)
    )


# --------------------------------------------------------------------------------------------------
#  Masking and shadowing
# --------------------------------------------------------------------------------------------------


class SmithMasking:
    """Smith's masking and shadowing, from the function Λ that a subclass gives (Heitz 2014).

    Args:
        height_correlated: Whether masking and shadowing count a facet's height once,
            ``1 / (1 + Λ(wi) + Λ(wo))``, rather than as independent events,
            ``G1(wi) G1(wo)`` (Heitz 2014, on the joint masking-shadowing function).
    """

    def __init__(self, height_correlated: bool = True) -> None:
        self.height_correlated = height_correlated

    def smith_lambda(self, w: mi.Vector3f, footprint: Footprint, active: mi.Bool) -> mi.Float:
        """Λ(w) ≥ 0 of the facets under the footprint, such that ``G1(w) = 1 / (1 + Λ(w))``."""
        return self.smith_lambdas([w], footprint, active)[0]

    def smith_lambdas(self, directions: list, footprint: Footprint, active: mi.Bool) -> list:
        """As :meth:`smith_lambda` for several directions. A subclass overrides either of the two:
        this one where directions share what is found under the footprint."""
        return [self.smith_lambda(w, footprint, active) for w in directions]

    def eval(
        self, wi: mi.Vector3f, wo: mi.Vector3f, footprint: Footprint, active: mi.Bool
    ) -> mi.Float:
        """The factor G in [0, 1] for two directions of the upper hemisphere."""
        lambda_i, lambda_o = self.smith_lambdas([wi, wo], footprint, active)
        if self.height_correlated:
            return dr.rcp(1 + lambda_i + lambda_o)
        return dr.rcp((1 + lambda_i) * (1 + lambda_o))

    def parameters_changed(self) -> None:
        """Rebuild what depends on the map."""


class BeckmannMasking(SmithMasking):
    """Masking of a Beckmann surface.

    Args:
        alpha_squared: ``mi.Vector2f``, squared roughness along u and v.
        height_correlated: see :class:`SmithMasking`.
    """

    def __init__(self, alpha_squared: mi.Vector2f, height_correlated: bool = True) -> None:
        super().__init__(height_correlated)
        self.alpha_squared = alpha_squared

    def smith_lambda(self, w: mi.Vector3f, footprint: Footprint, active: mi.Bool) -> mi.Float:
        return beckmann_lambda(w, self.alpha_squared)

    def __repr__(self) -> str:
        alpha_u, alpha_v = (sqrt(x[0]) for x in self.alpha_squared)
        return (
            f"beckmann[alpha_u = {alpha_u:.4g}, alpha_v = {alpha_v:.4g}, "
            f"height_correlated = {self.height_correlated}]"
        )


class MapBeckmannMasking(BeckmannMasking):
    """Masking of a Beckmann surface as rough as the whole map.

    The squared roughness is twice the mean squared slope ``n_xy / n_z`` of the map, and derivatives
    flow through it to the map.

    Args:
        pndf: the P-NDF whose map ``pndf.data`` (H×W×2 projected normals) gives the roughness.
        height_correlated: see :class:`SmithMasking`.
    """

    def __init__(self, pndf: object, height_correlated: bool = True) -> None:
        super().__init__(map_alpha_squared(pndf.data), height_correlated)
        self.pndf = pndf

    def parameters_changed(self) -> None:
        self.alpha_squared = map_alpha_squared(self.pndf.data)


class BeckmannLobe:
    """The facets of a smooth Beckmann surface, whatever the footprint: ``roughconductor``'s.

    Visible normals, masking and shadowing are separable, as in that plugin of Mitsuba.

    Args:
        alpha: ``mi.Vector2f``, roughness along u and v, at least 1e-4.

    Attributes:
        normals (VisibleBeckmannNormals), masking (BeckmannMasking): of these facets.
    """

    def __init__(self, alpha: mi.Vector2f) -> None:
        self.normals = VisibleBeckmannNormals(alpha)
        self.masking = BeckmannMasking(dr.square(alpha), height_correlated=False)

    def density(
        self, si: mi.SurfaceInteraction3f, m: mi.Vector3f, footprint: Footprint, active: mi.Bool
    ) -> mi.Float:
        """D of the unit normal ``m``; where and how large the footprint is plays no part."""
        return self.normals.distribution.eval(m)

    def parameters_changed(self) -> None:
        """Nothing follows from a map."""


class MapBeckmannLobe(BeckmannLobe):
    """The smooth surface as rough as a whole map: what its glints add up to, from afar.

    The squared roughness is that of :class:`MapBeckmannMasking`, twice the mean squared slope along
    u and along v, plus 2σ_r² for the intrinsic roughness of elements and lobes. A tilt of the map
    as a whole counts as roughness, and the two axes as uncorrelated. A flat map has the smallest
    roughness, 1e-4.

    Args:
        pndf: the P-NDF whose map ``pndf.data`` (H×W×2 projected normals) gives the roughness, and
            ``pndf.sigma_r``, if it has one, the intrinsic roughness.
    """

    def __init__(self, pndf: object) -> None:
        self.pndf = pndf
        self.parameters_changed()

    def parameters_changed(self) -> None:
        intrinsic = 2 * dr.square(getattr(self.pndf, "sigma_r", 0.0))
        super().__init__(dr.sqrt(dr.maximum(self.alpha_squared() + intrinsic, 1e-8)))

    def alpha_squared(self) -> mi.Vector2f:
        """Squared roughness along u and v, without the intrinsic one."""
        return map_alpha_squared(self.pndf.data)


class FlakesBeckmannLobe(MapBeckmannLobe):
    """The smooth surface as rough as all flakes together: ``pndf.alpha``, and their own roughness.

    Args:
        pndf: as of :class:`MapBeckmannLobe`, of flakes instead of a map.
    """

    def alpha_squared(self) -> mi.Vector2f:
        return mi.Vector2f(self.pndf.alpha**2)


def map_alpha_squared(data: mi.TensorXf) -> mi.Vector2f:
    """Squared Beckmann roughness of a map of projected normals (H×W×2) along u and v."""
    s = dr.unravel(mi.Vector2f, data.array)
    z_squared = 1 - dr.squared_norm(s)
    return mi.Vector2f([2 * dr.mean(x * x / z_squared) for x in s])


def beckmann_lambda(w: mi.Vector3f, alpha_squared: mi.Vector2f) -> mi.Float:
    """Λ(w) of an anisotropic Beckmann surface (Heitz 2014); 0 for a flat one.

    ``Λ = (exp(−a²) / (a √π) − erfc(a)) / 2`` with ``a = cosθ / √(α_u² w_x² + α_v² w_y²)``.
    """
    tangent_squared = alpha_squared.x * w.x * w.x + alpha_squared.y * w.y * w.y
    # Beyond a = 4, Λ is below 3e-10: float32 sees none of it, and a flat surface has an infinite a.
    visible = 16 * tangent_squared > w.z * w.z
    a = w.z * dr.rsqrt(dr.select(visible, tangent_squared, 1))
    value = 0.5 * (dr.exp(-a * a) / (a * sqrt(pi)) - (1 - dr.erf(a)))
    # The two terms cancel as a grows; rounding must not turn G into more than 1.
    return dr.select(visible, dr.maximum(value, 0), 0)
