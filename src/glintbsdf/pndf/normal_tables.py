"""Tables of the normals around the nodes of a lattice: how they are built and stored.

The nodes of a level are P/n texels apart along an axis of period P, at (k + ½) P/n. Node k stands
for the texels under a quadratic B-spline of that spacing, three spacings wide; the splines of all
nodes add up to one. For every node, a table tells how the mass under its spline spreads over a
grid of bins in the plane of projected normals, M_k(bin). As a spline is a sum of splines f times
finer, for any whole f, the tables of the coarse levels are sums of those of the finest.

Most of a table is zero, at rare normals above all. Per bin, 4×4 nodes share one word: which of them
have an entry, and how many entries come before.
"""

from __future__ import annotations

from itertools import pairwise
from math import sqrt
from typing import TYPE_CHECKING

import drjit as dr
import mitsuba as mi
import numpy as np

from ..lattice import floor_int
from ..progress import progress

if TYPE_CHECKING:
    from scipy.sparse import csr_matrix

#: Bins along each axis of the rectangle of the map's normals.
BINS = 128

#: Smallest bins, in units of projected normals: what no light resolves (half the sun's radius).
MIN_BIN = 1e-3

#: Memory allowed for the finest level, bytes. Every further level takes a quarter or a little more.
BYTES = 64 << 20

#: Share of it that is planned for: the need is estimated from a sample, up to 15 % too low.
PLANNED = 0.9

#: Smallest distance of nodes, texels. Below, the exact lists are as fast.
MIN_SPACING = 8

#: Nodes of a level, at most: 16 bits count the entries of a bin.
MAX_NODES = (1 << 16) - 1

#: Side of the square of nodes that share a word.
TILE = 4

#: Entries of the map's sparse matrix of quads and bins that are held at once.
STRIP_ENTRIES = 8e6


# ------------------------------------------------------------------------------------------------
#  Splines
# ------------------------------------------------------------------------------------------------


def spline_integral(t: np.ndarray) -> np.ndarray:
    """∫ from −∞ to ``t`` of the quadratic B-spline on [−3/2, 3/2], of unit spacing."""
    t = np.clip(t, -1.5, 1.5)
    middle = 0.5 + t * (0.75 - t * t / 3)
    return np.where(t < -0.5, (1.5 + t) ** 3 / 6, np.where(t > 0.5, 1 - (1.5 - t) ** 3 / 6, middle))


