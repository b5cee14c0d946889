"""From glints to their smooth limit: a P-NDF up to some size of the footprint, its lobe beyond."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi

from glintbsdf.core.errors import check
from glintbsdf.footprint.domain import Reach
from glintbsdf.footprint.kernels import TexelKernel
from glintbsdf.pndf.filters.filters import Filtered

#: Roughness of the lobe besides that of the map: almost none, as a P-NDF has none of its own.
ALPHA = 1e-3


class HandOver:
    """A mixture of a P-NDF and LEAN's lobe of the same map, by the size of the footprint.

    The size is the geometric mean of the footprint's standard deviations along its axes, in texels.
    Up to ``sigma`` there is the P-NDF alone, from twice that size on the lobe alone, which costs
    the same for every footprint; between them their mixture, whose weight is smooth in the
    logarithm of the size. Evaluation and sampling mix alike.

    Args:
        near: the P-NDF of a normal map.
        sigma (float): texels, > 0.
        owner (str): whom errors name, usually the plugin.
        reach (Reach): what will be asked, see :class:`Filtered`.
    """

    def __init__(
        self, near: object, sigma: float, owner: str = "HandOver", reach: Reach | None = None
    ) -> None:
        check(sigma > 0, owner, "hand_over", "a number > 0", sigma)
        self.near, self.sigma = near, float(sigma)
        self.far = Filtered(near.normal_map, "lean", alpha=ALPHA, owner=owner, reach=reach)

    # What others ask a P-NDF of a normal map for.
    data = property(lambda self: self.near.data)
    normal_map = property(lambda self: self.near.normal_map)
    kernel = property(lambda self: self.near.kernel)
    epsilon = property(lambda self: self.near.epsilon)

    def weight(self, footprint) -> mi.Float:
        """The lobe's share of the mixture, from 0 to 1."""
        height, width, _ = self.data.shape
        kernel = TexelKernel("gaussian", footprint, height, width, self.normal_map.wrap_mode)
        area = kernel.sigma_u_given_v * kernel.sigma_v
        t = dr.clip(0.5 * dr.log2(area * (1 / self.sigma**2)), 0, 1)
        return t * t * (3 - 2 * t)

    def eval(self, m: mi.Vector2f, footprint, active: bool | mi.Bool = True) -> mi.Float:
        """D(m), the density of projected normals over the unit disk; 0 outside of it."""
        weight = self.weight(footprint)
        near = self.near.eval(m, footprint, mi.Bool(active) & (weight < 1))
        far = self.far.eval(m, footprint, mi.Bool(active) & (weight > 0))
        return dr.fma(1 - weight, near, weight * far)

    def sample(
        self, footprint, sample1: mi.Float, sample2: mi.Point2f, active: bool | mi.Bool = True
    ) -> mi.Vector2f:
        """Draw a projected normal with density D."""
        weight = self.weight(footprint)
        is_far = sample1 < weight
        sample1 = dr.select(
            is_far,
            sample1 / dr.select(weight > 0, weight, 1),
            (sample1 - weight) / dr.select(weight < 1, 1 - weight, 1),
        )
        sample1 = dr.minimum(sample1, 1 - 2**-24)
        near = self.near.sample(footprint, sample1, sample2, mi.Bool(active) & ~is_far)
        return dr.select(is_far, self.far.sample(footprint, sample1, sample2), near)

    def traverse(self, callback: mi.TraversalCallback) -> None:
        self.near.traverse(callback)

    def parameters_changed(self, keys: list[str] = ()) -> None:
        """Check new data, and rebuild."""
        self.near.parameters_changed(keys)
        if not keys or "data" in keys:
            self.far.data = self.near.data
            self.far.build(self.near.normal_map)

    @property
    def nbytes(self) -> int:
        """Memory of both, bytes."""
        return self.near.nbytes + self.far.nbytes

    @property
    def parts(self) -> dict[str, int]:
        """Memory of each part of both, bytes."""
        return {**self.near.parts, **self.far.parts}

    def __repr__(self) -> str:
        near, far = (str(x).replace("\n", "\n  ") for x in (self.near, self.far))
        return f"HandOver[\n  {near},\n  {far},\n  sigma = {self.sigma:g} texels\n]"
