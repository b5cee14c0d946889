"""The exact P-NDF of the position-normal manifold.

Wu, Luan, Hašan and Ramamoorthi, "Position-Normal Manifold for Efficient Glint Rendering on
High-Resolution Normal Maps" (2024), section 4.1. Evaluation sums Eq. 5 over all triangles under the
footprint, which inverted lists find. Sampling is Eq. 6.
"""

from __future__ import annotations

from collections.abc import Sequence

import drjit as dr
import mitsuba as mi
import numpy as np

from glintbsdf.core.tuning import tuning
from glintbsdf.footprint.domain import Domain
from glintbsdf.footprint.gaussian import Footprint
from glintbsdf.footprint.kernels import gaussian_like
from glintbsdf.footprint.query import Query
from glintbsdf.maps.normalmap import NormalMap
from glintbsdf.microfacet.masking import SmithMasking
from glintbsdf.pndf.base import PNDF, register
from glintbsdf.pndf.elements.elements import Elements
from glintbsdf.pndf.index.lists import QuadLists, Window, every_quad
from glintbsdf.pndf.manifold import projected_area
from glintbsdf.pndf.manifold.mesh import TexelMesh, equilateral, quad_density
from glintbsdf.pndf.sharing import shared
from glintbsdf.pndf.smooth import SmoothBeckmann, smooth_alpha

#: Roughness σ_r of the elements that take the place of the manifold under lights. The sun, the
#: smallest light of a sky, spreads half vectors by a little more. Their lists are built for LISTED.
LIT_ROUGHNESS, LISTED = 1e-3, 5e-3

#: Roughness σ_r of the elements that replace the manifold while the map carries derivatives. It is
#: ROUGHNESS times the standard deviation of the map's normals, and at least MIN_ROUGHNESS.
ROUGHNESS, MIN_ROUGHNESS = 0.1, 1e-3


