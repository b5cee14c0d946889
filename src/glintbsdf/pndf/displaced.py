"""The facets of a displaced surface: a P-NDF of a height map, seen in the shading frame.

A P-NDF of a height map lives in the frame of the map: its slopes are texels over texels. On a
surface texels lie turned, mirrored or stretched, and so do the facets; the mathematics is in
:mod:`glintbsdf.microfacet.slope_frame`. This module puts both together, once for every method and
every masking.
"""

from __future__ import annotations

import drjit as dr
import mitsuba as mi

from glintbsdf.footprint.query import Query
from glintbsdf.microfacet.frame import normal_from_projection
from glintbsdf.microfacet.masking import SmithMasking
from glintbsdf.microfacet.slope_frame import SlopeFrame
from glintbsdf.pndf.base import PNDF


class Displaced(PNDF):
    """A P-NDF of a height map at one surface interaction.

    Args:
        pndf: the P-NDF in the frame of the map.
        frame: the surface's frame at the interaction.
    """

    def __init__(self, pndf: PNDF, frame: SlopeFrame) -> None:
        self.pndf, self.frame = pndf, frame
        self.owner, self.colors, self.intensity = pndf.owner, pndf.colors, pndf.intensity

    def eval_normal(self, m: mi.Vector3f, query: Query, active: mi.Bool) -> mi.Float:
        of_map = self.frame.normal_to_map(m)
        density = self.pndf.eval_normal(of_map, in_map(query, self.frame), active)
        return density * self.frame.density_ratio(m, of_map)

    def sample_visible(self, wi, query, sample1, sample2, active):
        seen_from = self.frame.direction_to_map(wi)
        of_map = self.pndf.sample_visible(
            seen_from, in_map(query, self.frame), sample1, sample2, active
        )
        # An invalid sample stays invalid.
        return dr.select(of_map.z > 0, self.frame.normal_from_map(of_map), of_map)

    def visible_pdf(self, wi, m, density, query, active):
        of_map = self.frame.normal_to_map(m)
        ratio = self.frame.density_ratio(m, of_map)
        own = density / dr.select(ratio > 0, ratio, 1)
        seen_from = self.frame.direction_to_map(wi)
        pdf = self.pndf.visible_pdf(seen_from, of_map, own, in_map(query, self.frame), active)
        # Per solid angle as well: divided by cosθ it is a density over the disk.
        return dr.select(ratio > 0, pdf * (ratio * m.z / of_map.z), 0)

    def _eval(self, m, query, active):
        normal = normal_from_projection(m)
        return dr.select(dr.squared_norm(m) < 1, self.eval_normal(normal, query, active), 0)

    def _sample(self, query, sample1, sample2, active):
        s = self.pndf.sample(in_map(query, self.frame), sample1, sample2, active)
        inside = dr.squared_norm(s) < 1
        m = self.frame.normal_from_map(normal_from_projection(s))
        return dr.select(inside, mi.Vector2f(m.x, m.y), s)


class DisplacedMasking(SmithMasking):
    """Masking and shadowing by the facets of a height map at one surface interaction.

    Args:
        masking: the masking in the frame of the map.
        frame: the surface's frame at the interaction.
    """

    def __init__(self, masking: SmithMasking, frame: SlopeFrame) -> None:
        super().__init__(masking.height_correlated)
        self.of_map, self.frame = masking, frame

    def eval(self, wi, wo, query, mode, active):
        wi, wo = (self.frame.direction_to_map(w) for w in (wi, wo))
        return self.of_map.eval(wi, wo, in_map(query, self.frame), mode, active)


def in_map(query: Query, frame: SlopeFrame) -> Query:
    """The query with the turn and the spread of projected normals in the frame of the map.

    Both are carried by M⁻¹, which is exact where UVs are conformal or facets lie flat: elsewhere
    ∂m′/∂m differs from it by the squares of slopes.
    """
    if query.turn is None and not query.spread:
        return query

    def make() -> Query:
        turn = None if query.turn is None else frame.inverse @ query.turn
        spread = tuple(frame.inverse @ vector for vector in query.spread)
        return Query(query.footprint, turn, spread, query.parameters, query.place)

    return query.once("displaced", make)
