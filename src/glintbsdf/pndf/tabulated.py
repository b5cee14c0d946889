"""The manifold's P-NDF at a cost that does not grow with the footprint, to an error of choice.

For large footprints the map is condensed to a lattice of nodes, B texels apart. Node k stands for
the texels around it, weighed by a hat, 1 at the node and 0 at its neighbours; the hats of all nodes
add up to one. For every node a table tells how the mass under its hat spreads over a grid of bins
in the plane of projected normals, M_k(bin). Interpolating the footprint's kernel between the nodes
gives

    D(m) = Σ_k k(u_k − x) M_k(bin of m) / (Σ_k k(u_k − x) M_k · area of a bin).

A sample takes a node with probability k(u_k − x) M_k, a place under its hat, the normal there, and
a place in that normal's bin: exactly this density, with no tables but M.

*The error.* A hat widens the kernel by the variance B²/6 per axis, which is taken off the
footprint's covariance beforehand; what is left is the difference of two kernels of equal mass, mean
and covariance. Its L1 norm bounds the relative L1 error of the P-NDF on bins as fine as the tables'
or coarser, whatever the map. The error itself is smaller, the more so the more independent places
of the map fall into a bin: :data:`ERROR` is what was measured on the procedural maps where it is
largest (``benchmarks/tables.py``).
"""

from __future__ import annotations

from math import sqrt

import drjit as dr
import mitsuba as mi
import numpy as np

from ..cache import load_or_build
from ..errors import check
from ..hashing import pcg3d, uniform
from ..kernels import SIGMA_MIN, TexelKernel
from ..lattice import floor_int
from ..normalmap import NormalMap
from ..progress import progress
from .manifold import Manifold, normal_in_quad

#: Bins along each axis of the rectangle of the map's normals.
BINS = 128

#: Relative L1 error of the P-NDF, coefficient c and power p of c (B/σ)^p, σ being the footprint's
#: smaller standard deviation. A kernel with an edge is known at the edge to a fraction of B only.
ERROR = {"gaussian": (0.053, 2), "disk": (0.38, 1), "box": (0.38, 1)}

#: Largest B/σ. Beyond, the hats' own variance, B²/6, nears that of the footprint.
MAX_REACH = 1.4

#: Memory allowed for the finest level, bytes. Every further level takes a quarter.
BYTES = 64e6

#: Smallest bins, in units of projected normals: what no light resolves (half the sun's radius).
MIN_BIN = 1e-3

#: Bins per quad that the build may visit; where the normals jump further, bins are made larger.
MAX_BINS_PER_QUAD = 300

#: Smallest distance of nodes, texels. Below, the exact lists are as fast.
MIN_SPACING = 8


