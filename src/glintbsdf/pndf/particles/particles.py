"""Facets as a point process in position × normal space.

Kemppinen, Paulin, Thonat, Thiery, Lehtinen and Boubekeur, "Evaluating and Sampling Glinty NDFs in
Constant Time" (SIGGRAPH Asia 2025), strew facets over a space of four dimensions: two of them are
positions, two are normals, mapped so that facets lie evenly. This module has their idea, an
implicit hierarchy of lattices in which every cell holds one hashed facet, and other means of its
own: it is normalised for every footprint, and its sampler has exactly its density.

**One level.** At level j, the square of normals (:mod:`.normals`) is cut in 4^j equal cells, and
the surface is covered by a lattice of cells 2^j spacings wide (:mod:`.placement`), so that all
facets are counted once. Every cell of normals holds one facet at every vertex of the lattice. Of a
cell a, a point sees the facets x_ac of the vertices c around it, with weights b_c that add up to
one, and every facet is a lobe k of mass one: so

    D(m) = cos⁻⁴θ_m Σ_a 4^−j Σ_c b_c k(x − x_ac),        ∫ D dm = Σ_a 4^−j = 1

for every footprint. Its mean over places is the whole distribution, and lobes are so narrow that
those of the four nearest cells are all that a slope x meets.

**The footprint** selects the level: one whose lattice shows as many facets as there are under the
footprint, N 4πσ² for a round Gaussian one. Between two levels, single cells of normals pass over
from one to the other, each at its own threshold. The variance of D over places then is that of a
Poisson process, (1/N) ∫k_f² ∫k² for the footprint k_f, at every size of the footprint.

**Many facets.** Where cells of normals would be narrower than a lobe, they stay as they are, and
each facet looked at stands for n = 4^(λ − m). It counts with the weight β = 1/√n, and the whole
distribution with 1 − β: again the mean, the variance and the mass are those of all facets.

**Turn and spread.** A facet away from the footprint's centre mirrors another half vector, by H
times its distance; a light's extent widens all lobes.
"""

from __future__ import annotations

from collections.abc import Sequence
from math import isfinite, log2, pi, sqrt
from typing import NamedTuple

import drjit as dr
import mitsuba as mi

from glintbsdf.core.errors import check
from glintbsdf.core.hashing import pcg, uniform, uniform_pair
from glintbsdf.core.loops import symbolic_loop
from glintbsdf.footprint.query import Query
from glintbsdf.microfacet.frame import normal_from_projection
from glintbsdf.microfacet.slope_distribution import DISTRIBUTIONS, SlopeLobe
from glintbsdf.pndf.base import PNDF, register
from glintbsdf.pndf.gaussian_elements import Gaussian
from glintbsdf.pndf.particles.normals import (
    REACH_SQUARED,
    EqualShares,
    finest_level,
    lobe,
    sample_lobe,
)
from glintbsdf.pndf.particles.placement import Lattice, Probes, Vertex, fade, skewed
from glintbsdf.pndf.smooth import MIN_ALPHA, SmoothSurface

#: The roughest facet, relative to the surface.
ROUGHEST = 0.5

#: Roughness of a facet where none is given and the surface allows it, and the smallest one allowed.
USUAL_MICRO_ALPHA, LEAST_MICRO_ALPHA = 0.01, 1e-6

#: Normals lower than this count as so high where a slope's variance is carried to the disk.
LOWEST = 0.05

#: While the share of the coarser level grows by this, a cell of normals passes over to it.
FADE = 1 / 16

#: Decimal logarithms of densities that are allowed. With a density beyond, places at |uv| = 10⁶
#: would be less exact than a facet, in double precision.
DENSITIES = (-8.0, 16.0)


