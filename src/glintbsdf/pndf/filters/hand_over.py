"""From glints to their smooth limit: a P-NDF for small footprints, and one lobe for large ones."""

from __future__ import annotations

from collections.abc import Sequence

import drjit as dr
import mitsuba as mi

from glintbsdf.core.errors import check
from glintbsdf.footprint.domain import Domain
from glintbsdf.footprint.gaussian import Footprint
from glintbsdf.footprint.query import Query
from glintbsdf.pndf.base import PNDF
from glintbsdf.pndf.filters.filters import Filtered

#: Base roughness of the lobe: almost none, as the P-NDF has only the roughness of the map.
ALPHA = 1e-3


class HandOver(PNDF):
    """A mixture of a P-NDF and LEAN's lobe of the same map, weighted by the footprint's size.

    The size is the geometric mean of the footprint's standard deviations along its axes, in texels.
    Up to the size ``sigma``, D is the P-NDF. From twice that size on it is the lobe, which costs
    the same for every footprint. Between them it is a mixture, whose weight is smooth in the
    logarithm of the size. Evaluation and sampling use the same weight.

    Args:
        near: the P-NDF of a normal map.
        sigma (float): size of the footprint, texels, > 0.
        owner (str): the name that errors give, usually the plugin's.
        domain (Domain): the queries to expect, see :class:`Filtered`.

    Raises:
        ParameterError: ``sigma`` is not positive; the message calls it ``hand_over``.
    """

    def __init__(
        self, near: PNDF, sigma: float, owner: str = "HandOver", domain: Domain | None = None
    ) -> None:
        check(sigma > 0, owner, "hand_over", "a number > 0", sigma)
        self.near, self.sigma, self.owner, self.domain = near, float(sigma), owner, domain
        self.far = Filtered(near.normal_map, "lean", alpha=ALPHA, owner=owner, domain=domain)

    # These are the P-NDF's own.
    data = property(lambda self: self.near.data)
    normal_map = property(lambda self: self.near.normal_map)
    kernel = property(lambda self: self.near.kernel)
    epsilon = property(lambda self: self.near.epsilon)
    roughness_keys = property(lambda self: self.near.roughness_keys)

    def build(self, domain: Domain | None = None) -> None:
        self.domain = domain
        for part in (self.near, self.far):
            part.build(domain)

    def prepare_for_lights(self) -> None:
        for part in (self.near, self.far):
            part.prepare_for_lights()

    def weight(self, query: Query | Footprint) -> mi.Float:
        """The lobe's weight in the mixture, in [0, 1]."""
        height, width, _ = self.data.shape
        wrap_mode = self.normal_map.wrap_mode
        kernel = Query.of(query).texel_kernel("gaussian", height, width, wrap_mode)
        area = kernel.sigma_u_given_v * kernel.sigma_v
        t = dr.clip(0.5 * dr.log2(area * (1 / self.sigma**2)), 0, 1)
        return t * t * (3 - 2 * t)

    def _eval(self, m: mi.Vector2f, query: Query, active: mi.Bool) -> mi.Float:
        """D(m), the density of projected normals over the unit disk; 0 outside of it."""
        weight = self.weight(query)
        near = self.near.eval(m, query, active & (weight < 1))
        far = self.far.eval(m, query, active & (weight > 0))
        return dr.fma(1 - weight, near, weight * far)

    def _sample(
        self, query: Query, sample1: mi.Float, sample2: mi.Point2f, active: mi.Bool
    ) -> mi.Vector2f:
        """Draw a projected normal with density D."""
        weight = self.weight(query)
        is_far = sample1 < weight
        sample1 = dr.select(
            is_far,
            sample1 / dr.select(weight > 0, weight, 1),
            (sample1 - weight) / dr.select(weight < 1, 1 - weight, 1),
        )
        sample1 = dr.minimum(sample1, 1 - 2**-24)
        near = self.near.sample(query, sample1, sample2, active & ~is_far)
        return dr.select(is_far, self.far.sample(query, sample1, sample2), near)

    def smooth(self) -> PNDF | None:
        return self.near.smooth()

    def projected_areas(self, directions, query, active):
        """The projected areas of the map's facets; the lobe has almost the same."""
        return self.near.projected_areas(directions, query, active)

    def masking(self, name: str, height_correlated: bool = True):
        return self.near.masking(name, height_correlated)

    def traverse(self, callback: mi.TraversalCallback) -> None:
        self.near.traverse(callback)

    def parameters_changed(self, keys: Sequence[str] = ()) -> None:
        """Check new data, and rebuild both."""
        self.near.parameters_changed(keys)
        if not keys or "data" in keys:
            self.far.data = self.near.data
            if self.near.normal_map is not None:
                self.far.normal_map = self.near.normal_map
            self.far.build(self.domain)

    def parts(self) -> dict[str, int]:
        """Memory of each part of both, bytes; they share the map, which counts once."""
        return {**self.far.parts(), **self.near.parts()}

    def __repr__(self) -> str:
        near, far = (str(x).replace("\n", "\n  ") for x in (self.near, self.far))
        return f"HandOver[\n  {near},\n  {far},\n  sigma = {self.sigma:g} texels\n]"
