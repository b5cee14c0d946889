"""Procedural microdetails on a hierarchy of grids.

Zirr and Kaplanyan, "Real-time Rendering of Procedural Multiscale Materials" (I3D 2016). Grids cover
the surface; their cells grow by powers of two. Of the microdetails in a cell, a random but
repeatable number reflects for a half vector. There is no map, no structure and no memory: hashes of
integers make everything. The functions follow the paper's order and use its symbols. Where they
depart from the paper, they say so. Section 4.1, the coherent hash, is
:func:`~glintbsdf.core.hashing.coherent_vertex`; Listing 1 is in :class:`Grid`.

Lights of some extent, and half vectors that turn over the footprint, go beyond the paper:
:mod:`glintbsdf.pndf.grid.ellipse`.

A slope is ``x = m_xy / m_z`` of a unit normal m; α = √2 σ is a Beckmann roughness. The subscript g
is for the whole surface (global), l for one microdetail (local), and m for the centres of the
microdetails (mesoscale).
"""

from __future__ import annotations

from collections.abc import Sequence
from math import isfinite, log, pi, sqrt

import drjit as dr
import mitsuba as mi

from glintbsdf.core.errors import check
from glintbsdf.core.hashing import coherent_vertex, gaussian, pcg3d, uniform
from glintbsdf.core.loops import symbolic_loop
from glintbsdf.footprint.gaussian import is_literal_zero
from glintbsdf.footprint.lattice import floor_int
from glintbsdf.footprint.query import Query
from glintbsdf.pndf.base import PNDF, register
from glintbsdf.pndf.grid.ellipse import EllipseOfCells
from glintbsdf.pndf.smooth import SmoothBeckmann

#: Level of the coarsest grid: its cells are 2⁴⁰ times as wide as cells of the finest grid. They
#: hold 2⁸⁰ microdetails, whose noise is below the last bit of a float.
MAX_LEVEL = 40

#: The smallest pixel, relative to the largest UV coordinate: four spacings of float32 numbers
#: there.
UV_RESOLUTION = 2.0**-22

#: Smallest half length of the median, in cells. It keeps the weights free of 0/0.
MIN_HALF_MEDIAN = 1e-3

#: The median is shortened at each end by this multiple of the pixel's smaller extent. The paper
#: takes half a cell. A little more saves the third column of pixels that perspective makes slightly
#: longer than wide.
SHORTENING = 0.55

#: The smallest roughness that Mitsuba's Beckmann distribution, which is sampled, can have.
MIN_ALPHA = 1e-4

#: Counts with an expectation up to EXACT_MEAN are drawn from the exact binomial distribution, by
#: its first EXACT_TERMS terms.
EXACT_MEAN, EXACT_TERMS = 4.0, 10

# ------------------------------------------------------------------------------------------------
#  Section 3: the biscale Beckmann distribution (Eq. 3 to 6)
# ------------------------------------------------------------------------------------------------


def beckmann(x: mi.Vector2f, alpha: mi.Vector2f) -> mi.Float:
    """Beckmann's density of slopes: a Gaussian with σ = α/√2 along each axis."""
    return dr.exp(-dr.squared_norm(x / alpha)) / (pi * alpha.x * alpha.y)


def slope_jacobian(cos_theta: mi.Float) -> mi.Float:
    """The factor 1/cos⁴θ from a density of slopes to one of projected normals (before Eq. 6)."""
    return dr.rcp(dr.square(dr.square(cos_theta)))


def mesoscale_roughness(alpha_g: mi.Vector2f, alpha_l: mi.Vector2f) -> mi.Vector2f:
    """α_m = √(α_g² − α_l²) of Eq. 4; 0 along the axis of grooves, where α_l = α_g (Eq. 6)."""
    return dr.safe_sqrt((alpha_g - alpha_l) * (alpha_g + alpha_l))


# ------------------------------------------------------------------------------------------------
#  Sections 4.2 and 4.4: the cells that a pixel covers
# ------------------------------------------------------------------------------------------------


