"""The interface at a facet: what happens to light that meets a single microfacet.

An interface has components, such as reflection. A component knows the half vector of two
directions, the direction that a facet scatters to, the Jacobian between the two, on which side of
the surface and of the facet light must be, and how much of it goes on. The BSDF loops over the
components and knows none of this itself.

With ``m`` the half vector and ``D`` a density over the disk of projected normals
(``∫ D d(m_x, m_y) = 1``, hence ``∫ D cosθ_m dω_m = 1``), reflection has

    f_r cosθ_o = F D G / (4 cosθ_i)                         (Walter et al. 2007: BRDF)
    pdf(wo)    = D cosθ_m / (4 |wo·m|)                      (Walter et al. 2007: sampling)

Directions are unit vectors in the local shading frame, pointing away from the surface.

Source: Walter et al., "Microfacet Models for Refraction through Rough Surfaces", EGSR 2007.
"""

from __future__ import annotations

from abc import ABC, abstractmethod

import drjit as dr
import mitsuba as mi

from glintbsdf.microfacet import frame
from glintbsdf.microfacet.fresnel import mueller_reflection

# --------------------------------------------------------------------------------------------------
#  Components
# --------------------------------------------------------------------------------------------------


class Component(ABC):
    """One way in which a facet scatters light.

    Attributes:
        flags (mi.BSDFFlags): what Mitsuba calls it.
        eta (float): index of refraction of the way out over that of the way in.
    """

    flags: mi.BSDFFlags
    eta: float = 1.0

    @abstractmethod
    def above_horizon(self, active: mi.Bool, *directions: mi.Vector3f) -> tuple:
        """``(active, *directions)``: active are lanes whose directions are on the sides of the
        surface that the component connects; elsewhere directions become the vertical, see
        :func:`~.above_horizon`."""

    @abstractmethod
    def half_vector(self, wi: mi.Vector3f, wo: mi.Vector3f) -> mi.Vector3f:
        """The unit normal of the facet that scatters ``wi`` to ``wo``."""

    @abstractmethod
    def scattered(
        self, wi: mi.Vector3f, m: mi.Vector3f, active: mi.Bool
    ) -> tuple[mi.Vector3f, mi.Bool]:
        """Where the facet ``m`` scatters ``wi`` to, and the active lanes in which it does: there
        the facet points up, and the new direction is on the right side of the surface."""

    def upward(self, wo: mi.Vector3f) -> mi.Vector3f:
        """The direction above the surface whose shadowing ``wo`` has: itself, for reflection."""
        return wo

    @abstractmethod
    def density_of_direction(self, pdf: mi.Float, wo: mi.Vector3f, m: mi.Vector3f) -> mi.Float:
        """Density of ``wo`` (1/steradian) when normals have the density ``pdf`` (1/steradian)."""

    @abstractmethod
    def value(
        self, density: mi.Float | mi.UnpolarizedSpectrum, cos_theta_i: mi.Float
    ) -> mi.Float | mi.UnpolarizedSpectrum:
        """``f cosθ_o`` (1/steradian) of facets of density D that let everything through, without
        masking."""

    @abstractmethod
    def throughput(
        self,
        value: mi.Float | mi.UnpolarizedSpectrum,
        mode: mi.TransportMode,
        si: mi.SurfaceInteraction3f,
        wi: mi.Vector3f,
        wo: mi.Vector3f,
        m: mi.Vector3f,
        active: mi.Bool,
    ) -> mi.Spectrum:
        """``value`` times the share of light that takes this way, or its Mueller matrix."""


class Reflection(Component):
    """Reflection from a facet, on the side that the normal points to.

    Args:
        interface (Interface): gives the reflectance.
    """

    def __init__(self, interface: Interface) -> None:
        self.interface = interface
        self.flags = mi.BSDFFlags.GlossyReflection

    def above_horizon(self, active, *directions):
        return frame.above_horizon(active, *directions)

    def half_vector(self, wi, wo):
        return frame.half_vector(wi, wo)

    def scattered(self, wi, m, active):
        wo = mi.reflect(wi, mi.Normal3f(m))
        return wo, active & (m.z > 0) & (mi.Frame3f.cos_theta(wo) > 0)

    def density_of_direction(self, pdf, wo, m):
        # 1 / (4 |wo·m|) is the Jacobian of the half vector.
        return pdf / (4 * dr.abs(dr.dot(wo, m)))

    def value(self, density, cos_theta_i):
        return density / (4 * cos_theta_i)

    def throughput(self, value, mode, si, wi, wo, m, active):
        if mi.is_polarized:
            return mueller_reflection(self.interface.index(si, active), value, mode, wi, wo, m)
        return self.interface.reflected(value, dr.dot(wo, m), si, active)