class Nodes:
    """The nodes along one axis, and those of every coarser level: each second one of the finer.

    Nodes lie on texels, as evenly spaced as that allows. Arrays on the device hold all levels one
    after another, each with its first node again at the end, one period later.

    Attributes:
        count (list of int): nodes per level, over one period of the lattice.
        first (mi.UInt32): index of each level's first node in the arrays.
        place (mi.Float): position (texels) and total of the hat (texels) of every node, in turn.
    """

    def __init__(self, period: int, count: int, levels: int) -> None:
        self.period = period
        self.levels = [np.arange(count + 1) * period // count]
        for _ in range(levels - 1):
            finer = self.levels[-1]
            self.levels.append(np.append(finer[:-1][::2], period))
        self.count = [len(level) - 1 for level in self.levels]
        self.counts = mi.Int(self.count)
        self.first = mi.UInt32(np.cumsum([0, *(n + 1 for n in self.count)])[:-1])
        totals = [np.append(t, t[0]) for t in map(self.totals, range(levels))]
        places = np.stack([np.concatenate(self.levels), np.concatenate(totals)], axis=-1)
        self.place = mi.Float(places.astype(np.float32).ravel())

    def totals(self, level: int) -> np.ndarray:
        """Integral of every hat of a level, texels: half the distance of its neighbours."""
        before, after = self.neighbours(level)
        return (before + after) / 2

    def neighbours(self, level: int) -> tuple[np.ndarray, np.ndarray]:
        """Distances of the nodes of a level to those before and after, texels."""
        gaps = np.diff(self.levels[level])
        return np.roll(gaps, 1), gaps


class Tables:
    """The tables of all levels, around the arrays that :meth:`build` makes.

    Attributes:
        rows (mi.UInt32): row of the tables that belongs to a bin, or ``EMPTY``.
        fraction: M_k(bin)/M_k as half floats times 2¹⁵, two to a word; per level, row, node y, x.
    """

    EMPTY = 0xFFFFFFFF
    VERSION = 1

    def __init__(self, arrays: dict[str, np.ndarray], periods: tuple[int, int]) -> None:
        self.lower, self.size = arrays["lower"], arrays["size"]  # of the grid of bins, of one bin
        self.bins = arrays["bins"]
        self.rows = mi.UInt32(arrays["rows"])
        count = [int(n) for n in arrays["count"]]
        self.levels = level_count(count)
        self.y, self.x = (Nodes(p, n, self.levels) for p, n in zip(periods, count, strict=True))
        filled = int((arrays["rows"] != self.EMPTY).sum())
        sizes = [filled * y * x for y, x in zip(self.y.count, self.x.count, strict=True)]
        self.start = mi.UInt32(np.cumsum([0, *sizes])[:-1])  # of every level in ``fraction``
        self.words = mi.UInt32(arrays.pop("fraction").view(np.uint32))
        self.nbytes = 4 * (dr.width(self.words) + dr.width(self.rows))

    def spacing(self, level: int) -> float:
        """Distance of neighbouring nodes, texels, along the axis where it is larger."""
        return max(axis.period / axis.count[level] for axis in (self.x, self.y))

    def bin(self, m):
        """``(index, inside)`` of the bin of a projected normal."""
        x, y = ((m[k] - float(self.lower[k])) * float(1 / self.size[k]) for k in range(2))
        columns, rows = (int(n) for n in self.bins)
        inside = (x >= 0) & (y >= 0) & (x < columns) & (y < rows)
        return mi.UInt32(dr.select(inside, y, 0)) * columns + mi.UInt32(
            dr.select(inside, x, 0)
        ), inside

    def row(self, m, active=True):
        """Row of the tables for the bin of ``m``, and whether there is one."""
        index, inside = self.bin(m)
        row = dr.gather(mi.UInt32, self.rows, index, active & inside)
        return row, active & inside & (row != self.EMPTY)

    def value(self, index, active):
        """M_k(bin)/M_k at an index of ``fraction``."""
        word = dr.gather(mi.UInt32, self.words, index >> 1, active)
        half = (word >> ((index & 1) << 4)) & 0x7FFF
        # A half float's exponent is 112 less than a float's; times the 2¹⁵ of storage.
        return dr.reinterpret_array(mi.Float, half << 13) * 2.0 ** (112 - 15)

    # --------------------------------------------------------------------------------------------
    #  Building
    # --------------------------------------------------------------------------------------------

    @staticmethod
    def build(lattice, triangles, bounds) -> dict[str, np.ndarray]:
        """Condense the lattice to tables. Arguments as for :meth:`QuadLists.build`."""
        lower, upper = (np.asarray(v, np.float64) for v in bounds)
        quads = (lattice.y.quads, lattice.x.quads)
        for bins in (BINS, BINS // 2, BINS // 4, BINS // 8):
            size = np.maximum((upper - lower) / bins, MIN_BIN)
            shape = np.maximum(np.ceil((upper - lower) / size - 1e-6), 1).astype(int)
            spread = Spread(lattice, triangles, lower, size, shape)
            if spread.bins_per_quad() <= MAX_BINS_PER_QUAD:
                break
        filled = spread.filled_bins()
        rows = np.full(shape[0] * shape[1], Tables.EMPTY, np.uint32)
        rows[filled] = np.arange(len(filled))

        # As many nodes as memory allows, of the same distance along both axes.
        finest = sqrt(quads[0] * quads[1] * len(filled) * 2 / BYTES)
        spacing = max(finest, MIN_SPACING)
        count = [max(1, int(n / spacing) // 2 * 2) for n in quads]
        depth = level_count(count)
        axes = [Nodes(n, k, depth) for n, k in zip(quads, count, strict=True)]
        mass = spread.mass(rows, len(filled), axes)
        levels = []
        for level in range(depth):
            if level > 0:
                mass = _coarser(_coarser(mass, axes[0], level, 1), axes[1], level, 2)
            total = np.outer(*(axis.totals(level) for axis in axes))
            levels.append((mass / total * 2**15).astype(np.float16).ravel())
        fraction = np.concatenate(levels)
        return {
            "lower": lower,
            "size": size,
            "bins": shape,
            "rows": rows,
            "count": np.array(count),
            "fraction": np.append(fraction, np.zeros(len(fraction) % 2, np.float16)),
        }


def level_count(count) -> int:
    """Levels until one node is left along both axes, for ``count`` nodes (y, x) at the finest."""
    return 1 + int(np.ceil(np.log2(max(count))))


def _coarser(mass: np.ndarray, nodes: Nodes, level: int, axis: int) -> np.ndarray:
    """Masses of a level from those of the finer one, along an axis: hats are sums of finer hats."""
    weights = np.zeros((nodes.count[level], nodes.count[level - 1]), np.float32)
    fine, coarse = nodes.levels[level - 1], nodes.levels[level]
    right = np.searchsorted(coarse, fine[:-1], side="right")
    t = (fine[:-1] - coarse[right - 1]) / (coarse[right] - coarse[right - 1])
    index = np.arange(len(fine) - 1)
    np.add.at(weights, (right - 1, index), 1 - t)
    np.add.at(weights, (right % nodes.count[level], index), t)
    return np.moveaxis(np.tensordot(weights, mass, axes=(1, axis)), 0, axis)


class Hats:
    """The two finest nodes next to every quad of an axis, and their hats at its centre."""

    def __init__(self, nodes: Nodes) -> None:
        edges, places = nodes.levels[0], np.arange(nodes.period) + 0.5
        before = np.searchsorted(edges, places) - 1
        share = (places - edges[before]) / np.diff(edges)[before]
        self.count = nodes.count[0]
        self.before, self.share = mi.UInt32(before), mi.Float(share.astype(np.float32))

    def at(self, quad, active):
        """``((node, hat), (node, hat))``."""
        before = dr.gather(mi.UInt32, self.before, mi.UInt32(quad), active)
        share = dr.gather(mi.Float, self.share, mi.UInt32(quad), active)
        after = dr.select(before + 1 == self.count, 0, before + 1)
        return (before, 1 - share), (after, share)


def _for_all_threads(count: int) -> mi.UInt32:
    """Lanes for ``count`` long loops, which may have more, without work, for all threads to share.

    The LLVM backend hands every thread 16384 lanes at a time, more than there may be.
    """
    lanes = 16384 * dr.thread_count()
    if dr.backend_v(mi.Float) != dr.JitBackend.LLVM or count >= lanes:
        return dr.arange(mi.UInt32, count)
    lane = np.full(lanes, count, np.uint32)
    lane[np.arange(count) * lanes // count] = np.arange(count)
    # Those of a thread side by side, to fill its vectors.
    return mi.UInt32(np.concatenate([np.sort(part) for part in np.split(lane, dr.thread_count())]))


class Spread:
    """How the normals of all triangles spread over the bins: a scan, one lane per cell of quads."""

    def __init__(self, lattice, triangles, lower, size, bins) -> None:
        self.lattice, self.triangles = lattice, triangles
        self.lower, self.size = lower, size
        self.columns, self.rows = (int(n) for n in bins)

    def touched_bins(self, row, column, lower_half, active=True):
        """A triangle's corners, in bins, and the rectangle of bins that it may touch."""
        upper, lower = self.triangles(row, column, active)
        a, e1, e2 = (dr.select(lower_half, q, p) for p, q in zip(upper, lower, strict=True))
        scale = mi.Vector2f(*(float(1 / s) for s in self.size))
        a = (a - mi.Vector2f(*(float(v) for v in self.lower))) * scale
        corners = a, a + e1 * scale, a + e2 * scale
        low, high = (op(op(*corners[:2]), corners[2]) for op in (dr.minimum, dr.maximum))
        rectangle = (
            dr.clip(floor_int(v), 0, n - 1)
            for v, n in (
                (low.x, self.columns),
                (low.y, self.rows),
                (high.x, self.columns),
                (high.y, self.rows),
            )
        )
        return corners, *rectangle

    def bins_per_quad(self) -> float:
        """Bins that the bounds of a quad's two triangles touch, estimated from some quads."""
        height, width = self.lattice.y.quads, self.lattice.x.quads
        quad = np.random.default_rng(0).integers(0, height * width, 20_000)
        row, column = (mi.Int(v) for v in divmod(quad, width))
        _, x0, y0, x1, y1 = self.touched_bins(row, column, mi.Bool(quad % 2 == 0))
        return 2 * float(np.mean(((x1 - x0 + 1) * (y1 - y0 + 1)).numpy()))

    def scan(self, top, bottom, left, right, visit) -> None:
        """Call ``visit(corners, x, y, row, column, active)`` for the bins (``x``, ``y``) of all
        triangles, with these ``corners``, of the quads (``row``, ``column``) of each lane's cell.

        ``top``, ``bottom``, ``left``, ``right`` (NumPy): the cells' quads, ends excluded.
        """
        lanes = _for_all_threads(len(top))
        top, bottom, left, right = (
            dr.gather(mi.Int, mi.Int(v), lanes, lanes < len(top))
            for v in (top, bottom, left, right)
        )

        # Lanes that fill up a vector are all zero, and integers do not forgive a division by it.
        width = dr.maximum(right - left, 1)

        def quad_of(triangle):
            quad = triangle >> 1
            return top + quad // width, left + quad % width

        def next_triangle(triangle, corners, x, y, x0, x1, y1, active):
            triangle = triangle + 1
            row, column = quad_of(triangle)
            active = active & (row < bottom)
            corners, x0, y, x1, y1 = self.touched_bins(row, column, (triangle & 1) == 1, active)
            return triangle, corners, x0 + 0, y, x0, x1, y1, active

        def body(*state):
            state = dr.if_stmt(
                state,
                state[-1] & (state[3] > state[-2]),
                next_triangle,
                lambda *state: state,
                label="next triangle",
            )
            triangle, corners, x, y, x0, x1, y1, active = state
            row, column = quad_of(triangle)
            visit(corners, x, y, row, column, active & (y <= y1))
            last = x == x1
            y = dr.select(last, y + 1, y)
            return triangle, corners, dr.select(last, x0, x + 1), y, x0, x1, y1, active

        n = dr.width(top)
        integer = dr.zeros(mi.Int, n)
        corners = tuple(dr.zeros(mi.Vector2f, n) for _ in range(3))
        state = (
            integer - 1,
            corners,
            *(integer + k for k in (0, 0, 0, 0, -1)),
            dr.full(mi.Bool, True, n),
        )
        dr.while_loop(state, lambda *state: state[-1], body, label="scan of triangles")

    def filled_bins(self) -> np.ndarray:
        """Indices of the bins that the bounds of any triangle touch."""
        marks = dr.zeros(mi.UInt32, self.columns * self.rows)
        top, left = (
            v.ravel()
            for v in np.meshgrid(
                *(np.arange(0, axis.quads, 8) for axis in (self.lattice.y, self.lattice.x))
            )
        )
        bottom = np.minimum(top + 8, self.lattice.y.quads)
        right = np.minimum(left + 8, self.lattice.x.quads)

        def mark(corners, x, y, row, column, active):
            dr.scatter(marks, 1, mi.UInt32(y * self.columns + x), active)

        self.scan(top, bottom, left, right, mark)
        return np.flatnonzero(marks.numpy())

    def mass(self, rows: np.ndarray, count: int, axes) -> np.ndarray:
        """Mass under the hats of the finest nodes, texels²: (rows, nodes y, nodes x).

        A cell between nodes adds to the four nodes at its corners. Cells that share none, every
        second one along both axes, are scanned together, so that no two lanes add to one number.
        """
        # While it grows, a node's numbers lie together: a lane stays within the same few pages.
        shape = (axes[0].count[0], axes[1].count[0], count)
        mass = dr.zeros(mi.Float, int(np.prod(shape)))
        row_of_bin = mi.UInt32(rows)
        edges = [axis.levels[0] for axis in axes]
        of_row, of_column = (Hats(axis) for axis in axes)

        def add(corners, x, y, row, column, active):
            # Half a texel² per triangle, spread evenly over its own area.
            part = clipped_area(corners, x, y) / dr.abs(doubled_area(*corners))
            active = active & (part > 0)
            index = mi.UInt32(y * self.columns + x)
            table_row = dr.gather(mi.UInt32, row_of_bin, index, active)
            nodes_y, nodes_x = (
                hats.at(k, active) for hats, k in ((of_row, row), (of_column, column))
            )
            for node_y, share_y in nodes_y:
                for node_x, share_x in nodes_x:
                    index = (node_y * shape[1] + node_x) * count + table_row
                    dr.scatter_add(
                        mass,
                        part * share_y * share_x,
                        index,
                        active,
                        mode=dr.ReduceMode.NoConflicts,
                    )

        with progress("Building tables of normals") as report:
            for done, (odd_y, odd_x) in enumerate(((0, 0), (0, 1), (1, 0), (1, 1))):
                node_y, node_x = (
                    v.ravel()
                    for v in np.meshgrid(
                        np.arange(odd_y, shape[0], 2), np.arange(odd_x, shape[1], 2)
                    )
                )
                if node_y.size == 0:
                    continue
                top, bottom = edges[0][node_y], edges[0][node_y + 1]
                left, right = edges[1][node_x], edges[1][node_x + 1]
                self.scan(top, bottom, left, right, add)
                dr.eval(mass)
                dr.sync_thread()
                report((done + 1) / 4)
        return np.ascontiguousarray(np.moveaxis(mass.numpy().reshape(shape), -1, 0))


def doubled_area(a, b, c):
    """Twice the signed area of a triangle."""
    return (b.x - a.x) * (c.y - a.y) - (b.y - a.y) * (c.x - a.x)


def clipped_area(corners, x, y):
    """Area of a triangle inside the unit square at (``x``, ``y``), ≥ 0.

    By Green's theorem: every edge adds the integral over its height in the square's rows of its
    abscissa clamped to the square's columns; the square's own edges then add nothing.
    """
    origin = mi.Vector2f(x, y)
    corners = [corner - origin for corner in corners]
    area = mi.Float(0)
    for p, q in zip(corners, corners[1:] + corners[:1], strict=True):
        rise = q.y - p.y
        slope = (q.x - p.x) / dr.select(dr.abs(rise) > 1e-9, rise, 1)
        start, end = dr.clip(p.y, 0, 1), dr.clip(q.y, 0, 1)
        from_x, to_x = p.x + slope * (start - p.y), p.x + slope * (end - p.y)
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


class TabulatedManifold(Manifold):
    """The manifold, exact for small footprints, by tables beyond; arguments as for ``Manifold``.

    Args:
        max_error (float): relative L1 error of the P-NDF allowed, > 0, on the bins of the tables:
            1/128 of the range of the map's normals. Footprints so small that their error would be
            larger are evaluated exactly.

    A map with ``wrap_mode`` ``clamp`` is always evaluated exactly. The tables carry derivatives
    with respect to the footprint, none with respect to the map.
    """

    def __init__(
        self,
        normal_map: NormalMap,
        kernel: str = "gaussian",
        epsilon: float = 1e-6,
        max_error: float = 0.05,
        owner: str = "TabulatedManifold",
    ) -> None:
        check(
            max_error > 0 and np.isfinite(max_error),
            owner,
            "max_error",
            "a finite number > 0",
            max_error,
        )
        self.max_error = float(max_error)
        key = f"tables {Tables.VERSION} {normal_map.content_hash} {epsilon!r}"
        self.cached_tables = lambda build: load_or_build(key, build)
        super().__init__(normal_map, kernel, epsilon, owner)
        self.cached_tables = lambda build: build()

    def build(self) -> None:
        """Make everything that depends on ``self.data``; the cache may know lists and tables."""
        super().build()
        self.tables = None
        if self.normal_map.wrap_mode != "clamp":
            arrays = self.cached_tables(
                lambda: Tables.build(self.lattice, self.effective_triangles, self.bounds())
            )
            self.tables = Tables(arrays, (self.lattice.y.quads, self.lattice.x.quads))

    def level(self, footprint) -> mi.Int:
        """The coarsest level of nodes that keeps the error, −1 where none does."""
        sigma = dr.sqrt(self.texel_kernel(footprint).minor_variance)
        coefficient, power = ERROR[self.kernel]
        reach = min((self.max_error / coefficient) ** (1 / power), MAX_REACH)
        level = mi.Int(-1)
        for k in range(self.tables.levels):
            level += dr.select(self.tables.spacing(k) <= reach * sigma, 1, 0)
        return level

    def node_kernel(self, footprint, level) -> TexelKernel:
        """The footprint's kernel, less the variance that the hats of a level add."""
        index = mi.UInt32(dr.maximum(level, 0))
        added = [
            dr.select(
                level >= 0,
                -dr.square(axis.period / dr.gather(mi.Float, mi.Float(axis.counts), index))
                * (1 / 6),
                SIGMA_MIN**2,
            )
            for axis in (self.tables.x, self.tables.y)
        ]
        height, width, _ = self.data.shape
        wrap_mode = self.normal_map.wrap_mode
        return TexelKernel(self.kernel, footprint, height, width, wrap_mode, tuple(added))

    def every_node(self, kernel, level, active, visit, *state):
        """Visit all nodes of a level under a kernel, row by row.

        ``visit(weight, y, x, index_y, index_x, active, *state)`` returns the new ``state``; the
        weight is k(u_k − x) M_k, the node's position ``x``, ``y`` in texels.
        """
        axes = (self.tables.y, self.tables.x)
        lane_level = mi.UInt32(dr.maximum(level, 0))
        count_y, count_x = (dr.gather(mi.Int, axis.counts, lane_level) for axis in axes)
        first_y, first_x = (dr.gather(mi.UInt32, axis.first, lane_level) for axis in axes)
        mean = mi.Vector2f(kernel.mean)

        def locate(position, count, period):
            """The last node at or before a position: its period's origin, and its index."""
            node = floor_int(position * count / period)
            origin = floor_int((mi.Float(node) + 0.5) / count)
            return origin * period, node - origin * count

        origin_y, index_y = locate(mean.y - kernel.reach_v, count_y, axes[0].period)
        start_x, start_index_x = locate(mean.x - kernel.reach_u, count_x, axes[1].period)

        def following(index, origin, count, period):
            wrapped = index + 1 == count
            return dr.select(wrapped, 0, index + 1), dr.select(wrapped, origin + period, origin)

        def body(index_y, origin_y, index_x, origin_x, active, *state):
            y, total_y = dr.gather(mi.Vector2f, axes[0].place, first_y + mi.UInt32(index_y), active)
            x, total_x = dr.gather(mi.Vector2f, axes[1].place, first_x + mi.UInt32(index_x), active)
            y, x = y + origin_y, x + origin_x
            weight = kernel.value(mi.Vector2f(x, y) - mean) * total_x * total_y
            state = visit(weight, y, x, index_y, index_x, active, *state)

            new_row = x > mean.x + kernel.reach_u
            next_x = following(index_x, origin_x, count_x, axes[1].period)
            next_y = following(index_y, origin_y, count_y, axes[0].period)
            index_x, origin_x = (
                dr.select(new_row, a, b)
                for a, b in zip((start_index_x, start_x), next_x, strict=True)
            )
            last = new_row & (y > mean.y + kernel.reach_v)
            index_y, origin_y = (
                dr.select(new_row, a, b) for a, b in zip(next_y, (index_y, origin_y), strict=True)
            )
            return index_y, origin_y, index_x, origin_x, active & ~last, *state

        state = (index_y, origin_y, start_index_x + 0, start_x + 0, mi.Bool(active), *state)
        return dr.while_loop(
            state, lambda *state: state[4], body, max_iterations=-1, label="every node"
        )[5:]

    def eval(self, m: mi.Vector2f, footprint, active: bool | mi.Bool = True) -> mi.Float:
        """D(m), see :meth:`Manifold.eval`: piecewise constant over bins where tables are used."""
        if self.tables is None:
            return super().eval(m, footprint, active)
        level = self.level(footprint)
        exact = super().eval(m, footprint, mi.Bool(active) & (level < 0))

        tables, kernel = self.tables, self.node_kernel(footprint, level)
        row, found = tables.row(m, mi.Bool(active) & (level >= 0) & (dr.squared_norm(m) < 1))
        lane_level = mi.UInt32(dr.maximum(level, 0))
        count_y, count_x = (
            mi.UInt32(dr.gather(mi.Int, axis.counts, lane_level)) for axis in (tables.y, tables.x)
        )
        table = dr.gather(mi.UInt32, tables.start, lane_level) + row * count_y * count_x

        def add(weight, y, x, index_y, index_x, active, mass, total):
            index = table + mi.UInt32(index_y) * count_x + mi.UInt32(index_x)
            fraction = tables.value(index, active & (weight > 0))
            return dr.fma(weight, fraction, mass), total + weight

        mass, total = self.every_node(kernel, level, found, add, mi.Float(0), mi.Float(0))
        area = float(np.prod(tables.size))
        return exact + dr.select(found & (total > 0), mass / (total * area), 0)

    def sample(
        self, footprint, sample1, sample2: mi.Point2f, active: bool | mi.Bool = True
    ) -> mi.Vector2f:
        """Draw a projected normal with the density that :meth:`eval` gives."""
        exact = super().sample(footprint, sample1, sample2, active)
        if self.tables is None:
            return exact
        level = self.level(footprint)
        return dr.select(level < 0, exact, self.sample_tables(footprint, level, sample2, active))

    def sample_tables(self, footprint, level, sample2, active) -> mi.Vector2f:
        """A node by its weight, a place under its hat, the normal there, a place in its bin."""
        tables, kernel = self.tables, self.node_kernel(footprint, level)
        active = mi.Bool(active) & (level >= 0)

        # More numbers than the two given are wanted: hashed from them.
        bits = [dr.reinterpret_array(mi.UInt32, mi.Float(u)) for u in (sample2.x, sample2.y)]
        randoms = [uniform(v) for stream in range(3) for v in pcg3d(*bits, mi.UInt32(stream))]
        choose, side_x, side_y, l1, l2, bin_x, bin_y = randoms[:7]

        def pick(weight, y, x, index_y, index_x, active, total, choice, at_y, at_x, hat_y, hat_x):
            """Weighted reservoir of one, the random number being stretched and used again."""
            total = total + weight
            chance = weight / dr.select(total > 0, total, 1)
            taken = active & (choice < chance)
            choice = dr.select(taken, choice / chance, (choice - chance) / (1 - chance))
            choice = dr.clip(choice, 0, 1 - 2.0**-24)
            new = (y, x, index_y, index_x)
            old = (at_y, at_x, hat_y, hat_x)
            return total, choice, *(dr.select(taken, a, b) for a, b in zip(new, old, strict=True))

        zero = mi.Float(0)
        _, _, y, x, index_y, index_x = self.every_node(
            kernel, level, active, pick, zero + 0, choose, zero + 0, zero + 0, mi.Int(0), mi.Int(0)
        )
        quad = []
        lane_level = mi.UInt32(dr.maximum(level, 0))
        for axis, index, position, u in (
            (tables.y, index_y, y, side_y),
            (tables.x, index_x, x, side_x),
        ):
            first = dr.gather(mi.UInt32, axis.first, lane_level)
            count = dr.gather(mi.Int, axis.counts, lane_level)
            at, _ = dr.gather(mi.Vector2f, axis.place, first + mi.UInt32(index), active)
            after, _ = dr.gather(mi.Vector2f, axis.place, first + mi.UInt32(index + 1), active)
            wrapped = dr.select(index == 0, count, index)
            end, _ = dr.gather(mi.Vector2f, axis.place, first + mi.UInt32(wrapped), active)
            before, _ = dr.gather(mi.Vector2f, axis.place, first + mi.UInt32(wrapped - 1), active)
            left, right = end - before, after - at
            # Inverse of the hat's distribution: a rising and a falling edge of a triangle.
            share = left / (left + right)
            rising = u < share
            v = dr.select(rising, u / share, (1 - u) / (1 - share))
            offset = dr.select(rising, left * (dr.sqrt(v) - 1), right * (1 - dr.sqrt(v)))
            quad.append(floor_int(position + offset))

        normals = self.quad_normals(
            self.lattice.y.locate(quad[0])[1], self.lattice.x.locate(quad[1])[1], active
        )
        m = normal_in_quad(l1, l2, normals, self.epsilon)
        index, _ = tables.bin(m)
        columns = int(tables.bins[0])
        place = mi.Vector2f(mi.Float(index % columns) + bin_x, mi.Float(index // columns) + bin_y)
        size, lower = (mi.Vector2f(*(float(v) for v in t)) for t in (tables.size, tables.lower))
        return lower + size * place

    @property
    def nbytes(self) -> int:
        """Memory of vertices, lists and tables, bytes."""
        return super().nbytes + (0 if self.tables is None else self.tables.nbytes)
