"""The P-NDF of a synthesised map, from lobes of the MIP level that suits the footprint.

Tan, Zhu, Xu, Meng, Wang and Yan, "Real-Time Microstructure Rendering with MIP-mapped Normal Map
Samples" (2022), section 5.2. The map is made from a small sample (:mod:`glintbsdf.synthesis`); its
lobes are those of the sample, gathered to few per grid on each MIP level
(:mod:`glintbsdf.pndf.lobe_levels`).

Of a level, all lobes of the grids that the footprint reaches count, each by the closed form of
:mod:`glintbsdf.gaussian_lobes`; their sum is divided by the sum of their masses, so that D
integrates to one whatever the footprint. With λ between two levels, both are blended; in the
paper's Eq. 9 the weights have changed places.
"""

from __future__ import annotations

import warnings
from functools import cached_property
from math import inf, log2

import drjit as dr
import mitsuba as mi
import numpy as np

from ..cache import load_or_build
from ..errors import check, check_whole
from ..footprint import Footprint
from ..gaussian_lobes import SIGMA_H
from ..hashing import pcg3d, uniform
from ..kernels import SIGMA_MIN, TexelKernel
from ..normalmap import NormalMap
from ..synthesis import VERSION as MAP_VERSION
from ..synthesis import Synthesis, check_sizes, synthesise
from . import lobe_levels, packed_lobes
from .manifold import add_where
from .mip_grids import Grids
from .packed_lobes import NORMAL_CUT, Lobe

#: Width of a footprint in standard deviations, a pixel's by default: its area in Eq. 8 is that of a
#: square as wide.
WIDTH = 2.0

#: A footprint more elongated than this counts as wider in Eq. 8, which limits the cost.
MAX_ANISOTROPY = 16.0