class Seen:
    """What a footprint sees of the lattices; the same for every normal.

    Attributes:
        probes (Probes): the round parts of the footprint.
        level (mi.Float): λ.
        fine (mi.Int): the finer of the two levels.
        passed (mi.Float): share of the coarser one at this place, in [0, 1].
        spacing (mi.Float): of facets, in units of UV or of space.
    """

    def __init__(self, query: Query, scale: mi.Float64, seed: mi.UInt32) -> None:
        self.place = query.place
        if self.place is None:
            centre, axes = query.footprint.uv, (query.footprint.du, query.footprint.dv)
        else:
            centre = self.place.position
            axes = tuple(self.place.tangent(v) for v in (query.footprint.du, query.footprint.dv))
        spacings = mi.Float(scale)
        self.spacing = dr.rcp(spacings)
        self.probes = Probes(list(axes[0]), list(axes[1]), spacings)
        self.step = skewed(self.probes.step)
        self.level = self.probes.level()
        self.fine, share = fade(self.level)
        coordinates = skewed([mi.Float64(x) * scale for x in centre])
        self.lattices = [Lattice(coordinates, self.fine + k, seed) for k in (0, 1)]
        # Places have thresholds, which change steadily between 0 and 1.
        phase = self.lattices[0].phase()
        threshold = dr.abs(2 * (phase - dr.floor(phase)) - 1)
        self.passed = dr.clip((share * (1 + FADE) - threshold) * (1 / FADE), 0, 1)

    def in_uv(self, distance: list) -> mi.Vector2f:
        """A distance in spacings, on the UV plane."""
        if self.place is None:
            return mi.Vector2f(*distance) * self.spacing
        return self.place.in_uv(mi.Vector3f(*distance) * self.spacing)

    def vertices(self, coarse: mi.Bool, probe: mi.Int) -> list[Vertex]:
        """The vertices around a probe, on the coarser or the finer lattice."""
        lattice = self.lattices[1].where(coarse, self.lattices[0])
        return lattice.vertices([mi.Float(probe) * x for x in self.step])


class Cells:
    """The cells of normals of both levels.

    Args:
        seen (Seen): what the footprint sees.
        finest (mi.Int): m, the finest level of normals.

    Attributes:
        beta (mi.Float): β, the share of single facets in D.
    """

    def __init__(self, seen: Seen, finest: mi.Int) -> None:
        self.counts = [mi.Int(1) << dr.minimum(seen.fine + k, finest) for k in (0, 1)]
        self.beta = dr.minimum(dr.exp2(mi.Float(finest) - seen.level), 1)

    def count(self, coarse: mi.Bool) -> mi.Int:
        """Cells along each side of the square, 2^j, of one of both levels."""
        return dr.select(coarse, self.counts[1], self.counts[0])


class Aim(NamedTuple):
    """A half vector: its projection, its slope, and cos⁻⁴θ, by which densities of slopes become
    those of projected normals; 0 outside of the disk."""

    normal: mi.Vector2f
    slope: mi.Vector2f
    density: mi.Float

    @staticmethod
    def at(s: mi.Vector2f) -> Aim:
        """The half vector of the projection s."""
        squared = 1 - dr.squared_norm(s)
        above = squared > 1e-8
        inverse = dr.rsqrt(dr.select(above, squared, 1))
        density = dr.square(dr.square(inverse))
        return Aim(s, dr.select(above, s, 0) * inverse, dr.select(above, density, 0))


class LobesOfSlopes:
    """Lobes of facets, each a bell around its slope."""

    def __init__(self, m: mi.Vector3f, micro_alpha: mi.Float, spread: tuple) -> None:
        variance = 0.5 * dr.square(micro_alpha)
        self.precision = dr.rcp(variance)
        self.peak = self.precision * (1 / (2 * pi))

    def eval(self, aim: Aim, slope: mi.Vector2f) -> mi.Float:
        """D of the facet with this slope."""
        distance = dr.squared_norm(aim.slope - slope) * self.precision
        return self.peak * aim.density * lobe(distance)


