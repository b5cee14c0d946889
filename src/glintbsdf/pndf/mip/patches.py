"""The look-up table of a synthesised map on the device: which patch owns a texel, and a quad.

A quad spans four texels of the large map, as everywhere. It is *whole* where one patch owns all of
them: then it looks like a quad of the sample. The others are *seam quads*, whose corners come from
two patches or more; there are a few in a hundred.
"""

from __future__ import annotations

import drjit as dr
import mitsuba as mi
import numpy as np

from glintbsdf.core.loops import symbolic_loop
from glintbsdf.core.opaque import opaque
from glintbsdf.footprint.kernels import TexelKernel
from glintbsdf.footprint.lattice import LatticeAxis, floor_int
from glintbsdf.maps.quilting import BEFORE_X, BEFORE_Y, Synthesis, overlap_index
from glintbsdf.pndf.index.lists import SHIFT, QuadLists

#: What is kept of a texel besides its owner, :data:`BEFORE_X` | :data:`BEFORE_Y`: whether the quad
#: that it is the last corner of lies on a seam.
SEAM = 4

#: Texels in a word.
PER_WORD = 8


def owner_cells(synthesis: Synthesis, rows: np.ndarray, columns: np.ndarray) -> np.ndarray:
    """The cell (row · n + column) whose patch owns each texel of some rows × columns of the map."""
    count = len(synthesis.patch)
    cell_y, cell_x = synthesis.cell_of[rows][:, None], synthesis.cell_of[columns]
    y, x = rows[:, None] - synthesis.starts[cell_y], columns - synthesis.starts[cell_x]
    step = synthesis.starts[cell_x + 1] - synthesis.starts[cell_x]
    place = overlap_index(y, x, step, synthesis.overlap)
    owner = np.where(place >= 0, synthesis.owners[cell_y, cell_x, place], 0)
    before_y, before_x = (owner & BEFORE_Y) != 0, (owner & BEFORE_X) != 0
    return (cell_y - before_y) % count * count + (cell_x - before_x) % count


