"""MIP chains of a map's moments, and their averages under a Gaussian footprint.

A filter of normal maps keeps a few numbers of the normals, averages them over the footprint, and
makes a lobe of the averages. Here is the averaging, whatever the numbers are.

The footprint is a Gaussian, so the chain is one of Gaussians as well: level 0 holds the texels,
level ℓ ≥ 1 the averages over an isotropic Gaussian of standard deviation :func:`level_sigma` (ℓ),
of the continuous map, triangles between texel centres, not of its texels alone. A footprint that
is a level's Gaussian around one of its texels gets exact averages; one between is a mixture of two
levels with the footprint's variance. Stretched footprints are sums of such lookups along the major
axis, as texture hardware does (Heckbert, "Fundamentals of Texture Mapping and Image Warping",
1989; McCormack et al., "Feline: Fast Elliptical Lines for Anisotropic Texture Mapping", SIGGRAPH
1999).

Accuracy (``python -m benchmarks accuracy moments``, 512² maps from isotropic to scratched): where
the minor axis has a standard deviation of at least 1.2 texels, and a 16th of the major one, the
slopes' first and second moments are those of the continuous map under the footprint to 0.6 % and
0.9 %, root mean square over random footprints, relative to the map's root mean square slope and to
its square. Narrower footprints mix the texels themselves in, whose mean squares exceed those of the
interpolated normals: 1 to 9 % off at one texel, 2 to 42 % at half a texel. Levels of half a texel
would mend that, for 2.9 times the memory.

Positions are in texels: texel (row i, column j) has its centre at (j, i).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property, partial
from math import ceil, floor, log2, sqrt
from typing import NamedTuple

import drjit as dr
import mitsuba as mi

from glintbsdf.core.loops import symbolic_loop
from glintbsdf.core.opaque import opaque
from glintbsdf.footprint.domain import Domain
from glintbsdf.footprint.gaussian import Footprint
from glintbsdf.footprint.kernels import TexelKernel
from glintbsdf.footprint.lattice import floor_int
from glintbsdf.footprint.query import Query

#: Standard deviation of a level over that of the one before.
RATIO = 2 ** (1 / 3)

#: Spacing of a level's samples over its standard deviation, at most, where that exceeds a texel.
SPACING = 0.8

#: Level texels beyond the border of a map that is not periodic: there its border has faded out.
BORDER = 6

#: Where a Gaussian that makes a level from a finer one is cut, in standard deviations.
CUT = 4.0

#: Distance of two lookups along the major axis, at most, in standard deviations of a lookup (a sum
#: of Gaussians ripples by 5 % at 2.3), and how far they reach, in standard deviations of the whole.
STEP, REACH = 2.3, 2.3

#: The same reach where there is one lookup on either side of the middle, which comes nearest to the
#: variance; it serves as long as what it adds is no wider than a lookup.
REACH_OF_ONE = sqrt(3)

#: Footprints whose major axis has a variance of 1 + ROUND² minor ones at most count as round.
ROUND = 0.5

#: No lookup is narrower than this (standard deviation, texels): the texels are interpolated.
SIGMA_LOOKUP = 0.5

#: Keeps the derivative of a root finite where a footprint is round (texels⁴).
TINY = 1e-12


def level_sigma(level: int) -> float:
    """Standard deviation of the Gaussian of a level ≥ 1, texels."""
    return RATIO ** (level - 1)


def level_below(variance):
    """The coarsest level fine enough for a lookup of this variance (texels²), which may be < 0.

    Fine enough with half of what interpolating adds at most.
    """
    return dr.floor(dr.log2(variance * (1 / (1 + SPACING**2 / 8))) / (2 * log2(RATIO))) + 1


# ------------------------------------------------------------------------------------------------
#  Central second moments
# ------------------------------------------------------------------------------------------------
#
# A variance that is the difference of two averages, E[x²] − E[x]², has lost the digits in which
# both agree. So what is kept are means, and then products of deviations from them; whoever averages
# such records takes all of them about one origin, one of the means, first (Chan, Golub and LeVeque,
# "Algorithms for Computing the Sample Variance", The American Statistician 1983).

#: For each product that is kept, the pairs of means whose deviations are multiplied and summed.
Spread = tuple[tuple[tuple[int, int], ...], ...]


def origin_of(record: list, spread: Spread) -> list:
    """The means of a record, for an origin; it is a constant, on which no average depends."""
    return dr.detach(record[: len(record) - len(spread)]) if spread else []


def about(origin: list, record: list, spread: Spread) -> list:
    """A record with means and products about ``origin``, whose averages can be taken."""
    if not spread:
        return record
    deviations = [mean - x for mean, x in zip(record, origin, strict=False)]
    products = record[len(origin) :]
    for k, pairs in enumerate(spread):
        for i, j in pairs:
            products[k] = dr.fma(deviations[i], deviations[j], products[k])
    return deviations + products


def central(origin: list, averages: list, spread: Spread) -> list:
    """The record that averages about ``origin`` stand for."""
    if not spread:
        return averages
    deviations, products = averages[: len(origin)], averages[len(origin) :]
    for k, pairs in enumerate(spread):
        for i, j in pairs:
            products[k] = dr.fma(-deviations[i], deviations[j], products[k])
    return [x + deviation for x, deviation in zip(origin, deviations, strict=True)] + products


# ------------------------------------------------------------------------------------------------
#  Building
# ------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class SampleAxis:
    """``count`` samples at ``origin + k spacing`` (texels) along one axis.

    Beyond them they repeat, or the outermost go on for ever.
    """

    count: int
    origin: float
    spacing: float
    periodic: bool

    @cached_property
    def samples(self) -> mi.Int:
        """``count`` for kernels, which are the same for maps of all sizes."""
        return opaque(mi.Int, self.count)

    @cached_property
    def inverse_count(self) -> mi.Float:
        """1/``count`` for kernels."""
        return opaque(mi.Float, 1 / self.count)

    def divided(self, index):
        """Row and column (``mi.UInt32``) of an index to rows of ``count`` samples."""
        columns = mi.UInt32(self.samples)
        row = index // columns
        return row, index - row * columns

    def wrapped(self, index):
        """The sample that stands at any ``mi.Int`` index."""
        if self.periodic:
            turns = floor_int((mi.Float(index) + 0.5) * self.inverse_count)
            return mi.UInt32(index - turns * self.samples)
        return mi.UInt32(dr.clip(index, 0, self.samples - 1))


def level_axis(texels: int, spacing: float, periodic: bool) -> SampleAxis:
    """The samples of a level with at most this spacing along an axis of ``texels``."""
    if periodic:
        count = ceil(texels / spacing)
        spacing = texels / count
        return SampleAxis(count, spacing / 2 - 0.5, spacing, True)
    count = ceil(texels / spacing) + 2 * BORDER
    return SampleAxis(count, (0.5 - BORDER) * spacing - 0.5, spacing, False)


def smooth(
    channels: list,
    axes: tuple[SampleAxis, SampleAxis],
    along: int,
    target: SampleAxis,
    variance: float,
    spread: Spread,
) -> list:
    """Average samples over a Gaussian along one axis, and take new samples of the result.

    Args:
        channels: arrays (``mi.Float``) of rows × columns samples.
        axes: of rows and of columns.
        along (int): which of them.
        target (SampleAxis): where to sample.
        variance (float): of the Gaussian, texels².
        spread: see :class:`MomentPyramid`.
    """
    source, other = axes[along], axes[1 - along]
    sample = dr.arange(mi.UInt32, target.count * other.count)
    row, column = (target if along == 1 else other).divided(sample)
    index, kept = (column, row) if along == 1 else (row, column)

    # Opaque, so that one kernel serves many levels.
    step = opaque(mi.Float, target.spacing / source.spacing)
    first = opaque(mi.Float, (target.origin - source.origin) / source.spacing)
    sharpness = opaque(mi.Float, source.spacing**2 / (2 * variance))
    place = dr.fma(mi.Float(index), step, first)
    nearest = floor_int(place + 0.5)

    def sample_at(offset: int) -> list:
        taken = source.wrapped(nearest + offset)
        columns = mi.UInt32((source if along == 1 else other).samples)
        position = kept * columns + taken if along == 1 else taken * columns + kept
        return [dr.gather(mi.Float, channel, position) for channel in channels]

    origin = origin_of(sample_at(0), spread)
    totals, weights = [mi.Float(0) for _ in channels], mi.Float(0)
    reach = ceil(CUT * sqrt(variance) / source.spacing)
    for offset in range(-reach, reach + 1):
        distance = mi.Float(nearest + offset) - place
        weight = dr.exp(-sharpness * distance * distance)
        totals = [
            dr.fma(weight, value, total)
            for value, total in zip(about(origin, sample_at(offset), spread), totals, strict=True)
        ]
        weights += weight
    return central(origin, [total / weights for total in totals], spread)


def all_texels(normals, texels: tuple[SampleAxis, SampleAxis], axes: tuple[SampleAxis, SampleAxis]):
    """The normals (``mi.Vector2f``) at the samples of ``axes``, which are texels."""
    index = dr.arange(mi.UInt32, axes[0].count * axes[1].count)
    row, column = (
        mi.Int(i) + int(axis.origin) for i, axis in zip(axes[1].divided(index), axes, strict=True)
    )
    index = texels[0].wrapped(row) * mi.UInt32(texels[1].samples) + texels[1].wrapped(column)
    return dr.gather(mi.Vector2f, normals, index)


def quad_averages(over_quad: Callable, normals, axes: tuple[SampleAxis, SampleAxis]):
    """What ``over_quad`` makes of the normals at the corners of each quad between four texels.

    Returns that and the axes of the quads' centres.
    """
    # Where the map is not periodic there is a constant quad beyond each border.
    quads = tuple(
        SampleAxis(axis.count, 0.5, 1.0, True)
        if axis.periodic
        else SampleAxis(axis.count + 1, -0.5, 1.0, False)
        for axis in axes
    )
    index = dr.arange(mi.UInt32, quads[0].count * quads[1].count)
    row, column = (
        mi.Int(i) if axis.periodic else mi.Int(i) - 1
        for i, axis in zip(quads[1].divided(index), axes, strict=True)
    )
    corners = [
        dr.gather(
            mi.Vector2f,
            normals,
            axes[0].wrapped(row + i) * mi.UInt32(axes[1].samples) + axes[1].wrapped(column + j),
        )
        for i in (0, 1)
        for j in (0, 1)
    ]
    return over_quad(corners), quads


def record_of(moments: Callable, spread: Spread, normal) -> list:
    """The record of a single normal, which deviates from nothing."""
    return moments(normal) + [dr.zeros(mi.Float, dr.width(normal)) for _ in spread]


def midpoint_rule(moments: Callable, spread: Spread, corners: list) -> list:
    """Averages over a quad of moments of its normals, by the midpoints of its triangles' edges.

    Over the two triangles of a quad the projected normal is linear. The rule integrates its
    quadratic polynomials exactly, and slopes are almost linear in it.
    """
    n0, n1, n2, n3 = corners
    edges = ((n1, n2, 2), (n0, n1, 1), (n0, n2, 1), (n1, n3, 1), (n2, n3, 1))
    records = [record_of(moments, spread, 0.5 * (a + b)) for a, b, _ in edges]
    origin = origin_of(records[0], spread)
    parts = [
        [weight / 6 * x for x in about(origin, record, spread)]
        for record, (*_, weight) in zip(records, edges, strict=True)
    ]
    averages = [sum(part[1:], part[0]) for part in zip(*parts, strict=True)]
    return central(origin, averages, spread)


def samples_within(axis: SampleAxis, first: float, last: float) -> tuple[int, int]:
    """First and number of the samples that an interpolation between two positions (texels) needs.

    Those of a periodic axis need not lie within its period.
    """
    low, high = (floor((x - axis.origin) / axis.spacing) for x in (first, last))
    low, high = low - 1, high + 2  # the sample after, and one more on either side for rounding
    if not axis.periodic:
        low, high = (min(max(k, 0), axis.count - 1) for k in (low, high))
    return low, high - low + 1


def samples(window) -> int:
    """Number of samples in a window, ``(first, number)`` of its rows and of its columns."""
    (_, rows), (_, columns) = window
    return rows * columns


def cut_out(level: list, axes: tuple[SampleAxis, SampleAxis], window) -> list:
    """The part of a level in a window, which may lie across the border."""
    (top, rows), (left, columns) = window
    if window == tuple((0, axis.count) for axis in axes):
        return level
    index = dr.arange(mi.UInt32, rows * columns)
    columns = opaque(mi.UInt32, columns)
    row = index // columns
    column = axes[1].wrapped(opaque(mi.Int, left) + mi.Int(index - row * columns))
    row = axes[0].wrapped(opaque(mi.Int, top) + mi.Int(row))
    index = row * mi.UInt32(axes[1].samples) + column
    return [dr.gather(mi.Float, channel, index) for channel in level]


class LevelSamples(NamedTuple):
    """Where a level's samples are: the first of a whole level, though it may not be stored, samples
    stored per row, samples per texel, their number and its inverse, these for x and y; the level's
    variance (texels²), and half of the squared spacing."""

    offset: mi.UInt32
    pitch: mi.UInt32
    scale: mi.Vector2f
    counts: mi.Vector2f
    inverse_count: mi.Vector2f
    variance: mi.Float
    half_square: mi.Vector2f


def principal_axes(kernel: TexelKernel):
    """Unit vector of the footprint's major axis; variances (texels²) along major and minor axis."""
    variance_u, variance_v = dr.square(kernel.sigma_u), dr.square(kernel.sigma_v)
    covariance = kernel.shear * variance_v
    mean, difference = 0.5 * (variance_u + variance_v), 0.5 * (variance_u - variance_v)
    radius = dr.sqrt(dr.fma(difference, difference, dr.fma(covariance, covariance, TINY)))
    # The eigenvector, from the row of Σ − λ₂ I that does not cancel.
    axis = dr.select(
        difference >= 0,
        mi.Vector2f(difference + radius, covariance),
        mi.Vector2f(covariance, radius - difference),
    )
    major = mean + radius
    # The smaller eigenvalue from the determinant, whose digits the kernel has kept.
    minor = dr.square(kernel.sigma_u_given_v * kernel.sigma_v) / major
    return axis * dr.rsqrt(dr.squared_norm(axis)), major, minor


