"""Inverted lists: for every normal, the quads of texels that can show it.

The plane of projected normals is divided into cells, and the lattice of texels into rows of blocks.
For every row of blocks and every cell there is a list of the quads in the row whose normals reach
into the cell. A list goes from left to right and is subdivided by blocks. The normal of a query
lies in one cell. So each row of blocks under the footprint is one run of consecutive entries,
whatever the footprint's shape. There is no tree and no stack, and a query visits only quads that
are near in position and in normal.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import reduce
from math import inf
from operator import or_
from typing import NamedTuple

import drjit as dr
import mitsuba as mi
import numpy as np

from glintbsdf.core.loops import symbolic_loop
from glintbsdf.core.opaque import opaque, stored
from glintbsdf.core.progress import progress
from glintbsdf.footprint.domain import Domain
from glintbsdf.footprint.lattice import BLOCK, Lattice, floor_int

SHIFT = BLOCK.bit_length() - 1  # index of a quad >> SHIFT is the index of its block

#: Resolution per axis of the table that maps a normal to its cell.
RESOLUTION = 1024

#: Numbers of cells per axis to try; the builder takes the largest one that the memory allows.
DIVISIONS = (48, 40, 32, 28, 24, 20, 16, 12, 8, 6, 4, 3, 2, 1)

#: Blocks, at most, from which the memory of the lists is estimated.
SAMPLED_BLOCKS = 512

#: Memory allowed to the lists, bytes per quad; the vertices are not counted.
BYTES_PER_QUAD = 48

#: Bounds of normals are widened by this (in units of projected normals) against rounding.
MARGIN = 1e-6

#: Number of counters in one strip of the build. It bounds the memory that the build needs besides
#: its result.
STRIP_COUNTERS = 1 << 23


# ------------------------------------------------------------------------------------------------
#  Queries
# ------------------------------------------------------------------------------------------------


def every_quad(lattice: Lattice, kernel, add, active, zero=None):
    """Sum over all quads that the kernel's bounding box touches; see :meth:`QuadLists.visit`.

    This loop is for footprints of a few texels, where a search costs more than it saves. The sum
    begins with ``zero`` (default: ``mi.Float(0)``) and may be of any type that ``add`` returns.
    """
    mean = mi.Vector2f(kernel.mean)
    left, top = floor_int(mean.x - kernel.reach_u), floor_int(mean.y - kernel.reach_v)
    right, bottom = floor_int(mean.x + kernel.reach_u), floor_int(mean.y + kernel.reach_v)
    first_column, first_row = lattice.x.locate(left)[1], lattice.y.locate(top)[1]

    def body(x, y, column, row, active, density):
        density = add(density, row, column, mi.Vector2f(x, y) - mean, active)
        new_row = x == right
        row = dr.select(new_row, lattice.y.following(y, row), row)
        column = dr.select(new_row, first_column, lattice.x.following(x, column))
        x, y = dr.select(new_row, left, x + 1), dr.select(new_row, y + 1, y)
        return x, y, column, row, active & (y <= bottom), density

    state = (
        mi.Int(left),
        mi.Int(top),
        mi.Int(first_column),
        first_row,
        mi.Bool(active),
        mi.Float(0) if zero is None else zero,
    )
    return symbolic_loop(state, lambda *state: state[4], body, "every quad")[5]


def walk(lattice: Lattice, shift, kernel, run_of, place_of, add, active, zero=None) -> mi.Float:
    """Sum over the entries of the lists that the kernel touches; see :meth:`QuadLists.visit`.

    The lattice's blocks have the side ``1 << shift``, a number or one per lane (``mi.Int``).
    ``run_of(row of blocks, first block, last block, active)`` returns the begin and the end of a
    run of consecutive entries. ``place_of(entry, first row of the row of blocks, active)`` returns
    the row and the column of an entry, and any further arguments of ``add``. The sum begins with
    ``zero``, as in :func:`every_quad`.

    An outer loop goes over the runs, an inner one over the entries of a run. A single flat loop
    would be slower: in nearly every step, some lane would begin a new run, and all others would
    wait while it is found. It is cheaper to wait once at the end of each run.
    """
    columns, rows = lattice.x, lattice.y
    mean = mi.Vector2f(kernel.mean)
    bottom = floor_int(mean.y + kernel.reach_v)

    def body(x, right, next_y, origin_y, row, active, density):
        # Where this row of blocks is done, go to the next one and find its extent under the kernel.
        new_row = x > right
        active = active & ~(new_row & (next_y > bottom))
        origin, y, row_end = rows.locate(next_y)
        first_row = (y >> shift) << shift
        below = origin + dr.minimum(first_row + (1 << shift), row_end)
        start, stop = kernel.row_extent(
            mi.Float(origin + first_row) - mean.y, mi.Float(below) - mean.y
        )
        x, right, next_y, origin_y, row = (
            dr.select(new_row, new, old)
            for new, old in (
                (floor_int(mean.x + start), x),
                (floor_int(mean.x + stop), right),
                (below, next_y),
                (origin, origin_y),
                (first_row, row),
            )
        )
        # The row's next run goes as far as blocks are stored side by side.
        origin_x, column, column_end = columns.locate(x)
        last = dr.minimum(right - origin_x, column_end - 1) >> shift
        entry, end = run_of(
            mi.UInt32(row >> shift), mi.UInt32(column >> shift), mi.UInt32(last), active
        )
        x = origin_x + dr.minimum((last + 1) << shift, column_end)

        def add_entry(entry, density):
            found = active & (entry < end)
            place = place_of(entry, row, found)
            corner = mi.Vector2f(origin_x + place[1], origin_y + place[0]) - mean
            return entry + 1, add(density, *place, corner, found)

        _, density = symbolic_loop(
            (entry, density), lambda entry, _: active & (entry < end), add_entry, "entries"
        )
        return x, right, next_y, origin_y, row, active, density

    top = floor_int(mean.y - kernel.reach_v)
    none = mi.Int(0)
    zero = mi.Float(0) if zero is None else zero
    state = (none + 0, none - 1, top, none + 0, none + 0, mi.Bool(active), zero)
    return symbolic_loop(state, lambda *state: state[-2], body, "quad lists")[-1]


class Packed:
    """An array of unsigned integers on the device. Two share a word where 16 bits are enough."""

    def __init__(self, values: np.ndarray) -> None:
        self.half = values.dtype == np.uint16
        if self.half:
            if len(values) % 2:
                values = np.append(values, np.uint16(0))
            values = values.view(np.uint32)
        self.words = stored(mi.UInt32, values)
        self.nbytes = values.nbytes

    def __getitem__(self, item):
        """Gather values; ``item`` is the pair (index, active)."""
        index, active = item
        if not self.half:
            return dr.gather(mi.UInt32, self.words, index, active)
        word = dr.gather(mi.UInt32, self.words, index >> 1, active)
        return (word >> ((index & 1) << 4)) & 0xFFFF


class NormalCells:
    """Division of a rectangle of projected normals into S×S cells.

    There are S slabs along x, and each slab is divided into S cells along y. A cut is the mean of a
    uniform division and a quantile of the map's normals. So cells are small where normals, and
    queries with them, are frequent.
    """

    divisions: int | mi.UInt32

    def __init__(self, lower, upper, slab_of_x: np.ndarray, cell_of_y: np.ndarray) -> None:
        """``slab_of_x`` (RESOLUTION) and ``cell_of_y`` (S, RESOLUTION) are tables over the
        rectangle from ``lower`` to ``upper``."""
        self.lower, self.upper = (np.asarray(v, np.float32) for v in (lower, upper))
        self.divisions = len(cell_of_y)
        self.scale = (RESOLUTION / (self.upper - self.lower)).astype(np.float32)
        # Opaque values: one kernel serves all maps.
        self.origin, self.pixels = (
            [dr.opaque(mi.Float, float(x)) for x in values] for values in (self.lower, self.scale)
        )
        self.count = dr.opaque(mi.UInt32, self.divisions)
        self.slab_of_x = stored(mi.UInt32, slab_of_x.astype(np.uint32))
        self.cell_of_y = stored(mi.UInt32, cell_of_y.astype(np.uint32).ravel())

    @staticmethod
    def histogram(normals, lower, upper) -> np.ndarray:
        """Numbers of ``normals`` (``mi.Float``, x and y by turns) in the pixels of the tables, an
        array over x and y, cumulative along x: row i counts the pixels of all rows before i."""
        count = dr.arange(mi.UInt32, dr.width(normals) // 2)
        scale = (RESOLUTION / (upper - lower)).astype(np.float32)
        pixel = []
        for k in (0, 1):
            origin, pixels = (opaque(mi.Float, float(v[k])) for v in (lower, scale))
            place = (dr.gather(mi.Float, normals, 2 * count + k) - origin) * pixels
            pixel.append(mi.UInt32(dr.clip(place, 0, RESOLUTION - 1)))
        counts = dr.zeros(mi.UInt32, RESOLUTION**2)
        dr.scatter_add(counts, mi.UInt32(1), pixel[0] * RESOLUTION + pixel[1])
        sums = np.zeros((RESOLUTION + 1, RESOLUTION), np.uint32)
        np.cumsum(counts.numpy().reshape(RESOLUTION, RESOLUTION), axis=0, out=sums[1:])
        return sums

    @staticmethod
    def tables(histogram: np.ndarray, divisions: int):
        """The tables ``(slab_of_x, cell_of_y)`` for normals with this :meth:`histogram`."""

        def cut(counts):
            mass = np.cumsum(counts) / max(counts.sum(), 1)
            uniform = np.arange(1, RESOLUTION + 1) / RESOLUTION
            before = 0.5 * (np.append(0, mass[:-1]) + np.append(0, uniform[:-1]))
            return np.minimum(before * divisions, divisions - 1).astype(np.uint8)

        slab_of_x = cut(np.diff(histogram.sum(1)))
        slabs = np.diff(histogram[np.searchsorted(slab_of_x, np.arange(divisions + 1))], axis=0)
        return slab_of_x, np.stack([cut(counts) for counts in slabs])

    def pixel(self, value, axis):
        """Position of a coordinate in the table, in pixels."""
        return (value - self.origin[axis]) * self.pixels[axis]

    def covers(self, m):
        """Whether ``m`` lies in the rectangle."""
        x, y = self.pixel(m.x, 0), self.pixel(m.y, 1)
        return (x >= 0) & (x < RESOLUTION) & (y >= 0) & (y < RESOLUTION)

    def slab(self, x, active=True):
        """Index of the slab of the coordinate ``x``."""
        index = mi.UInt32(dr.clip(self.pixel(x, 0), 0, RESOLUTION - 1))
        return dr.gather(mi.UInt32, self.slab_of_x, index, active)

    def cell_in_slab(self, slab, y, active=True):
        """Index, within a slab, of the cell of the coordinate ``y``."""
        index = mi.UInt32(dr.clip(self.pixel(y, 1), 0, RESOLUTION - 1))
        return dr.gather(mi.UInt32, self.cell_of_y, slab * RESOLUTION + index, active)

    def cell(self, m, active=True):
        """Index of the cell of ``m``."""
        slab = self.slab(m.x, active)
        return slab * self.count + self.cell_in_slab(slab, m.y, active)

    def edges(self) -> tuple[mi.Float, mi.Float]:
        """Edges of the slabs (S + 1), and edges of the cells of each slab (S·(S + 1))."""
        wanted = np.arange(self.divisions + 1)
        slabs = np.searchsorted(self.slab_of_x.numpy(), wanted)
        cells = [
            np.searchsorted(row, wanted)
            for row in self.cell_of_y.numpy().reshape(self.divisions, RESOLUTION)
        ]
        x = self.lower[0] + slabs / self.scale[0]
        y = self.lower[1] + np.concatenate(cells) / self.scale[1]
        return stored(mi.Float, x.astype(np.float32)), stored(mi.Float, y.astype(np.float32))


class Span(NamedTuple):
    """``size`` blocks from the block ``first`` on, of ``all`` blocks along a periodic axis."""

    first: int
    size: int
    all: int

    def place(self, block):
        """Index within the span of a block (``mi.UInt32``)."""
        if self.size == self.all and self.first == 0:
            return block
        first, all = (dr.opaque(mi.UInt32, x) for x in (self.first, self.all))
        return dr.select(block < first, block + all, block) - first

    def block(self, place):
        """The block (``mi.UInt32``) at an index within the span."""
        if self.size == self.all and self.first == 0:
            return place
        first, all = (dr.opaque(mi.UInt32, x) for x in (self.first, self.all))
        block = place + first
        return dr.select(block >= all, block - all, block)


class Window(NamedTuple):
    """A rectangle of blocks of quads."""

    rows: Span
    columns: Span

    @staticmethod
    def whole(lattice: Lattice) -> Window:
        """All blocks."""
        return Window(*(Span(0, axis.blocks, axis.blocks) for axis in (lattice.y, lattice.x)))

    @staticmethod
    def touched(lattice: Lattice, domain: Domain) -> Window:
        """The blocks that footprints within the domain touch."""
        touched = lattice.y.touched_blocks(*domain.rows), lattice.x.touched_blocks(*domain.columns)
        axes = lattice.y, lattice.x
        return Window(*(Span(*t, a.blocks) for t, a in zip(touched, axes, strict=True)))


class QuadLists:
    """The lists, on the device.

    Args:
        lattice (Lattice): the lattice of quads.
        arrays (dict): the arrays that :meth:`build` returns; they are taken out of it.
        window (Window): the blocks that have lists, by default all. Queries must touch no others.

    The arrays (NumPy), with R rows of blocks, B blocks in a row, and C cells, are

    * ``lower``, ``upper``, ``slab_of_x``, ``cell_of_y``: the cells, see :class:`NormalCells`;
    * ``entries``: the quads, as ``column << SHIFT | row in block``;
    * ``start`` (R·C): index of the first entry of each list;
    * ``offset`` (R·C·(B + 1)): first entry of each block, counted from the start of its list.
    """

    def __init__(
        self, lattice: Lattice, arrays: dict[str, np.ndarray], window: Window | None = None
    ) -> None:
        self.lattice, self.window = lattice, window or Window.whole(lattice)
        self.cells = NormalCells(
            arrays["lower"], arrays["upper"], arrays["slab_of_x"], arrays["cell_of_y"]
        )
        # Taken out one by one: a large map then never has two copies of more than one array.
        self.entries, self.offset = Packed(arrays.pop("entries")), Packed(arrays.pop("offset"))
        self.start = stored(mi.UInt32, arrays.pop("start"))
        self.nbytes = self.entries.nbytes + self.offset.nbytes + 4 * dr.width(self.start)

    def covers(self, m):
        """Whether ``m`` is within the bounds of the lists: elsewhere no quad shows it."""
        return self.cells.covers(m)

    def visit(self, m, kernel, add, active, zero=None) -> mi.Float:
        """Sum over all quads that may show ``m`` under the kernel; the sum begins with ``zero``.

        Calls ``add(density, row, column, corner, active)`` for stored quads of the lattice. It
        returns the new ``density``. ``corner`` (``mi.Vector2f``) is the quad's position relative to
        the kernel's centre, in texels. Sums are differentiable in both modes.
        """
        rows, columns = self.window
        count, width = dr.square(self.cells.count), dr.opaque(mi.UInt32, columns.size + 1)
        cell = self.cells.cell(m, active)

        def run_of(block_row, first, last, active):
            list_index = rows.place(block_row) * count + cell
            start = dr.gather(mi.UInt32, self.start, list_index, active)
            return tuple(
                start + self.offset[list_index * width + k, active]
                for k in (columns.place(first), columns.place(last) + 1)
            )

        return walk(self.lattice, SHIFT, kernel, run_of, self.quad_of, add, active, zero)

    def quad_of(self, entry, row, active) -> tuple[mi.Int, mi.Int]:
        """Row and column of the quad of an entry, whose row of blocks begins at ``row``."""
        quad = mi.Int(self.entries[entry, active])
        return row + (quad & (BLOCK - 1)), quad >> SHIFT

    # --------------------------------------------------------------------------------------------
    #  Building
    # --------------------------------------------------------------------------------------------

    @staticmethod
    def build(
        lattice: Lattice,
        triangles,
        normals: mi.Float,
        bounds,
        window: Window | None = None,
        bytes_per_quad: float = BYTES_PER_QUAD,
    ) -> dict[str, np.ndarray]:
        """Build the arrays of a window of the lattice, in two passes: one counts, one fills.

        Args:
            triangles: function ``(row, column, active)`` that returns the triangles of a stored
                quad, each as a vertex and two edges (``mi.Vector2f``).
            normals: projected normals of the map (``mi.Float``, x and y by turns).
            bounds: rectangle (lower, upper) of projected normals that holds all triangles.
            window: the blocks to make lists for, by default all.
            bytes_per_quad: memory allowed.
        """
        window = window or Window.whole(lattice)
        blocks = BlocksOfQuads(lattice, triangles, window)
        return Builder(blocks, normals, bounds, bytes_per_quad).arrays()


class Blocks:
    """The input of :class:`Builder`: items in blocks, each with a few shapes that hold its normals.

    A shape is three ``mi.Vector2f``. In this class it is a triangle: a vertex and two edges.

    Attributes:
        rows, columns (int): number of blocks along each axis.
        mean_count (float): mean number of items in a block.
        largest_entry, longest_list (int): the largest entry that the lists may hold, and the most
            entries in one list.
        shapes_each (int): number of shapes of an item.
    """

    shapes_each = 2

    @staticmethod
    def extent(triangle):
        """Lower and upper corner of a shape's bounding box."""
        a, e1, e2 = triangle
        b, c = a + e1, a + e2
        return dr.minimum(dr.minimum(a, b), c), dr.maximum(dr.maximum(a, b), c)

    @staticmethod
    def span(triangle) -> Callable:
        """The part of a shape between two x: a function ``(left, right)`` that returns its lowest
        and its highest y. The lowest exceeds the highest where there is no such part."""
        a, e1, e2 = triangle
        edges = []
        for start, edge in ((a, e1), (a, e2), (a + e1, e2 - e1)):
            run = dr.select(dr.abs(edge.x) < 1e-12, 1e-12, edge.x)  # a vertical edge leans a bit
            edges.append((start, edge.y, 1 / run))

        def between(left, right):
            lowest, highest = mi.Float(inf), mi.Float(-inf)
            for start, rise, inverse in edges:
                # The fractions of the edge between which it lies within.
                enter, leave = ((x - start.x) * inverse for x in (left, right))
                first = dr.maximum(dr.minimum(enter, leave), 0)
                last = dr.minimum(dr.maximum(enter, leave), 1)
                ends = [dr.fma(t, rise, start.y) for t in (first, last)]
                within = first <= last
                lowest = dr.select(within, dr.minimum(lowest, dr.minimum(*ends)), lowest)
                highest = dr.select(within, dr.maximum(highest, dr.maximum(*ends)), highest)
            return lowest, highest

        return between