# --------------------------------------------------------------------------------------------------
#  Interfaces
# --------------------------------------------------------------------------------------------------


class Interface(ABC):
    """The optical interface of a facet.

    Attributes:
        components (tuple[Component, ...]): for example reflection. No two of them lead to the
            same direction.
    """

    components: tuple[Component, ...]

    def __init__(self) -> None:
        self.components = (Reflection(self),)

    @abstractmethod
    def index(self, si: mi.SurfaceInteraction3f, active: mi.Bool) -> list[mi.Complex2f]:
        """The complex index of refraction at ``si``, one entry per channel of a spectrum."""

    @abstractmethod
    def reflectance(
        self, cos_theta: mi.Float, si: mi.SurfaceInteraction3f, active: mi.Bool
    ) -> mi.UnpolarizedSpectrum:
        """Unpolarised reflectance at the angle of incidence ``cos_theta`` (> 0)."""

    def reflected(
        self,
        value: mi.Float | mi.UnpolarizedSpectrum,
        cos_theta: mi.Float,
        si: mi.SurfaceInteraction3f,
        active: mi.Bool,
    ) -> mi.Spectrum:
        """``value`` times the reflectance."""
        return value * self.reflectance(cos_theta, si, active)

    def traverse(self, callback: mi.TraversalCallback) -> None:
        """Show the parameters to ``callback``."""


class Mirror(Interface):
    """A perfect mirror, F = 1, which needs no code.

    In polarised variants it has the Mueller matrix of the conductor with eta = 0 and k = 1, which
    is the default of ``roughconductor`` and reflects everything.
    """

    def index(self, si, active):
        return [mi.Complex2f(0, 1)] * dr.size_v(mi.UnpolarizedSpectrum)

    def reflectance(self, cos_theta, si, active):
        return mi.UnpolarizedSpectrum(1)

    def reflected(self, value, cos_theta, si, active):
        return value

    def __repr__(self) -> str:
        return "Mirror[]"


class Conductor(Interface):
    """A metal.

    Args:
        eta, k: ``mi.Texture``, real and imaginary part of the index of refraction relative to the
            outside, ≥ 0.
    """

    def __init__(self, eta: mi.Texture, k: mi.Texture) -> None:
        super().__init__()
        self.eta, self.k = eta, k

    def index(self, si, active):
        return [
            mi.Complex2f(eta, k)
            for eta, k in zip(self.eta.eval(si, active), self.k.eval(si, active), strict=True)
        ]

    def reflectance(self, cos_theta, si, active):
        return mi.UnpolarizedSpectrum(
            [mi.fresnel_conductor(cos_theta, index) for index in self.index(si, active)]
        )

    def traverse(self, callback: mi.TraversalCallback) -> None:
        flags = mi.ParamFlags.Differentiable | mi.ParamFlags.Discontinuous
        callback.put("eta", self.eta, flags)
        callback.put("k", self.k, flags)

    def __repr__(self) -> str:
        return f"Conductor[eta = {self.eta}, k = {self.k}]"


class Dielectric(Interface):
    """A smooth dielectric surface; what it transmits is absorbed.

    Args:
        eta: index of refraction inside over outside, > 0.
    """

    def __init__(self, eta: float) -> None:
        super().__init__()
        self.eta = mi.Float(eta)

    def index(self, si, active):
        return [mi.Complex2f(self.eta, 0)] * dr.size_v(mi.UnpolarizedSpectrum)

    def reflectance(self, cos_theta, si, active):
        return mi.UnpolarizedSpectrum(mi.fresnel(cos_theta, self.eta)[0])

    def traverse(self, callback: mi.TraversalCallback) -> None:
        callback.put("eta", self.eta, mi.ParamFlags.Differentiable | mi.ParamFlags.Discontinuous)

    def __repr__(self) -> str:
        return f"Dielectric[eta = {self.eta[0]:g}]"