class CoveredCells:
    """The vertices of two grids that a footprint covers, and their weights (Fig. 3 and 6).

    The paper's cell is here the neighbourhood of a vertex of the grid, weighted by a bilinear tent.
    So a vertex has the same position in all grids that it is part of.

    The pixel is a rectangle along the principal axes of the footprint, one standard deviation to
    either side. Its smaller extent selects the grids. The median along its larger extent is walked
    column by column, or row by row where it is steeper than 45°. At both ends it is shortened by
    ``SHORTENING`` times the smaller extent. The weight of a column is the integral of its tent over
    the median. In a column, the two nearest vertices have the weights of their tents. All weights
    sum to one and change continuously.

    Args:
        footprint (Footprint): the footprint.
        scale (mi.Float): cells of the finest grid per unit of UV.
        stretch (mi.Vector2f): factors ≤ 1 on the coordinates, applied after the selection of grids.
        max_anisotropy (mi.Float): K_a, the largest ratio of the extents. Cells grow where the
            footprint is longer.

    Attributes:
        level (mi.Int): level of the finer grid: its cells are 2^level times as wide as the finest.
        blend (mi.Float): weight of the coarser grid, in [0, 1).
        major, minor (mi.Vector2f): two axes of the footprint (UV), those of its ellipse in
            stretched coordinates; the median goes along the major one.
        walked (mi.Float): length of the median, relative to the major axis.
    """

    def __init__(self, footprint, scale, stretch, max_anisotropy) -> None:
        limit = 2.0**MAX_LEVEL
        du, dv = (dr.clip(axis * scale, -limit, limit) for axis in (footprint.du, footprint.dv))
        a, b, c = covariance(du, dv)
        major = dr.sqrt(larger_eigenvalue(a, b, c))
        minor = dr.abs(du.x * dv.y - du.y * dv.x) / dr.select(major > 0, major, 1)

        # s_c, in cells of the finest grid, whose cells have one microdetail: none finer is needed
        size = dr.maximum(2 * minor, 2 * major / max_anisotropy)
        size = dr.maximum(size, UV_RESOLUTION * dr.max(dr.abs(footprint.uv)) * scale)
        size = dr.clip(size, 1, limit)
        self.level = (
            mi.Int(dr.reinterpret_array(mi.UInt32, dr.detach(size)) >> 23) - 127
        )  # floor(log2)
        self.blend = dr.log2(size * power_of_two(-self.level))

        # The median, in stretched coordinates: p along it and q across, q = slope · p
        du, dv = du * stretch, dv * stretch
        a, b, c = covariance(du, dv)
        squared_major = larger_eigenvalue(a, b, c)
        self.along_x = a >= c
        rise = squared_major - dr.minimum(a, c)
        self.slope = dr.select(rise > 0, b / dr.select(rise > 0, rise, 1), 0)
        half = dr.maximum(dr.sqrt(squared_major) - SHORTENING * size, 0)
        self.half = half * dr.rsqrt(1 + dr.square(self.slope))
        self.walked = dr.select(squared_major > 0, half * dr.rsqrt(squared_major), 0)
        self.major, self.minor = self.principal(footprint, du, dv)
        self.centre = self.swapped(footprint.uv * scale * stretch)

        # With a stretch of 0 along one axis, all vertices lie on a line
        self.rows = 1 if any(is_literal_zero(s) for s in stretch) else 2

    def principal(self, footprint, du, dv) -> tuple[mi.Vector2f, mi.Vector2f]:
        """:attr:`major` and :attr:`minor`; ``du``, ``dv``: stretched axes of the footprint."""
        difference = dr.squared_norm(du) - dr.squared_norm(dv)
        sine, cosine = dr.sincos(0.5 * dr.atan2(2 * dr.dot(du, dv), difference))
        along = self.swapped(du * cosine + dv * sine).x
        sign = dr.select(along < 0, -1, 1)
        return (
            sign * (footprint.du * cosine + footprint.dv * sine),
            footprint.dv * cosine - footprint.du * sine,
        )

    def swapped(self, v):
        """(p, q) from (x, y), and back."""
        return type(v)(dr.select(self.along_x, v.x, v.y), dr.select(self.along_x, v.y, v.x))

    def grid(self, level, weight):
        """The median in one grid, in cells of this grid.

        Its origin is the vertex before the centre, along both axes. Returns the grid's level and
        weight, the origin's p and q, the centre's p and q relative to the origin, the median's half
        length along p, the first column relative to the origin, and the number of columns.
        """
        spacing = power_of_two(-level)
        centre = self.centre * spacing
        origin = dr.floor(centre)
        centre = centre - origin
        half = dr.maximum(self.half * spacing, MIN_HALF_MEDIAN)
        first = floor_int(centre.x - half)
        return (
            level,
            weight,
            mi.Int(origin.x),
            mi.Int(origin.y),
            centre.x,
            centre.y,
            half,
            first,
            floor_int(centre.x + half) + 2 - first,
        )

    def sum(self, term, zero, active):
        """Σ weight · term(x, y, level, active, along) over all vertices (x, y) of both grids.

        ``along``: where a vertex is seen on the median, from −1 to 1. ``zero`` is the empty sum;
        ``term`` must return a value of its type.
        """
        grids = self.grid(self.level, 1 - self.blend), self.grid(self.level + 1, self.blend)
        finer_columns, coarser_columns = (grid[-1] for grid in grids)

        def column(step, total):
            finer = step < finer_columns
            level, weight, p0, q0, p, q, half, first, _ = (
                dr.select(finer, *pair) for pair in zip(*grids, strict=True)
            )
            i = first + dr.select(finer, step, step - finer_columns)
            x = mi.Float(i)
            weight = weight * (tent_integral(p + half - x) - tent_integral(p - half - x))
            weight = weight / (2 * half)
            along = dr.clip(x, p - half, p + half) - p
            y, along = q + self.slope * along, along / half
            row = dr.floor(y)
            fraction = y - row
            row = q0 + mi.Int(row)
            weights = (weight * (1 - fraction), weight * fraction) if self.rows == 2 else (weight,)
            for j, share in enumerate(weights):
                vertex = self.swapped(mi.Vector2i(p0 + i, row + j))
                total = total + share * term(vertex.x, vertex.y, level, active & (share > 0), along)
            return step + 1, total

        end = finer_columns + coarser_columns
        more = lambda step, total: active & (step < end)  # noqa: E731
        return symbolic_loop((mi.Int(0), zero), more, column, "cells")[1]


