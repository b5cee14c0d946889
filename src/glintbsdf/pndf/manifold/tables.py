"""Tables of the normals around the nodes of a lattice: how they are built and stored.

Along an axis of period P, a level has n nodes, at (k + ½) P/n texels. Node k stands for the texels
under a quadratic B-spline, which is three spacings P/n wide. The splines of all nodes add up to
one. For every node there is a histogram M_k(bin) of the normals under its spline, over a grid of
bins in the plane of projected normals. A spline is a sum of splines that are f times finer, for any
whole f. So the tables of coarse levels are sums of tables of the finest level. Between the finest
level and the level twice as coarse there is one that is 1½ times as coarse. Its nodes have mixtures
of the finest splines in place of splines.

Most entries of a table are zero, above all for rare normals. In each bin, 4×4 nodes share one word.
It says which of the nodes have an entry, and how many entries come before.
"""

from __future__ import annotations

from math import sqrt
from multiprocessing.pool import ThreadPool
from typing import TYPE_CHECKING

import drjit as dr
import mitsuba as mi
import numpy as np

from glintbsdf.core.opaque import opaque, stored
from glintbsdf.core.progress import progress
from glintbsdf.core.tuning import usable_cores
from glintbsdf.footprint.lattice import floor_int
from glintbsdf.pndf.manifold import table_error
from glintbsdf.pndf.manifold.table_error import correlation_lengths

if TYPE_CHECKING:
    from scipy.sparse import csr_matrix

#: Bins along each axis of the rectangle of the map's normals.
BINS = 128

#: Smallest size of a bin, in units of projected normals: a twentieth of the radius of the sun's
#: half vectors.
MIN_BIN = 1e-4

#: Memory allowed to the finest level, bytes. All levels together take up to 3 times as much.
BYTES = 64 << 20

#: Share of this memory to plan for, as the estimate from a sample may be too low.
PLANNED = 0.9

#: Smallest distance of nodes, texels. Where it would be smaller, the exact lists are as fast.
MIN_SPACING = 8

#: Largest number of nodes of a level: 16 bits count the entries of a bin.
MAX_NODES = (1 << 16) - 1

#: Side of the square of nodes that share a word.
TILE = 4

#: Number of entries of the sparse matrix (quads, bins) of the map that are in memory at a time.
STRIP_ENTRIES = 8e6

#: Number of masses (nodes × bins) of the finest level that each thread has in a dense array.
CHUNK = 1 << 19

#: Number of threads for the work of NumPy and SciPy.
THREADS = usable_cores()


# ------------------------------------------------------------------------------------------------
#  Splines
# ------------------------------------------------------------------------------------------------


def spline_integral(t: np.ndarray) -> np.ndarray:
    """∫ from −∞ to ``t`` of the quadratic B-spline of unit spacing, on [−3/2, 3/2]."""
    t = np.clip(t, -1.5, 1.5)
    middle = 0.5 + t * (0.75 - t * t / 3)
    return np.where(t < -0.5, (1.5 + t) ** 3 / 6, np.where(t > 0.5, 1 - (1.5 - t) ** 3 / 6, middle))


