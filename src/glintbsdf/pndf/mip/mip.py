"""The P-NDF of a synthesised map, from lobes of the MIP level that suits the footprint.

Tan, Zhu, Xu, Meng, Wang and Yan, "Real-Time Microstructure Rendering with MIP-mapped Normal Map
Samples" (2022), section 5.2. The map is made from a small sample
(:mod:`glintbsdf.maps.quilting`); it takes its lobes from the sample, gathered to few per grid on
each MIP level (:mod:`glintbsdf.pndf.mip.levels`).

On a level, all lobes of the grids that the footprint reaches count, each by the closed form of
:mod:`glintbsdf.pndf.gaussian_elements`. Their sum is divided by the sum of their masses, so that D
integrates to one whatever the footprint. Where λ lies between two levels, both are blended; in the
paper's Eq. 9 the weights have changed places.
"""

from __future__ import annotations

from collections.abc import Sequence
from math import inf, log2, pi

import drjit as dr
import mitsuba as mi
import numpy as np

from glintbsdf.core.cache import load_or_build
from glintbsdf.core.errors import check, check_whole
from glintbsdf.core.hashing import pcg3d, uniform
from glintbsdf.core.loops import add_where, symbolic_loop, where_needed
from glintbsdf.core.messages import warn
from glintbsdf.core.tuning import tuning
from glintbsdf.footprint.domain import Domain
from glintbsdf.footprint.gaussian import Footprint
from glintbsdf.footprint.kernels import REACH, SIGMA_MIN, TexelKernel
from glintbsdf.footprint.query import Query
from glintbsdf.maps.normalmap import MapShape, NormalMap, map_bytes
from glintbsdf.maps.quilting import Synthesis, check_sizes, synthesise
from glintbsdf.microfacet.mean_plane import lobe_area, slope_of
from glintbsdf.pndf.base import PNDF, changed_map, register
from glintbsdf.pndf.elements.elements import check_sigma_r, cut_of_lists, mass_under_fade
from glintbsdf.pndf.gaussian_elements import SIGMA_H, lattice_mass, point_of_ellipse
from glintbsdf.pndf.mip import levels as lobe_levels
from glintbsdf.pndf.mip.cells import LevelCells
from glintbsdf.pndf.mip.packing import NORMAL_CUT, Lobe
from glintbsdf.pndf.smooth import SmoothBeckmann, smooth_alpha

#: Width of a footprint in standard deviations, a pixel's by default: its area in Eq. 8 is that of a
#: square as wide.
WIDTH = 2.0

#: A footprint more elongated than this counts as wider in Eq. 8, which limits the cost.
MAX_ANISOTROPY = 16.0


#: Squared distance, in standard deviations of footprint and lobe together, from which on lobes of
#: grids count for nothing: 0.4 % of the mass.
GRID_CUT = 12.25


