"""Masking and shadowing of facets.

Directions are unit vectors of the upper hemisphere in the local shading frame.

Source: Heitz, "Understanding the Masking-Shadowing Function in Microfacet-Based BRDFs", JCGT 2014.
"""

from __future__ import annotations

from collections.abc import Sequence
from math import pi, sqrt

import drjit as dr
import mitsuba as mi

from glintbsdf.footprint.query import Query
from glintbsdf.microfacet.mean_plane import mean_plane_area, visibility


class SmithMasking:
    """Smith's masking and shadowing, from the function Λ that a subclass gives (Heitz 2014).

    Args:
        height_correlated: Whether masking and shadowing count a facet's height once,
            ``1 / (1 + Λ(wi) + Λ(wo))``, rather than as independent events,
            ``G1(wi) G1(wo)`` (Heitz 2014, on the joint masking-shadowing function).
    """

    def __init__(self, height_correlated: bool = True) -> None:
        self.height_correlated = height_correlated

    def smith_lambda(self, w: mi.Vector3f, query: Query, active: mi.Bool) -> mi.Float:
        """Λ(w) ≥ 0 of the facets under the footprint, such that ``G1(w) = 1 / (1 + Λ(w))``."""
        return self.smith_lambdas([w], query, active)[0]

    def smith_lambdas(self, directions: list, query: Query, active: mi.Bool) -> list:
        """As :meth:`smith_lambda` for several directions. A subclass overrides either of the two:
        this one if the directions share computations over the footprint."""
        return [self.smith_lambda(w, query, active) for w in directions]

    def eval(
        self,
        wi: mi.Vector3f,
        wo: mi.Vector3f,
        query: Query,
        mode: mi.TransportMode,
        active: mi.Bool,
    ) -> mi.Float:
        """The factor G in [0, 1] for two directions of the upper hemisphere.

        ``mode``: what ``wi`` transports, light or importance; Smith's factor is the same for both.
        """
        lambda_i, lambda_o = self.smith_lambdas([wi, wo], query, active)
        if self.height_correlated:
            return dr.rcp(1 + lambda_i + lambda_o)
        return dr.rcp((1 + lambda_i) * (1 + lambda_o))

    def parts(self) -> dict[str, int]:
        """Memory of each part of what it has built, bytes."""
        return {}

    def parameters_changed(self, keys: Sequence[str] = ()) -> None:
        """Rebuild what depends on the parameters named; on any of them where none is named."""


class DistributionMasking(SmithMasking):
    """Masking of a surface whose facets all together have a roughness.

    A subclass says which distribution they have.

    Args:
        alpha_squared: function that returns an ``mi.Vector2f``, squared roughness along u and v. It
            is called again when one of ``keys`` has changed.
        height_correlated: see :class:`SmithMasking`.
        keys: names of the parameters on which the roughness depends.
    """

    def __init__(self, alpha_squared, height_correlated: bool = True, keys=("data",)) -> None:
        super().__init__(height_correlated)
        self.current, self.keys = alpha_squared, frozenset(keys)
        self.alpha_squared = alpha_squared()

    name: str

    def parameters_changed(self, keys=()):
        if not keys or self.keys & set(keys):
            self.alpha_squared = self.current()

    def __repr__(self) -> str:
        alpha_u, alpha_v = (sqrt(x[0]) for x in self.alpha_squared)
        return (
            f"{self.name}[alpha_u = {alpha_u:.4g}, alpha_v = {alpha_v:.4g}, "
            f"height_correlated = {self.height_correlated}]"
        )


class BeckmannMasking(DistributionMasking):
    """Masking of a Beckmann surface."""

    name = "beckmann"

    def smith_lambda(self, w, query, active):
        return beckmann_lambda(w, self.alpha_squared)


class GGXMasking(DistributionMasking):
    """Masking of a GGX surface."""

    name = "ggx"

    def smith_lambda(self, w, query, active):
        return ggx_lambda(w, self.alpha_squared)


class MeanPlaneMasking(SmithMasking):
    """Masking of the facets under the footprint over their own mean plane.

    See :mod:`glintbsdf.microfacet.mean_plane`: ``f cosθ_o = F D V/4``.

    Args:
        facets: what knows the facets under a footprint, by
            ``projected_areas(directions, query, active)``: a :class:`~.PNDF`, say.
        height_correlated: see :class:`SmithMasking`.
        name: what it is called in print.
    """

    def __init__(self, facets, height_correlated: bool = True, name: str = "footprint") -> None:
        super().__init__(height_correlated)
        self.facets, self.name = facets, name

    def eval(self, wi, wo, query, mode, active):
        """The factor on F D/(4 cosθ_i), which may exceed 1: V cosθ_i.

        Where importance is transported, light comes along ``wi`` and leaves for the viewer along
        ``wo``. V is then that of the directions exchanged, and BRDF and cosines leave V cosθ_o.
        """
        (p_i, p_o), slope = self.facets.projected_areas([wi, wo], query, active)
        plane_i, plane_o = (mean_plane_area(w, slope) for w in (wi, wo))
        if mode == mi.TransportMode.Importance:
            return wo.z * visibility(p_o, plane_o, p_i, plane_i, self.height_correlated)
        return wi.z * visibility(p_i, plane_i, p_o, plane_o, self.height_correlated)

    def __repr__(self) -> str:
        return f"{self.name}[height_correlated = {self.height_correlated}]"


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


def ggx_lambda(w: mi.Vector3f, alpha_squared: mi.Vector2f) -> mi.Float:
    """Λ(w) = (√(1 + (α_u² w_x² + α_v² w_y²)/w_z²) − 1)/2 of a GGX surface (Heitz 2014)."""
    tangent_squared = alpha_squared.x * w.x * w.x + alpha_squared.y * w.y * w.y
    t = tangent_squared / dr.square(dr.maximum(w.z, 1e-6))
    return 0.5 * t / (1 + dr.sqrt(1 + t))  # without cancellation