class Mip:
    """P-NDF of a large map synthesised from a sample (Tan et al. 2022).

    Belongs to the variant of Mitsuba that is active when it is made. The unit square of UV is the
    large map. Its ``wrap_mode`` is the sample's: to ``repeat``, its edges are made to fit;
    ``mirror`` mirrors it; ``clamp`` does so too, and holds the footprint's centre inside.

    Args:
        normal_map (NormalMap): the sample.
        output_size, patch_size, overlap, balance, seed: see
            :func:`~glintbsdf.synthesis.synthesise`.
        clusters (int): k, lobes per grid of each level, from 1 to 1024.
        lod_scale (float): C_P ≥ 0 of Eq. 8, λ = C_P log₂ P with P the footprint's area in texels,
            (2σ)² for a round one. With 1/2, a level's grids are as wide as the footprint.
        sigma_r (float): intrinsic roughness, the standard deviation of normals about those of the
            map, > 0.
        normal_weight (float): weight ≥ 0 of normals against positions where lobes are clustered;
            see :class:`~glintbsdf.pndf.lobe_levels.Clustering`.
        owner (str): whom errors name, usually the plugin.

    Attributes:
        data (mi.TensorXf): projected normals of the sample, h×w×2. After a change of its values,
            :meth:`parameters_changed` rebuilds everything.
        sigma_r (mi.Float): the roughness. Derivatives flow through it.
        synthesis (Synthesis): the large map.

    Raises :class:`~glintbsdf.errors.ParameterError`.
    """

    #: For references: the footprint is a Gaussian, and no triangle is clamped.
    kernel, epsilon = "gaussian", 0.0

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
        self.check_sigma_r()
        self.data = mi.TensorXf(normal_map.normals)
        self.build(normal_map)

    def check_sigma_r(self) -> None:
        """Raise unless the roughness is in range."""
        value = self.sigma_r[0]
        check(0 < value <= 1, self.owner, "sigma_r", "a number in (0, 1]", value)

    def build(self, sample: NormalMap) -> None:
        """Synthesise the map and cluster its lobes; the cache on disk may know them already."""
        distinct = len(np.unique(sample.normals.view(np.complex64)))
        if distinct < self.clusters:
            warnings.warn(
                f"{self.owner}: the sample has {distinct} distinct normals, fewer than "
                f'"clusters" = {self.clusters}: lobes that differ in position only are kept apart',
                stacklevel=2,
            )
        options = {**self.options, "toroidal": self.wrap_mode == "repeat"}
        key = " ".join(
            (
                f"mip {MAP_VERSION}.{lobe_levels.VERSION}.{packed_lobes.VERSION}",
                sample.content_hash,
                *(f"{name}={value!r}" for name, value in options.items()),
                f"{self.clusters} {self.normal_weight}",
            )
        )

        def build() -> dict:
            synthesis = synthesise(sample, **options, owner=self.owner)
            levels = lobe_levels.build(
                synthesis, self.clusters, self.normal_weight, self.options["seed"]
            )
            return {**synthesis.arrays(), **levels}

        arrays = load_or_build(key, build)
        self.__dict__.pop("normal_map", None)
        self.synthesis = Synthesis.from_arrays(
            sample.normals, self.options["output_size"], self.options["overlap"], arrays
        )
        self.grids = Grids(
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

    def texel_kernel(self, footprint, added: mi.Float | None = None) -> TexelKernel:
        """The footprint on the map's texels, widened by the variance ``added`` (texels²)."""
        size = self.synthesis.size
        added = SIGMA_MIN**2 if added is None else added + SIGMA_MIN**2
        wrap_mode = self.wrap_mode
        if wrap_mode == "clamp":
            footprint = Footprint(dr.clip(footprint.uv, 0, 1), footprint.du, footprint.dv)
            wrap_mode = "mirror"
        return TexelKernel("gaussian", footprint, size, size, wrap_mode, added=(added, added))

    def level(self, kernel: TexelKernel) -> tuple[mi.UInt32, mi.UInt32, mi.Float]:
        """Eq. 8: the levels below and above λ, and the weight of the one above (Eq. 9).

        The levels are indices of :class:`~glintbsdf.pndf.mip_grids.Grids`. Between texels and the
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
        """Call ``state = add(state, lobe, d, sign, active)`` for all lobes that count.

        ``d`` (texels) is the footprint's centre as seen from the lobe, in the lobe's own frame,
        whose axes a mirrored map flips: ``sign``. One flat loop: a lobe a turn. What is not summed
        is whole numbers: Dr.Jit (1.5) cannot take forward derivatives past floats from a branch.
        """
        grids, mirrored = self.grids, self.wrap_mode != "repeat"
        with dr.suspend_grad():
            # A texel's lobe is as wide as a texel: those around the footprint count as well. It
            # stands between this texel and the next; in a mirror image, the one before.
            texels = level == 0
            width, shift = (SIGMA_H + 0.5 / 3, 0.0) if mirrored else (SIGMA_H, 0.5)
            reach = self.texel_kernel(footprint, dr.select(texels, mi.Float(width**2), 0))
            centre = mi.Vector2f(reach.mean) + dr.select(texels, 0.5 - shift, 0.5)
            axis = grids.axis.on(level, active)
            top = axis.locate(centre.y - reach.reach_v)
            bottom = axis.locate(centre.y + reach.reach_v)
            extent = dr.gather(mi.Float, grids.extent, level, active)
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

        def body(state, walk):
            walk = dr.if_stmt(
                walk,
                active & (walk[1] == 0),
                next_run,
                lambda *walk: walk,
                label="next run",
            )
            first, count, first_2, count_2, y, x, right, origin, sign = walk
            inside = active & (y <= bottom) & (count > 0)
            axes = mi.Vector2f(sign) if mirrored else mi.Vector2f(1)
            lobe = Lobe(self.words, first, extent, *self.seen(kernel, axes), inside)
            d = (mean - mi.Vector2f(origin)) * axes - lobe.position
            state = add(state, lobe, d, axes, inside)
            count = dr.select(inside, count - 1, count)
            origin = mi.Vector2i(dr.select(texels, origin.x + 1, origin.x), origin.y)
            return state, (first + 1, count, first_2, count_2, y, x, right, origin, sign)

        walk = (
            *(mi.UInt32(0) for _ in range(4)),
            top - 1,
            mi.Int(0),
            mi.Int(-1),
            mi.Vector2i(0),
            mi.Vector2i(1),
        )
        state, _ = dr.while_loop(
            (state, walk),
            lambda state, walk: active & (walk[4] <= bottom),
            body,
            max_iterations=-1,
            label="lobes",
        )
        return state

    # --------------------------------------------------------------------------------------------
    #  Section 5.2.2: evaluation and sampling
    # --------------------------------------------------------------------------------------------

    def eval(self, m: mi.Vector2f, footprint, active: bool | mi.Bool = True) -> mi.Float:
        """D(m), the density of projected normals over the unit disk (Eq. 9); 0 outside of it.

        ``footprint``: a :class:`~glintbsdf.footprint.Footprint`, in the UV space of the large map.
        """
        kernel = self.texel_kernel(footprint)
        active = mi.Bool(active) & (dr.squared_norm(m) < 1)
        below, above, fraction = self.level(kernel)
        density = self.level_density(m, footprint, kernel, below, active)
        blended = active & (fraction > 0)
        finer = dr.select(blended, 1 - fraction, 1) * density
        return finer + fraction * self.level_density(m, footprint, kernel, above, blended)

    def level_density(self, m, footprint, kernel, level, active) -> mi.Float:
        """D(m) of one level."""
        variance = dr.square(self.sigma_r)
        active = active & self.grids.may_have(m, level, NORMAL_CUT * self.sigma_r, active)

        def add(state, lobe, d, sign, active):
            density, mass = state
            weight = lobe.weight(d)

            def contribution():
                return weight * lobe.normals(d).eval(m, variance)

            reach = NORMAL_CUT**2 * dr.fma(lobe.spread, lobe.spread, variance)
            near = (weight > 0) & (dr.squared_norm(m - lobe.mean_normal()) < reach)
            return add_where(density, near, contribution, active), mass + weight

        state = mi.Float(0), mi.Float(0)
        density, mass = self.visit(footprint, kernel, level, add, state, active)
        return dr.select(mass > 0, density / dr.select(mass > 0, mass, 1), 0)

    def sample(
        self, footprint, sample1, sample2: mi.Point2f, active: bool | mi.Bool = True
    ) -> mi.Vector2f:
        """Draw a projected normal with density D: a level, a lobe of it, a normal of the lobe.

        The lobe is chosen by a weighted reservoir: the next one takes the place of the last with
        probability weight/total so far. One that falls outside the disk is an invalid sample.
        """
        kernel = self.texel_kernel(footprint)
        active = mi.Bool(active)
        below, above, fraction = self.level(kernel)
        bits, name, _ = pcg3d(dr.reinterpret_array(mi.UInt32, mi.Float(sample1)), 0, 0)
        level = dr.select(uniform(bits) < fraction, above, below)

        def add(state, lobe, d, sign, active):
            mass, turn, index, place, side = state
            weight = lobe.weight(d)
            mass = mass + weight
            chosen = uniform(pcg3d(turn, name, 0)[0]) * mass < weight
            return (
                mass,
                turn + 1,
                dr.select(chosen, lobe.index, index),
                dr.select(chosen, d, place),
                dr.select(chosen, sign, side),
            )

        state = mi.Float(0), mi.UInt32(0), mi.UInt32(0), mi.Vector2f(0), mi.Vector2f(1)
        state = self.visit(footprint, kernel, level, add, state, active)
        mass, _, index, place, side = state
        active &= mass > 0
        extent = dr.gather(mi.Float, self.grids.extent, level, active)
        lobe = Lobe(self.words, index, extent, *self.seen(kernel, side), active)
        normal = mi.warp.square_to_std_normal(mi.Point2f(sample2))
        return lobe.normals(place).sample(normal, dr.square(self.sigma_r))

    def seen(self, kernel: TexelKernel, sign: mi.Vector2f) -> tuple[tuple, mi.Float]:
        """Two vectors that make up the footprint's covariance (texels²), in the frame of a copy of
        the map, and its determinant."""
        vectors = (
            mi.Vector2f(kernel.sigma_u_given_v, 0),
            mi.Vector2f(kernel.shear * kernel.sigma_v, kernel.sigma_v),
        )
        if self.wrap_mode != "repeat":
            vectors = tuple(v * sign for v in vectors)
        return vectors, dr.square(kernel.sigma_u_given_v * kernel.sigma_v)

    def traverse(self, callback: mi.TraversalCallback) -> None:
        callback.put("data", self.data, mi.ParamFlags.NonDifferentiable)
        callback.put("sigma_r", self.sigma_r, mi.ParamFlags.Differentiable)

    def parameters_changed(self, keys: list[str] = ()) -> None:
        """Check what has changed; a new sample makes everything anew."""
        self.check_sigma_r()
        if not keys or "data" in keys:
            self.build(NormalMap(self.data.numpy(), self.wrap_mode, self.owner, "data"))

    @cached_property
    def normal_map(self) -> NormalMap:
        """The large map, for references: as large as what is saved by not storing it."""
        return self.synthesis.normal_map()

    @property
    def nbytes(self) -> int:
        """Memory of lobes and look-up tables, bytes."""
        return 4 * dr.width(self.words) + self.grids.nbytes

    def __repr__(self) -> str:
        return (
            f"Mip[{self.synthesis}, clusters={self.clusters}, lod_scale={self.lod_scale:g}, "
            f"sigma_r={self.sigma_r[0]:g}, {self.wrap_mode}, {self.nbytes / 1e6:.1f} MB]"
        )