def taps(variance_major, variance):
    """How to make a Gaussian, stretched along one axis, of round ones of the variance across.

    Returns the variance of a round one, the distance between two, how many there are on either side
    of the middle, and the ``s`` of their weights ``exp(−s k²)``.
    """
    spread = dr.sqrt(dr.maximum(variance_major - variance, 0))
    sigma = dr.maximum(dr.sqrt(variance), SIGMA_LOOKUP)
    one, many = spread > ROUND * sigma, spread > sigma
    steps = dr.select(many, dr.ceil(REACH / STEP * spread / sigma), dr.select(one, 1, 0))
    reach = dr.select(many, REACH / dr.maximum(steps, 1), REACH_OF_ONE)
    steps = dr.detach(steps)  # constant but for jumps, and a loop counts to it
    variance = dr.select(one, variance, 0.5 * (variance_major + variance))
    return variance, reach * spread, steps, 0.5 * dr.square(reach)


class MomentPyramid:
    """The MIP chain of some moments of a map.

    Args:
        data (mi.TensorXf): projected normals, H×W×2. Derivatives flow through it.
        wrap_mode (str): what lies beyond the map's border.
        moments: function of projected normals (``mi.Vector2f``) that returns a list of ``mi.Float``
            whose averages are wanted, any number of them. None for a chain without the texels
            themselves, for footprints no narrower than level 1.
        spread (Spread): products of deviations from the averages of ``moments``. Their own
            averages, central second moments, follow in everything that is stored and returned.
        between (bool): whether what means differ by between samples of the chain, and between
            lookups, adds to those products.
        finish: function from the averages of a sample of the chain to what is stored there and
            interpolated; by default the averages themselves.
        max_anisotropy (float): ratio of the footprint's axes, ≥ 1, beyond which it is widened.
        over_quad: function of the normals at the corners of a quad that returns the averages over
            it; by default that of ``moments`` by :func:`midpoint_rule`.
        first (int): the finest level; by default the texels, or 1 without them. A footprint that is
            narrower is widened.
        records: what is averaged, of each texel of a map that repeats, instead of ``over_quad``:
            one ``mi.Float`` of H·W numbers per channel.
        domain (Domain): what will be asked for; levels and parts of levels that no such footprint
            needs are left out. What lies within the domain has the same averages to the last bit.

    Attributes:
        first, top (int): finest and coarsest level.
        nbytes (int): memory of the chain.
    """

    def __init__(
        self,
        data: mi.TensorXf,
        wrap_mode: str,
        moments: Callable | None,
        finish: Callable = lambda averages: averages,
        max_anisotropy: float = 16.0,
        over_quad: Callable | None = None,
        domain: Domain | None = None,
        spread: Spread = (),
        between: bool = True,
        first: int | None = None,
        records: list | None = None,
    ) -> None:
        self.spread = spread if between else ()
        self.height, self.width, _ = data.shape
        self.wrap_mode, self.max_anisotropy = wrap_mode, max_anisotropy
        self.periodic = wrap_mode != "clamp"
        normals, rows, columns = self.one_period(data)
        texels = (
            SampleAxis(rows, 0.0, 1.0, self.periodic),
            SampleAxis(columns, 0.0, 1.0, self.periodic),
        )
        self.first = (0 if moments is not None else 1) if first is None else first
        self.top = self.first + 1
        while max(rows, columns) > level_sigma(self.top):
            self.top += 1
        if domain is not None:  # with a margin for rounding
            last = self.top - 1
            self.first = int(dr.clip(level_below(0.998 * domain.smallest**2), self.first, last))
            last = int(dr.clip(level_below(1.002 * domain.largest**2), self.first, last))
            self.top = last + 1

        def axes_of(number: int) -> tuple[SampleAxis, SampleAxis]:
            spacing = 2.0 ** max(0, floor(log2(level_sigma(number) * SPACING)))
            return tuple(level_axis(n, spacing, self.periodic) for n in (rows, columns))

        shapes = [axes_of(number) for number in range(self.first, self.top + 1)]
        windows = self.choose_windows(shapes, domain)
        stored: list[list[mi.Float]] = []

        def keep(level: list) -> None:
            k = len(stored)
            stored.append(finish(cut_out(level, shapes[k], windows[k])))

        if self.first == 0:
            keep(record_of(moments, spread, all_texels(normals, texels, axes_of(0))))
        level, axes = records, texels
        if records is None:
            over_quad = over_quad or partial(midpoint_rule, moments, spread)
            level, axes = quad_averages(over_quad, normals, texels)
        variance = 1 / 12  # of a quad or a texel, along each axis
        for number in range(1, self.top + 1):
            sigma, target = level_sigma(number), axes_of(number)
            for along in (0, 1):
                level = smooth(level, axes, along, target[along], sigma**2 - variance, spread)
                axes = (target[0], axes[1]) if along == 0 else target
                dr.eval(level)
            variance = sigma**2
            if number >= self.first:
                keep(level)
        self.store(stored, shapes, windows)

    def choose_windows(
        self, shapes: list[tuple[SampleAxis, SampleAxis]], domain: Domain | None
    ) -> list:
        """What to store of each level: ``(first, number)`` of the rows, and of the columns.

        All of all levels, or what lies within the domain, if that is less. It may lie across the
        border of a periodic level, and is stored as it lies: lookups need not wrap then.
        """
        whole = [tuple((0, axis.count) for axis in axes) for axes in shapes]
        self.wraps = self.periodic
        if domain is None:
            return whole
        ends = domain.rows, domain.columns
        parts = [
            tuple(samples_within(axis, *end) for axis, end in zip(axes, ends, strict=True))
            for axes in shapes
        ]
        if sum(map(samples, parts)) >= sum(map(samples, whole)):
            return whole
        self.wraps = False
        return parts

    def one_period(self, data):
        """Projected normals, rows and columns of the map, or of the period of a mirrored one."""
        if self.wrap_mode != "mirror":
            return data.array, self.height, self.width
        index = dr.arange(mi.UInt32, 4 * self.height * self.width)
        height, width = (opaque(mi.UInt32, n) for n in (self.height, self.width))
        row = index // (2 * width)
        column = index - row * (2 * width)
        row = dr.minimum(row, 2 * height - 1 - row)
        column = dr.minimum(column, 2 * width - 1 - column)
        mirrored = dr.gather(mi.Vector2f, data.array, row * width + column)
        return dr.ravel(mirrored), 2 * self.height, 2 * self.width

    def store(
        self, levels: list[list], shapes: list[tuple[SampleAxis, SampleAxis]], windows: list
    ) -> None:
        """Lay the levels out one after the other, as records of four numbers, and of one each.

        ``windows``: of each level ``(first, number)`` of the rows, and of the columns, given.
        """
        channels = [dr.concat(parts) for parts in zip(*levels, strict=True)]
        dr.eval(channels)
        self.channels = len(channels)
        zero = dr.zeros(mi.Float, dr.width(channels[0]))
        self.records = []
        while len(channels) > 1:
            group, channels = channels[:4], channels[4:]
            group = group + [zero] * (4 - len(group))
            self.records.append(dr.ravel(mi.Vector4f(group)))
        self.single = channels[0] if channels else None
        sizes = [samples(window) for window in windows]
        pitches = [columns for _, (_, columns) in windows]
        # Of the first sample of the whole level: possibly before all, in arithmetic modulo 2³².
        offsets = [
            (sum(sizes[:k]) - top * columns - left) % 2**32
            for k, ((top, _), (left, columns)) in enumerate(windows)
        ]
        self.layout = dr.ravel(mi.Vector2u(mi.UInt32(offsets), mi.UInt32(pitches)))
        # index = (position + 1/2) / spacing − 1/2 (+ border), for every level; see level_axis.
        self.grids = dr.ravel(
            mi.Vector4f(
                [
                    mi.Float([1 / columns.spacing for _, columns in shapes]),
                    mi.Float([1 / rows.spacing for rows, _ in shapes]),
                    mi.Float([columns.count for _, columns in shapes]),
                    mi.Float([rows.count for rows, _ in shapes]),
                ]
            )
        )
        dr.eval(self.records, self.single, self.layout, self.grids)
        self.nbytes = 4 * sum(sizes) * (4 * len(self.records) + (self.single is not None))

    # --------------------------------------------------------------------------------------------
    #  Lookup
    # --------------------------------------------------------------------------------------------

    def average(self, query: Query | Footprint, active: bool | mi.Bool = True) -> list:
        """What is stored, averaged over a footprint: one ``mi.Float`` per channel.

        ``query``: a query, or just a footprint in the UV space of the map.
        """
        query = Query.of(query)
        kernel = query.texel_kernel("gaussian", self.height, self.width, self.wrap_mode)
        major, variance_major, variance_minor = principal_axes(kernel)
        variance = dr.maximum(variance_minor, variance_major / self.max_anisotropy**2)
        variance, step, steps, sharpness = taps(variance_major, variance)
        last = opaque(mi.Float, self.top - 1)
        level = dr.clip(level_below(variance), opaque(mi.Float, self.first), last)
        grids = [self.grid(level), self.grid(level + 1)]
        steps = dr.select(active, steps, -1)  # none at all, as they go from −steps to steps
        step = major * step
        origin = self.nearest_means(kernel.mean, grids[0])

        def body(k, weights, *totals):
            weight = dr.exp(-sharpness * k * k)
            values = self.lookup(kernel.mean + k * step, variance, grids, origin)
            totals = [dr.fma(weight, x, total) for x, total in zip(values, totals, strict=True)]
            return k + 1, weights + weight, *totals

        state = (-steps, mi.Float(0), *[mi.Float(0) for _ in range(self.channels)])
        _, weights, *totals = symbolic_loop(state, lambda k, *_: k <= steps, body, "taps")
        weights = dr.select(active, weights, 1)
        return central(origin, [total / weights for total in totals], self.spread)

    def grid(self, level) -> LevelSamples:
        """The samples of a level (``mi.Float``)."""
        index = mi.UInt32(level - opaque(mi.Float, self.first))
        scale_x, scale_y, columns, rows = dr.gather(mi.Vector4f, self.grids, index)
        variance = dr.select(level > 0, dr.exp2((2 * log2(RATIO)) * (level - 1)), 0)
        offset, pitch = dr.gather(mi.Vector2u, self.layout, index)
        return LevelSamples(
            offset,
            pitch,
            mi.Vector2f(scale_x, scale_y),
            mi.Vector2f(columns, rows),
            mi.Vector2f(dr.rcp(columns), dr.rcp(rows)),
            variance,
            mi.Vector2f(0.5 * dr.rcp(dr.square(scale_x)), 0.5 * dr.rcp(dr.square(scale_y))),
        )

    def lookup(self, position, variance, grids, origin: list) -> list:
        """The mixture, at a position, of a level and the next that has this variance."""
        (fine, fine_variance), (coarse, coarse_variance) = (
            self.bilinear(position, grid, origin) for grid in grids
        )
        weight = dr.clip((variance - fine_variance) * dr.rcp(coarse_variance - fine_variance), 0, 1)
        return [dr.lerp(a, b, weight) for a, b in zip(fine, coarse, strict=True)]

    def corners(self, position, grid: LevelSamples):
        """First and second sample (``mi.Vector2u``: column, row) of a level on either side of a
        position along each axis, and where between them it lies, from 0 to 1."""
        count = grid.counts
        place = (position + 0.5) * grid.scale + (-0.5 if self.periodic else BORDER - 0.5)
        corner = dr.floor(place)
        if self.wraps:
            first = corner - count * dr.floor((corner + 0.5) * grid.inverse_count)
            second = dr.select(first + 1 < count, first + 1, 0)
        elif self.periodic:
            first, second = (mi.Vector2i(corner + k) for k in (0, 1))  # may be below 0
        else:
            first, second = (dr.clip(corner + k, 0, count - 1) for k in (0, 1))
        return mi.Vector2u(first), mi.Vector2u(second), place - corner

    def record(self, index) -> list:
        """What is stored at an index."""
        values = [x for records in self.records for x in dr.gather(mi.Vector4f, records, index)]
        if self.single is not None:
            values.append(dr.gather(mi.Float, self.single, index))
        return values[: self.channels]

    def nearest_means(self, position, grid: LevelSamples) -> list:
        """The means of a level's sample that is nearest to a position, for an origin."""
        if not self.spread:
            return []
        first, second, f = self.corners(position, grid)
        x, y = dr.select(f < 0.5, first, second)
        return origin_of(self.record(grid.offset + y * grid.pitch + x), self.spread)

    def bilinear(self, position, grid: LevelSamples, origin: list):
        """What a level says at a position, and the variance (texels²) of the kernel there."""
        (x0, y0), (x1, y1), f = self.corners(position, grid)
        rows = [grid.offset + y * grid.pitch for y in (y0, y1)]
        weight = [wy * wx for wy in (1 - f.y, f.y) for wx in (1 - f.x, f.x)]
        records = [
            about(origin, self.record(row + x), self.spread) for row in rows for x in (x0, x1)
        ]
        averages = [value * weight[0] for value in records[0]]
        for record, w in zip(records[1:], weight[1:], strict=True):
            averages = [dr.fma(x, w, total) for x, total in zip(record, averages, strict=True)]
        # Between two samples, weighed 1 − f and f, interpolation adds the variance f (1 − f) h².
        return averages, grid.variance + dr.dot(f * (1 - f), grid.half_square)
