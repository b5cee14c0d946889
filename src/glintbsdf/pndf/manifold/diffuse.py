"""Diffuse reflection of the facets under a footprint.

Both classes compute ``f cosθ_o`` of a white surface, per steradian. Directions are unit vectors of
the upper hemisphere, in the local shading frame.
"""

from __future__ import annotations

from math import pi

import drjit as dr
import mitsuba as mi

from glintbsdf.footprint.domain import Domain
from glintbsdf.footprint.query import Query
from glintbsdf.microfacet.mean_plane import slope_of
from glintbsdf.microfacet.slope_frame import SlopeFrame
from glintbsdf.pndf.filters.moments import MomentPyramid
from glintbsdf.pndf.manifold.mesh import TexelMesh
from glintbsdf.pndf.manifold.projected_area import ProjectedArea
from glintbsdf.pndf.sharing import shared


class FacetDiffuse:
    """All facets under the footprint, each diffuse: f_d = P(ω) / (π ω_z), with ω to the light.

    Wu, Luan, Hašan and Ramamoorthi, "Position-Normal Manifold for Efficient Glint Rendering on
    High-Resolution Normal Maps" (2024), section 4.3, Eq. 14. A facet counts with its own area,
    which is 1/m_z times its area on the surface. Facets neither hide nor light each other. So the
    share of uniform light that they reflect is the mean of (1 + 1/m_z)/2, which exceeds 1 by a
    quarter of the mean squared slope.

    Args:
        mesh (TexelMesh): the manifold.
    """

    def __init__(self, mesh: TexelMesh) -> None:
        self.area = ProjectedArea(mesh)

    def parameters_changed(self) -> None:
        """Follow a change of the mesh's data."""
        self.area.parameters_changed()

    def eval(
        self,
        wi,
        wo,
        mode: mi.TransportMode,
        query: Query,
        active: mi.Bool,
        frame: SlopeFrame | None = None,
    ) -> mi.Float:
        """``f_d cosθ_o``. The light is at ``wo``, or at ``wi`` where importance is transported.

        ``frame``: the frame of a height map's slopes on the surface. The direction ω in the shading
        frame is ω′ in the map, and P(ω)/ω_z = P′(ω′)/ω′_z.
        """
        if frame is not None:
            seen_i, seen_o = frame.direction_to_map(wi), frame.direction_to_map(wo)
            own = self.eval(seen_i, seen_o, mode, query, active)
            return own * (wo.z / seen_o.z)
        if mode == mi.TransportMode.Importance:
            return self.area.eval(wi, query, active) * wo.z / (pi * wi.z)
        return self.area.eval(wo, query, active) / pi

    def parts(self) -> dict[str, int]:
        """Memory of each part, besides the mesh, bytes."""
        return {}

    def __repr__(self) -> str:
        return "manifold"


class OrenNayarDiffuse:
    """The filtered surface: Oren and Nayar's model around the mean normal of the footprint.

    Wu24, appendix C: the frame is that of the mean projected normal, and the roughness follows from
    the variance of slopes, as in LEADR mapping (Dupuy et al. 2013). σ² is half the trace of the
    slopes' covariance. The model is the "qualitative" one of Oren and Nayar, "Generalization of
    Lambert's Reflectance Model", SIGGRAPH 1994, without interreflection.

    Args:
        mesh (TexelMesh): holds the normals; its triangles are not used.
        domain (Domain): the queries to expect, see :class:`~.MomentPyramid`.
    """

    def __init__(self, mesh: TexelMesh, domain: Domain | None = None) -> None:
        self.mesh, self.domain = mesh, domain
        self.parameters_changed()

    def parts(self) -> dict[str, int]:
        """Memory of each part, besides the mesh, bytes."""
        return {f"MIP levels {self.pyramid.first} to {self.pyramid.top}": self.pyramid.nbytes}

    def parameters_changed(self) -> None:
        """Recompute the averages from the data of the mesh."""

        def make() -> MomentPyramid:
            wrap_mode = self.mesh.normal_map.wrap_mode
            return MomentPyramid(self.mesh.data, wrap_mode, slope_moments, domain=self.domain)

        self.pyramid = shared(self.mesh, make, "slopes of facets", self.domain)

    def eval(
        self,
        wi,
        wo,
        mode: mi.TransportMode,
        query: Query,
        active: mi.Bool,
        frame: SlopeFrame | None = None,
    ) -> mi.Float:
        """``f cosθ_o``; zero where either direction is below the mean facet.

        The model is reciprocal about the mean normal, but cosθ_o is relative to the surface, as in
        Mitsuba's ``normalmap``. So the two directions are swapped where importance is transported.

        ``frame``: the frame of a height map's slopes on the surface. The variance of slopes counts
        as the same in all directions of the map.
        """
        x, y, slope_x, slope_y, squared = self.pyramid.average(query)
        variance = 0.5 * dr.maximum(squared - slope_x * slope_x - slope_y * slope_y, 0)
        normal = mi.Vector3f(x, y, dr.safe_sqrt(1 - x * x - y * y))
        if frame is not None:
            normal = frame.normal_from_map(normal)
            entries = [frame.matrix[i, j] for i in range(2) for j in range(2)]
            variance = variance * (0.5 * sum(entry * entry for entry in entries))
        mean = mi.Frame3f(mi.Normal3f(normal))
        local_i, local_o = mean.to_local(wi), mean.to_local(wo)
        if mode == mi.TransportMode.Importance:
            return oren_nayar(local_o, local_i, variance) * (wo.z / wi.z)
        return oren_nayar(local_i, local_o, variance)

    def __repr__(self) -> str:
        return f"oren_nayar[{self.pyramid.nbytes / 2**20:.1f} MiB]"


def slope_moments(m: mi.Vector2f) -> list:
    """Projected normal, slope, and squared slope of a facet."""
    slope = slope_of(m)
    return [m.x, m.y, slope.x, slope.y, dr.squared_norm(slope)]


def oren_nayar(wi: mi.Vector3f, wo: mi.Vector3f, variance: mi.Float) -> mi.Float:
    """``f cosθ_o`` of a white rough surface (Oren and Nayar 1994).

    ``variance``: σ², the variance of the facets' inclination, radians².
    """
    active = (wi.z > 0) & (wo.z > 0)
    a = 1 - 0.5 * variance / (variance + 0.33)
    b = 0.45 * variance / (variance + 0.09)
    # cos(φ_i − φ_o) sin α tan β, with α the larger and β the smaller angle. The product of the
    # projections is sinθ_i sinθ_o cos(φ_i − φ_o), and the smaller angle has the larger cosine.
    product = dr.fma(wi.x, wo.x, wi.y * wo.y)
    across = dr.maximum(product, 0) / dr.select(active, dr.maximum(wi.z, wo.z), 1)
    return dr.select(active, (a + b * across) * wo.z / pi, 0)