def covariance(du: mi.Vector2f, dv: mi.Vector2f) -> tuple[mi.Float, mi.Float, mi.Float]:
    """The entries xx, xy, yy of du duᵀ + dv dvᵀ."""
    return (
        dr.fma(du.x, du.x, dv.x * dv.x),
        dr.fma(du.x, du.y, dv.x * dv.y),
        dr.fma(du.y, du.y, dv.y * dv.y),
    )


def larger_eigenvalue(a: mi.Float, b: mi.Float, c: mi.Float) -> mi.Float:
    """The larger eigenvalue of the symmetric matrix ((a, b), (b, c))."""
    difference = 0.5 * (a - c)
    # Of a round footprint the root is 0, where it has no derivative.
    squared = dr.maximum(dr.fma(difference, difference, b * b), dr.smallest(mi.Float))
    return 0.5 * (a + c) + dr.sqrt(squared)


def power_of_two(exponent: mi.Int) -> mi.Float:
    """2^exponent, exactly, for an exponent in [−126, 127]."""
    return dr.reinterpret_array(mi.Float, mi.UInt32(exponent + 127) << 23)


def tent_integral(x: mi.Float) -> mi.Float:
    """∫ max(1 − |t|, 0) dt from 0 to x; odd in x."""
    x = dr.clip(x, -1, 1)
    return x * (1 - 0.5 * dr.abs(x))


# ------------------------------------------------------------------------------------------------
#  Section 4.3: the number of reflecting microdetails
# ------------------------------------------------------------------------------------------------


def paraboloid_map(x: mi.Vector2f, cos_theta: mi.Float) -> mi.Vector2f:
    """The paraboloid map of the half vector with the slope ``x``: tan(θ/2) along its azimuth."""
    return x * (cos_theta / (1 + cos_theta))


