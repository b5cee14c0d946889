"""The grids of a synthesised map that a footprint touches, level by level, and their lobes.

:mod:`glintbsdf.pndf.mip.levels` makes the levels and their arrays. A level's grids divide
the map along each axis by the same borders, so a grid is a pair of indices. Level 0 has one texel
per grid; then come the divisions of cells, the cells, and groups of cells.
"""

from __future__ import annotations

from math import log2

import drjit as dr
import mitsuba as mi
import numpy as np

from glintbsdf.footprint.lattice import floor_int
from glintbsdf.maps.quilting import BEFORE_X, BEFORE_Y, Synthesis
from glintbsdf.pndf.mip.levels import Layout, morton


class CellAxis:
    """The grids along either axis of the map, which goes on for ever, repeated or mirrored.

    Beyond the map, grids are counted on; :meth:`at` says which stored grid one looks like.

    Args:
        synthesis: the map.
        layout: its division.
        mirrored: whether the map is mirrored, rather than repeated.
    """

    def __init__(self, synthesis: Synthesis, layout: Layout, mirrored: bool) -> None:
        self.size, self.mirrored = synthesis.size, mirrored
        self.inner, self.count = layout.inner, len(synthesis.patch)
        self.starts = mi.UInt32(synthesis.starts)
        self.cell_of = mi.UInt32(synthesis.cell_of)
        divisions = len(layout.divisions)
        # Per level: log2 of the grids in a cell, log2 of the cells in a grid, grids in the map.
        split = [0, *(int(log2(n)) for n in layout.divisions), *(0 for _ in layout.cells)]
        joined = [0] * (1 + divisions) + list(range(len(layout.cells)))
        period = [self.size, *(n * self.count for n in layout.divisions), *layout.cells]
        self.split, self.joined, self.period = mi.UInt32(split), mi.UInt32(joined), mi.Int(period)

    @property
    def nbytes(self) -> int:
        return 4 * (dr.width(self.starts) + dr.width(self.cell_of))

    def on(self, level: mi.UInt32, active: mi.Bool) -> CellsAlongAxis:
        """The axis as one level divides it, for each lane its own."""
        split, joined = (dr.gather(mi.UInt32, v, level, active) for v in (self.split, self.joined))
        period = dr.gather(mi.Int, self.period, level, active)
        return CellsAlongAxis(self, level == 0, split, joined, period, active)


class CellsAlongAxis:
    """The grids of one level along an axis; see :class:`CellAxis`."""

    def __init__(self, axis, texels, split, joined, period, active) -> None:
        self.axis, self.texels, self.active = axis, texels, active
        self.split, self.joined, self.period = split, joined, period

    def locate(self, x: mi.Float) -> mi.Int:
        """The grid at the position ``x``, texels from the map's edge."""
        axis = self.axis
        turn = dr.floor(x * (1 / axis.size))
        x = x - turn * axis.size
        turn = mi.Int(turn)
        flipped = self.is_flipped(turn)
        x = dr.select(flipped, axis.size - x, x)
        texel = mi.UInt32(dr.clip(floor_int(x), 0, axis.size - 1))
        cell = dr.gather(mi.UInt32, axis.cell_of, texel, self.active)
        offset = x - mi.Float(dr.gather(mi.UInt32, axis.starts, cell, self.active))
        n = mi.Int(1 << self.split)
        part = dr.clip(floor_int(offset * mi.Float(n) * (1 / axis.inner)), 0, n - 1)
        index = mi.Int((cell >> self.joined) << self.split) + part
        index = dr.select(self.texels, mi.Int(texel), index)
        return turn * self.period + dr.select(flipped, self.period - 1 - index, index)

    def is_flipped(self, turn: mi.Int) -> mi.Bool:
        """Whether this copy of the map is a mirror image."""
        return (turn & 1) != 0 if self.axis.mirrored else mi.Bool(False)

    def at(self, grid: mi.Int) -> tuple[mi.UInt32, mi.Int, mi.Bool]:
        """``(index, turn, flipped)``: the stored grid, and which copy of the map this is."""
        turn = floor_int((mi.Float(grid) + 0.5) / mi.Float(self.period))
        index = grid - turn * self.period
        flipped = self.is_flipped(turn)
        return mi.UInt32(dr.select(flipped, self.period - 1 - index, index)), turn, flipped

    def border(self, index: mi.UInt32) -> mi.Float:
        """Where a stored grid begins, texels from the map's edge."""
        cell = dr.minimum((index >> self.split) << self.joined, self.axis.count)
        start = dr.gather(mi.UInt32, self.axis.starts, cell, self.active & ~self.texels)
        part = index & ((1 << self.split) - 1)
        offset = mi.Float(part) * self.axis.inner / mi.Float(1 << self.split)
        return dr.select(self.texels, mi.Float(index), mi.Float(start) + offset)

    def origin(self, index: mi.UInt32) -> mi.Int:
        """Texel from which positions of the lobes of a stored grid count: its first cell's."""
        cell = (index >> self.split) << self.joined
        start = dr.gather(mi.UInt32, self.axis.starts, cell, self.active & ~self.texels)
        return mi.Int(dr.select(self.texels, index, start))

    def placed(self, x: mi.Float | mi.Int, turn: mi.Int, flipped: mi.Bool) -> mi.Float | mi.Int:
        """The position in a copy of the map that a stored position has there."""
        x = dr.select(flipped, self.axis.size - x, x)
        return x + type(x)(turn * self.axis.size)


