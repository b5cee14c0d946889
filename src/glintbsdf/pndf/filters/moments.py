"""MIP chains of a map's moments, and their averages under a Gaussian footprint.

A filter of normal maps averages a few moments of the normals over the footprint, and makes a lobe
of the averages. This module averages, whatever the moments are.

The footprint is a Gaussian, and so are the levels of the chain. Level 0 holds the texels. Level
ℓ ≥ 1 holds averages over an isotropic Gaussian, see :class:`Scale`. They are averages of the
continuous map, which has triangles between texel centres. The averages are exact for a footprint
that equals a level's Gaussian around one of its samples. Any other round footprint is a mixture of
two levels that has the footprint's variance. A stretched footprint is a sum of such lookups along
its major axis, as in texture hardware (Heckbert, "Fundamentals of Texture Mapping and Image
Warping", 1989; McCormack et al., "Feline: Fast Elliptical Lines for Anisotropic Texture Mapping",
SIGGRAPH 1999).

Footprints narrower than a texel mix in the texels themselves. Their mean squares exceed those of
the interpolated normals, so these footprints are the least accurate
(tests/pndf/filters/test_moments.py).

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
import numpy as np

from glintbsdf.core.loops import symbolic_loop
from glintbsdf.core.opaque import joined, opaque
from glintbsdf.core.progress import progress
from glintbsdf.footprint.domain import Domain
from glintbsdf.footprint.gaussian import Footprint
from glintbsdf.footprint.kernels import TexelKernel
from glintbsdf.footprint.lattice import floor_int
from glintbsdf.footprint.query import Query
from glintbsdf.pndf.filters.records import FloatRecords, PackedRecords

#: Samples of the map from which a strip of the finest levels is made. It bounds the memory that the
#: build needs besides its result.
STRIP = 1 << 20

#: Samples of a level beyond each border of a map that is not periodic. Farther out, the averages
#: are constant.
BORDER = 6

#: Cut of the Gaussian that makes a level from a finer one, in standard deviations.
CUT = 4.0

#: Largest distance between lookups along the major axis, in standard deviations of a lookup: the
#: sum of Gaussians at this distance ripples by 5 %. Reach of the lookups, in standard deviations of
#: the Gaussian that they must add to a single one.
STEP, REACH = 2.3, 2.3

#: Reach where there is one lookup on either side of the middle: this one keeps the variance best.
#: One is enough while the Gaussian to add is no wider than a lookup.
REACH_OF_ONE = sqrt(3)

#: A footprint counts as round if the variance along its major axis is at most 1 + ROUND² times the
#: variance along its minor axis.
ROUND = 0.5

#: Smallest standard deviation of a lookup, texels, as texels are interpolated.
SIGMA_LOOKUP = 0.5

#: Keeps the derivative of a root finite where a footprint is round (texels⁴).
TINY = 1e-12


class Scale(NamedTuple):
    """The Gaussians of the levels ≥ 1 of a chain.

    Attributes:
        sigma (float): standard deviation of level 1, texels.
        ratio (float): ratio of the standard deviations of two successive levels.
        spacing (float): largest spacing of a level's samples, in standard deviations of the level.
            It is never less than a texel.
    """

    sigma: float
    ratio: float
    spacing: float

    def sigma_of(self, level: int) -> float:
        """Standard deviation of a level ≥ 1, texels."""
        return self.sigma * self.ratio ** (level - 1)

    def spacing_of(self, level: int) -> float:
        """Largest spacing of a level's samples, texels."""
        return 2.0 ** max(0, floor(log2(self.sigma_of(level) * self.spacing) + 1e-6))

    def variance_of(self, level):
        """Variance of a level (``mi.Float``), texels²."""
        variance = dr.exp2(2 * log2(self.ratio) * (level - 1)) * self.sigma**2
        return dr.select(level > 0, variance, 0)

    def level_below(self, variance):
        """The coarsest level that is fine enough for a lookup of this variance (texels²).

        A level counts with its variance and half of the largest variance that interpolation adds.
        The result is < 1 for variances below those of level 1, or of the texels.
        """
        relative = variance * (1 / (self.sigma**2 * (1 + self.spacing**2 / 8)))
        return dr.floor(dr.log2(relative) / (2 * log2(self.ratio))) + 1

    def narrowest(self, level: int) -> float:
        """Standard deviation of the narrowest footprint for which a level is fine enough."""
        return self.sigma_of(level) * sqrt(1 + self.spacing**2 / 8)