def spline_weights(period: int, count: int) -> csr_matrix:
    """Mean of every node's spline over every quad along an axis, (``count``, ``period``)."""
    from scipy.sparse import csr_matrix

    spacing = period / count
    quad = np.repeat(np.arange(period), 4)
    node = (np.arange(period) // spacing).astype(int).repeat(4) + np.tile([-1, 0, 1, 2], period)
    place = quad / spacing - (node + 0.5)
    share = spacing * (spline_integral(place + 1 / spacing) - spline_integral(place))
    return csr_matrix((share.astype(np.float32), (node % count, quad)), (count, period))


def count_near(wanted: float) -> int:
    """The largest number ≤ ``wanted``, but at least 1, that has many divisors."""
    many = (m << k for m in (3, 9, 15, 21) for k in range(1, 17))
    return max((n for n in (1, 2, 3, 4, *many) if n <= wanted), default=1)


def axis_counts(count: int) -> list[int]:
    """Nodes along an axis of levels 1, 1½, 2, 3, 4, 6, 8, … times coarser than ``count``.

    All numbers but the second divide ``count``, so a level may be somewhat coarser than that.
    """
    divisors = [n for n in range(1, count + 1) if count % n == 0]
    counts = [count, 2 * count // 3 if count % 6 == 0 else count]
    for octave in range(1, count.bit_length() + 1):
        for factor in (2**octave, 3 * 2 ** (octave - 1)):
            counts.append(max((n for n in divisors if n * factor <= count), default=1))
    return counts


def level_counts(count: tuple[int, int]) -> list[tuple[int, int]]:
    """Nodes (y, x) of all levels, from the finest to a single one."""
    axes = [axis_counts(n) for n in count]
    longest = max(map(len, axes))
    y, x = (axis + [1] * (longest - len(axis)) for axis in axes)
    return sorted(set(zip(y, x, strict=True)), reverse=True)


def refinement_weights(finer: int, count: int) -> tuple[np.ndarray, np.ndarray]:
    """The functions of ``count`` nodes as sums of splines of ``finer`` nodes.

    Returns ``(finer nodes, weights)``, both (``count``, K). Where ``count`` divides ``finer``, a
    coarse spline is exactly a sum of fine ones. Where ``count`` is two thirds of ``finer``, the
    function is the closest one to the coarse spline that has positive weights, keeps the mean, and
    whose weights add up to one for every fine spline.
    """
    node = np.arange(count)[:, None]
    if 3 * count == 2 * finer:
        weights = np.array(TWO_THIRDS)
        steps = np.arange(-1, 2)
        odd = node % 2 == 1
        place = 3 * node // 2 + np.where(odd, 1 - steps, steps)
        return place % finer, np.broadcast_to(weights, place.shape)
    factor = finer // count
    ones = np.ones(factor)
    weights = np.convolve(np.convolve(ones, ones), ones) / factor**2
    place = factor * node + np.arange(len(weights)) - (factor - 1)
    return place % finer, np.broadcast_to(weights, place.shape)


#: Weights of three fine splines in a function 1½ times as wide: the one to the left of the spline
#: nearest to its centre, the nearest, and the one to the right. For odd nodes they are mirrored.
TWO_THIRDS = (1 / 8, 7 / 8, 1 / 2)


def spline_variance(count: int, finest: int) -> float:
    """Variance of the function of a node, in units of the squared spacing of its level."""
    if 3 * count == 2 * finest:
        left, _, right = (w / 1.5 for w in TWO_THIRDS)
        return (0.25 + left + right - (right - left) ** 2) / 1.5**2
    return 0.25


def variances_of(periods, count, finest) -> tuple[float, float]:
    """Variance (y, x), texels², of the functions of the nodes of a level of ``count`` nodes."""
    return tuple(
        spline_variance(n, f) * (p / n) ** 2 for p, n, f in zip(periods, count, finest, strict=True)
    )


def mixed_levels(counts) -> list[bool]:
    """For every level, whether the functions of its nodes are mixtures of finer splines."""
    return [any(3 * n == 2 * f for n, f in zip(count, counts[0], strict=True)) for count in counts]


def refinement(finer: int, count: int) -> csr_matrix:
    """Matrix (``count``, ``finer``) that expresses functions of ``count`` nodes by finer
    splines."""
    from scipy.sparse import csr_matrix, identity

    if finer == count:
        return identity(count, np.float32, "csr")
    places, weights = refinement_weights(finer, count)
    begin = np.arange(count + 1) * places.shape[1]
    return csr_matrix((weights.ravel().astype(np.float32), places.ravel(), begin), (count, finer))


def refinements(counts) -> list[tuple[int, csr_matrix]]:
    """For all levels but the first: a finer level, and the matrix (nodes, finer nodes) that sums
    its tables."""
    from scipy.sparse import kron

    found = []
    for level, count in enumerate(counts[1:], 1):

        def fits(finer, count=count):
            """Whether ``level`` is a sum of tables of the level ``finer``, along both axes."""
            axes = zip(counts[finer], count, counts[0], strict=True)
            return all(p in (n, f) or p % n == f % p == 0 for p, n, f in axes)

        nearest = max(filter(fits, range(level)))
        y, x = (refinement(p, n) for p, n in zip(counts[nearest], count, strict=True))
        found.append((nearest, kron(y, x, format="csr")))
    return found


# ------------------------------------------------------------------------------------------------
#  Normals over bins
# ------------------------------------------------------------------------------------------------


def clipped_area(corners, x, y):
    """Area of a triangle inside the unit square at (``x``, ``y``), ≥ 0.

    By Green's theorem: every edge is cut to the heights of the square, and adds the integral over
    its height of x clamped to the square. The edges of the square then add nothing.
    """
    origin = mi.Vector2f(x, y)
    corners = [corner - origin for corner in corners]
    area = mi.Float(0)
    for p, q in zip(corners, corners[1:] + corners[:1], strict=True):
        start, end, from_x, to_x = within_row(p, q)
        run = to_x - from_x
        # Mean over the edge of x clamped to [0, 1]: ∫ clamp(x) dx = ½ clamp(x)² + max(x − 1, 0).
        middle = dr.clip(0.5 * (from_x + to_x), 0, 1)
        first, last = (
            0.5 * dr.square(dr.clip(v, 0, 1)) + dr.maximum(v - 1, 0) for v in (from_x, to_x)
        )
        steep = dr.abs(run) < 1e-3
        mean = dr.select(steep, middle, (last - first) / dr.select(steep, 1, run))
        area += (end - start) * mean
    return dr.abs(area)


def within_row(p, q):
    """The part of an edge from p to q with y in [0, 1]: y at both its ends, and x at both."""
    rise = q.y - p.y
    slope = (q.x - p.x) / dr.select(dr.abs(rise) > 1e-9, rise, 1)
    start, end = dr.clip(p.y, 0, 1), dr.clip(q.y, 0, 1)
    return start, end, p.x + slope * (start - p.y), p.x + slope * (end - p.y)


class Bins:
    """A grid of bins over a rectangle of projected normals.

    ``bounds`` (lower, upper): the rectangle; ``size``: extents of a bin, :data:`BINS` of them along
    each axis by default.

    Attributes:
        lower, size (float64 (2,)): corner of the grid, and extents of a bin.
        columns, rows (int): bins along x and y.
    """

    def __init__(self, bounds, size: np.ndarray | None = None) -> None:
        self.lower, upper = (np.asarray(v, np.float64) for v in bounds)
        if size is None:
            size = np.maximum((upper - self.lower) / BINS, MIN_BIN)
        self.size = size
        shape = np.maximum(np.ceil((upper - self.lower) / self.size - 1e-6), 1)
        self.columns, self.rows = (int(n) for n in shape)
        # Opaque values: one kernel serves all maps.
        self.corner, self.extent, self.per_size = (
            mi.Vector2f(*(opaque(mi.Float, float(x)) for x in values))
            for values in (self.lower, self.size, 1 / self.size)
        )
        self.per_row = opaque(mi.Float, 1 / self.columns)
        self.shape = mi.Vector2u(*(opaque(mi.UInt32, n) for n in (self.columns, self.rows)))

    @property
    def area(self) -> float:
        """Area of a bin, in units of projected normals."""
        return float(np.prod(self.size))

    def place(self, m):
        """Position of a projected normal in the grid, in bins."""
        return (m - self.corner) * self.per_size

    def index(self, m):
        """``(index, inside)`` of the bin of a projected normal."""
        p = self.place(m)
        inside = dr.all((p >= 0) & (p < mi.Vector2f(self.shape)))
        x, y = (mi.UInt32(dr.select(inside, v, 0)) for v in (p.x, p.y))
        return y * self.shape.x + x, inside

    def normal(self, index, jitter):
        """The projected normal at the position ``jitter`` ∈ [0, 1)² in a bin."""
        # Not an integer division by a variable: the variable is 0 in lanes that call another BSDF,
        # and the processor would stop the program.
        row = mi.UInt32((mi.Float(index) + 0.5) * self.per_row)
        place = mi.Vector2f(mi.Float(index - row * self.shape.x), mi.Float(row))
        return self.corner + self.extent * (place + jitter)

    def rasterize(self, triangles, row: np.ndarray, column: np.ndarray) -> csr_matrix:
        """The share of each quad's normals in each bin: (quads, bins), where every row sums to 1.

        ``row``, ``column`` (N) are stored quads. ``triangles(row, column, active)`` returns the two
        normal triangles of a quad, each as a vertex and two edges (``mi.Vector2f``). Each triangle
        has half of the quad's normals, uniformly over its area.
        """
        from scipy.sparse import csr_matrix

        # Two lanes per quad, one for each triangle.
        lane = dr.arange(mi.UInt32, 2 * len(row))
        row, column = (dr.gather(mi.Int, mi.Int(v), lane >> 1) for v in (row, column))
        (a, *first), (b, *second) = triangles(row, column, mi.Bool(True))
        upper = (lane & 1) == 0
        scale = self.per_size
        corner = self.place(dr.select(upper, a, b))
        edges = (scale * dr.select(upper, p, q) for p, q in zip(first, second, strict=True))
        corners = [corner, *(corner + edge for edge in edges)]
        dr.eval(corners)

        y, bottom = (
            dr.clip(floor_int(least(least(*(c.y for c in corners[:2])), corners[2].y)), 0, top)
            for top in (mi.Int(self.shape.y) - 1,)
            for least in (dr.minimum, dr.maximum)
        )

        def add_row(y, count):
            first, last = self.columns_of(corners, mi.Float(y))
            return y + 1, count + mi.UInt32(last - first + 1)

        _, counted = dr.while_loop(
            (y, mi.UInt32(0)), lambda y, _: y <= bottom, add_row, label="rows of bins"
        )
        begin = dr.prefix_sum(counted)
        dr.eval(begin, counted)
        entries = int(begin[-1] + counted[-1])
        part, bins = dr.zeros(mi.Float, entries), dr.zeros(mi.Int, entries)

        def add_bin(x, last, y, place, total):
            area = clipped_area(corners, mi.Float(x), mi.Float(y))
            dr.scatter(part, area, place)
            dr.scatter(bins, y * mi.Int(self.shape.x) + x, place)
            new_row = x >= last
            y = dr.select(new_row, y + 1, y)
            start, stop = self.columns_of(corners, mi.Float(y))
            x, last = dr.select(new_row, start, x + 1), dr.select(new_row, stop, last)
            return x, last, y, place + 1, total + area

        state = (*self.columns_of(corners, mi.Float(y)), mi.Int(y), begin + 0, mi.Float(0))
        total = dr.while_loop(state, lambda *state: state[2] <= bottom, add_bin, label="bins")[4]
        dr.eval(total, part, bins)

        part, total, counted, begin = (v.numpy() for v in (part, total, counted, begin))
        for empty in np.flatnonzero(total == 0):  # triangles whose area is lost to rounding
            part[begin[empty] : begin[empty] + counted[empty]] = 1
            total[empty] = counted[empty]
        part *= np.repeat(np.float32(0.5) / total, counted)
        first = np.append(begin[::2], entries).astype(np.int32)
        return csr_matrix((part, bins.numpy(), first), (len(first) - 1, self.rows * self.columns))

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
            dr.clip(floor_int(v), 0, mi.Int(self.shape.x) - 1)
            for v in (lowest - margin, highest + margin)
        )


# ------------------------------------------------------------------------------------------------
#  The tables
# ------------------------------------------------------------------------------------------------


class NormalTables:
    """The tables of all levels, on the device.

    They are made of the arrays (NumPy) that :meth:`build` returns. With L levels and F bins that
    are not empty, these are

    * ``bounds`` (2, 2): the rectangle of normals;
    * ``counts`` (L, 2): number of nodes (y, x);
    * ``rows``: for every bin its index among the F, or ``EMPTY``;
    * ``words``: for every level, bin and tile, which of the tile's nodes have an entry (16 bits),
      and the number of the bin's entries in the tiles before (16 bits);
    * ``starts`` (L, F): index of the first entry of a bin;
    * ``entries``: M_k(bin) in texels², over the area of a node, as half floats times 2¹⁵;
    * ``correlation_lengths`` (L, kernels, knots): see :func:`~.correlation_lengths`.

    Attributes:
        periods (pair of ints): quads along y and x.
        counts (list of pairs): nodes (y, x) of every level.
        correlation_lengths (nested lists): for every level, kernel and knot, texels.
        mixed (list of bools): whether the functions of the nodes are mixtures of finer splines.
        variances (list of pairs): variances (y, x) of the functions of every level's nodes,
            texels².
        level_nbytes (list of int): memory of every level, bytes.
    """

    EMPTY = 0xFFFFFFFF

    def __init__(self, arrays: dict[str, np.ndarray], periods: tuple[int, int]) -> None:
        self.bins, self.periods = Bins(arrays["bounds"]), periods
        self.counts = [tuple(int(n) for n in count) for count in arrays["counts"]]
        self.correlation_lengths = arrays["correlation_lengths"].tolist()
        self.mixed = mixed_levels(self.counts)
        self.variances = [variances_of(periods, count, self.counts[0]) for count in self.counts]
        self.rows = stored(mi.UInt32, arrays["rows"])
        filled = int((arrays["rows"] != self.EMPTY).sum())
        tiles = [filled * y * x for y, x in map(tiles_of, self.counts)]
        entries = np.diff([*arrays["starts"][:, 0], len(arrays["entries"])])
        self.level_nbytes = [
            4 * n + 2 * int(m) + 4 * filled for n, m in zip(tiles, entries, strict=True)
        ]
        self.nbytes = sum(self.level_nbytes) + arrays["rows"].nbytes
        self.filled = filled
        self.count_y, self.count_x = (mi.Int(v) for v in zip(*self.counts, strict=True))
        # In units of the squared spacing of nodes.
        self.variance_y, self.variance_x = (
            mi.Float([spline_variance(n, axis[0]) for n in axis])
            for axis in zip(*self.counts, strict=True)
        )
        self.first_word = stored(mi.UInt32, np.cumsum([0, *tiles])[:-1].astype(np.uint32))
        self.words = stored(mi.UInt32, arrays["words"])
        self.starts = stored(mi.UInt32, arrays["starts"].ravel())
        entries = arrays.pop("entries")
        padded = np.append(entries, np.zeros(len(entries) % 2, np.float16))
        self.entries = stored(mi.UInt32, padded.view(np.uint32))

    @property
    def levels(self) -> int:
        """Number of levels."""
        return len(self.counts)

    def spacing(self, level: int) -> float:
        """Spacing of a level's nodes, texels; the larger one of both axes."""
        return max(p / n for p, n in zip(self.periods, self.counts[level], strict=True))

    def row(self, m, active=True):
        """The index of the bin of ``m`` among the filled bins, and whether it is one of them."""
        index, inside = self.bins.index(m)
        row = dr.gather(mi.UInt32, self.rows, index, active & inside)
        return row, active & inside & (row != self.EMPTY)

    def table(self, level, row, active):
        """The position in memory of the table of a bin, an argument of :meth:`value`."""
        count_y, count_x = (dr.gather(mi.Int, n, level) for n in (self.count_y, self.count_x))
        tiles_y, tiles_x = ((mi.UInt32(n) + (TILE - 1)) // TILE for n in (count_y, count_x))
        word = dr.gather(mi.UInt32, self.first_word, level) + row * tiles_y * tiles_x
        start = dr.gather(
            mi.UInt32, self.starts, level * opaque(mi.UInt32, self.filled) + row, active
        )
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
        # The exponent of a half float is 112 less than that of a float; entries are times 2¹⁵.
        return dr.reinterpret_array(mi.Float, half << 13) * 2.0 ** (112 - 15)

    # --------------------------------------------------------------------------------------------
    #  Building
    # --------------------------------------------------------------------------------------------

    @classmethod
    def build(cls, lattice, triangles, bounds) -> dict[str, np.ndarray]:
        """Build the arrays of the tables of a lattice.

        ``triangles(row, column, active)`` returns the two triangles of a stored quad, each as a
        vertex and two edges (``mi.Vector2f``). ``bounds`` (lower, upper) is the rectangle of
        projected normals that holds all triangles.
        """
        periods = (lattice.y.quads, lattice.x.quads)
        bins = Bins(bounds)

        def rasterize(row, column):
            return bins.rasterize(triangles, row % periods[0], column % periods[1])

        count, per_quad = affordable(periods, bins, rasterize)
        with progress("Building tables of normals") as report:
            while True:
                finest = masses(periods, count, rasterize, per_quad, report)
                filled = np.flatnonzero(np.bincount(finest.indices, minlength=finest.shape[1]))
                if 2 * finest.nnz + 4 * len(filled) * (np.prod(tiles_of(count)) + 1) <= BYTES:
                    break
                count = count_near(count[0] - 1), count_near(count[1] - 1)
        counts = level_counts(count)
        finest, coarser = without_empty_rows(finest.T.tocsr(), filled), refinements(counts)

        def all_levels(bins):
            """Masses of all levels in some of the filled bins: (nodes, bins)."""
            levels = [finest[bins].toarray(order="F").T]
            for nearest, matrix in coarser:
                levels.append(matrix @ levels[nearest])
            return levels

        def packed(first):
            levels = zip(all_levels(slice(first, first + step)), counts, strict=True)
            return [pack(mass, count, periods) for mass, count in levels]

        step = max(1, CHUNK // int(np.prod(count)))
        with ThreadPool(THREADS) as pool:
            chunks = pool.map(packed, range(0, len(filled), step))
        words, lengths, entries = (
            [np.concatenate(level) for level in zip(*part, strict=True)]
            for part in zip(*(zip(*chunk, strict=True) for chunk in chunks), strict=True)
        )
        rows = np.full(bins.rows * bins.columns, cls.EMPTY, np.uint32)
        rows[filled] = np.arange(len(filled))
        ends = np.cumsum(np.concatenate(lengths))
        some = slice(None, None, max(1, len(filled) // table_error.CALIBRATION_BINS))
        functions = (
            [variances_of(periods, count, counts[0]) for count in counts],
            mixed_levels(counts),
        )
        return {
            "bounds": np.asarray(bounds),
            "counts": np.array(counts),
            "rows": rows,
            "words": np.concatenate([w.ravel() for w in words]),
            "starts": (ends - np.concatenate(lengths)).astype(np.uint32).reshape(len(counts), -1),
            "entries": np.concatenate(entries),
            "correlation_lengths": correlation_lengths(
                periods, counts, *functions, all_levels(some), rasterize, filled[some]
            ),
        }


def tiles_of(count: tuple[int, int]) -> tuple[int, int]:
    """Number of tiles (y, x) for a number of nodes (y, x)."""
    return tuple(-(-n // TILE) for n in count)


def affordable(periods, bins: Bins, rasterize) -> tuple[tuple[int, int], float]:
    """Number of nodes (y, x) of the finest level whose tables fit in :data:`BYTES`, and the mean
    number of bins that a quad touches.

    The bins under splines of a few sizes are counted in windows of the map.
    """
    rng = np.random.default_rng(0)
    side, windows = 48, 32
    sides = [min(side, n) for n in periods]
    y, x = (v.ravel() for v in np.indices(sides))
    row = (rng.integers(periods[0], size=(windows, 1)) + y).ravel()
    column = (rng.integers(periods[1], size=(windows, 1)) + x).ravel()
    normals = rasterize(row, column)
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
    # The number of bins is interpolated, and extrapolated, as a power of the spacing.
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


def masses(periods, count, rasterize, per_quad: float, report) -> csr_matrix:
    """Masses M_k(bin) under the splines of nodes, texels²: (nodes, bins), nodes row by row."""
    from scipy.sparse import kron, vstack

    of_y, of_x = (spline_weights(p, n) for p, n in zip(periods, count, strict=True))
    strips = np.array_split(
        np.arange(periods[0]), -(-int(per_quad * np.prod(periods)) // int(STRIP_ENTRIES))
    )
    rows_of_nodes = [None] * count[0]
    for done, strip in enumerate(s for s in strips if len(s)):
        row, column = (v.ravel() for v in np.meshgrid(strip, np.arange(periods[1]), indexing="ij"))
        weights = of_y[:, strip]
        touched = np.flatnonzero(np.diff(weights.indptr))
        normals = rasterize(row, column)

        def sums(node, weights=weights, normals=normals):
            return kron(weights[node], of_x, format="csr") @ normals

        with ThreadPool(THREADS) as pool:
            products = pool.map(sums, touched)
        for node, part in zip(touched, products, strict=True):
            before = rows_of_nodes[node]
            rows_of_nodes[node] = part if before is None else before + part
        report((done + 1) / len(strips))
    return vstack(rows_of_nodes, format="csr")


def without_empty_rows(matrix: csr_matrix, filled: np.ndarray) -> csr_matrix:
    """A view of the rows ``filled`` of a matrix, whose other rows must be empty."""
    from scipy.sparse import csr_matrix

    begin = np.append(matrix.indptr[filled], matrix.nnz)
    return csr_matrix((matrix.data, matrix.indices, begin), (len(filled), matrix.shape[1]))


def pack(mass: np.ndarray, count, periods) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """The words of a level (bins, tiles), its numbers of entries (bins), and its entries.

    ``mass`` (nodes, bins) are the masses of ``count`` (y, x) nodes, texels². See
    :class:`NormalTables`.
    """
    tiles = tiles_of(count)
    padding = [(0, TILE * t - n) for t, n in zip(tiles, count, strict=True)]
    slots = np.pad(mass.reshape(*count, -1), [*padding, (0, 0)])
    slots = slots.reshape(tiles[0], TILE, tiles[1], TILE, -1).transpose(4, 0, 2, 1, 3).ravel()
    present = slots > 0
    nodes = np.packbits(present, bitorder="little").view("<u2").reshape(-1, np.prod(tiles))
    number = np.bitwise_count(nodes).astype(np.uint32)
    after = np.cumsum(number, 1, dtype=np.uint32)
    per_node = np.float32(2**15 * np.prod(count) / np.prod(periods))
    entries = (slots[present] * per_node).astype(np.float16)
    return nodes | (after - number) << 16, after[:, -1], entries