class LevelCells:
    """Where the lobes of a grid are found: runs of consecutive lobes in one array.

    Args:
        synthesis: the map.
        arrays: what :func:`~.build` has made.
        clusters: k.
        mirrored: whether the map is mirrored at its border, rather than repeated.

    Attributes:
        levels: number of levels, the texels' included.
        extent (mi.Float): per level, the unit of the lobes' packed positions, texels.
    """

    def __init__(self, synthesis: Synthesis, arrays, clusters: int, mirrored: bool) -> None:
        self.layout = layout = Layout.of(synthesis)
        self.clusters, self.overlap = clusters, synthesis.overlap
        self.count = len(synthesis.patch)
        self.axis = CellAxis(synthesis, layout, mirrored)
        self.divisions = len(layout.divisions)
        self.levels = 1 + self.divisions + len(layout.cells)
        self.patch = mi.UInt32(synthesis.patch.ravel())
        self.origins = mi.UInt32(synthesis.origins.ravel())
        self.width = synthesis.normals.shape[1]
        self.owners = mi.UInt32(_packed_owners(synthesis.owners))
        self.owners_per_cell = synthesis.owners.shape[2]
        self.segments = mi.UInt32(arrays["segments"])

        # First lobe of every kind in the array of all, and of every level among its kind.
        sizes = [len(arrays[name]) for name in ("texels", "inside", "overlaps")]
        self.inside, self.overlaps, self.cells = (int(v) for v in np.cumsum(sizes))
        per_level = [n * n for n in layout.divisions]
        self.grids_per_patch = sum(per_level)
        first_inside = np.cumsum([0, *per_level])[: self.divisions]
        first_cells = np.cumsum([0, *(n * n for n in layout.cells)])[: len(layout.cells)]
        self.first = mi.UInt32(np.concatenate(([0], first_inside, first_cells)))
        step = float(np.diff(synthesis.starts).max())
        extents = [1.0, *(step for _ in layout.divisions)]
        self.extent = mi.Float(extents + [step * 2**j for j in range(len(layout.cells))])
        self.normals = mi.Float(arrays["normals"].astype(np.float32).ravel())

    @property
    def nbytes(self) -> int:
        """Memory of the tables, bytes; the lobes are not counted."""
        tables = (self.patch, self.origins, self.owners, self.segments)
        return 4 * sum(dr.width(v) for v in tables) + self.axis.nbytes

    def may_have(self, m: mi.Vector2f, level, margin: mi.Float, active) -> mi.Bool:
        """Whether ``m`` is within the ``margin`` of normals that lobes of the level have."""
        lower, upper = (dr.gather(mi.Vector2f, self.normals, 2 * level + k, active) for k in (0, 1))
        return dr.all((m > lower - margin) & (m < upper + margin))

    def run(self, level, axis: CellsAlongAxis, y, x, flipped, active):
        """The lobes of the stored grid (``y``, ``x``): ``(first, count, first_2, count_2)``.

        The second run has the lobes in the cell's overlaps; it is empty but for divisions of cells.
        For texels, the run goes on over the texels that follow in x, as far as their lobes do,
        unless the map is ``flipped`` in x.
        """
        first_of_level = dr.gather(mi.UInt32, self.first, level, active)
        texels, cells = level == 0, level > self.divisions
        group = first_of_level + y * mi.UInt32(axis.period) + x
        first = self.cells + group * self.clusters
        source, following = self.source(y, x, active & texels)
        first = dr.select(texels, source, first)
        following = dr.select(flipped, 1, following)
        count = dr.select(texels, following, mi.UInt32(self.clusters))
        first_2 = count_2 = mi.UInt32(0)
        if self.divisions:
            inside = active & ~texels & ~cells
            n = 1 << axis.split
            part_y, part_x = y & (n - 1), x & (n - 1)
            cell = (y >> axis.split) * self.count + (x >> axis.split)
            patch = dr.gather(mi.UInt32, self.patch, cell, inside)
            group = patch * self.grids_per_patch + first_of_level + part_y * n + part_x
            first = dr.select(inside, self.inside + group * self.clusters, first)
            # Finer grids of the finest division, in Morton order, make up this one.
            finest = self.layout.divisions[0]
            finer = 2 * (int(log2(finest)) - axis.split)
            place = cell * (finest**2 + 1) + (morton(part_y, part_x, finest) << finer)
            begin = dr.gather(mi.UInt32, self.segments, place, inside)
            end = dr.gather(mi.UInt32, self.segments, place + (1 << finer), inside)
            first_2 = self.overlaps + begin
            count_2 = dr.select(inside, end - begin, 0)
        return first, count, first_2, count_2

    def source(self, y: mi.UInt32, x: mi.UInt32, active: mi.Bool) -> tuple[mi.UInt32, mi.UInt32]:
        """The sample's texel that the texel (``y``, ``x``) of the map shows, and the number of
        texels from here on that it is known to go on without a break."""
        axis, cells, offsets, steps = self.axis, [], [], []
        for index in (y, x):
            cell = dr.gather(mi.UInt32, axis.cell_of, index, active)
            begin = dr.gather(mi.UInt32, axis.starts, cell, active)
            end = dr.gather(mi.UInt32, axis.starts, cell + 1, active)
            cells.append(cell)
            offsets.append(index - begin)
            steps.append(end - begin)
        row, column = offsets
        above, beside = row < self.overlap, column < self.overlap
        place = dr.select(
            above,
            row * steps[1] + column,
            self.overlap * steps[1] + (row - self.overlap) * self.overlap + column,
        )
        place = (cells[0] * self.count + cells[1]) * self.owners_per_cell + place
        cut = active & (above | beside)
        word = dr.gather(mi.UInt32, self.owners, place >> 4, cut) >> ((place & 15) << 1)
        owner = dr.select(cut, word & 3, 0)
        # As far as the word goes and the owner stays the same, and no further than the strip
        alike = dr.minimum(dr.tzcnt(word ^ (owner * 0x55555555)) >> 1, 16 - (place & 15))
        alike = dr.minimum(alike, dr.select(above, steps[1], self.overlap) - column)
        for k, bit in enumerate((BEFORE_Y, BEFORE_X)):
            before = (owner & bit) != 0
            cell = dr.select(cells[k] == 0, self.count, cells[k]) - 1
            begin = dr.gather(mi.UInt32, axis.starts, cell, before)
            end = dr.gather(mi.UInt32, axis.starts, cell + 1, before)
            offsets[k] = offsets[k] + dr.select(before, end - begin, 0)
            cells[k] = dr.select(before, cell, cells[k])
        patch = dr.gather(mi.UInt32, self.patch, cells[0] * self.count + cells[1], active)
        origin = dr.gather(mi.Vector2u, self.origins, patch, active)
        source = (origin.x + offsets[0]) * self.width + origin.y + offsets[1]
        return source, dr.select(cut, alike, steps[1] - column)


def _packed_owners(owners: np.ndarray) -> np.ndarray:
    """Numbers from 0 to 3, sixteen to a word, the first lowest."""
    flat = owners.ravel().astype(np.uint32)
    words = np.append(flat, np.zeros(-len(flat) % 16, np.uint32)).reshape(-1, 16)
    return np.bitwise_or.reduce(words << (2 * np.arange(16, dtype=np.uint32)), axis=1)