#: Three levels per octave, for lobes that are made of the averages.
FINE = Scale(1.0, 2 ** (1 / 3), 0.8)

#: Two levels per octave, and none as fine as the map, for masking. In packed records such a chain
#: takes 5 bytes per texel, a tenth of the memory of lists of quads and their vertices.
COARSE = Scale(2 * sqrt(2), sqrt(2), 1.0)


# ------------------------------------------------------------------------------------------------
#  Central second moments
# ------------------------------------------------------------------------------------------------
#
# A variance that is a difference of two averages, E[x²] − E[x]², has lost the digits in which both
# agree. So a record holds means, and averages of products of deviations from these means. To
# average records, all of them are first moved to one origin, which is one of the means (Chan, Golub
# and LeVeque, "Algorithms for Computing the Sample Variance", The American Statistician 1983).

#: For each product that is kept, the pairs of means whose deviations are multiplied and summed.
Spread = tuple[tuple[tuple[int, int], ...], ...]


def origin_of(record: list, spread: Spread) -> list:
    """The means of a record, to be used as an origin. Averages do not depend on the origin, so it
    carries no derivatives."""
    return dr.detach(record[: len(record) - len(spread)]) if spread else []


def about(origin: list, record: list, spread: Spread) -> list:
    """A record moved to ``origin``: means and products of deviations from it. Such records can be
    averaged."""
    if not spread:
        return record
    deviations = [mean - x for mean, x in zip(record, origin, strict=False)]
    products = record[len(origin) :]
    for k, pairs in enumerate(spread):
        for i, j in pairs:
            products[k] = dr.fma(deviations[i], deviations[j], products[k])
    return deviations + products