@register("manifold", title="manifold, exact", plugin="glint_manifold")
class Manifold(TexelMesh, PNDF):
    """Exact P-NDF of a normal map (Eq. 5) and its exact sampler (Eq. 6).

    Other arguments, attributes and errors are the same as in :class:`~.TexelMesh`.

    Args:
        domain (Domain): the queries to expect; None for any. Lists are made for the part of the map
            that these touch, and not at all where all footprints are summed quad by quad.
            Evaluation within the domain is the same to the last bit.

    As a function of the map, D at a fixed m jumps wherever an edge of a triangle crosses m. So its
    derivative is only a distribution, ``∂D/∂θ = −div_m ∫ k δ(m − n(u)) ∂n/∂θ du``. While the
    ``data`` carry derivatives, a mixture of :class:`~.Elements` of the same map replaces the
    manifold, in evaluation and in sampling. Its roughness is small, see :data:`ROUGHNESS`. The
    mixture is smooth, and its elements follow the same triangles. Averages of D over more than this
    roughness have the same derivatives as averages of the mixture. Where lights are integrated,
    their extent makes D smooth, and elements answer with derivatives and without.
    """

    normal_map: NormalMap
    area: projected_area.ProjectedArea | None = None

    maskings = ("ggx_fit", "analytic", "beckmann", "none")
    roughness_keys = ("data",)
    bytes_per_texel = 80.0
    integrates_lights = finds_environment = True

    #: Elements of the same map, for queries with a light's spread or the half vector's turn, with
    #: derivatives or without; None until :meth:`prepare_for_lights`.
    lit: Elements | None = None

    def __init__(
        self,
        normal_map: NormalMap,
        kernel: str = "gaussian",
        epsilon: float = 1e-6,
        owner: str = "Manifold",
        domain: Domain | None = None,
    ) -> None:
        self.check_room(normal_map, owner, domain)
        super().__init__(normal_map, kernel, epsilon, owner)
        self.build(domain)

    def build(self, domain: Domain | None = None) -> None:
        """Build the lists for queries within ``domain``, or load them from the cache."""
        self.domain = domain
        self.lists, self.area, self.stand_in, self.lit = None, None, None, None
        if dr.grad_enabled(self.data):
            spread = float(np.mean(np.var(self.normal_map.normals, axis=(0, 1)))) ** 0.5
            roughness = max(ROUGHNESS * spread, MIN_ROUGHNESS)
            self.stand_in = Elements(
                self.normal_map, roughness, owner=self.owner, domain=domain, data=self.data
            )
            return
        if domain is not None and domain.most_quads <= tuning().few_quads:
            return
        window = Window.whole(self.lattice)
        if domain is not None:
            window = Window.touched(self.lattice, domain)

        def build_lists() -> dict[str, np.ndarray]:
            return QuadLists.build(
                self.lattice,
                self.effective_triangles,
                self.data.array,
                self.normal_bounds(),
                window,
            )

        def make() -> QuadLists:
            arrays = self.cached(build_lists, self.epsilon, window)
            return QuadLists(self.lattice, arrays, window)

        self.lists = shared(self, make, "lists of quads", self.epsilon, window)

    def prepare_for_lights(self) -> None:
        """Make the elements that answer queries with a spread or a turn: the manifold's triangles
        are averaged over them as Gaussians, of which the elements are a mixture."""
        if self.lit is not None:
            return
        self.lit = Elements(
            self.normal_map,
            LIT_ROUGHNESS,
            owner=self.owner,
            domain=self.domain,
            data=None if self.stand_in is None else self.data,
            listed=LISTED,
        )
        self.lit.prepare_for_lights()

    def parameters_changed(self, keys: Sequence[str] = ()) -> None:
        """Check new data, and rebuild. Derivatives keep flowing to the data."""
        if keys and "data" not in keys:
            return
        super().parameters_changed(keys)
        self.build(self.domain)

    def normal_bounds(self) -> tuple[np.ndarray, np.ndarray]:
        """Smallest rectangle (lower, upper) of projected normals that holds all triangles."""
        normals = dr.unravel(mi.Vector2f, dr.detach(self.data.array))
        reach = equilateral(self.epsilon)[0][1] * 1.001
        lower, upper = (
            np.array([extreme(x)[0] for x in normals], np.float32) for extreme in (dr.min, dr.max)
        )
        return lower - np.float32(reach), upper + np.float32(reach)

    def eval(
        self, m: mi.Vector2f, query: Query | Footprint, active: bool | mi.Bool = True
    ) -> mi.Float:
        if self.stand_in is None and dr.grad_enabled(self.data):
            raise RuntimeError(
                f'{self.owner}: derivatives with respect to "data" need a smooth P-NDF, which '
                "params.update() makes; it must be called after dr.enable_grad()"
            )
        query = Query.of(query)
        if self.lit is None or not (query.spread or query.turn is not None):
            return self.eval_unlit(m, query, active)
        lit = query.once("lit", lambda: is_lit(query))
        return self.eval_unlit(m, query, active & ~lit) + dr.select(
            lit, self.lit.eval(m, self.query_of_elements(query), active & lit), 0
        )

    def sample(
        self,
        query: Query | Footprint,
        sample1: mi.Float,
        sample2: mi.Point2f,
        active: bool | mi.Bool = True,
    ) -> mi.Vector2f:
        query = Query.of(query)
        unlit = self.sample_unlit(query, sample1, sample2, active)
        if self.lit is None or not (query.spread or query.turn is not None):
            return unlit
        lit = query.once("lit", lambda: is_lit(query))
        seen = self.query_of_elements(query)
        return dr.select(lit, self.lit.sample(seen, sample1, sample2, active & lit), unlit)

    def eval_unlit(self, m: mi.Vector2f, query: Query, active: bool | mi.Bool) -> mi.Float:
        """D(m) for queries without a spread or a turn."""
        if self.stand_in is None:
            return super().eval(m, query, active)
        return self.stand_in.eval(m, self.query_of_elements(query), active)

    def sample_unlit(
        self, query: Query, sample1: mi.Float, sample2: mi.Point2f, active: bool | mi.Bool
    ) -> mi.Vector2f:
        """Draw a projected normal with the density :meth:`eval_unlit`."""
        if self.stand_in is None:
            return super().sample(query, sample1, sample2, active)
        return self.stand_in.sample(self.query_of_elements(query), sample1, sample2, active)

    def query_of_elements(self, question: Query | Footprint) -> Query:
        """The query with a narrower footprint: the Gaussian with the variance of this kernel."""
        query = Query.of(question)

        def narrowed() -> Query:
            return query.at(gaussian_like(self.kernel, query.footprint))

        return query.once(("elements", self.kernel), narrowed)

    def _eval(self, m: mi.Vector2f, query: Query, active: mi.Bool) -> mi.Float:
        """D(m), the density of projected normals over the unit disk (Eq. 5); 0 outside of it."""
        kernel = self.texel_kernel(query)
        active = active & (dr.squared_norm(m) < 1)
        if self.lists is not None:
            active &= self.lists.covers(m)
        small = kernel.touched_quads() <= tuning().few_quads

        def add(density, row, column, corner, active):
            normals = self.quad_normals(row, column, active)
            added = quad_density(m, corner, kernel, normals, self.epsilon, active)
            return density + dr.select(active, added, 0)

        # The lists come first: in the other order they are slower on LLVM.
        density = mi.Float(0)
        if self.lists is not None:
            density = self.lists.visit(m, kernel, add, active & ~small)
        return density + every_quad(self.lattice, kernel, add, active & small)

    def _sample(
        self, query: Query, sample1: mi.Float, sample2: mi.Point2f, active: mi.Bool
    ) -> mi.Vector2f:
        """Draw a projected normal with density D (Eq. 6): the normal at a position drawn from k.

        ``sample1`` is not used.
        """
        kernel = self.texel_kernel(query)
        return self.normal_at(kernel.mean + kernel.sample(sample2), active)

    def smooth(self) -> SmoothBeckmann:
        return SmoothBeckmann(lambda: smooth_alpha(self.alpha_squared()), owner=self.owner)

    def masking(self, name: str, height_correlated: bool = True) -> SmithMasking | None:
        """``ggx_fit`` and ``analytic`` are the masking of the facets under the footprint, over
        their mean plane; they differ in the estimate of the projected area."""
        area = projected_area.area(name, self, self.domain)
        if area is None:
            return super().masking(name, height_correlated)
        return projected_area.ProjectedAreaMasking(area, height_correlated)

    def projected_areas(self, directions, query, active):
        """The projected areas of the triangles, by :class:`~.ProjectedArea`. The first call must
        not be part of a recorded loop."""
        if self.area is None:
            self.area = projected_area.ProjectedArea(self)
        return self.area.projected_areas(directions, query, active)

    def parts(self) -> dict[str, int]:
        """Memory of each part of the structure, bytes."""
        parts = super().parts()
        for purpose, elements in (("derivatives", self.stand_in), ("lights", self.lit)):
            if elements is not None:
                own = elements.parts().items()
                parts |= {f"{name} for {purpose}": size for name, size in own if name != "map"}
        return {**parts, "lists of quads": 0 if self.lists is None else self.lists.nbytes}


def is_lit(query: Query) -> mi.Bool:
    """Whether the spread of a query, or its turn, is not zero."""
    lit = mi.Bool(False)
    for v in query.spread:
        lit |= dr.any(v != 0)
    if query.turn is not None:
        for column in query.turn:
            lit |= dr.any(column != 0)
    return lit