def shares(period: int, count: int) -> csr_matrix:
    """Mean of every node's spline over every quad of an axis, (``count``, ``period``)."""
    from scipy.sparse import csr_matrix

    spacing = period / count
    quad = np.repeat(np.arange(period), 4)
    node = (np.arange(period) // spacing).astype(int).repeat(4) + np.tile([-1, 0, 1, 2], period)
    place = quad / spacing - (node + 0.5)
    share = spacing * (spline_integral(place + 1 / spacing) - spline_integral(place))
    return csr_matrix((share.astype(np.float32), (node % count, quad)), (count, period))


def refinement(count: int, factor: int) -> csr_matrix:
    """The coarse splines in terms of the fine ones: (``count`` / ``factor``, ``count``)."""
    from scipy.sparse import csr_matrix

    ones = np.ones(factor)
    weights = np.convolve(np.convolve(ones, ones), ones) / factor**2
    node = np.repeat(np.arange(count // factor), len(weights))
    finer = factor * node + np.tile(np.arange(len(weights)) - (factor - 1), count // factor)
    values = np.tile(weights.astype(np.float32), count // factor)
    return csr_matrix((values, (node, finer % count)), (count // factor, count))


def divisor(count: int) -> int:
    """By how much the nodes of an axis are thinned out for the next level."""
    return next((f for f in (2, 3, 5) if count % f == 0), 1)


def level_counts(count: tuple[int, int]) -> list[tuple[int, int]]:
    """Nodes (y, x) of all levels, from the finest to a single one."""
    levels = [count]
    while max(levels[-1]) > 1:
        levels.append(tuple(n // divisor(n) for n in levels[-1]))
    return levels


def count_near(wanted: float) -> int:
    """The largest number of nodes ≤ ``wanted``, at least 1, that can be halved often enough."""
    return max((m << k for m in (1, 3, 5, 9, 15) for k in range(17) if m << k <= wanted), default=1)


def tile_order(count: tuple[int, int]) -> tuple[np.ndarray, np.ndarray]:
    """The nodes (y, x), row by row, in the order in which they are stored, and their slots there.

    Slots count 16 to a tile; tiles at the border may leave some of them empty.
    """
    y, x = np.indices(count)
    tiles = -(-count[1] // TILE)
    slot = ((y // TILE * tiles + x // TILE) * TILE + y % TILE) * TILE + x % TILE
    order = np.argsort(slot, axis=None)
    return order, slot.ravel()[order].astype(np.int32)


# ------------------------------------------------------------------------------------------------
#  Normals over bins
# ------------------------------------------------------------------------------------------------


def clipped_area(corners, x, y):
    """Area of a triangle inside the unit square at (``x``, ``y``), ≥ 0.

    By Green's theorem: every edge adds the integral over its height in the square's rows of its
    abscissa clamped to the square's columns; the square's own edges then add nothing.
    """
    origin = mi.Vector2f(x, y)
    corners = [corner - origin for corner in corners]
    area = mi.Float(0)
    for p, q in zip(corners, corners[1:] + corners[:1], strict=True):
        start, end, from_x, to_x = within_row(p, q)
        run = to_x - from_x
        # Mean over the edge of its abscissa clamped to [0, 1]: ∫ clamp = ½ c² + max(x − 1, 0).
        middle = dr.clip(0.5 * (from_x + to_x), 0, 1)
        first, last = (
            0.5 * dr.square(dr.clip(v, 0, 1)) + dr.maximum(v - 1, 0) for v in (from_x, to_x)
        )
        steep = dr.abs(run) < 1e-3
        mean = dr.select(steep, middle, (last - first) / dr.select(steep, 1, run))
        area += (end - start) * mean
    return dr.abs(area)


def within_row(p, q):
    """The part of an edge between the ordinates 0 and 1: its ordinates, and its abscissas."""
    rise = q.y - p.y
    slope = (q.x - p.x) / dr.select(dr.abs(rise) > 1e-9, rise, 1)
    start, end = dr.clip(p.y, 0, 1), dr.clip(q.y, 0, 1)
    return start, end, p.x + slope * (start - p.y), p.x + slope * (end - p.y)


class Bins:
    """A grid of bins over a rectangle of projected normals.

    Attributes:
        lower, size (float64 (2,)): corner of the grid, and extents of a bin.
        columns, rows (int): bins along x and y.
    """

    def __init__(self, bounds) -> None:
        self.lower, upper = (np.asarray(v, np.float64) for v in bounds)
        self.size = np.maximum((upper - self.lower) / BINS, MIN_BIN)
        shape = np.maximum(np.ceil((upper - self.lower) / self.size - 1e-6), 1)
        self.columns, self.rows = (int(n) for n in shape)

    @property
    def area(self) -> float:
        """Area of a bin, in units of projected normals."""
        return float(np.prod(self.size))

    def place(self, m):
        """Position of a projected normal in the grid, in bins."""
        return mi.Vector2f(
            *((m[k] - float(self.lower[k])) * float(1 / self.size[k]) for k in range(2))
        )

    def index(self, m):
        """``(index, inside)`` of the bin of a projected normal."""
        p = self.place(m)
        inside = (p.x >= 0) & (p.y >= 0) & (p.x < self.columns) & (p.y < self.rows)
        x, y = (mi.UInt32(dr.select(inside, v, 0)) for v in (p.x, p.y))
        return y * self.columns + x, inside

    def normal(self, index, jitter):
        """The projected normal at a place ``jitter`` ∈ [0, 1)² in a bin."""
        place = mi.Vector2f(mi.Float(index % self.columns), mi.Float(index // self.columns))
        size, lower = (mi.Vector2f(*(float(v) for v in t)) for t in (self.size, self.lower))
        return lower + size * (place + jitter)

    def spread(self, triangles, row: np.ndarray, column: np.ndarray) -> csr_matrix:
        """How the normals of quads spread over the bins: (quads, bins), every row of sum 1.

        ``row``, ``column`` (N): stored quads; ``triangles(row, column, active)`` returns the two
        triangles of each, as a vertex and two edges (``mi.Vector2f``) over which half of the quad
        is spread evenly.
        """
        from scipy.sparse import csr_matrix

        corners = []
        for triangle in triangles(mi.Int(row), mi.Int(column), mi.Bool(True)):
            vertices = self.place(triangle[0])
            edges = [e * mi.Vector2f(*(float(1 / s) for s in self.size)) for e in triangle[1:]]
            corners.append([vertices, *(vertices + e for e in edges)])
        # The triangles of a quad in turn.
        stored = [dr.zeros(mi.Float, 4 * len(row)) for _ in range(3)]
        quad = dr.arange(mi.UInt32, len(row))
        for half, vertices in enumerate(corners):
            for array, vertex in zip(stored, vertices, strict=True):
                dr.scatter(array, vertex, 2 * quad + half)

        def corners_of(triangle):
            return [dr.gather(mi.Vector2f, array, triangle) for array in stored]

        a, b, c = corners_of(dr.arange(mi.UInt32, 2 * len(row)))
        lowest, highest = (
            dr.minimum(dr.minimum(a.y, b.y), c.y),
            dr.maximum(dr.maximum(a.y, b.y), c.y),
        )
        triangle, y, first_run = runs(
            *(dr.clip(floor_int(v), 0, self.rows - 1) for v in (lowest, highest))
        )
        device_y, device_triangle = mi.UInt32(y), mi.UInt32(triangle)
        run, x, first = runs(*self.columns_of(corners_of(device_triangle), mi.Float(device_y)))
        device_run, device_x = mi.UInt32(run), mi.UInt32(x)
        corners = corners_of(dr.gather(mi.UInt32, device_triangle, device_run))
        at_y = dr.gather(mi.UInt32, device_y, device_run)
        part = clipped_area(corners, mi.Float(device_x), mi.Float(at_y)).numpy()
        bins = (at_y * self.columns + device_x).numpy().astype(np.int32)

        first = first[first_run]  # of every triangle
        total = np.add.reduceat(part, first[:-1])
        for lost in np.flatnonzero(total == 0):  # to rounding: triangles of next to no area
            part[first[lost] : first[lost + 1]] = 1
            total[lost] = first[lost + 1] - first[lost]
        part *= np.repeat(np.float32(0.5) / total, np.diff(first))
        matrix = csr_matrix((part, bins, first[::2]), (len(row), self.rows * self.columns))
        matrix.eliminate_zeros()
        return matrix

    def columns_of(self, corners, y) -> tuple[mi.Int, mi.Int]:
        """First and last column of the bins of row ``y`` that a triangle may touch."""
        origin = mi.Vector2f(0, y)
        corners = [corner - origin for corner in corners]
        lowest, highest = mi.Float(dr.inf), mi.Float(-dr.inf)
        for p, q in zip(corners, corners[1:] + corners[:1], strict=True):
            _, _, from_x, to_x = within_row(p, q)
            meets = (dr.minimum(p.y, q.y) <= 1) & (dr.maximum(p.y, q.y) >= 0)
            level = dr.abs(q.y - p.y) <= 1e-9
            from_x, to_x = dr.select(level, p.x, from_x), dr.select(level, q.x, to_x)
            lowest = dr.select(meets, dr.minimum(lowest, dr.minimum(from_x, to_x)), lowest)
            highest = dr.select(meets, dr.maximum(highest, dr.maximum(from_x, to_x)), highest)
        margin = 1e-4  # bins
        return tuple(
            dr.clip(floor_int(v), 0, self.columns - 1) for v in (lowest - margin, highest + margin)
        )


def runs(first: mi.Int, last: mi.Int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """The numbers from ``first`` to ``last`` of all runs, one run after the other.

    Returns the run and the number of each, and where every run begins (one more, the end).
    """
    first, last = first.numpy(), last.numpy()
    begin = np.zeros(len(first) + 1, np.int32)
    np.cumsum(last - first + 1, out=begin[1:])
    run = np.repeat(np.arange(len(first), dtype=np.int32), np.diff(begin))
    number = np.arange(begin[-1], dtype=np.int32) - np.repeat(begin[:-1] - first, np.diff(begin))
    return run, number, begin


# ------------------------------------------------------------------------------------------------
#  The tables
# ------------------------------------------------------------------------------------------------


class NormalTables:
    """The tables of all levels, around the arrays that :meth:`build` makes.

    Arrays (NumPy), with L levels and F bins that any normal falls into:
        ``bounds`` (2, 2): the rectangle of normals; ``counts`` (L, 2): nodes (y, x);
        ``rows``: number of a bin among the F, or ``EMPTY``;
        ``words``: per level, bin and tile, which of its nodes have an entry (16 bits), and the
        number of entries of the bin in tiles before (16 bits);
        ``starts`` (L, F): first entry of a bin;
        ``entries``: M_k(bin) per texel² as half floats times 2¹⁵, over the area of a node;
        ``grains`` (L): see :func:`grains`.

    Attributes:
        periods (pair of ints): quads along y and x.
        counts (list of pairs): nodes (y, x) of every level.
        grains (list of float): texels, of every level.
        level_nbytes (list of int): memory of every level, bytes.
    """

    EMPTY = 0xFFFFFFFF
    VERSION = 3

    def __init__(self, arrays: dict[str, np.ndarray], periods: tuple[int, int]) -> None:
        self.bins, self.periods = Bins(arrays["bounds"]), periods
        self.counts = [tuple(int(n) for n in count) for count in arrays["counts"]]
        self.grains = [float(g) for g in arrays["grains"]]
        self.rows = mi.UInt32(arrays["rows"])
        filled = int((arrays["rows"] != self.EMPTY).sum())
        tiles = [filled * y * x for y, x in map(tiles_of, self.counts)]
        entries = np.diff([*arrays["starts"][:, 0], len(arrays["entries"])])
        self.level_nbytes = [
            4 * n + 2 * int(m) + 4 * filled for n, m in zip(tiles, entries, strict=True)
        ]
        self.nbytes = sum(self.level_nbytes) + arrays["rows"].nbytes
        self.filled = filled
        self.count_y, self.count_x = (mi.Int(v) for v in zip(*self.counts, strict=True))
        self.first_word = mi.UInt32(np.cumsum([0, *tiles])[:-1])
        self.words, self.starts = mi.UInt32(arrays["words"]), mi.UInt32(arrays["starts"].ravel())
        entries = arrays.pop("entries")
        padded = np.append(entries, np.zeros(len(entries) % 2, np.float16))
        self.entries = mi.UInt32(padded.view(np.uint32))

    @property
    def levels(self) -> int:
        """Number of levels."""
        return len(self.counts)

    def spacing(self, level: int) -> float:
        """Distance of neighbouring nodes, texels, along the axis where it is larger."""
        return max(p / n for p, n in zip(self.periods, self.counts[level], strict=True))

    def row(self, m, active=True):
        """The number of the bin of ``m`` among the filled ones, and whether it is one."""
        index, inside = self.bins.index(m)
        row = dr.gather(mi.UInt32, self.rows, index, active & inside)
        return row, active & inside & (row != self.EMPTY)

    def table(self, level, row, active):
        """Where the table of a bin is stored, to be handed to :meth:`value`."""
        count_y, count_x = (dr.gather(mi.Int, n, level) for n in (self.count_y, self.count_x))
        tiles_y, tiles_x = ((mi.UInt32(n) + (TILE - 1)) // TILE for n in (count_y, count_x))
        word = dr.gather(mi.UInt32, self.first_word, level) + row * tiles_y * tiles_x
        start = dr.gather(mi.UInt32, self.starts, level * self.filled + row, active)
        return word, tiles_x, start

    def value(self, table, y, x, active):
        """M_k(bin) over the area of a node, for the node (``y``, ``x``) (``mi.UInt32``)."""
        first_word, tiles_x, start = table
        word = dr.gather(
            mi.UInt32, self.words, first_word + (y // TILE) * tiles_x + x // TILE, active
        )
        bit = mi.UInt32(1) << ((y % TILE) * TILE + x % TILE)
        index = start + (word >> 16) + dr.popcnt(word & (bit - 1))
        found = active & ((word & bit) != 0)
        pair = dr.gather(mi.UInt32, self.entries, index >> 1, found)
        half = dr.select(found, (pair >> ((index & 1) << 4)) & 0x7FFF, 0)
        # A half float's exponent is 112 less than a float's; times the 2¹⁵ of storage.
        return dr.reinterpret_array(mi.Float, half << 13) * 2.0 ** (112 - 15)

    # --------------------------------------------------------------------------------------------
    #  Building
    # --------------------------------------------------------------------------------------------

    @classmethod
    def build(cls, lattice, triangles, bounds) -> dict[str, np.ndarray]:
        """Condense a lattice to tables.

        ``triangles(row, column, active)`` returns the two triangles of a stored quad, each as a
        vertex and two edges (``mi.Vector2f``); ``bounds`` (lower, upper): the rectangle of
        projected normals in which they lie.
        """
        periods = (lattice.y.quads, lattice.x.quads)
        bins = Bins(bounds)

        def spread(row, column):
            return bins.spread(triangles, row % periods[0], column % periods[1])

        count, per_quad = affordable(periods, bins, spread)
        with progress("Building tables of normals") as report:
            while True:
                finest = masses(periods, count, spread, per_quad, report)
                filled = np.flatnonzero(np.bincount(finest.indices, minlength=finest.shape[1]))
                stored = [pack(finest, periods, count, filled)]
                if sum(array.nbytes for array in stored[0]) <= BYTES:
                    break
                count = tuple(count_near(n - 1) for n in count)
        rows = np.full(finest.shape[1], cls.EMPTY, np.uint32)
        rows[filled] = np.arange(len(filled))
        counts, levels = level_counts(count), [finest]
        for finer, count in pairwise(counts):
            levels.append(coarser(levels[-1], finer))
            stored.append(pack(levels[-1], periods, count, filled))
        words, starts, entries = zip(*stored, strict=True)
        first = np.cumsum([0, *(len(e) for e in entries)])[:-1]
        return {
            "bounds": np.asarray(bounds),
            "counts": np.array(counts),
            "rows": rows,
            "words": np.concatenate(words),
            "starts": (np.stack(starts) + first[:, None]).astype(np.uint32),
            "entries": np.concatenate(entries),
            "grains": np.array(grains(periods, counts, levels, spread)),
        }


def tiles_of(count: tuple[int, int]) -> tuple[int, int]:
    """Tiles (y, x) for so many nodes."""
    return tuple(-(-n // TILE) for n in count)


def affordable(periods, bins: Bins, spread) -> tuple[tuple[int, int], float]:
    """Nodes (y, x) of the finest level that :data:`BYTES` hold, and entries of the map per quad.

    The bins under splines of a few sizes are counted in windows of the map.
    """
    rng = np.random.default_rng(0)
    side, windows = 48, 32
    sides = [min(side, n) for n in periods]
    y, x = (v.ravel() for v in np.indices(sides))
    row = (rng.integers(periods[0], size=(windows, 1)) + y).ravel()
    column = (rng.integers(periods[1], size=(windows, 1)) + x).ravel()
    normals = spread(row, column)
    spacings = np.array([4, 6, 8, 11, 16])
    counted = []
    for spacing in spacings:
        half = 1.5 * spacing
        inside = (np.abs(y + 0.5 - sides[0] / 2) <= half) & (np.abs(x + 0.5 - sides[1] / 2) <= half)
        found = [
            len(np.unique(normals[k * len(y) + np.flatnonzero(inside)].indices))
            for k in range(windows)
        ]
        counted.append(np.mean(found))
    most = len(np.unique(normals.indices))
    # As a power of the spacing, between the sizes counted and beyond them.
    logs = np.log(spacings), np.log(counted)
    slope = (logs[1][-1] - logs[1][-2]) / (logs[0][-1] - logs[0][-2])

    def bytes_at(spacing):
        beyond = slope * max(0, np.log(spacing / spacings[-1]))
        entries = min(np.exp(np.interp(np.log(spacing), *logs) + beyond), most)
        return np.prod(periods) / spacing**2 * (2 * entries + 4 * most / TILE**2)

    spacing = max(MIN_SPACING, sqrt(np.prod(periods) / MAX_NODES))
    while True:
        count = tuple(count_near(n / spacing) for n in periods)
        if bytes_at(sqrt(np.prod(periods) / np.prod(count))) <= PLANNED * BYTES:
            return count, normals.nnz / len(row)
        spacing *= 1.02


def masses(periods, count, spread, per_quad: float, report) -> csr_matrix:
    """Mass under the splines of nodes, texels²: (nodes, bins), the nodes row by row."""
    from scipy.sparse import kron, vstack

    of_y, of_x = (shares(p, n) for p, n in zip(periods, count, strict=True))
    strips = np.array_split(
        np.arange(periods[0]), -(-int(per_quad * np.prod(periods)) // int(STRIP_ENTRIES))
    )
    rows_of_nodes = [None] * count[0]
    for done, strip in enumerate(s for s in strips if len(s)):
        row, column = (v.ravel() for v in np.meshgrid(strip, np.arange(periods[1]), indexing="ij"))
        weights = of_y[:, strip]
        touched = np.flatnonzero(np.diff(weights.indptr))
        product = kron(weights[touched], of_x, format="csr") @ spread(row, column)
        for k, node in enumerate(touched):
            part = product[k * count[1] : (k + 1) * count[1]]
            before = rows_of_nodes[node]
            rows_of_nodes[node] = part if before is None else before + part
        report((done + 1) / len(strips))
    return vstack(rows_of_nodes, format="csr")


def coarser(mass: csr_matrix, count: tuple[int, int]) -> csr_matrix:
    """The masses of the next level from those of a level of ``count`` nodes."""
    from scipy.sparse import kron

    y, x = (refinement(n, divisor(n)) for n in count)
    return kron(y, x, format="csr") @ mass


def pack(mass: csr_matrix, periods, count, filled: np.ndarray):
    """The words, first entries and entries of a level, see :class:`NormalTables`."""
    order, slots = tile_order(count)
    columns = mass[order].tocsc()
    begin = columns.indptr[:-1][filled]
    number = np.repeat(
        np.arange(len(filled), dtype=np.int32), np.diff(np.append(begin, columns.nnz))
    )  # of the bin of an entry
    slot = slots[columns.indices]
    tiles = int(np.prod(tiles_of(count)))
    tile = number * tiles + slot // TILE**2
    first = np.flatnonzero(np.diff(tile, prepend=-1))  # entry of every tile that has any
    words = np.zeros(len(filled) * tiles, np.uint32)
    words[tile[first]] = np.bitwise_or.reduceat(
        np.uint32(1) << (slot % TILE**2).astype(np.uint32), first
    )
    words[tile[first]] |= (first - begin[number[first]]).astype(np.uint32) << 16
    per_node = np.float32(2**15 * np.prod(count) / np.prod(periods))
    return words, begin, (columns.data * per_node).astype(np.float16)


# ------------------------------------------------------------------------------------------------
#  The error
# ------------------------------------------------------------------------------------------------

#: Variance of the kernels of unit standard deviation, which are cut off.
VARIANCE = {
    "gaussian": 1 - 4.5 * float(np.exp(-4.5)) / (1 - float(np.exp(-4.5))),
    "disk": 1.5**2 / 4,
    "box": 1.5**2 / 3,
}


def kernel_error(kernel: str, x):
    """L1 norm of the difference of a kernel and its interpolation by splines.

    ``x``: spacing of the nodes over the kernel's standard deviation. Fitted to the norms, averaged
    over the nodes' places. A kernel with an edge is known there to a fraction of the spacing only,
    and half as much is added: the errors along an edge average out less than others.
    """
    if kernel == "gaussian":
        return x * (0.016 + x * x * (0.012 + 0.008 * (x * x) * (x * x)))
    return 0.9 * x


def grains(periods, counts, levels, spread) -> list[float]:
    """How far apart the independent places of a map are, texels, at the scale of every level.

    Under a footprint of standard deviations σ₁, σ₂, the normals in a bin come from many places,
    whose errors average out: that of the P-NDF is, for rough maps of all kinds,

        kernel_error · g / (g + √(σ₁ σ₂)).

    g is taken from the errors themselves under a few footprints: those of the finest level against
    the map, those of the others against the next finer one, which errs a tenth as much.
    """
    rng = np.random.default_rng(0)
    found = []
    for level, count in enumerate(counts):
        if level > 0 and min(count) < 4:  # footprints as large as the map
            found.append(found[-1])
            continue
        spacing = [p / n for p, n in zip(periods, count, strict=True)]
        sigma = max(spacing) / CALIBRATED
        errors = []
        for mean in rng.random((6, 2)) * periods:
            table = density_at(mean, sigma, periods, count, levels[level])
            if level == 0:
                truth = true_density(mean, sigma, spread)
            else:
                truth = density_at(mean, sigma, periods, counts[level - 1], levels[level - 1])
            errors.append(np.abs(table - truth).sum())
        share = min(np.mean(errors) / kernel_error("gaussian", CALIBRATED), 0.99)
        found.append(sigma * share / (1 - share))
    return found


#: Spacing of the nodes over the standard deviation of the footprints of :func:`grains`.
CALIBRATED = 1.3


def lattice_weights(mean, sigma, spacing, variance):
    """A round Gaussian, cut at 3σ, on a lattice: its points (y, x), and its weights, of sum 1.

    The points lie at the centres of cells of ``spacing`` (y, x); ``variance`` (y, x) of the
    Gaussian, which ``sigma`` bounds.
    """
    axes = [
        np.arange(int((m - 3 * sigma) // s), int((m + 3 * sigma) // s) + 1)
        for m, s in zip(mean, spacing, strict=True)
    ]
    y, x = (
        ((points + 0.5) * s - m) ** 2 / v
        for points, s, m, v in zip(axes, spacing, mean, variance, strict=True)
    )
    distance = y[:, None] + x
    weight = np.where(distance <= 9, np.exp(-0.5 * distance), 0).ravel()
    used = weight > 0
    y, x = (v.ravel()[used] for v in np.meshgrid(*axes, indexing="ij"))
    return y, x, (weight[used] / weight.sum()).astype(np.float32)


def true_density(mean, sigma: float, spread) -> np.ndarray:
    """Mass in every bin under a round Gaussian footprint at ``mean`` (y, x), texels."""
    y, x, weight = lattice_weights(mean, sigma, (1, 1), (sigma**2, sigma**2))
    return spread(y, x).T @ weight


def density_at(mean, sigma: float, periods, count, mass: csr_matrix) -> np.ndarray:
    """The same from the masses under the splines of a level."""
    spacing = [p / n for p, n in zip(periods, count, strict=True)]
    variance = [sigma**2 - narrowing(s) for s in spacing]
    y, x, weight = lattice_weights(mean, sigma, spacing, variance)
    return mass[(y % count[0]) * count[1] + x % count[1]].T @ weight / np.prod(spacing)


def narrowing(spacing: float, kernel: str = "gaussian") -> float:
    """Variance to take off a footprint against what the splines add to its kernel, texels²."""
    return spacing**2 / 4 / VARIANCE[kernel]
