"""Smooth surfaces as P-NDFs: the same distribution of normals wherever one looks."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence

import drjit as dr
import mitsuba as mi

from glintbsdf.footprint.query import Query
from glintbsdf.microfacet.frame import normal_from_projection
from glintbsdf.pndf.base import PNDF

#: The smallest roughness that Mitsuba's Beckmann distribution can have.
MIN_ALPHA = 1e-4


def smooth_alpha(alpha_squared: mi.Vector2f, sigma_r: float | mi.Float = 0.0) -> mi.Vector2f:
    """The roughness of a smooth surface, at least :data:`MIN_ALPHA`.

    Its facets have this squared roughness together, and each has the intrinsic roughness σ_r, which
    adds 2σ_r².
    """
    return dr.sqrt(dr.maximum(alpha_squared + 2 * dr.square(sigma_r), MIN_ALPHA**2))


class SmoothSurface(PNDF):
    """The facets of a smooth surface, as ``roughconductor`` has them, for any footprint.

    Visible normals, masking and shadowing are separable, as in that plugin of Mitsuba.

    Args:
        alpha: function that returns an ``mi.Vector2f``, the roughness along u and v, at least 1e-4.
        keys: names of the parameters on which the roughness depends.
        distribution (str): ``beckmann`` or ``ggx``.
    """

    def __init__(
        self,
        alpha: Callable[[], mi.Vector2f],
        keys: Iterable[str] = ("data",),
        owner: str = "SmoothSurface",
        distribution: str = "beckmann",
    ) -> None:
        self.owner, self.name = owner, distribution
        self.maskings = (distribution, "none")  # type: ignore[misc]
        self.current, self.keys = alpha, frozenset(keys)
        self.roughness_keys = tuple(keys)  # type: ignore[misc]
        self.derive()

    def derive(self) -> None:
        """Take up the roughness."""
        self.alpha = self.current()
        kind = {"beckmann": mi.MicrofacetType.Beckmann, "ggx": mi.MicrofacetType.GGX}[self.name]
        self.distribution = mi.MicrofacetDistribution(
            kind, self.alpha.x, self.alpha.y, sample_visible=True
        )

    def alpha_squared(self) -> mi.Vector2f:
        return dr.square(self.alpha)

    def parameters_changed(self, keys: Sequence[str] = ()) -> None:
        if not keys or self.keys & set(keys):
            self.derive()

    def eval_normal(self, m: mi.Vector3f, query: Query, active: mi.Bool) -> mi.Float:
        return self.distribution.eval(m)

    def _eval(self, m: mi.Vector2f, query: Query, active: mi.Bool) -> mi.Float:
        return self.distribution.eval(normal_from_projection(m))

    def _sample(self, query, sample1, sample2, active):
        # From straight above, all facets are seen in proportion to their projections.
        return mi.Vector3f(self.distribution.sample(mi.Vector3f(0, 0, 1), sample2)[0]).xy

    def sample_visible(self, wi, query, sample1, sample2, active):
        """One of the normals that the view sees (Heitz and d'Eon 2014)."""
        return mi.Vector3f(self.distribution.sample(wi, sample2)[0])

    def visible_pdf(self, wi, m, density, query, active):
        return self.distribution.pdf(wi, m)

    def __repr__(self) -> str:
        alpha_u, alpha_v = (x[0] for x in self.alpha)
        return f"{type(self).__name__}[alpha_u = {alpha_u:.4g}, alpha_v = {alpha_v:.4g}]"


class SmoothBeckmann(SmoothSurface):
    """The facets of a smooth Beckmann surface."""