def central(origin: list, averages: list, spread: Spread) -> list:
    """The inverse of :func:`about`, for the averages of such records."""
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

    The samples repeat if the axis is periodic; otherwise the outermost ones continue.
    """

    count: int
    origin: float
    spacing: float
    periodic: bool

    @cached_property
    def samples(self) -> mi.Int:
        """``count`` as an opaque value: one kernel serves maps of all sizes."""
        return opaque(mi.Int, self.count)

    @cached_property
    def inverse_count(self) -> mi.Float:
        """1/``count`` as an opaque value."""
        return opaque(mi.Float, 1 / self.count)

    def divided(self, index):
        """Row and column (``mi.UInt32``) of an index into rows of ``count`` samples."""
        columns = mi.UInt32(self.samples)
        row = index // columns
        return row, index - row * columns

    def wrapped(self, index):
        """The index of the stored sample that stands at any ``mi.Int`` index."""
        if self.periodic:
            turns = floor_int((mi.Float(index) + 0.5) * self.inverse_count)
            return mi.UInt32(index - turns * self.samples)
        return mi.UInt32(dr.clip(index, 0, self.samples - 1))

    def part(self, rows: range) -> SampleAxis:
        """Some of the samples, which may lie outside of the first period, as an axis of their
        own."""
        if rows == range(self.count):
            return self
        origin = self.origin + self.spacing * rows.start
        return SampleAxis(len(rows), origin, self.spacing, False)

    def reached(self, target: SampleAxis, rows: range, reach: float) -> range:
        """The samples within ``reach`` (texels) of some ``rows`` of another axis."""
        first, last = (target.origin + target.spacing * k for k in (rows.start, rows.stop - 1))
        low = floor((first - reach - self.origin) / self.spacing) - 1
        high = ceil((last + reach - self.origin) / self.spacing) + 2
        if self.periodic:
            return range(low, high)
        return range(max(low, 0), min(high, self.count))


def level_axis(texels: int, spacing: float, periodic: bool) -> SampleAxis:
    """The samples of a level along an axis of ``texels``; ``spacing`` is the largest allowed."""
    if periodic:
        count = ceil(texels / spacing)
        spacing = texels / count
        return SampleAxis(count, spacing / 2 - 0.5, spacing, True)
    count = ceil(texels / spacing) + 2 * BORDER
    return SampleAxis(count, (0.5 - BORDER) * spacing - 0.5, spacing, False)


def lanes(count: int) -> tuple[mi.UInt32, mi.Bool]:
    """Indices of ``count`` samples, and which of them count.

    Dr.Jit writes the index of a single lane into its kernel. So there are at least two; the second
    of a single sample repeats the first, and does not count.
    """
    index = dr.arange(mi.UInt32, max(count, 2))
    end = opaque(mi.UInt32, count)
    return dr.minimum(index, end - 1), index < end


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
        axes: the axes of rows and of columns.
        along (int): index of the axis along which to average.
        target (SampleAxis): positions of the new samples along that axis.
        variance (float): variance of the Gaussian, texels².
        spread: see :class:`MomentPyramid`.
    """
    dr.eval(channels)  # nothing can be evaluated inside of a loop
    source, other = axes[along], axes[1 - along]
    sample, _ = lanes(target.count * other.count)
    row, column = (target if along == 1 else other).divided(sample)
    index, kept = (column, row) if along == 1 else (row, column)

    # Opaque, so that one kernel serves many levels.
    step = opaque(mi.Float, target.spacing / source.spacing)
    first = opaque(mi.Float, (target.origin - source.origin) / source.spacing)
    sharpness = opaque(mi.Float, source.spacing**2 / (2 * variance))
    place = dr.fma(mi.Float(index), step, first)
    nearest = floor_int(place + 0.5)

    def sample_at(offset: mi.Int | int) -> list:
        taken = source.wrapped(nearest + offset)
        columns = mi.UInt32((source if along == 1 else other).samples)
        position = kept * columns + taken if along == 1 else taken * columns + kept
        return [dr.gather(mi.Float, channel, position) for channel in channels]

    origin = origin_of(sample_at(0), spread)
    # A loop, as the reach in samples depends on the size of the map.
    reach = opaque(mi.Int, ceil(CUT * sqrt(variance) / source.spacing))

    def add(offset, weights, *totals):
        distance = mi.Float(nearest + offset) - place
        weight = dr.exp(-sharpness * distance * distance)
        moved = about(origin, sample_at(offset), spread)
        added = [dr.fma(weight, value, total) for value, total in zip(moved, totals, strict=True)]
        return offset + 1, weights + weight, *added

    zeros = [dr.zeros(mi.Float, dr.width(sample)) for _ in range(1 + len(channels))]
    _, weights, *totals = symbolic_loop(
        (-reach, *zeros), lambda offset, *_: offset <= reach, add, "averages along an axis"
    )
    return central(origin, [total / weights for total in totals], spread)


def texel_normals(
    normals,
    texels: tuple[SampleAxis, SampleAxis],
    axes: tuple[SampleAxis, SampleAxis],
    rows: range,
):
    """The normals (``mi.Vector2f``) at some rows of the samples of ``axes``, which are texels."""
    row, column = axes[1].divided(lanes(len(rows) * axes[1].count)[0])
    row = texels[0].wrapped(mi.Int(row) + opaque(mi.Int, rows.start + int(axes[0].origin)))
    column = texels[1].wrapped(mi.Int(column) + int(axes[1].origin))
    return dr.gather(mi.Vector2f, normals, row * mi.UInt32(texels[1].samples) + column)


def quad_axes(axes: tuple[SampleAxis, SampleAxis]) -> tuple[SampleAxis, SampleAxis]:
    """The axes of the centres of the quads between four texels. Where the map is not periodic there
    is a constant quad beyond each border."""
    return tuple(
        SampleAxis(axis.count, 0.5, 1.0, True)
        if axis.periodic
        else SampleAxis(axis.count + 1, -0.5, 1.0, False)
        for axis in axes
    )


def quad_averages(
    over_quad: Callable, normals, axes: tuple[SampleAxis, SampleAxis], rows: range
) -> list:
    """Averages over each quad of some ``rows`` of quads between four texels.

    ``over_quad`` computes them from the normals at the corners.
    """
    columns = quad_axes(axes)[1]
    row, column = columns.divided(lanes(len(rows) * columns.count)[0])
    shift = 0 if columns.periodic else 1
    row, column = mi.Int(row) + opaque(mi.Int, rows.start - shift), mi.Int(column) - shift
    corners = [
        dr.gather(
            mi.Vector2f,
            normals,
            axes[0].wrapped(row + i) * mi.UInt32(axes[1].samples) + axes[1].wrapped(column + j),
        )
        for i in (0, 1)
        for j in (0, 1)
    ]
    return over_quad(corners)