class BlocksOfQuads(Blocks):
    """The quads of a window of a lattice."""

    def __init__(self, lattice: Lattice, shapes, window: Window) -> None:
        """``shapes(row, column, active)`` returns the shapes of a stored quad."""
        self.lattice, self.shapes_of_quad = lattice, shapes
        self.window = window
        self.rows, self.columns = window.rows.size, window.columns.size
        self.mean_count = float(BLOCK**2)
        self.longest_list = self.columns * BLOCK**2
        self.largest_entry = self.window.columns.all * BLOCK**2 - 1

    def count(self, block_row, block_column):
        """Number of quads in a block."""
        return BLOCK**2

    def shapes(self, block_row, block_column, quad, active):
        """Whether the quad with the index ``quad`` in a block exists, and its shapes."""
        row = self.window.rows.block(block_row) * BLOCK + (quad >> SHIFT)
        column = self.window.columns.block(block_column) * BLOCK + (quad & (BLOCK - 1))
        exists = active & (mi.Int(row) < self.lattice.y.count)
        exists &= mi.Int(column) < self.lattice.x.count
        return exists, self.shapes_of_quad(row, column, exists)

    def entry(self, block_row, block_column, quad):
        """The entry that stands in the lists for the quad with the index ``quad`` in a block."""
        column = self.window.columns.block(block_column) * BLOCK + (quad & (BLOCK - 1))
        return (column << SHIFT) | (quad >> SHIFT)