class LobesOnDisk:
    """Lobes of facets under a light of some extent: bells around their projected normals.

    Their covariance is the light's and that of slopes, by ∂s/∂x = m_z (I − s sᵀ) at the normal m.
    Lanes without a light have lobes of slopes.
    """

    def __init__(self, m: mi.Vector3f, micro_alpha: mi.Float, spread: tuple) -> None:
        s, size = mi.Vector2f(m.x, m.y), sqrt(0.5) * micro_alpha * dr.maximum(m.z, LOWEST)
        axes = (mi.Vector2f(1, 0) - s * s.x) * size, (mi.Vector2f(0, 1) - s * s.y) * size
        self.width = Gaussian((*spread, *axes))
        self.of_slopes = LobesOfSlopes(m, micro_alpha, spread)
        self.lit = sum(dr.squared_norm(v) for v in spread) > 0

    def eval(self, aim: Aim, slope: mi.Vector2f) -> mi.Float:
        """D of the facet with this slope."""
        normal = slope * dr.rsqrt(1 + dr.squared_norm(slope))
        value = self.width.peak * lobe(self.width.distance_squared(aim.normal - normal))
        return dr.select(self.lit, value, self.of_slopes.eval(aim, slope))


@register("particles", title="particles", plugin="glint_particles", takes_map=False)
class Particles(PNDF):
    """P-NDF of facets that are points in position × normal space.

    It belongs to the variant of Mitsuba that is active when it is made. Nothing is built, and
    nothing is stored.

    Args:
        alpha (pair of floats): roughness of all facets together along u and v, ≥ 1e-4.
        density (float): log10 of the number of facets per unit of UV area, in [−8, 16]; where
            queries have a place in space, per unit of area there.
        micro_alpha (float): Beckmann roughness of one facet, ≥ 1e-6, at most half of the least α;
            None for :func:`usual_micro_alpha`.
        distribution (str): ``ggx`` or ``beckmann``.
        colors (Wheel, Palette or None): colours of the facets.
        seed (int): another one gives other facets, in [0, 2³²).
        owner (str): the name that errors give, usually the plugin's.

    Raises :class:`~.ParameterError`.
    """

    integrates_lights = True
    maskings = ("ggx", "beckmann", "none")
    roughness_keys = ("alpha_u", "alpha_v")

    alpha_u: mi.Float
    alpha_v: mi.Float
    density: mi.Float
    micro_alpha: mi.Float

    NAMES = ("alpha_u", "alpha_v", "density", "micro_alpha")

    def __init__(
        self,
        alpha=(0.3, 0.3),
        density=8.0,
        micro_alpha=None,
        distribution="ggx",
        colors=None,
        seed=0,
        owner="Particles",
    ) -> None:
        check(distribution in DISTRIBUTIONS, owner, "distribution", "ggx or beckmann", distribution)
        check(
            isinstance(seed, int) and not isinstance(seed, bool) and 0 <= seed < 2**32,
            owner,
            "seed",
            "a whole number in [0, 2³²)",
            seed,
        )
        self.distribution, self.colors, self.owner = distribution, colors, owner
        if micro_alpha is None:
            micro_alpha = usual_micro_alpha(alpha)
        values = dict(zip(self.NAMES, (*alpha, density, micro_alpha), strict=True))
        check_ranges(values, owner)
        for name, value in values.items():
            setattr(self, name, mi.Float(value))
        self.seed = dr.opaque(mi.UInt32, seed)
        self.derive()
        self.mean = SmoothSurface(
            lambda: self.alpha, self.roughness_keys, owner, distribution=distribution
        )

    def parameters_changed(self, keys: Sequence[str] = ()) -> None:
        """Check parameters that have changed, and derive what depends on them."""
        if not keys or set(keys) & set(self.NAMES):
            values = {name: getattr(self, name)[0] for name in self.NAMES}
            check_ranges(values, self.owner)
            self.derive()
            self.mean.parameters_changed(keys)

    def derive(self) -> None:
        """Everything that depends on the parameters alone."""
        self.alpha = mi.Vector2f(self.alpha_u, self.alpha_v)
        self.shares = EqualShares(self.distribution, self.alpha, self.micro_alpha)
        with dr.suspend_grad():
            # √N, in double precision
            self.scale = dr.exp2(mi.Float64(self.density) * (0.5 * log2(10)))
            dr.make_opaque(self.scale)

    # ----------------------------------------------------------------------------------------------
    #  The density
    # ----------------------------------------------------------------------------------------------

    def seen(self, query: Query) -> Seen:
        """What the footprint sees; made once for each query."""

        def make() -> Seen:
            with dr.suspend_grad():
                return Seen(query, self.scale, self.seed)

        return query.once((self, "seen"), make)

    def cells(self, query: Query) -> Cells:
        """The cells of normals that hold the lobes of this query."""
        with dr.suspend_grad():
            # On the disk, with a light's extent, no lobe is wider than where slopes are small.
            width = Gaussian(query.spread, 0.5 * dr.square(dr.detach(self.micro_alpha)))
            difference = 0.5 * (width.xx - width.yy)
            root = dr.sqrt(dr.fma(difference, difference, dr.square(width.xy)))
            variance = dr.detach(0.5 * (width.xx + width.yy) + root)
            finest = finest_level(dr.sqrt(REACH_SQUARED * variance), dr.detach(self.alpha))
            return Cells(self.seen(query), finest)

    def facets(self, m: mi.Vector3f, query: Query, active: mi.Bool) -> tuple:
        """``(D, coloured D)`` of single facets, their share β included, and 1 − β.

        Without colours the second is the first.
        """
        m = dr.select(active, m, mi.Vector3f(0, 0, 1))
        lobes = LobesOnDisk if query.spread else LobesOfSlopes
        lobes = lobes(m, self.micro_alpha, query.spread)
        seen, cells, turn = self.seen(query), self.cells(query), query.turn
        here = Aim.at(mi.Vector2f(m.x, m.y))
        shares, colors, probes = self.shares, self.colors, seen.probes

        def around(aim, count):
            """The first of the nearest cells along each axis."""
            q = dr.detach(shares.place(aim.slope)) * mi.Float(count)
            last = dr.maximum(count - 2, 0)
            return [mi.UInt32(dr.clip(mi.Int(dr.floor(p - 0.5)), 0, last)) for p in q]

        def body(i, total, colored):
            # The finer level's probes, then those of the coarser
            coarse = i >= probes.count
            ordinal = i - dr.select(coarse, probes.count, 0)
            probe = dr.select((ordinal & 1) != 0, (ordinal + 1) >> 1, -(ordinal >> 1))
            aim = here
            with dr.suspend_grad():
                vertices = seen.vertices(coarse, probe)
                count = cells.count(coarse)
                first = around(aim, count)
                size, cells_in_all = dr.rcp(mi.Float(count)), mi.UInt32(count)
                share = dr.select(coarse, seen.passed, 1 - seen.passed)
                share = share * probes.weight(probe) * dr.square(size)
            for vertex in vertices:
                if turn is not None:
                    aim = Aim.at(here.normal + turn @ seen.in_uv(vertex.distance))
                    with dr.suspend_grad():
                        first = around(aim, count)
                for k in range(4):
                    with dr.suspend_grad():
                        cell = [c + (k >> axis & 1) for axis, c in enumerate(first)]
                        random = facet_bits(vertex.seed, cell)
                        place = place_in(cell, random, size)
                        inside = (cell[0] < cells_in_all) & (cell[1] < cells_in_all)
                        weight = dr.select(inside, share * vertex.weight, 0)
                    term = weight * lobes.eval(aim, shares.slope(place))
                    total = total + term
                    if colors is not None:
                        colored = colored + term * colors.pick(uniform(pcg(random)))
            return i + 1, total, colored

        zero = mi.Float(0) if colors is None else mi.Color3f(0)
        begin = dr.select(seen.passed == 1, probes.count, 0)
        end = dr.select(seen.passed == 0, probes.count, 2 * probes.count)
        state = mi.Int(begin), mi.Float(0), zero
        found = symbolic_loop(state, lambda i, *_: active & (i < end), body, "facets")
        scalar = found[1] * cells.beta
        return scalar, scalar if colors is None else found[2] * cells.beta, 1 - cells.beta

    def density_of(self, m: mi.Vector3f, query: Query, active: mi.Bool) -> tuple:
        """What :meth:`facets` returns; asked once for each normal of a query."""
        key = (self, "facets", m.x.index, m.y.index)
        kept = query.once(key, lambda: (self.facets(m, query, active), m))
        return kept[0]

    def smooth_density(self, m: mi.Vector3f, query: Query) -> mi.Float:
        """D of all facets together, under the light's extent and the half vector's turn over the
        footprint, of which slopes count as the normals that they nearly are where most of the
        facets are."""
        spread = query.spread
        if query.turn is not None:
            axes = query.footprint.du, query.footprint.dv
            spread = (*spread, *(query.turn @ axis for axis in axes))
        if not spread:
            return self.mean.distribution.eval(m)
        width = Gaussian(spread)
        uu = dr.fma(2, width.xx, dr.square(self.alpha.x))
        vv = dr.fma(2, width.yy, dr.square(self.alpha.y))
        uv = 2 * width.xy
        lobe = SlopeLobe(mi.Vector2f(0), uu, vv, uv, uu * vv - dr.square(uv), self.distribution)
        return lobe.eval(mi.Vector2f(m.x, m.y))

    def eval_normal(self, m: mi.Vector3f, query: Query, active: mi.Bool) -> mi.Float | mi.Color3f:
        active = mi.Bool(active) & (m.z > 1e-4)
        _, density, rest = self.density_of(m, query, active)
        mean = 1 if self.colors is None else mi.Color3f(*self.colors.mean)
        return dr.select(active, density + rest * self.smooth_density(m, query) * mean, 0)

    def _eval(self, m: mi.Vector2f, query: Query, active: mi.Bool) -> mi.Float | mi.Color3f:
        return self.eval_normal(normal_from_projection(m), query, active)

    # ----------------------------------------------------------------------------------------------
    #  The sampler
    # ----------------------------------------------------------------------------------------------

    def choose(self, query: Query, sample1: mi.Float, sample2: mi.Point2f, active: mi.Bool):
        """``(single, slope, sample)``: whether a single facet was drawn, the slope of a normal of
        its lobe, and what is left of ``sample1`` where none was."""
        seen, cells = self.seen(query), self.cells(query)
        single = sample1 < cells.beta
        rest = 1 - cells.beta
        left = (sample1 - cells.beta) / dr.select(rest > 0, rest, 1)
        sample = dr.minimum(sample1 / cells.beta, 1 - 2.0**-24)

        probe, sample = seen.probes.draw(sample)
        coarse, sample = split_sample(sample, seen.passed)
        vertices = seen.vertices(coarse, probe)
        seed, total = vertices[0].seed, vertices[0].weight
        for vertex in vertices[1:]:  # by reservoir sampling
            total = total + vertex.weight
            taken, sample = split_sample(sample, vertex.weight / total)
            seed = dr.select(taken, vertex.seed, seed)

        # A cell of normals, all of which weigh alike, and a place in its facet's lobe
        count = cells.count(coarse)
        place = mi.Vector2f(sample2) * mi.Float(count)
        cell = [dr.minimum(mi.UInt32(p), mi.UInt32(count) - 1) for p in place]
        place = mi.Vector2f(*(p - mi.Float(c) for p, c in zip(place, cell, strict=True)))
        centre = place_in(cell, facet_bits(seed, cell), dr.rcp(mi.Float(count)))
        slope = self.shares.slope(centre) + sample_lobe(place) * (sqrt(0.5) * self.micro_alpha)
        return single, slope, left

    def _sample(self, query, sample1, sample2, active):
        # From straight above, all facets are seen in proportion to their projections.
        above = mi.Vector3f(0, 0, 1)
        return self.sample_visible(above, query, sample1, sample2, active).xy

    def sample_visible(self, wi, query, sample1, sample2, active):
        """A normal of a single facet, or one that the view sees of all of them together."""
        with dr.suspend_grad():
            single, slope, left = self.choose(query, sample1, sample2, mi.Bool(active))
            m = dr.normalize(mi.Vector3f(slope.x, slope.y, 1))
            return dr.select(single, m, self.mean.sample_visible(wi, query, left, sample2, active))

    def visible_pdf(self, wi, m, density, query, active):
        active = mi.Bool(active) & (m.z > 1e-4)
        single, _, rest = self.density_of(m, query, active)
        return dr.select(active, dr.fma(single, m.z, rest * self.mean.distribution.pdf(wi, m)), 0)

    # ----------------------------------------------------------------------------------------------
    #  Roughness, and as a part of a scene
    # ----------------------------------------------------------------------------------------------

    def alpha_squared(self) -> mi.Vector2f:
        return dr.square(self.alpha)

    def smooth(self) -> SmoothSurface:
        return self.mean

    def traverse(self, callback: mi.TraversalCallback) -> None:
        smooth, fixed = mi.ParamFlags.Differentiable, mi.ParamFlags.NonDifferentiable
        for name in self.NAMES:
            flags = fixed if name == "density" else smooth | mi.ParamFlags.Discontinuous
            callback.put(name, getattr(self, name), flags)

    def __repr__(self) -> str:
        members = ", ".join(f"{name}={getattr(self, name)[0]:g}" for name in self.NAMES)
        return f"Particles[{members}, distribution={self.distribution}, colors={self.colors}]"


