"""The P-NDF of a synthesised map, exactly, from structures of its sample.

Every texel of the large map is one of the sample's, seen through the patch that owns it. So the
elements of the large map (:mod:`glintbsdf.pndf.elements.elements`) are found without storing it:

* a footprint of a few texels sums all elements under it, whose texels the look-up table finds;
* a larger one walks the sample's lists of elements once for every patch under it, and counts a
  quad if the patch owns it; the quads on seams are summed one by one
  (:mod:`glintbsdf.pndf.mip.patches`);
* tables of the sample's normals serve where a footprint is so large that their error is allowed
  (:mod:`glintbsdf.pndf.mip.tables`).

The first two are what :class:`~.Elements` of the large map gives, and so is the sampler.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from types import SimpleNamespace

import drjit as dr
import mitsuba as mi
import numpy as np

from glintbsdf.core.cache import load_or_build
from glintbsdf.core.errors import check
from glintbsdf.footprint.domain import Domain
from glintbsdf.footprint.gaussian import Footprint
from glintbsdf.footprint.kernels import TexelKernel
from glintbsdf.footprint.lattice import LatticeAxis
from glintbsdf.footprint.query import Query
from glintbsdf.maps.normalmap import MapShape, NormalMap, map_bytes
from glintbsdf.maps.quilting import Synthesis, check_sizes, synthesise
from glintbsdf.microfacet.mean_plane import choose_areas
from glintbsdf.pndf.base import changed_map, register
from glintbsdf.pndf.elements.elements import Elements, check_sigma_r
from glintbsdf.pndf.manifold.projected_area import mean_over_points
from glintbsdf.pndf.mip import tables
from glintbsdf.pndf.mip.patches import InSample, PatchLists, PatchTable


def synthesis_of(sample: NormalMap, options: Mapping, owner: str) -> Synthesis:
    """The look-up table of a map that is made of ``sample``, from the cache if it knows it.

    ``options``: the arguments of :func:`~.synthesise` besides.
    """

    def build() -> dict[str, np.ndarray]:
        return synthesise(sample, **options, owner=owner).arrays()

    arrays = load_or_build(build, sample.content_hash, *options.items())
    return Synthesis.from_arrays(sample.normals, options["output_size"], options["overlap"], arrays)


@register(
    "patches",
    title="synthesised map",
    plugin="glint_mip",
    options={"output_size": 512, "patch_size": 32},
    settings={"output_size": 512, "patch_size": 32, "representation": "exact"},
)
class Patches(Elements):
    """P-NDF of a large map synthesised from a sample: that of its elements, half a texel apart.

    It belongs to the variant of Mitsuba that is active when it is made. The unit square of UV is
    the large map, which repeats.

    Args:
        normal_map (NormalMap): the sample; it must repeat.
        output_size, patch_size, overlap, balance, seed: see :func:`~.synthesise`.
        sigma_r (float): intrinsic roughness, the standard deviation of normals about the map's, in
            [1e-8, 1].
        max_error (float): relative L1 error of the P-NDF allowed, on average over the map, ≥ 0; see
            :mod:`glintbsdf.pndf.mip.tables`. With 0 there are no tables.
        owner (str): the name that errors give, usually the plugin's.

    Attributes:
        data (mi.TensorXf): projected normals of the sample, h×w×2. After a change of its values,
            :meth:`parameters_changed` rebuilds everything.
        sigma_r (mi.Float): the roughness. Derivatives flow through it.
        synthesis (Synthesis): the large map.

    Raises :class:`~.ParameterError`.
    """

    integrates_lights = False
    step, curved = 0.5, True

    def __init__(
        self,
        normal_map: NormalMap,
        output_size: int = 4096,
        patch_size: int = 64,
        overlap: int | None = None,
        balance: float = 0.9,
        sigma_r: float = 0.005,
        max_error: float = 0.05,
        seed: int = 0,
        owner: str = "Patches",
    ) -> None:
        check(
            max_error >= 0 and np.isfinite(max_error),
            owner,
            "max_error",
            "a finite number ≥ 0",
            max_error,
        )
        check_sigma_r(owner, sigma_r)
        sample = (normal_map.height, normal_map.width)
        self.options = {
            "output_size": output_size,
            "patch_size": patch_size,
            "overlap": check_sizes(sample, output_size, patch_size, overlap, owner),
            "balance": balance,
            "seed": seed,
            "toroidal": True,
        }
        check(
            normal_map.wrap_mode == "repeat",
            owner,
            "representation",
            'lobes where "wrap_mode" is not repeat',
            f"exact, {normal_map.wrap_mode}",
        )
        self.max_error = float(max_error)
        self.owner, self.wrap_mode = owner, normal_map.wrap_mode
        self.sample_map, self.data = normal_map, mi.TensorXf(normal_map.normals)
        self.sigma_r = mi.Float(sigma_r)
        self.build()

    def build(self, domain: Domain | None = None) -> None:
        """Synthesise the map, and make the lists of the sample; for any query."""
        self.domain = domain
        self.synthesis = synthesis_of(self.sample_map, self.options, self.owner)
        size = self.synthesis.size
        self.place_seeds(size, size)
        self.table = PatchTable(self.synthesis)
        axis = LatticeAxis(size, self.wrap_mode)
        # Its axes are all that is asked of the lattice
        self.texels = self.lattice = SimpleNamespace(x=axis, y=axis)  # type: ignore[assignment]
        self.of_sample = Elements(
            self.sample_map, self.sigma_r[0], self.step, self.curved, self.owner
        )
        self.lists = PatchLists(  # type: ignore[assignment]  # with the same methods
            self.table, self.of_sample.lists, axis
        )
        self.tables = None
        if self.max_error > 0 and size >= tables.SMALLEST:
            synthesis, sigma_r = self.synthesis, self.sigma_r[0]
            arrays = load_or_build(
                lambda: tables.build(synthesis, sigma_r),
                self.sample_map.content_hash,
                *self.options.items(),
                sigma_r,
            )
            shape = self.sample_map.height - 1, self.sample_map.width - 1
            self.tables = tables.Tables(arrays, self.table, shape, self.max_error)

    def texel_kernel(self, query: Query | Footprint) -> TexelKernel:
        """The footprint on the map's texels."""
        size = self.synthesis.size
        return Query.of(query).texel_kernel("gaussian", size, size, self.wrap_mode)

    def level(self, query: Query | Footprint) -> mi.Int:
        """Which table answers, see :meth:`.Tables.level`; with derivatives by σ_r, none."""
        query = Query.of(query)
        made, kernel = self.tables, self.texel_kernel(query)
        if made is None or dr.grad_enabled(self.sigma_r):
            return mi.Int(-1)
        return query.once((self, "level"), lambda: made.level(kernel))

    def relative_error(self, query):
        if self.tables is None:
            return mi.Float(0)
        return self.tables.error(self.texel_kernel(query))

    def _eval(self, m, query, active):
        level = self.level(query)
        density = super()._eval(m, query, active & (level < 0))
        if self.tables is None:
            return density
        active = active & (dr.squared_norm(m) < 1)
        return density + self.tables.eval(m, query.footprint, self.wrap_mode, level, active)

    def _sample(self, query, sample1, sample2, active):
        level = self.level(query)
        exact = super()._sample(query, sample1, sample2, active & (level < 0))
        if self.tables is None:
            return exact
        footprint = query.footprint
        drawn = self.tables.sample(
            self.of_sample, footprint, self.wrap_mode, level, sample2, active
        )
        return dr.select(level < 0, exact, drawn)

    def corner_normals(self, row, column, active):
        if isinstance(row, InSample):
            return self.of_sample.corner_normals(row.row, column, active)
        with dr.suspend_grad():
            (top, bottom), (left, right) = (
                (mi.Int(v), self.lattice.x.following(v, mi.Int(v))) for v in (row, column)
            )
            places = self.table.corners((top, bottom), (left, right), active)
        corners = []
        for y, x in zip(places[::2], places[1::2], strict=True):
            index = 2 * self.of_sample.texels.vertex(y, x)
            corners.append(
                mi.Vector2f(
                    *(
                        dr.gather(mi.Float, self.of_sample.vertices, index + k, active)
                        for k in (0, 1)
                    )
                )
            )
        return corners

    def make_slopes(self) -> None:
        """None are kept: masking asks points of the map."""

    def projected_areas(self, directions, query, active):
        """Those of the elements under a footprint of a few texels; else means over points of it."""
        few = self.weights(query)[1]
        summed = super().projected_areas(directions, query, active)
        points = mean_over_points(
            self,
            self.texel_kernel(query),
            directions,
            active & ~few,
            None,
            dr.square(self.sigma_r),
        )
        return choose_areas(few, summed, points)

    def prepare_for_lights(self) -> None:
        """Nothing: lights are sampled."""

    def traverse(self, callback: mi.TraversalCallback) -> None:
        callback.put("data", self.data, mi.ParamFlags.NonDifferentiable)
        callback.put("sigma_r", self.sigma_r, mi.ParamFlags.Differentiable)

    def parameters_changed(self, keys: Sequence[str] = ()) -> None:
        """Check what has changed; a new sample makes everything anew."""
        check_sigma_r(self.owner, self.sigma_r[0])
        if not keys or "data" in keys:
            self.sample_map = changed_map(self.data, self.wrap_mode, self.owner)
        self.build()

    @property
    def shape(self) -> MapShape:
        """Size and wrap mode of the large map."""
        return MapShape(self.synthesis.size, self.synthesis.size, self.wrap_mode)

    @property
    def normal_map(self) -> NormalMap:  # type: ignore[override]  # made anew
        """The large map, made anew whenever it is asked for: it is for references and plots, and as
        large as what is saved by not storing it."""
        return self.synthesis.normal_map()

    def parts(self) -> dict[str, int]:
        """Memory of sample, lists, tables and look-up table, bytes."""
        of_sample = self.of_sample.parts()
        return {
            "sample": map_bytes(self.sample_map) + of_sample["elements"],
            "lists of elements": of_sample["lists of elements"],
            "tables": 0 if self.tables is None else self.tables.nbytes,
            "look-up table": self.table.nbytes,
        }

    def __repr__(self) -> str:
        return (
            f"Patches[{self.synthesis}, sigma_r={self.sigma_r[0]:g}, {self.wrap_mode}, "
            f"{self.nbytes / 1e6:.1f} MB]"
        )