@register(
    "mip",
    title="MIP-mapped lobes",
    plugin="glint_mip",
    options={"output_size": 512, "patch_size": 32},
    settings={"output_size": 512, "patch_size": 32},
)
class Mip(PNDF):
    """P-NDF of a large map synthesised from a sample (Tan et al. 2022).

    It belongs to the variant of Mitsuba that is active when it is made. The unit square of UV is
    the large map. Its ``wrap_mode`` is the sample's: to ``repeat``, its edges are made to fit;
    ``mirror`` mirrors it; ``clamp`` does so too, and holds the footprint's centre inside.

    Args:
        normal_map (NormalMap): the sample.
        output_size, patch_size, overlap, balance, seed: see
            :func:`~.synthesise`.
        clusters (int): k, lobes per grid of each level, from 1 to 1024.
        lod_scale (float): C_P ≥ 0 of Eq. 8, λ = C_P log₂ P with P the footprint's area in texels,
            (2σ)² for a round one. With 1/2, a level's grids are as wide as the footprint.
        sigma_r (float): intrinsic roughness, the standard deviation of normals about the map's, in
            [1e-8, 1].
        normal_weight (float): weight ≥ 0 of normals against positions where lobes are clustered;
            see :class:`~.Clustering`.
        owner (str): the name that errors give, usually the plugin's.

    Attributes:
        data (mi.TensorXf): projected normals of the sample, h×w×2. After a change of its values,
            :meth:`parameters_changed` rebuilds everything.
        sigma_r (mi.Float): the roughness. Derivatives flow through it.
        synthesis (Synthesis): the large map.

    Raises :class:`~.ParameterError`.
    """

    integrates_lights = finds_environment = True
    maskings = ("footprint", "beckmann", "none")

    def __init__(
        self,
        normal_map: NormalMap,
        output_size: int = 4096,
        patch_size: int = 64,
        overlap: int | None = None,
        clusters: int = 32,
        lod_scale: float = 0.5,
        balance: float = 0.9,
        sigma_r: float = 0.005,
        seed: int = 0,
        normal_weight: float = 8.0,
        owner: str = "Mip",
    ) -> None:
        sample = (normal_map.height, normal_map.width)
        overlap = check_sizes(sample, output_size, patch_size, overlap, owner)
        check_whole(clusters, lambda k: 1 <= k <= 1024, owner, "clusters", "from 1 to 1024")
        check(0 <= lod_scale < 16, owner, "lod_scale", "a number in [0, 16)", lod_scale)
        check(0 <= normal_weight < inf, owner, "normal_weight", "a number ≥ 0", normal_weight)
        self.clusters, self.lod_scale, self.owner = clusters, float(lod_scale), owner
        self.normal_weight = float(normal_weight)
        self.options = {
            "output_size": output_size,
            "patch_size": patch_size,
            "overlap": overlap,
            "balance": balance,
            "seed": seed,
        }
        self.wrap_mode = normal_map.wrap_mode
        self.sigma_r = mi.Float(sigma_r)
        check_sigma_r(owner, sigma_r)
        self.data = mi.TensorXf(normal_map.normals)
        self.sample_map = normal_map
        self.build()

    def build(self, domain: Domain | None = None) -> None:
        """Synthesise the map and cluster its lobes, for any query; the cache on disk may know them
        already."""
        sample = self.sample_map
        distinct = len(np.unique(sample.normals.view(np.complex64)))
        if distinct < self.clusters:
            warn(
                f"{self.owner}: the sample has {distinct} distinct normals, fewer than "
                f'"clusters" = {self.clusters}: lobes that differ in position only are kept apart'
            )
        options = {**self.options, "toroidal": self.wrap_mode == "repeat"}

        def build_levels() -> dict[str, np.ndarray]:
            synthesis = synthesise(sample, **options, owner=self.owner)
            levels = lobe_levels.build(
                synthesis, self.clusters, self.normal_weight, self.options["seed"]
            )
            return {**synthesis.arrays(), **levels}

        key = (sample.content_hash, *options.items(), self.clusters, self.normal_weight)
        arrays = load_or_build(build_levels, *key)
        self.synthesis = Synthesis.from_arrays(
            sample.normals, self.options["output_size"], self.options["overlap"], arrays
        )
        self.grids = LevelCells(
            self.synthesis, arrays, self.clusters, mirrored=self.wrap_mode != "repeat"
        )
        self.words = mi.UInt32(lobe_levels.all_words(arrays))
        # λ at which a level's grids are as wide as it says: log2 of their width, rounded
        layout = self.grids.layout
        self.cell_level = round(log2(layout.inner))
        self.finest_level = self.cell_level - len(layout.divisions)
        dr.eval(self.words)

    # --------------------------------------------------------------------------------------------
    #  Section 5.2.1: levels and lobes
    # --------------------------------------------------------------------------------------------

    def texel_kernel(self, query: Query | Footprint) -> TexelKernel:
        """The footprint on the map's texels."""
        query = Query.of(query)
        return query.once((self, "kernel"), lambda: self.make_kernel(query.footprint))

    def make_kernel(self, footprint: Footprint, added: mi.Float | None = None) -> TexelKernel:
        """The footprint on the map's texels, widened by the variance ``added`` (texels²)."""
        size = self.synthesis.size
        variance = SIGMA_MIN**2 if added is None else added + SIGMA_MIN**2
        wrap_mode = self.wrap_mode
        if wrap_mode == "clamp":
            footprint = Footprint(dr.clip(footprint.uv, 0, 1), footprint.du, footprint.dv)
            wrap_mode = "mirror"
        return TexelKernel("gaussian", footprint, size, size, wrap_mode, added=(variance, variance))

    def level(self, kernel: TexelKernel) -> tuple[mi.UInt32, mi.UInt32, mi.Float]:
        """Eq. 8: the levels below and above λ, and the weight of the one above (Eq. 9).

        The levels are indices of :class:`~.LevelCells`. Between texels and the
        finest grids that there are, λ belongs to the texels.
        """
        variance = dr.square(kernel.sigma_u) + dr.square(kernel.sigma_v)
        major = variance - kernel.minor_variance
        minor = dr.maximum(kernel.minor_variance, major * (1 / MAX_ANISOTROPY**2))
        area = WIDTH**2 * dr.sqrt(major * minor)
        scaled = self.lod_scale * dr.log2(area) - (self.finest_level - 1)
        scaled = dr.clip(scaled, 0, self.grids.levels - 1)
        below = dr.floor(scaled)
        fraction = scaled - below
        above = dr.select(fraction > 0, below + 1, below)
        return mi.UInt32(below), mi.UInt32(above), fraction

    def visit(self, footprint, kernel, level, add, state: tuple, active) -> tuple:
        """Call ``state = add(state, lobe, offset, sign, active)`` for all lobes that count.

        ``offset`` (texels) is the footprint's centre as seen from the origin of the lobe's
        positions, in the frame of the lobe's copy of the map, whose axes a mirrored map flips:
        ``sign``. One flat loop takes ``lobes_per_turn`` lobes a turn. State that is no sum is in
        whole numbers: Dr.Jit (1.5) cannot take forward derivatives past floats from a branch.
        """
        grids, mirrored = self.grids, self.wrap_mode != "repeat"
        with dr.suspend_grad():
            # A texel's lobe is as wide as a texel: those around the footprint count as well. It
            # stands between this texel and the next; in a mirror image, the one before.
            texels = level == 0
            width, shift = (SIGMA_H + 0.5 / 3, 0.0) if mirrored else (SIGMA_H, 0.5)
            reach = self.make_kernel(footprint, dr.select(texels, mi.Float(width**2), 0))
            reach.cut_at(dr.select(texels, dr.sqrt(self.texel_cut(kernel)), REACH["gaussian"]))
            centre = mi.Vector2f(reach.mean) + dr.select(texels, 0.5 - shift, 0.5)
            axis = grids.axis.on(level, active)
            top = axis.locate(centre.y - reach.reach_v)
            bottom = axis.locate(centre.y + reach.reach_v)
        mean = mi.Vector2f(kernel.mean) + 0.5  # from the map's edge

        def next_row(y, x, right):
            y = y + 1
            index, turn, flipped = axis.at(y)
            borders = [
                axis.placed(axis.border(index + k), turn, flipped) - centre.y for k in (0, 1)
            ]
            start, stop = reach.row_extent(dr.minimum(*borders), dr.maximum(*borders))
            return y, axis.locate(centre.x + start), axis.locate(centre.x + stop)

        def next_grid(first, count, first_2, count_2, y, x, right, origin, sign):
            y, x, right = dr.if_stmt(
                (y, x + 1, right),
                x + 1 > right,
                next_row,
                lambda *state: state,
                label="next row",
            )
            inside = y <= bottom
            row, turn_y, flipped_y = axis.at(y)
            column, turn_x, flipped_x = axis.at(x)
            first, count, first_2, count_2 = grids.run(level, axis, row, column, flipped_x, inside)
            origin = mi.Vector2i(
                axis.placed(axis.origin(column), turn_x, flipped_x),
                axis.placed(axis.origin(row), turn_y, flipped_y),
            )
            if mirrored:
                sign = mi.Vector2i(dr.select(flipped_x, -1, 1), dr.select(flipped_y, -1, 1))
            # Texels of a run are grids of their own.
            count = dr.select(texels, dr.minimum(count, mi.UInt32(right - x + 1)), count)
            x = dr.select(texels, x + mi.Int(count) - 1, x)
            return first, count, first_2, count_2, y, x, right, origin, sign

        def next_run(first, count, first_2, count_2, *rest):
            return dr.if_stmt(
                (first_2, count_2, mi.UInt32(first), mi.UInt32(0), *rest),
                count_2 == 0,
                next_grid,
                lambda *state: state,
                label="next grid",
            )

        per_turn = tuning().lobes_per_turn

        def body(state, walk):
            walk = dr.if_stmt(
                walk,
                active & (walk[1] == 0),
                next_run,
                lambda *walk: walk,
                label="next run",
            )
            first, count, first_2, count_2, y, x, right, origin, sign = walk
            inside = active & (y <= bottom)
            axes = mi.Vector2f(sign) if mirrored else mi.Vector2f(1)
            for k in range(per_turn):
                found = inside & (count > k)
                place = mi.Vector2i(origin.x + dr.select(texels, k, 0), origin.y)
                offset = (mean - mi.Vector2f(place)) * axes
                lobe = Lobe(self.words, first + k, found)
                state = add(state, lobe, offset, axes, found)
            taken = dr.minimum(count, per_turn)
            origin = mi.Vector2i(origin.x + dr.select(texels, mi.Int(taken), 0), origin.y)
            count = dr.select(inside, count - taken, count)
            return state, (first + taken, count, first_2, count_2, y, x, right, origin, sign)

        walk = (
            *(mi.UInt32(0) for _ in range(4)),
            top - 1,
            mi.Int(0),
            mi.Int(-1),
            mi.Vector2i(0),
            mi.Vector2i(1),
        )
        more = lambda state, walk: active & (walk[4] <= bottom)  # noqa: E731
        return symbolic_loop((state, walk), more, body, "lobes")[0]

    # --------------------------------------------------------------------------------------------
    #  Section 5.2.2: evaluation and sampling
    # --------------------------------------------------------------------------------------------

    def _eval(self, m: mi.Vector2f, query: Query, active: mi.Bool) -> mi.Float:
        """D(m), the density of projected normals over the unit disk (Eq. 9); 0 outside of it.

        The query's footprint is given in the UV space of the large map.
        """
        kernel = self.texel_kernel(query)
        active = active & (dr.squared_norm(m) < 1)
        below, above, fraction = self.level(kernel)
        density = self.level_density(m, query, kernel, below, active)
        blended = active & (fraction > 0)
        finer = dr.select(blended, 1 - fraction, 1) * density
        density = finer + fraction * self.level_density(m, query, kernel, above, blended)
        return dr.maximum(density, 0) if query.spread else density

    def level_density(self, m, query, kernel, level, active) -> mi.Float:
        """D(m) of one level."""
        variance, footprint, light = dr.square(self.sigma_r), query.footprint, query.spread
        lit, turned = self.reach(query)
        margin = NORMAL_CUT * (dr.sqrt(lit) + (0 if turned is None else turned))
        active = active & self.grids.may_have(m, level, margin, active)
        cut, extent = self.cut(kernel, level), dr.gather(mi.Float, self.grids.extent, level, active)
        summed = self.mass_is_summed(level)

        def add(state, lobe, offset, sign, active):
            near = lobe.may_show(m, lit, turned)

            def added(density, mass):
                seen = lobe.under(offset, extent, *self.seen(kernel, sign))
                weight = seen.weight(cut)
                density = add_where(
                    density,
                    near & (weight > 0),
                    lambda: weight * seen.normals(self.turn(query, sign)).eval(m, variance, light),
                    active,
                )
                return density, mass + weight

            return where_needed(active & (near | summed), added, state)

        density, mass = self.visit(
            footprint, kernel, level, add, (mi.Float(0), mi.Float(0)), active
        )
        mass = dr.select(summed, mass, self.mass_of_texels(kernel))
        return dr.select(mass > 0, density / dr.select(mass > 0, mass, 1), 0)

    def reach(self, query: Query) -> tuple[mi.Float, mi.Float | None]:
        """What makes normals visible farther from a lobe's own: σ_r² with the variance of the
        light's spread, and the standard deviation of the half vector over the footprint, None where
        it does not turn. Both are of the two components together."""
        variance = dr.square(self.sigma_r)
        for v in query.spread:
            variance = variance + dr.squared_norm(v)
        if query.turn is None:
            return variance, None
        axes = query.footprint.du, query.footprint.dv
        return variance, dr.sqrt(sum(dr.squared_norm(query.turn @ axis) for axis in axes))

    def turn(self, query: Query, sign: mi.Vector2f) -> mi.Matrix2f | None:
        """The half vector's turn per texel, in the frame of a copy of the map; None for none."""
        if query.turn is None:
            return None
        x, y = sign * (1 / self.synthesis.size)
        return query.turn @ mi.Matrix2f(x, 0, 0, y)

    def projected_areas(self, directions, query, active):
        """Those of the lobes, every one of them with its own."""
        kernel = self.texel_kernel(query)
        below, above, fraction = self.level(kernel)
        blended = active & (fraction > 0)
        finer = self.areas_of_level(directions, query, kernel, below, active)
        coarser = self.areas_of_level(directions, query, kernel, above, blended)
        share = dr.select(blended, fraction, 0)
        *areas, slope = (dr.lerp(a, b, share) for a, b in zip(finer, coarser, strict=True))
        return areas, slope

    def areas_of_level(self, directions, query, kernel, level, active) -> list:
        """The projected areas of one level's lobes, and their mean slope."""
        variance = dr.square(self.sigma_r)
        cut, extent = self.cut(kernel, level), dr.gather(mi.Float, self.grids.extent, level, active)

        def add(state, lobe, offset, sign, active):
            seen = lobe.under(offset, extent, *self.seen(kernel, sign))
            weight = seen.weight(cut)

            def added(mass, slope, *areas):
                normals = seen.normals()
                q_xx, q_yx, q_yy = normals.rest
                vectors = (*normals.vectors, mi.Vector2f(q_xx, q_yx), mi.Vector2f(0, q_yy))
                areas = [
                    dr.fma(weight, lobe_area(w, normals.mean, vectors, variance), area)
                    for w, area in zip(directions, areas, strict=True)
                ]
                slope = slope + mi.Vector2f(weight * slope_of(normals.mean))
                return mass + weight, slope, *areas

            return where_needed(active & (weight > 0), added, state)

        zero = (mi.Float(0), mi.Vector2f(0), *(mi.Float(0) for _ in directions))
        mass, slope, *areas = self.visit(query.footprint, kernel, level, add, zero, active)
        inverse = dr.rcp(dr.select(mass > 0, mass, 1))
        return [*(area * inverse for area in areas), slope * inverse]

    def cut(self, kernel: TexelKernel, level: mi.UInt32) -> mi.Float:
        """Squared distance at which lobes are cut."""
        return dr.select(level == 0, self.texel_cut(kernel), GRID_CUT)

    def texel_cut(self, kernel: TexelKernel) -> mi.Float:
        """Squared distance at which lobes of texels are cut, so that their mass is known."""
        return cut_of_lists(dr.sqrt(kernel.minor_variance + SIGMA_H**2))

    def mass_is_summed(self, level: mi.UInt32) -> mi.Bool:
        """Whether the mass of all lobes is to be summed. Lobes of texels are a lattice, whose mass
        is known, except where a mirrored map has two at its edge, or none."""
        return (level > 0) | (self.wrap_mode != "repeat")

    def mass_of_texels(self, kernel: TexelKernel) -> mi.Float:
        """The sum of the weights of all lobes of texels, which stand at whole numbers."""
        first, second = self.seen(kernel, mi.Vector2f(1))[0]
        xx = dr.fma(first.x, first.x, dr.fma(second.x, second.x, SIGMA_H**2))
        yy = dr.fma(second.y, second.y, SIGMA_H**2)
        mass = lattice_mass(mi.Vector2f(kernel.mean) + 0.5, xx, second.x * second.y, yy)
        return 2 * pi * mass_under_fade(self.texel_cut(kernel)) * mass

    def _sample(
        self, query: Query, sample1: mi.Float, sample2: mi.Point2f, active: mi.Bool
    ) -> mi.Vector2f:
        """Draw a projected normal with density D: a level, a lobe of it, a normal of the lobe.

        The lobe is chosen by a weighted reservoir: the next one takes the place of the last with
        probability weight/total so far.
        """
        kernel, footprint = self.texel_kernel(query), query.footprint
        below, above, fraction = self.level(kernel)
        bits, name, _ = pcg3d(dr.reinterpret_array(mi.UInt32, mi.Float(sample1)), 0, 0)
        level = dr.select(uniform(bits) < fraction, above, below)

        cut, extent = self.cut(kernel, level), dr.gather(mi.Float, self.grids.extent, level, active)

        def add(state, lobe, offset, sign, active):
            mass, turn, index, place, side = state
            weight = lobe.under(offset, extent, *self.seen(kernel, sign)).weight(cut)
            mass = mass + weight
            chosen = uniform(pcg3d(turn, name, 0)[0]) * mass < weight
            return (
                mass,
                turn + 1,
                dr.select(chosen, lobe.index, index),
                dr.select(chosen, offset, place),
                dr.select(chosen, sign, side),
            )

        state = mi.Float(0), mi.UInt32(0), mi.UInt32(0), mi.Vector2f(0), mi.Vector2f(1)
        state = self.visit(footprint, kernel, level, add, state, active)
        mass, _, index, place, side = state
        active &= mass > 0
        lobe = Lobe(self.words, index, active)
        seen = lobe.under(place, extent, *self.seen(kernel, side))
        normal = mi.warp.square_to_std_normal(mi.Point2f(sample2))
        seen = seen.normals(self.turn(query, side))
        m = seen.sample(normal, dr.square(self.sigma_r))
        if query.spread:
            random = pcg3d(bits, name, dr.reinterpret_array(mi.UInt32, mi.Float(sample2[0])))
            m = m + point_of_ellipse(query.spread, mi.Point2f(*map(uniform, random[:2])))
        return m

    def seen(self, kernel: TexelKernel, sign: mi.Vector2f) -> tuple[tuple, mi.Float]:
        """Two vectors that make up the footprint's covariance (texels²), in the frame of a copy of
        the map, and its determinant."""
        vectors = (
            mi.Vector2f(kernel.sigma_u_given_v, 0),
            mi.Vector2f(kernel.shear * kernel.sigma_v, kernel.sigma_v),
        )
        if self.wrap_mode != "repeat":
            vectors = vectors[0] * sign, vectors[1] * sign
        return vectors, dr.square(kernel.sigma_u_given_v * kernel.sigma_v)

    def traverse(self, callback: mi.TraversalCallback) -> None:
        callback.put("data", self.data, mi.ParamFlags.NonDifferentiable)
        callback.put("sigma_r", self.sigma_r, mi.ParamFlags.Differentiable)

    def parameters_changed(self, keys: Sequence[str] = ()) -> None:
        """Check what has changed; a new sample makes everything anew."""
        check_sigma_r(self.owner, self.sigma_r[0])
        if not keys or "data" in keys:
            self.sample_map = changed_map(self.data, self.wrap_mode, self.owner)
            self.build()

    def smooth(self) -> SmoothBeckmann:
        return SmoothBeckmann(
            lambda: smooth_alpha(self.alpha_squared(), self.sigma_r),
            self.roughness_keys,
            self.owner,
        )

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
        """Memory of sample, lobes and look-up tables, bytes."""
        return {
            "sample": map_bytes(self.sample_map),
            "lobes": 4 * dr.width(self.words),
            "grids": self.grids.nbytes,
        }

    def __repr__(self) -> str:
        return (
            f"Mip[{self.synthesis}, clusters={self.clusters}, lod_scale={self.lod_scale:g}, "
            f"sigma_r={self.sigma_r[0]:g}, {self.wrap_mode}, {self.nbytes / 1e6:.1f} MB]"
        )