def facet_bits(seed: mi.UInt32, cell: list) -> mi.UInt32:
    """The hashed number of the facet in a cell of normals; ``seed``: of its vertex."""
    # Each cell has another number, in any column of up to 2^16 cells.
    return pcg(seed ^ (cell[0] + (cell[1] << 16)))


def place_in(cell: list, bits: mi.UInt32, size: mi.Float) -> mi.Vector2f:
    """The facet's place on the square of normals; ``size``: of a cell."""
    pair = zip(cell, uniform_pair(bits), strict=True)
    return mi.Vector2f(*((mi.Float(c) + u) * size for c, u in pair))


def split_sample(sample: mi.Float, chance: mi.Float) -> tuple[mi.Bool, mi.Float]:
    """Whether ``sample`` in [0, 1) is below ``chance``, and what is left of it, in [0, 1]."""
    below = sample < chance
    low, width = dr.select(below, 0, chance), dr.select(below, chance, 1 - chance)
    return below, dr.clip((sample - low) / dr.maximum(width, 1e-8), 0, 1)


def usual_micro_alpha(alpha) -> float:
    """The roughness of facets of a surface with the roughness ``alpha`` along u and v."""
    return min(USUAL_MICRO_ALPHA, ROUGHEST * min(alpha))


def check_ranges(values: dict[str, float], owner: str) -> None:
    """Raise ``ParameterError`` unless all numbers of :class:`Particles` are in range."""
    for axis in "uv":
        name = f"alpha_{axis}"
        allowed = isfinite(values[name]) and values[name] >= 0.999 * MIN_ALPHA
        check(allowed, owner, name, f"a finite number ≥ {MIN_ALPHA:g}", values[name])
    most = ROUGHEST * min(values["alpha_u"], values["alpha_v"])
    micro_alpha = values["micro_alpha"]
    check(
        isfinite(micro_alpha) and 0.999 * LEAST_MICRO_ALPHA <= micro_alpha <= 1.000001 * most,
        owner,
        "micro_alpha",
        f"at least {LEAST_MICRO_ALPHA:g}, as a mirror shows nothing of a point light, and at most "
        f"{most:g}, half of the least alpha, as all facets together are rougher than each",
        micro_alpha,
    )
    low, high = DENSITIES
    requirement = f"log10 of a density, from {low:g} to {high:g}"
    density = values["density"]
    check(isfinite(density) and low <= density <= high, owner, "density", requirement, density)