def record_of(moments: Callable, spread: Spread, normal) -> list:
    """The record of a single normal: its moments, and products of deviations that are 0."""
    return moments(normal) + [dr.zeros(mi.Float, dr.width(normal)) for _ in spread]


def midpoint_rule(moments: Callable, spread: Spread, corners: list) -> list:
    """Averages of moments over a quad, from the midpoints of its triangles' edges.

    The projected normal is linear over each triangle. The rule is exact for quadratic polynomials
    of it, and slopes are almost linear in it.
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
    """The samples that interpolation needs between two positions (texels): the first, and how many.

    On a periodic axis they may lie outside of the first period.
    """
    low, high = (floor((x - axis.origin) / axis.spacing) for x in (first, last))
    low, high = low - 1, high + 2  # the next sample, and one more on either side for rounding
    if not axis.periodic:
        low, high = (min(max(k, 0), axis.count - 1) for k in (low, high))
    return low, high - low + 1


def samples(window) -> int:
    """Number of samples in a window: pairs ``(first, number)`` for its rows and for its columns."""
    (_, rows), (_, columns) = window
    return rows * columns


class Strip(NamedTuple):
    """The ``rows`` of a level that a step of the build has, and those among them that it stores."""

    rows: range
    own: range


class LevelSamples(NamedTuple):
    """Layout of a level's samples. Vectors have a value for x and one for y.

    Attributes:
        offset: index of the first sample of the whole level, even if only a part is stored.
        pitch: stored samples per row.
        scale: samples per texel.
        counts, inverse_count: number of samples of the whole level, and its inverse.
        variance: variance of the level's Gaussian, texels².
        half_square: half of the squared spacing, texels².
    """

    offset: mi.UInt32
    pitch: mi.UInt32
    scale: mi.Vector2f
    counts: mi.Vector2f
    inverse_count: mi.Vector2f
    variance: mi.Float
    half_square: mi.Vector2f


def principal_axes(kernel: TexelKernel):
    """Unit vector of the footprint's major axis; variances (texels²) along its major and its minor
    axis."""
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
    # The smaller eigenvalue comes from the determinant, which the kernel knows without
    # cancellation.
    minor = dr.square(kernel.sigma_u_given_v * kernel.sigma_v) / major
    return axis * dr.rsqrt(dr.squared_norm(axis)), major, minor


def taps(variance_major, variance):
    """Round Gaussians whose sum is a stretched one, with ``variance`` (texels²) across.

    Returns the variance of a round Gaussian, the distance between two, how many there are on either
    side of the middle one, and ``s`` of their weights ``exp(−s k²)``.
    """
    spread = dr.sqrt(dr.maximum(variance_major - variance, 0))
    sigma = dr.maximum(dr.sqrt(variance), SIGMA_LOOKUP)
    one, many = spread > ROUND * sigma, spread > sigma
    steps = dr.select(many, dr.ceil(REACH / STEP * spread / sigma), dr.select(one, 1, 0))
    reach = dr.select(many, REACH / dr.maximum(steps, 1), REACH_OF_ONE)
    steps = dr.detach(steps)  # a number of loop turns: its derivative is 0 between jumps
    variance = dr.select(one, variance, 0.5 * (variance_major + variance))
    return variance, reach * spread, steps, 0.5 * dr.square(reach)


class MomentPyramid:
    """The MIP chain of some moments of a map.

    Args:
        data (mi.TensorXf): projected normals, H×W×2. Derivatives flow through it.
        wrap_mode (str): how the map continues beyond its border.
        moments: function of projected normals (``mi.Vector2f``) that returns the moments to
            average, a list of any number of ``mi.Float``. None for a chain without level 0, for
            footprints no narrower than level 1.
        spread (Spread): products of deviations from the averages of ``moments``. Their averages,
            which are central second moments, follow the averages of ``moments`` in all records.
        between (bool): whether central second moments include the differences of means between
            samples of the chain, and between lookups.
        max_anisotropy (float): largest ratio of the footprint's axes, ≥ 1. A longer footprint is
            widened across.
        over_quad: function of the normals at the corners of a quad that returns the averages over
            the quad; by default :func:`midpoint_rule` of ``moments``.
        first (int): the finest level; by default 0, or 1 without ``moments``. A narrower footprint
            is widened.
        scale (Scale): the Gaussians of the levels.
        records: for a map that repeats, the values of each texel to average in place of
            ``over_quad``: one ``mi.Float`` of H·W numbers per channel.
        domain (Domain): the queries to expect. Levels and parts of levels that none of them needs
            are left out. Averages within the domain are the same to the last bit.

    Attributes:
        first, top (int): finest and coarsest level.
        nbytes (int): memory of the chain, bytes.
    """

    def __init__(
        self,
        data: mi.TensorXf,
        wrap_mode: str,
        moments: Callable | None,
        max_anisotropy: float = 16.0,
        over_quad: Callable | None = None,
        domain: Domain | None = None,
        spread: Spread = (),
        between: bool = True,
        first: int | None = None,
        records: list | None = None,
        scale: Scale = FINE,
    ) -> None:
        self.spread, self.scale = spread if between else (), scale
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
        while max(rows, columns) > scale.sigma_of(self.top):
            self.top += 1
        if domain is not None:  # with a margin for rounding
            last = self.top - 1
            fit = scale.level_below
            self.first = int(dr.clip(fit(0.998 * domain.smallest**2), self.first, last))
            last = int(dr.clip(fit(1.002 * domain.largest**2), self.first, last))
            self.top = last + 1

        self.texels, self.normals = texels, normals
        self.shapes = {
            number: tuple(
                level_axis(n, scale.spacing_of(number) if number else 1.0, self.periodic)
                for n in (rows, columns)
            )
            for number in range(self.top + 1)
        }
        self.windows = self.choose_windows(domain)
        over_quad = over_quad or partial(midpoint_rule, moments, spread)
        self.build(moments, over_quad, records, spread)
        del self.normals

    def build(
        self,
        moments: Callable | None,
        over_quad: Callable,
        records: list | None,
        spread: Spread,
    ) -> None:
        """Average the map, level by level, and store the levels.

        The levels as fine as the map, and the first one that is coarser, are made in strips: no
        such level exists as a whole in floats.
        """
        self.channels = len(records or over_quad([mi.Vector2f(0)] * 4))
        numbers = range(self.first, self.top + 1)
        sizes = [samples(self.windows[number]) for number in numbers]
        ends = np.cumsum([0, *sizes]).tolist()
        self.begin = dict(zip(numbers, ends[:-1], strict=True))
        self.records: PackedRecords | FloatRecords
        if spread and not dr.grad_enabled(self.normals):
            means = self.channels - len(spread)
            self.records = PackedRecords(ends[-1], means, len(spread))
        else:
            self.records = FloatRecords(ends[-1], self.channels)
        self.nbytes = self.records.nbytes

        coarse = next((n for n in range(1, self.top) if self.scale.spacing_of(n) > 1), self.top)
        base = self.texels if records else quad_axes(self.texels)
        strips = 1
        if records is None:
            strips = min(base[0].count * base[1].count // STRIP, self.shapes[coarse][0].count // 8)
        strips = max(strips, 1)
        with progress("Averaging the map", self.nbytes) as report:
            parts = []
            for k in range(strips):
                plan = self.plan(base[0], coarse, k, strips)
                if self.first == 0:
                    rows = plan[0].own
                    texels = texel_normals(self.normals, self.texels, self.shapes[0], rows)
                    self.keep(0, record_of(moments, spread, texels), Strip(rows, rows))
                level, axes = records, base
                if records is None:
                    level = quad_averages(over_quad, self.normals, self.texels, plan[0].rows)
                    axes = base[0].part(plan[0].rows), base[1]
                for number in range(1, coarse + 1):
                    level, axes = self.next_level(level, axes, number, plan[number].rows, spread)
                    self.keep(number, level, plan[number])
                parts.append(level)
                report(0.8 * (k + 1) / strips)
            level = joined(parts) if strips > 1 else parts[0]
            parts.clear()
            axes = self.shapes[coarse]
            for number in range(coarse + 1, self.top + 1):
                rows = range(self.shapes[number][0].count)
                level, axes = self.next_level(level, axes, number, rows, spread)
                self.keep(number, level, Strip(rows, rows))
        dr.flush_malloc_cache()
        self.index_levels()

    def plan(self, base: SampleAxis, coarse: int, k: int, strips: int) -> list[Strip]:
        """The rows of strip ``k`` of the base of the chain, and of its levels up to ``coarse``."""

        def own(axis: SampleAxis) -> range:
            return range(axis.count * k // strips, axis.count * (k + 1) // strips)

        axes = [base] + [self.shapes[number][0] for number in range(1, coarse + 1)]
        plan = [Strip(own(axes[-1]), own(axes[-1]))]
        for number in range(coarse, 0, -1):
            mine = own(self.shapes[number - 1][0])
            rows = range(axes[number - 1].count)
            if strips > 1:
                reach = CUT * sqrt(self.added_variance(number))
                rows = axes[number - 1].reached(axes[number], plan[0].rows, reach)
                if number > 1:
                    rows = range(min(rows.start, mine.start), max(rows.stop, mine.stop))
            plan.insert(0, Strip(rows, mine))
        return plan

    def added_variance(self, number: int) -> float:
        """Variance (texels²) of the Gaussian that makes a level from the one below, or from quads
        or texels, along each axis."""
        below = self.scale.sigma_of(number - 1) ** 2 if number > 1 else 1 / 12
        return self.scale.sigma_of(number) ** 2 - below

    def next_level(self, level: list, axes, number: int, rows: range, spread: Spread) -> tuple:
        """Some rows of a level, from those of the level below, and their axes."""
        target = self.shapes[number][0].part(rows), self.shapes[number][1]
        for along in (0, 1):
            variance = self.added_variance(number)
            level = smooth(level, axes, along, target[along], variance, spread)
            axes = (target[0], axes[1]) if along == 0 else target
            dr.eval(level)
        return level, axes

    def keep(self, number: int, level: list, strip: Strip) -> None:
        """Store the part of a strip of a level that is the strip's own and in the window."""
        if number < self.first:
            return
        rows, columns = self.shapes[number]
        (top, height), (left, width) = self.windows[number]
        turns = range(top // rows.count, -(-(top + height) // rows.count))
        for turn in turns if rows.periodic else (0,):
            shift = turn * rows.count
            first = max(top, strip.own.start + shift)
            last = min(top + height, strip.own.stop + shift)
            if first >= last:
                continue
            index, active = lanes((last - first) * width)
            begin = opaque(mi.UInt32, self.begin[number] + (first - top) * width)
            # The levels of a small map are stored as they are.
            found = level
            if (strip.rows, left, width) != (range(first, last), 0, columns.count):
                pitch = opaque(mi.UInt32, width)
                row = index // pitch
                column = columns.wrapped(opaque(mi.Int, left) + mi.Int(index - row * pitch))
                row = row + opaque(mi.UInt32, first - shift - strip.rows.start)
                source = row * mi.UInt32(columns.samples) + column
                found = [dr.gather(mi.Float, channel, source) for channel in level]
            self.records.put(begin + index, found, active)

    def choose_windows(self, domain: Domain | None) -> dict:
        """The part of each level to store: ``(first, number)`` of its rows, and of its columns.

        These are the whole levels, or their parts within the domain if these are smaller. A part
        may cross the border of a periodic level. It is stored in one piece, so that lookups need
        not wrap.
        """
        kept = {number: self.shapes[number] for number in range(self.first, self.top + 1)}
        whole = {n: tuple((0, axis.count) for axis in axes) for n, axes in kept.items()}
        self.wraps = self.periodic
        if domain is None:
            return whole
        ends = domain.rows, domain.columns
        parts = {
            n: tuple(samples_within(axis, *end) for axis, end in zip(axes, ends, strict=True))
            for n, axes in kept.items()
        }
        if sum(map(samples, parts.values())) >= sum(map(samples, whole.values())):
            return whole
        self.wraps = False
        return parts

    def one_period(self, data):
        """Projected normals, rows and columns of one period: the map, or four mirrored copies."""
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

    def index_levels(self) -> None:
        """Tell where the levels are stored, and where their samples stand."""
        # Index of the first sample of the whole level. It may be negative: indices are modulo 2³².
        offsets, pitches = zip(
            *(
                ((self.begin[n] - top * columns - left) % 2**32, columns)
                for n, ((top, _), (left, columns)) in self.windows.items()
            ),
            strict=True,
        )
        shapes = [self.shapes[n] for n in self.windows]
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
        dr.eval(self.layout, self.grids)

    # --------------------------------------------------------------------------------------------
    #  Lookup
    # --------------------------------------------------------------------------------------------

    def average(self, query: Query | Footprint, active: bool | mi.Bool = True) -> list:
        """The stored values, averaged over a footprint: one ``mi.Float`` per channel.

        ``query``: a query, or just a footprint in the UV space of the map.
        """
        query = Query.of(query)
        kernel = query.texel_kernel("gaussian", self.height, self.width, self.wrap_mode)
        major, variance_major, variance_minor = principal_axes(kernel)
        variance = dr.maximum(variance_minor, variance_major / self.max_anisotropy**2)
        variance, step, steps, sharpness = taps(variance_major, variance)
        last = opaque(mi.Float, self.top - 1)
        level = self.scale.level_below(variance)
        level = dr.clip(level, opaque(mi.Float, self.first), last)
        grids = [self.grid(level), self.grid(level + 1)]
        steps = dr.select(active, steps, -1)  # the loop runs from −steps to steps: it does not run
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
        """Layout of the samples of a level (``mi.Float``)."""
        index = mi.UInt32(level - opaque(mi.Float, self.first))
        scale_x, scale_y, columns, rows = dr.gather(mi.Vector4f, self.grids, index)
        offset, pitch = dr.gather(mi.Vector2u, self.layout, index)
        return LevelSamples(
            offset,
            pitch,
            mi.Vector2f(scale_x, scale_y),
            mi.Vector2f(columns, rows),
            mi.Vector2f(dr.rcp(columns), dr.rcp(rows)),
            self.scale.variance_of(level),
            mi.Vector2f(0.5 * dr.rcp(dr.square(scale_x)), 0.5 * dr.rcp(dr.square(scale_y))),
        )

    def lookup(self, position, variance, grids, origin: list) -> list:
        """The values at a position (texels), from the mixture of two levels with this variance."""
        (fine, fine_variance), (coarse, coarse_variance) = (
            self.bilinear(position, grid, origin) for grid in grids
        )
        weight = dr.clip((variance - fine_variance) * dr.rcp(coarse_variance - fine_variance), 0, 1)
        return [dr.lerp(a, b, weight) for a, b in zip(fine, coarse, strict=True)]

    def corners(self, position, grid: LevelSamples):
        """The samples of a level on either side of a position (texels), along each axis: the first
        and the second (``mi.Vector2u``: column, row), and the fraction between them, in [0, 1)."""
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

    def nearest_means(self, position, grid: LevelSamples) -> list:
        """The means of the sample nearest to a position (texels), as an origin for the averages."""
        if not self.spread:
            return []
        first, second, f = self.corners(position, grid)
        x, y = dr.select(f < 0.5, first, second)
        return origin_of(self.records.get(grid.offset + y * grid.pitch + x), self.spread)

    def bilinear(self, position, grid: LevelSamples, origin: list):
        """The values of a level at a position (texels), and the variance (texels²) of the kernel
        that made them."""
        (x0, y0), (x1, y1), f = self.corners(position, grid)
        rows = [grid.offset + y * grid.pitch for y in (y0, y1)]
        weight = [wy * wx for wy in (1 - f.y, f.y) for wx in (1 - f.x, f.x)]
        records = [
            about(origin, self.records.get(row + x), self.spread) for row in rows for x in (x0, x1)
        ]
        averages = [value * weight[0] for value in records[0]]
        for record, w in zip(records[1:], weight[1:], strict=True):
            averages = [dr.fma(x, w, total) for x, total in zip(record, averages, strict=True)]
        # Interpolation with the weights 1 − f and f adds the variance f (1 − f) h², for a spacing
        # h.
        return averages, grid.variance + dr.dot(f * (1 - f), grid.half_square)