class ReflectingCount:
    """Draws the number of microdetails out of n that reflect, each with probability P(h).

    It counts the less likely of the two outcomes, so that P → 1 is as accurate as P → 0. Counts
    with a small expectation follow the exact binomial distribution, by inversion. After
    ``EXACT_TERMS`` terms its tail is a truncated geometric distribution with the ratio of the next
    two terms. All other counts follow a Gaussian with the binomial's mean and variance. The
    quadratic term of the expansion of Cornish and Fisher gives it the binomial's skewness, too.
    Without it, the Gaussian would often be negative for expectations near ``EXACT_MEAN``. The mean
    is n P within 8e-4; the error is largest at ``EXACT_MEAN``.

    Args:
        p (mi.Float): P(h), in [0, 1].
    """

    def __init__(self, p: mi.Float) -> None:
        self.inverted = p > 0.5
        self.p = dr.select(self.inverted, 1 - p, p)
        self.odds = self.p / (1 - self.p)
        # log(1 − p); float32 rounds 1 − p where p is small
        series = -self.p * (1 + self.p * (0.5 + self.p * (1 / 3)))
        self.log_none = dr.select(self.p < 0.02, series, dr.log(1 - self.p))

    def draw(self, bits: mi.UInt32, n: mi.Float, active: mi.Bool) -> mi.Float:
        """The count for random ``bits``; ``n`` is a whole number up to 1e30."""
        u, mean = uniform(bits), n * self.p
        exact = mean <= EXACT_MEAN
        # P(N = 0) ≥ 1 − n P: in most cells nothing reflects, and this saves their inversion
        search = active & exact & (u >= 1 - mean)
        (count,) = dr.if_stmt(
            (mi.Float(0),),
            active & ~exact,
            lambda count: (self.approximate(gaussian(bits), n),),
            lambda count: (count,),
            label="many",
        )
        (count,) = dr.if_stmt(
            (count,),
            search,
            lambda count: (self.exact(u, n, search),),
            lambda count: (count,),
            label="few",
        )
        return dr.select(self.inverted, n - count, count)

    def exact(self, u: mi.Float, n: mi.Float, active: mi.Bool) -> mi.Float:
        """The count by inversion: how many values of the distribution function are ≤ u."""

        def next_term(count, probability, below):
            # From P(N = k) and P(N ≤ k) to P(N = k + 1) and P(N ≤ k + 1)
            probability = probability * dr.maximum(n - count, 0) * self.odds / (count + 1)
            return count + 1, probability, below + probability

        none = dr.exp(n * self.log_none)
        count, probability, below = symbolic_loop(
            (mi.Float(0), none, none + 0),
            lambda count, probability, below: active & (u >= below) & (count < EXACT_TERMS),
            next_term,
            "binomial",
        )
        ratio = dr.maximum(n - EXACT_TERMS, 0) * (self.odds / (EXACT_TERMS + 1))

        def tail(count):
            # From here on P(N ≥ k) falls by the same ratio from k to k + 1, up to N = n
            log_ratio = dr.log(ratio)
            left = (1 - u) / (1 - (below - probability))
            last = dr.exp(log_ratio * (n - EXACT_TERMS + 1))
            return (count + dr.floor(dr.log(dr.fma(left, 1 - last, last)) / log_ratio),)

        return dr.if_stmt(
            (count,),
            active & (count == EXACT_TERMS) & (ratio > 0),
            tail,
            lambda count: (count,),
            label="tail",
        )[0]

    def approximate(self, x: mi.Float, n: mi.Float) -> mi.Float:
        """The count from a standard normal number ``x``: its mean is n P, its skewness
        (1 − 2P)/σ."""
        mean = n * self.p
        count = mean + dr.sqrt(mean * (1 - self.p)) * x
        count = count + (1 - 2 * self.p) / 6 * (x * x - 1)
        return dr.clip(count, 0, n)


# ------------------------------------------------------------------------------------------------
#  Listing 1
# ------------------------------------------------------------------------------------------------


class Vertex:
    """The random numbers of a vertex of a grid.

    Attributes:
        level (mi.Int): of the grid.
        shift (mi.Vector2f): of the grid of half vectors, in cells.
        bits (mi.UInt32): seed of its counts.
    """

    def __init__(self, x: mi.Int, y: mi.Int, level: mi.Int, seed: mi.UInt32) -> None:
        x, y, name = coherent_vertex(x, y, level)
        a, b, self.bits = pcg3d(x, y, name + seed)
        self.level, self.shift = level, mi.Vector2f(uniform(a), uniform(b))