class PatchTable:
    """Which patch shows what, on the device.

    Texels of a cell that need a look are those in the first ``strip`` rows or columns, one more
    than the overlap. Each has four bits: its owner, and :data:`SEAM`. A row of the cell begins a
    new word.

    Args:
        synthesis (Synthesis): the map; it must fit to itself.
    """

    def __init__(self, synthesis: Synthesis) -> None:
        count, steps = len(synthesis.patch), np.diff(synthesis.starts)
        strip, longest = synthesis.overlap + 1, int(steps.max())
        words = [-(-n // PER_WORD) for n in (longest, strip)]  # of a row across the cell, or beside
        shape = (count, count, strip * words[0] + (longest - strip) * words[1])
        codes = codes_of_cells(synthesis, strip, words, shape)
        origins = synthesis.origins[synthesis.patch.ravel()].astype(np.uint32)
        index = np.arange(synthesis.size) - synthesis.starts[synthesis.cell_of]
        self.codes = mi.UInt32(codes.ravel())
        self.origins = mi.UInt32(origins[:, 0] << 16 | origins[:, 1])
        self.places = mi.UInt32((synthesis.cell_of | index << 16).astype(np.uint32))
        self.starts = mi.Int(synthesis.starts.astype(np.int32))
        self.nbytes = 4 * sum(
            dr.width(v) for v in (self.codes, self.origins, self.places, self.starts)
        )
        self.count, self.size, self.overlap = (
            opaque(mi.Int, n) for n in (count, synthesis.size, synthesis.overlap)
        )
        self.inverse_count = opaque(mi.Float, 1 / count)
        self.strip, self.across, self.beside, self.per_cell = (
            opaque(mi.UInt32, n) for n in (strip, *words, shape[2])
        )

    def place(self, texel: mi.Int, active) -> tuple[mi.Int, mi.Int]:
        """The cell that holds a row or column of the map, and the offset from the cell's first."""
        word = dr.gather(mi.UInt32, self.places, mi.UInt32(texel), active)
        return mi.Int(word & 0xFFFF), mi.Int(word >> 16)

    def word_of(self, cell_y, cell_x, y, x) -> tuple[mi.UInt32, mi.Bool]:
        """Index of the word that has a texel's code, and whether there is one."""
        y, x = mi.UInt32(y), mi.UInt32(x)
        above = y < self.strip
        row = dr.select(
            above, y * self.across, self.strip * self.across + (y - self.strip) * self.beside
        )
        word = mi.UInt32(cell_y * self.count + cell_x) * self.per_cell + row + x // PER_WORD
        return word, above | (x < self.strip)

    def code(self, cell_y, cell_x, y, x, active) -> mi.UInt32:
        """The four bits of a texel of a cell."""
        word, kept = self.word_of(cell_y, cell_x, y, x)
        word = dr.gather(mi.UInt32, self.codes, word, active & kept)
        return (word >> ((mi.UInt32(x) % PER_WORD) * 4)) & 0xF

    def step(self, cell: mi.Int, active) -> mi.Int:
        """Texels from a cell to the next along an axis."""
        first, last = (dr.gather(mi.Int, self.starts, mi.UInt32(cell + k), active) for k in (0, 1))
        return last - first

    def located(self, row: mi.Int, column: mi.Int, active) -> tuple:
        """``(row, column, code)``: of the sample's texel that a texel of the map shows, and the
        texel's code."""
        (cell_y, y), (cell_x, x) = (self.place(v, active) for v in (row, column))
        code = self.code(cell_y, cell_x, y, x, active)
        axes = []
        for cell, offset, bit in ((cell_y, y, BEFORE_Y), (cell_x, x, BEFORE_X)):
            before = (code & bit) != 0
            previous = dr.select(cell == 0, self.count, cell) - 1
            step = self.step(previous, active & before)
            axes.append((dr.select(before, previous, cell), offset + dr.select(before, step, 0)))
        (cell_y, y), (cell_x, x) = axes
        origin = self.origin((cell_y, cell_x), active)
        return origin[0] + y, origin[1] + x, code

    def origin(self, cell: tuple, active) -> tuple[mi.Int, mi.Int]:
        """Row and column in the sample of the patch of a cell (y, x)."""
        index = mi.UInt32(cell[0] * self.count + cell[1])
        word = dr.gather(mi.UInt32, self.origins, index, active)
        return mi.Int(word >> 16), mi.Int(word & 0xFFFF)

    def source(self, row: mi.Int, column: mi.Int, active) -> tuple[mi.Int, mi.Int]:
        """Row and column of the sample's texel that a texel of the map shows."""
        return self.located(row, column, active)[:2]

    def corners(self, rows, columns, active) -> tuple[mi.Int, ...]:
        """Rows and columns in the sample of a quad's corners n0…n3, in turn.

        ``rows``, ``columns``: the map's two rows and columns. Of a whole quad the last corner tells
        them all.
        """
        (top, bottom), (left, right) = rows, columns
        y, x, code = self.located(bottom, right, active)

        def one_by_one(*corners):
            texels = ((top, left), (top, right), (bottom, left), (bottom, right))
            return tuple(v for texel in texels for v in self.source(*texel, active))

        return dr.if_stmt(
            (y - 1, x - 1, y - 1, mi.Int(x), mi.Int(y), x - 1, mi.Int(y), mi.Int(x)),
            active & ((code & SEAM) != 0),
            one_by_one,
            lambda *corners: corners,
            label="seam",
        )

    def around(self, cell: mi.Int) -> tuple[mi.Int, mi.Int]:
        """The stored cell that a cell of the endless plane looks like, and its copy of the map."""
        turn = floor_int((mi.Float(cell) + 0.5) * self.inverse_count)
        return cell - turn * self.count, turn

    def cell_at(self, x: mi.Int, active) -> mi.Int:
        """The cell of the endless plane at a position, texels."""
        turn = floor_int((mi.Float(x) + 0.5) * (1 / mi.Float(self.size)))
        return self.place(x - turn * self.size, active)[0] + turn * self.count

    def quarters(self, patch: Patch, row: mi.Int, column: mi.Int, active) -> mi.Float:
        """What of a quad of the sample a patch owns, a quarter for each corner."""
        whole, near = self.is_whole(patch, row, column, active), active
        for axis, place in enumerate((row, column)):
            offset = place - patch.origin[axis]
            near = near & (offset >= -1) & (offset < patch.steps[axis] + self.overlap)

        def counted(share):
            count = mi.UInt32(0)
            for down in (0, 1):
                for across in (0, 1):
                    mine = self.is_owned(patch, row + down, column + across, 3, near)
                    count = count + dr.select(mine, mi.UInt32(1), 0)
            return (mi.UInt32(count),)

        all_ = dr.select(whole, mi.UInt32(4), 0)
        (count,) = dr.if_stmt((all_,), near & ~whole, counted, lambda share: (share,), label="seam")
        return mi.Float(count) * 0.25

    def is_whole(self, patch: Patch, row: mi.Int, column: mi.Int, active) -> mi.Bool:
        """Whether a quad of the sample belongs to a patch with all its corners."""
        inside = active & (row >= patch.origin[0]) & (column >= patch.origin[1])
        return self.is_owned(patch, row + 1, column + 1, 3 | SEAM, inside)

    def is_owned(self, patch: Patch, row: mi.Int, column: mi.Int, bits: int, active) -> mi.Bool:
        """Whether a patch owns a texel of the sample; ``bits`` of its code tell."""
        places, owner, inside = [], mi.UInt32(0), active
        for axis, (texel, bit) in enumerate(((row, BEFORE_Y), (column, BEFORE_X))):
            offset, step = texel - patch.origin[axis], patch.steps[axis]
            inside = inside & (offset >= 0) & (offset < step + self.overlap)
            beyond = offset >= step
            places.append(
                (
                    dr.select(beyond, patch.following[axis], patch.cell[axis]),
                    offset - dr.select(beyond, step, 0),
                )
            )
            owner = owner | dr.select(beyond, mi.UInt32(bit), 0)
        (cell_y, y), (cell_x, x) = places
        return inside & ((self.code(cell_y, cell_x, y, x, inside) & bits) == owner)

    def walk(self, kernel: TexelKernel, shift: int, lead: int, margins, visit, active, state):
        """Go through lists of the sample, patch by patch of those under a kernel.

        The sample's rows, from ``lead`` before its first, are grouped ``1 << shift`` at a time. For
        every group in every patch, ``state = visit(patch, row, first, last, active, state)`` is
        called, with the group's first row, and the sample's columns under the kernel from first to
        last.

        Args:
            margins: quads before the patch's first texel to begin with, and after its last one.
        """
        mean = mi.Vector2f(kernel.mean)
        left, top = floor_int(mean.x - kernel.reach_u), floor_int(mean.y - kernel.reach_v)
        right, bottom = floor_int(mean.x + kernel.reach_u), floor_int(mean.y + kernel.reach_v)
        before, after = margins
        # The first patch may be that of the cell before
        first_y, first_x = (self.cell_at(v - self.overlap - after - 1, active) for v in (top, left))
        last_y, last_x = (self.cell_at(v + before, active) for v in (bottom, right))

        def body(cell_y, cell_x, y, active, state):
            patch = Patch(self, cell_y, cell_x, active)
            (low_y, low_x), (high_y, high_x) = (
                [dr.maximum(v, b - before) for v, b in zip((top, left), patch.begin, strict=True)],
                [
                    dr.minimum(v, b + step + self.overlap + after)
                    for v, b, step in zip((bottom, right), patch.begin, patch.steps, strict=True)
                ],
            )
            y = dr.maximum(y, low_y)
            shift_y, shift_x = (o - b for o, b in zip(patch.origin, patch.begin, strict=True))
            row = (((y + shift_y + lead) >> shift) << shift) - lead
            below = row + (1 << shift) - shift_y
            last = dr.minimum(high_y, below - 1)
            start, stop = kernel.row_extent(mi.Float(y) - mean.y, mi.Float(last + 1) - mean.y)
            first_column = dr.maximum(floor_int(mean.x + start), low_x)
            last_column = dr.minimum(floor_int(mean.x + stop), high_x)
            found = active & (y <= last) & (first_column <= last_column)
            state = visit(patch, row, first_column + shift_x, last_column + shift_x, found, state)
            done = below > high_y
            y = dr.select(done, top, below)
            new_row = done & (cell_x >= last_x)
            cell_x = dr.select(new_row, first_x, dr.select(done, cell_x + 1, cell_x))
            cell_y = dr.select(new_row, cell_y + 1, cell_y)
            return cell_y, cell_x, y, active & (cell_y <= last_y), state

        first = (first_y, mi.Int(first_x), mi.Int(top), mi.Bool(active), state)
        return symbolic_loop(first, lambda *state: state[3], body, "patches")[4]


class Patch:
    """A patch in a cell of the endless plane.

    Attributes:
        cell, following (pairs of mi.Int, y first): the stored cell, and the next along each axis.
        steps, begin (pairs of mi.Int): the cell's extents, and where it begins on the map.
        origin (pair of mi.Int): the patch's first texel in the sample.
    """

    def __init__(self, table: PatchTable, cell_y: mi.Int, cell_x: mi.Int, active) -> None:
        cell, steps, begin = [], [], []
        for of_plane in (cell_y, cell_x):
            stored, turn = table.around(of_plane)
            first, last = (
                dr.gather(mi.Int, table.starts, mi.UInt32(stored + k), active) for k in (0, 1)
            )
            cell.append(stored)
            steps.append(last - first)
            begin.append(first + turn * table.size)
        self.cell, self.steps, self.begin = tuple(cell), tuple(steps), tuple(begin)
        self.following = tuple(dr.select(c + 1 == table.count, 0, c + 1) for c in cell)
        self.origin = table.origin(self.cell, active)

    def on_map(self, row: mi.Int, column: mi.Int) -> mi.Vector2f:
        """Where a row and a column of the sample are on the map, (x, y) in texels."""
        y, x = (v - o + b for v, o, b in zip((row, column), self.origin, self.begin, strict=True))
        return mi.Vector2f(x, y)


def codes_of_cells(synthesis: Synthesis, strip: int, words: list[int], shape) -> np.ndarray:
    """The words of all cells; see :class:`PatchTable`."""
    codes = np.zeros(shape, np.uint32)
    starts, count = synthesis.starts, len(synthesis.patch)
    cell_x = synthesis.cell_of
    x = np.arange(synthesis.size) - starts[cell_x]
    shift = (4 * (x % PER_WORD)).astype(np.uint32)
    for cell_y in range(count):
        rows = np.arange(starts[cell_y] - 1, starts[cell_y + 1])
        owner = owner_cells(synthesis, rows % synthesis.size, np.arange(synthesis.size))
        beside = np.roll(owner, 1, axis=1)
        seam = (owner[1:] != beside[1:]) | (owner[1:] != owner[:-1]) | (owner[1:] != beside[:-1])
        owner_y, owner_x = divmod(owner[1:], count)
        code = BEFORE_Y * (owner_y != cell_y) + BEFORE_X * (owner_x != cell_x) + SEAM * seam
        code = code.astype(np.uint32) << shift
        for y in range(len(rows) - 1):
            kept = slice(None) if y < strip else x < strip
            first = y * words[0] if y < strip else strip * words[0] + (y - strip) * words[1]
            place = first + x[kept] // PER_WORD
            np.bitwise_or.at(codes, (cell_y, cell_x[kept], place), code[y, kept])
    return codes


class InSample:
    """The row of a quad that is one of the sample's, with its column beside it."""

    def __init__(self, row: mi.Int) -> None:
        self.row = row


class PatchLists:
    """The sample's lists of quads, seen through the patches of the map under a footprint.

    Args:
        table (PatchTable): the map's table.
        lists (QuadLists): the sample's lists.
        axis (LatticeAxis): either axis of the map.
    """

    def __init__(self, table: PatchTable, lists: QuadLists, axis: LatticeAxis) -> None:
        self.table, self.lists, self.axis = table, lists, axis
        self.nbytes = lists.nbytes

    def covers(self, m) -> mi.Bool:
        """Whether any quad may show the normal ``m``; of seam quads, nothing is known."""
        return mi.Bool(True)

    def visit(self, m, kernel: TexelKernel, add, active, zero=None):
        """As :meth:`.QuadLists.visit`; the row is an :class:`InSample` where quads are whole."""
        density = mi.Float(0) if zero is None else zero
        density = self.visit_patches(m, kernel, add, active & self.lists.covers(m), density)
        return self.visit_seams(kernel, add, active, density)

    def visit_patches(self, m, kernel, add, active, density):
        """The whole quads."""
        table, lists, mean = self.table, self.lists, mi.Vector2f(kernel.mean)
        cell = lists.cells.cell(m, active)
        cells, width = (
            dr.square(lists.cells.count),
            opaque(mi.UInt32, lists.window.columns.size + 1),
        )

        def visit(patch, row, first, last, active, density):
            index = mi.UInt32(row >> SHIFT) * cells + cell
            start = dr.gather(mi.UInt32, lists.start, index, active)
            entry, end = (
                start + lists.offset[index * width + mi.UInt32(k), active]
                for k in (first >> SHIFT, (last >> SHIFT) + 1)
            )

            def add_entry(entry, density):
                found = active & (entry < end)
                of_quad, column = lists.quad_of(entry, row, found)
                corner = patch.on_map(of_quad, column) - mean
                found = table.is_whole(patch, of_quad, column, found)
                return entry + 1, add(density, InSample(of_quad), column, corner, found)

            return symbolic_loop(
                (entry, density), lambda entry, _: active & (entry < end), add_entry, "entries"
            )[1]

        # The last corner of a quad is the patch's as well
        return table.walk(kernel, SHIFT, 0, (0, -2), visit, active, density)

    def visit_seams(self, kernel, add, active, density):
        """The seam quads.

        A step of the outer loop takes a word of codes, eight texels of a row, the inner one the
        seam quads among them. Y, X: the quads' last corners.
        """
        table, axis = self.table, self.axis
        mean = mi.Vector2f(kernel.mean)
        bottom = floor_int(mean.y + kernel.reach_v) + 1
        top = floor_int(mean.y - kernel.reach_v) + 1

        def extent(y):
            start, stop = kernel.row_extent(mi.Float(y - 1) - mean.y, mi.Float(y) - mean.y)
            return floor_int(mean.x + start) + 1, floor_int(mean.x + stop) + 1

        def body(y, x, right, active, density):
            stored_y, stored_x = (axis.locate(v)[1] for v in (y, x))
            (cell_y, of_y), (cell_x, of_x) = (table.place(v, active) for v in (stored_y, stored_x))
            step = table.step(cell_x, active)
            word, kept = table.word_of(cell_y, cell_x, of_y, of_x)
            word = dr.gather(mi.UInt32, table.codes, word, active & kept)
            first = x - (of_x & (PER_WORD - 1))
            # Seams among those from x to the right end
            seams = (word >> 2) & 0x11111111
            seams = (seams >> mi.UInt32(4 * (x - first))) << mi.UInt32(4 * (x - first))
            beyond = dr.maximum(PER_WORD - 1 - (right - first), 0)
            seams = (seams << mi.UInt32(4 * dr.minimum(beyond, 7))) >> mi.UInt32(
                4 * dr.minimum(beyond, 7)
            )
            row = dr.select(stored_y == 0, axis.count, stored_y) - 1

            def add_quad(seams, density):
                found = active & (seams != 0)
                column = first + mi.Int(dr.tzcnt(seams) >> 2) - 1
                corner = mi.Vector2f(column, y - 1) - mean
                added = add(density, row, axis.locate(column)[1], corner, found)
                return seams & (seams - 1), added

            _, density = symbolic_loop(
                (seams, density), lambda seams, _: active & (seams != 0), add_quad, "seam quads"
            )
            # The next word, which may be the next cell's
            following = first + PER_WORD
            above = mi.UInt32(of_y) < table.strip
            kept = above | (mi.UInt32(of_x - (x - first)) + PER_WORD < table.strip)
            end = x - of_x + step
            x = dr.select(kept, dr.minimum(following, end), end)
            new_row = x > right
            y = dr.select(new_row, y + 1, y)
            left, new_right = extent(y)
            x, right = dr.select(new_row, left, x), dr.select(new_row, new_right, right)
            return y, x, right, active & (y <= bottom), density

        left, right = extent(top)
        state = (top, left, right, mi.Bool(active) & (top <= bottom), density)
        return symbolic_loop(state, lambda *state: state[3], body, "seams")[4]