class Builder:
    """Builds the lists: it tests all quads against all cells in reach, one lane per block of quads.

    Only one lane touches the counters of a block. So the order of the entries, and of every later
    sum, is the same on all machines.

    Args:
        blocks (Blocks): the items.
        normals: projected normals of the map (``mi.Float``, x and y by turns), by which cells are
            placed.
        bounds: rectangle (lower, upper) of projected normals that holds all shapes.
        bytes_per_quad (float): memory allowed to the lists, per item.
    """

    def __init__(self, blocks, normals, bounds, bytes_per_quad: float = BYTES_PER_QUAD) -> None:
        self.blocks, self.allowed = blocks, bytes_per_quad
        self.lower, self.upper = (np.asarray(v, np.float32) for v in bounds)
        self.histogram = NormalCells.histogram(normals, self.lower, self.upper)
        self.rows, self.columns = blocks.rows, blocks.columns
        self.entry_type = np.dtype(np.uint16 if blocks.largest_entry < 1 << 16 else np.uint32)
        # No list is longer than a row of blocks.
        self.offset_type = np.dtype(np.uint16 if blocks.longest_list < 1 << 16 else np.uint32)

    def arrays(self) -> dict[str, np.ndarray]:
        """Build the arrays of :class:`QuadLists`, strip by strip."""
        estimates = ((n, self.bytes_per_quad(n)) for n in DIVISIONS)
        divisions, per_quad = next(e for e in estimates if e[0] == 1 or e[1] <= self.allowed)
        tables = self.use(divisions)
        lists, width = self.rows * divisions**2, self.columns + 1

        start = np.empty(lists, np.uint32)
        # Of an even length each, as two share a word.
        offset = np.zeros(lists * width + lists * width % 2, self.offset_type)
        entries, total = np.empty(0, self.entry_type), 0
        step = max(1, STRIP_COUNTERS // (divisions**2 * width))
        items = self.rows * self.columns * self.blocks.mean_count
        with progress("Building lists of quads", items * per_quad) as report:
            for first in range(0, self.rows, step):
                last = min(first + step, self.rows)
                own = slice(first * divisions**2, last * divisions**2)
                begin, offsets, found = self.strip(first, last)
                start[own] = begin + np.uint32(total)
                offset[own.start * width : own.stop * width] = offsets
                # The system moves a large array without a copy.
                entries.resize(total + len(found), refcheck=False)
                entries[total:] = found
                total += len(found)
                report(last / self.rows)
            entries.resize(total + total % 2, refcheck=False)
        dr.flush_malloc_cache()
        return {
            "lower": self.lower,
            "upper": self.upper,
            "slab_of_x": tables[0],
            "cell_of_y": tables[1],
            "start": start,
            "offset": offset,
            "entries": entries,
        }

    def use(self, divisions: int):
        """Divide the normals into ``divisions``² cells, and return the tables of the cells."""
        tables = NormalCells.tables(self.histogram, divisions)
        self.cells = NormalCells(self.lower, self.upper, *tables)
        self.slab_edges, self.cell_edges = self.cells.edges()
        return tables

    def bytes_per_quad(self, divisions: int) -> float:
        """Memory of the lists with this many divisions, estimated from a sample of blocks.

        Where the offsets alone take more than is allowed, nothing is sampled.
        """
        size = self.offset_type.itemsize
        offsets = (size + (size + 4) / (self.columns + 1)) * divisions**2 / self.blocks.mean_count
        if offsets > self.allowed:
            return offsets
        self.use(divisions)
        count = self.rows * self.columns
        sample = np.arange(count)
        if count > SAMPLED_BLOCKS:
            sample = np.random.default_rng(0).integers(0, count, SAMPLED_BLOCKS)
        row, column = (stored(mi.UInt32, v.astype(np.uint32)) for v in divmod(sample, self.columns))
        counters, own = dr.zeros(mi.UInt32, len(sample)), dr.arange(mi.UInt32, len(sample))
        self.scan(row, column, lambda cell: own, counters)
        entries = dr.sum(counters)[0] / (len(sample) * self.blocks.mean_count)
        return self.entry_type.itemsize * entries + offsets

    def strip(self, first: int, last: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """The lists of a strip, the rows of blocks from ``first`` to before ``last``.

        Returns the index of each list's first entry, within the strip; the first entry of each
        block, counted from the start of its list; and the entries.
        """
        block = dr.arange(mi.UInt32, (last - first) * self.columns)
        columns, cells = (dr.opaque(mi.UInt32, n) for n in (self.columns, self.cells.divisions**2))
        width = columns + 1
        row = block // columns
        column = block - row * columns

        def scan(counters, entries=None) -> None:
            self.scan(
                row + dr.opaque(mi.UInt32, first),
                column,
                lambda cell: (row * cells + cell) * width + column,
                counters,
                entries,
            )

        # First the quads of each list and block are counted, then each is entered in its place.
        lists = (last - first) * self.cells.divisions**2
        counters = dr.zeros(mi.UInt32, lists * (self.columns + 1))
        scan(counters)
        places = dr.prefix_sum(counters)
        count = places[-1] + counters[-1]
        begin = dr.gather(mi.UInt32, places, dr.arange(mi.UInt32, lists) * width)
        of_list = dr.arange(mi.UInt32, dr.width(counters)) // width
        offset = places - dr.gather(mi.UInt32, places, of_list * width)
        entries = dr.empty(mi.UInt32, max(count, 1))
        dr.eval(begin, offset)
        scan(places, entries)
        return begin.numpy(), offset.numpy(), entries.numpy()[:count]

    def scan(self, block_row, block_column, counter_of_cell, counters, entries=None) -> None:
        """Count the quads of the given blocks in all cells that they reach, or enter them there.

        ``counters`` count the quads of each list and block. With ``entries``, each counter is the
        index of the next entry of its list and block.
        """
        cells, blocks = self.cells, self.blocks
        count = blocks.count(block_row, block_column)

        def loop(first, condition, body, label) -> None:
            dr.while_loop((first,), condition, body, mode="symbolic", label=label)

        def each_quad(quad):
            exists, shapes = blocks.shapes(block_row, block_column, quad, mi.Bool(True))
            lower, upper = zip(*(blocks.extent(shape) for shape in shapes), strict=True)
            lowest, highest = reduce(dr.minimum, lower).x, reduce(dr.maximum, upper).x
            last_slab = mi.Int(cells.slab(highest + MARGIN, exists))
            last_slab = dr.select(exists, last_slab, -1)
            spans_between = [blocks.span(shape) for shape in shapes]

            def each_slab(slab):
                s = mi.UInt32(slab)
                left, right = (dr.gather(mi.Float, self.slab_edges, s + k) for k in (0, 1))
                spans = [span(left - MARGIN, right + MARGIN) for span in spans_between]
                low, high = zip(*spans, strict=True)
                lowest, highest = reduce(dr.minimum, low), reduce(dr.maximum, high)
                last_cell = mi.Int(cells.cell_in_slab(s, highest + MARGIN))
                last_cell = dr.select(lowest <= highest, last_cell, -1)

                def each_cell(cell):
                    c = mi.UInt32(cell)
                    edge = s * (cells.count + 1) + c
                    bottom, top = (dr.gather(mi.Float, self.cell_edges, edge + k) for k in (0, 1))
                    met = reduce(
                        or_,
                        ((y <= top + MARGIN) & (z >= bottom - MARGIN) for y, z in spans),
                    )
                    place = counter_of_cell(s * cells.count + c)
                    if entries is None:  # no two lanes meet at a counter
                        dr.scatter_add(
                            counters, mi.UInt32(1), place, met, dr.ReduceMode.NoConflicts
                        )
                    else:
                        slot = dr.scatter_inc(counters, place, met)
                        entry = blocks.entry(block_row, block_column, quad)
                        dr.scatter(entries, entry, slot, met)
                    return (cell + 1,)

                first_cell = mi.Int(cells.cell_in_slab(s, lowest - MARGIN))
                loop(first_cell, lambda cell: cell <= last_cell, each_cell, "cells of a quad")
                return (slab + 1,)

            first_slab = mi.Int(cells.slab(lowest - MARGIN, exists))
            loop(first_slab, lambda slab: slab <= last_slab, each_slab, "slabs of a quad")
            return (quad + 1,)

        quad = dr.zeros(mi.UInt32, dr.width(block_row))
        loop(quad, lambda quad: quad < count, each_quad, "scan of quads")
        dr.eval(counters, entries)