def check_ranges(values: dict[str, float], owner: str) -> None:
    """Raise :class:`~.ParameterError` unless all numeric parameters of :class:`Grid` are in
    range."""

    def require(name: str, requirement: str, allowed: bool) -> None:
        check(isfinite(values[name]) and allowed, owner, name, requirement, values[name])

    for axis in "uv":
        alpha, detail = values[f"alpha_{axis}"], values[f"detail_alpha_{axis}"]
        # A little room is for rounding to float32
        require(f"alpha_{axis}", f"a finite number ≥ {MIN_ALPHA:g}", alpha >= 0.999 * MIN_ALPHA)
        require(
            f"detail_alpha_{axis}",
            f'greater than 0 and at most "alpha_{axis}" = {alpha:g}',
            0 < detail <= alpha,
        )
    require("density", "log10 of a density, in [-20, 20]", abs(values["density"]) <= 20)
    require("size_variation", "a finite number ≥ 0", values["size_variation"] >= 0)
    require("intensity", "a finite number ≥ 0", values["intensity"] >= 0)
    require("light_spread", "an angle in [0, π/2)", 0 <= values["light_spread"] < pi / 2)
    require("max_anisotropy", "a finite number ≥ 1", values["max_anisotropy"] >= 1)


@register("grid", title="grids", plugin="glint_grid", takes_map=False)
class Grid(PNDF):
    """P-NDF of procedural microdetails (Listing 1).

    D(m) is the Beckmann density of the roughness α_g times a random factor of mean one: the number
    of reflecting microdetails over its expectation. So the mean of D over all positions is exactly
    the Beckmann distribution. At a single position D is not normalised: a surplus of microdetails
    in one direction is not compensated by a lack in others. Samples are drawn from the mean.

    Derivatives are right on average over places. Those with respect to the roughness and to
    ``intensity`` flow through the Beckmann density alone: the glints then stay in their places.
    Those with respect to ``density`` and to the size of the footprint flow through the weights of
    the cells, see :meth:`.Footprint.among_details`. Other parameters have none. They do not change
    the mean over places, and counts of microdetails do not change by degrees.

    It belongs to the variant of Mitsuba that is active when it is made.

    Args:
        alpha (pair of floats): α_g along u and v, ≥ 1e-4.
        detail_alpha (pair of floats): α_l, in (0, α_g] per axis; α_l = α_g along one axis makes
            grooves along it.
        density (float): log10 of the microdetails per unit of UV area, in [−20, 20].
        size_variation (float): standard deviation, ≥ 0, of the number of microdetails in a cell,
            relative to its mean.
        intensity (float): factor on the result, ≥ 0.
        light_spread (float): half angle of the light's cone, radians, in [0, π/2). Half vectors
            within half of this angle see the same microdetails.
        colors (Wheel, Palette or None): colours of the microdetails.
        max_anisotropy (float): K_a ≥ 1, the largest aspect ratio of a pixel that is resolved.
        seed (int): seed of the microdetails, in [0, 2³²).
        owner (str): the name that errors give, usually the plugin's.

    Raises:
        ParameterError: a parameter is out of range.
    """

    integrates_lights = True
    maskings = ("beckmann",)
    roughness_keys = ("alpha_u", "alpha_v")

    alpha_u: mi.Float
    alpha_v: mi.Float
    detail_alpha_u: mi.Float
    detail_alpha_v: mi.Float
    density: mi.Float
    size_variation: mi.Float
    light_spread: mi.Float
    max_anisotropy: mi.Float

    #: Finds the cells that a footprint covers; benchmarks replace it with more accurate ways.
    covered_cells = CoveredCells

    NAMES = (
        "alpha_u",
        "alpha_v",
        "detail_alpha_u",
        "detail_alpha_v",
        "density",
        "size_variation",
        "intensity",
        "light_spread",
        "max_anisotropy",
    )

    def __init__(
        self,
        alpha=(0.3, 0.3),
        detail_alpha=(0.05, 0.05),
        density=8.0,
        size_variation=0.3,
        intensity=1.0,
        light_spread=0.0,
        colors=None,
        max_anisotropy=16.0,
        seed=0,
        owner="Grid",
    ) -> None:
        values = (
            *alpha,
            *detail_alpha,
            density,
            size_variation,
            intensity,
            light_spread,
            max_anisotropy,
        )
        values = dict(zip(self.NAMES, values, strict=True))
        check_ranges(values, owner)
        check(
            isinstance(seed, int) and not isinstance(seed, bool) and 0 <= seed < 2**32,
            owner,
            "seed",
            "a whole number in [0, 2³²)",
            seed,
        )
        for name, value in values.items():
            setattr(self, name, mi.Float(value))
        self.colors, self.owner = colors, owner
        self.seed = pcg3d(dr.opaque(mi.UInt32, seed), 0, 0)[0]
        dr.make_opaque(self.seed)
        self.derive()
        self.mean = SmoothBeckmann(lambda: self.alpha, self.roughness_keys, owner)

    def parameters_changed(self, keys: Sequence[str] = ()) -> None:
        """Check parameters that have changed, and recompute what depends on them."""
        if not keys or set(keys) & set(self.NAMES):
            check_ranges({name: getattr(self, name)[0] for name in self.NAMES}, self.owner)
            self.derive()
            self.mean.parameters_changed(keys)

    def alpha_squared(self) -> mi.Vector2f:
        return dr.square(self.alpha)

    def smooth(self) -> SmoothBeckmann:
        return self.mean

    def masking(self, name: str = "beckmann", height_correlated: bool = False):
        """The masking of the mean, the same as in Mitsuba's ``roughconductor``."""
        return super().masking(name, height_correlated)

    # Samples come from the mean over all places.
    def _sample(self, query, sample1, sample2, active):
        return self.mean.sample(query, sample1, sample2, active)

    def sample_visible(self, wi, query, sample1, sample2, active):
        return self.mean.sample_visible(wi, query, sample1, sample2, active)

    def visible_pdf(self, wi, m, density, query, active):
        return self.mean.visible_pdf(wi, m, density, query, active)

    def derive(self) -> None:
        """Compute everything that depends on the parameters alone."""
        self.alpha = mi.Vector2f(self.alpha_u, self.alpha_v)
        with dr.suspend_grad():
            alpha_g = mi.Vector2f(self.alpha)
            alpha_l = mi.Vector2f(self.detail_alpha_u, self.detail_alpha_v)
            alpha_m = mesoscale_roughness(alpha_g, alpha_l)
            # Under a wide light a microdetail looks rougher, but never rougher than the surface
            apparent = dr.minimum(alpha_l + dr.tan(0.5 * self.light_spread), alpha_g)
            self.largest_p = apparent.x * apparent.y / (alpha_g.x * alpha_g.y)
            # A cell of half vectors is as large as the lobe of a microdetail, √π α_l, so that a
            # microdetail reflects in about one cell. The paraboloid map halves lengths. Along
            # grooves all microdetails share one lobe, and there is a single cell.
            self.cells_per_unit = 2 * alpha_m / (sqrt(pi) * apparent * alpha_g)
            # γ_m of section 4.4: microdetails are long along the axis of the smaller α_m, as this
            # coordinate shrinks
            larger = dr.max(alpha_m)
            self.stretch = dr.select(larger > 0, alpha_m / dr.select(larger > 0, larger, 1), 1)
            # The finest grid has one microdetail per cell
            self.scale = dr.exp(self.density * (0.5 * log(10)))

    def _eval(self, m: mi.Vector2f, query: Query, active: mi.Bool) -> mi.Float | mi.Color3f:
        """D(m) over the disk of projected normals, in colour where there are ``colors``."""
        cells = self.cells(query)
        if query.spread or query.turn is not None:
            return self.averaged(m, query, cells, active)
        density, x, cos_theta, active = self.mean_density(m, active)
        with dr.suspend_grad():
            p = self.reflecting_share(x)
            active &= p > dr.smallest(mi.Float)
            hp = paraboloid_map(x, cos_theta) * self.cells_per_unit
            binomial = ReflectingCount(p)

        def fraction(x, y, level, active, along):
            vertex = Vertex(x, y, level, self.seed)
            # Line 12: quantise the half vector; the grid of half vectors is shifted in each cell
            cell = mi.Vector2i(dr.floor(hp + vertex.shift))
            return self.fraction(vertex, cell, binomial, active)

        noise = cells.sum(fraction, self.zero(), active) / dr.select(active, p, 1)
        return dr.select(active, density * noise, 0)

    def averaged(self, m, query: Query, cells: CoveredCells, active) -> mi.Float | mi.Color3f:
        """D(m) averaged over the ellipse of the light's spread, and over the half vector's turn.

        Along the footprint's median the half vector turns from vertex to vertex. Elsewhere a vertex
        does not tell where in the footprint its microdetails are: this part of the turn widens the
        ellipse.

        Derivatives are those of the Beckmann density at the ellipse's centre, relative to it.
        """
        turn, spread = query.turn, query.spread
        active = active & (dr.squared_norm(m) < 1)
        m = dr.select(active, m, 0)
        with dr.suspend_grad():
            if turn is not None:
                # A segment has the variance of a third of its half length squared
                turned = sqrt(3) * (turn @ (cells.major * cells.walked))
                left = dr.safe_sqrt(1 - dr.square(cells.walked))
                spread = (*spread, turn @ (cells.major * left), turn @ cells.minor)
            ellipse = EllipseOfCells(m, spread, self.cells_per_unit)

        def at_vertex(x, y, level, active, along):
            vertex = Vertex(x, y, level, self.seed)

            def at_normal(x, y, m, active):
                density, slope, _, active = self.mean_density(m, active)
                p = self.reflecting_share(slope)
                active &= p > dr.smallest(mi.Float)
                binomial = ReflectingCount(dr.select(active, p, 0.5))
                noise = self.fraction(vertex, mi.Vector2i(x, y), binomial, active)
                noise = noise / dr.select(active, p, 1)
                noise = dr.fma(ellipse.beta, noise - self.mean_color(), self.mean_color())
                return dr.select(active, density * noise, 0)

            with dr.suspend_grad():
                seen = m if turn is None else m + turned * along
                return ellipse.sum(seen, vertex.shift, at_normal, self.zero(), active)

        total = cells.sum(at_vertex, self.zero(), active)
        centre = self.mean_density(m, active)[0]
        above = centre > 0
        growth = dr.select(above, centre, 1) / dr.detach(dr.select(above, centre, 1))
        return dr.select(active, total * growth, 0)

    def mean_density(self, m: mi.Vector2f, active: mi.Bool) -> tuple:
        """``(D_g(m), slope, cosθ, active)``: the mean over all places, and where m is above the
        horizon."""
        squared_z = 1 - dr.squared_norm(m)
        active = active & (squared_z > 1e-8)
        cos_theta = dr.sqrt(dr.select(active, squared_z, 1))
        x = dr.select(active, m, 0) / cos_theta
        density = self.intensity * beckmann(x, self.alpha) * slope_jacobian(cos_theta)
        return density, x, cos_theta, active

    def reflecting_share(self, x: mi.Vector2f) -> mi.Float:
        """P(h) = D_g(h) / D_l(0) (Eq. 7) for the slope x."""
        return self.largest_p * dr.exp(-dr.squared_norm(x / self.alpha))

    def cells(self, query: Query) -> CoveredCells:
        """The cells that the footprint covers."""
        growth = dr.exp((self.density - dr.detach(self.density)) * log(10))
        footprint = query.footprint.among_details(growth)
        return self.covered_cells(footprint, self.scale, self.stretch, self.max_anisotropy)

    def zero(self) -> mi.Float | mi.Color3f:
        """The empty sum of densities."""
        return mi.Float(0) if self.colors is None else mi.Color3f(0)

    def mean_color(self) -> mi.Float | mi.Color3f:
        """The mean of :meth:`fraction` over P."""
        return mi.Float(1) if self.colors is None else mi.Color3f(*self.colors.mean)

    def fraction(self, vertex, cell, binomial, active):
        """The fraction of a vertex's microdetails that reflect for a cell of half vectors
        (Listing 1, lines 14 to 20)."""
        a, b, c = pcg3d(mi.UInt32(cell.x), mi.UInt32(cell.y), vertex.bits)
        # Lines 14 and 16: a whole number of microdetails, at least one
        n = power_of_two(2 * vertex.level)
        if not is_literal_zero(self.size_variation):
            n = dr.round(n * dr.abs(1 + self.size_variation * gaussian(a)))
            n = dr.maximum(n, 1)
        # Lines 18 and 20; D_l(0) cancels
        count = binomial.draw(b, n, active)
        if self.colors is None:
            return count / n
        # Section 4.5: the mean of N random colours differs from the mean colour by 1/√N
        mean = mi.Color3f(*self.colors.mean)
        color = self.colors.pick(uniform(c)) - mean
        return count / n * (mean + color * dr.rsqrt(dr.maximum(count, 1)))

    def traverse(self, callback: mi.TraversalCallback) -> None:
        smooth, discontinuous = mi.ParamFlags.Differentiable, mi.ParamFlags.NonDifferentiable
        for name in self.NAMES:
            is_smooth = name in ("alpha_u", "alpha_v", "density", "intensity")
            callback.put(name, getattr(self, name), smooth if is_smooth else discontinuous)

    def __repr__(self) -> str:
        members = ", ".join(f"{name}={getattr(self, name)[0]:g}" for name in self.NAMES)
        return f"Grid[{members}, colors={self.colors}]"
