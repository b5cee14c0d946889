"""The lattice of texels: the plane over which a finite map repeats, mirrors or stretches.

Texel (row i, column j) has its centre at the position (x, y) = (j, i). The quad (i, j) spans four
texels, (i, j) to (i+1, j+1): the plane is tiled by quads. Data per quad are stored for a
finite rectangle of quads, and this module gives the stored quad for any quad of the plane.
"""

from __future__ import annotations

from functools import cached_property

import drjit as dr
import mitsuba as mi
import numpy as np

from glintbsdf.core.alignment import aligned

#: Quads are grouped in square blocks of this side. A power of two.
BLOCK = 8


def floor_int(x):
    """The largest integer ≤ ``x``, as ``mi.Int``."""
    return mi.Int(dr.floor(x))


class LatticeAxis:
    """One axis of the lattice: ``texels`` texels, wrapped by ``wrap_mode``.

    Attributes:
        block (int): side of a block of quads, a power of two.
        quads (int): quads stored. ``repeat``: one period; ``mirror``: a period of 2 × ``texels``;
            ``clamp``: the map between two borders of whole blocks, which represent the constant
            strips beyond, which are infinite.
        source (int32 array of ``quads + 1``): the texel shown by each stored vertex.
    """

    def __init__(self, texels: int, wrap_mode: str, block: int = BLOCK) -> None:
        self.block = block
        self.clamped = wrap_mode == "clamp"
        if self.clamped:
            inner_blocks = -(-(block + texels - 1) // block)
            self.quads = (inner_blocks + 1) * block
            self.source = np.clip(np.arange(self.quads + 1) - block, 0, texels - 1)
        elif wrap_mode == "mirror":
            self.quads = 2 * texels
            index = np.arange(self.quads + 1) % self.quads
            self.source = np.minimum(index, self.quads - 1 - index)
        else:
            self.quads = texels
            self.source = np.arange(self.quads + 1) % self.quads
        self.blocks = -(-self.quads // block)

    @cached_property
    def count(self) -> mi.Int:
        """``quads`` for kernels, which are the same for maps of all sizes."""
        return dr.opaque(mi.Int, self.quads)

    @cached_property
    def inverse_count(self) -> mi.Float:
        """1/``quads`` for kernels."""
        return dr.opaque(mi.Float, 1 / self.quads)

    def locate(self, x):
        """Index of the stored quad for the position ``x`` (``mi.Int``, texels).

        Returns ``(origin, index, end)``: ``x = origin + index`` with ``index`` in [0, ``quads``),
        and all of [``index``, ``end``) is stored contiguously from this origin.
        """
        if not self.clamped:
            origin = floor_int((mi.Float(x) + 0.5) * self.inverse_count) * self.count
            return origin, x - origin, mi.Int(self.count)
        block = self.block
        last = self.count - block
        x = x + block
        before, after = x < 0, x >= last
        beyond = dr.select(before, x, dr.select(after, x - last, 0))
        origin = beyond & -block  # whole blocks, rounded down
        end = dr.select(before, block, dr.select(after, self.count, last))
        return origin - block, x - origin, end

    def touched_blocks(self, first: int, last: int) -> tuple[int, int]:
        """The stored blocks in which the positions from ``first`` to ``last`` (texels) lie.

        Returns the first and their number. Past the last stored block of a map that repeats or
        mirrors comes block 0.
        """
        if self.clamped:
            first = min(max(first + self.block, 0), self.quads - self.block)
            last = min(max(last + self.block, 0), self.quads - 1)
            if first < self.block:  # any place in the border represents all beyond
                first = 0
            if last >= self.quads - self.block:
                last = self.quads - 1
        else:
            if last - first >= self.quads - self.block:
                return 0, self.blocks
            first, last = first % self.quads, last % self.quads
        first, last = first // self.block, last // self.block
        return first, (last - first) % self.blocks + 1

    def following(self, x, index):
        """Index of the quad after ``x``, from the ``index`` of ``x``."""
        if self.clamped:
            return self.locate(x + 1)[1]
        return dr.select(index == self.count - 1, 0, index + 1)


class Lattice:
    """The lattice of a map of ``height`` × ``width`` texels.

    Vertices are stored in tiles of 4×2, one cache line of 64 bytes for two floats each: the 9×9
    vertices of a block of quads then lie in 15 lines instead of 20.

    Attributes:
        x, y (LatticeAxis): columns and rows.
        source (uint32 array): flat index of the texel shown by each stored vertex.
    """

    def __init__(self, height: int, width: int, wrap_mode: str) -> None:
        self.x, self.y = LatticeAxis(width, wrap_mode), LatticeAxis(height, wrap_mode)
        tiles = -(-(self.y.quads + 1) // 2), -(-(self.x.quads + 1) // 4)
        self.pitch = 8 * tiles[1]  # of a row of tiles
        rows = np.resize(self.y.source, 2 * tiles[0]).reshape(tiles[0], 1, 2, 1)
        columns = np.resize(self.x.source, 4 * tiles[1]).reshape(1, tiles[1], 1, 4)
        self.source = aligned((rows * width + columns).astype(np.uint32).ravel())

    @cached_property
    def row_pitch(self) -> mi.UInt32:
        """``pitch`` for kernels."""
        return dr.opaque(mi.UInt32, self.pitch)

    def corners(self, row, column):
        """Indices of the four vertices n0, n1, n2, n3 of a stored quad (``mi.UInt32``)."""
        row, column = mi.UInt32(row), mi.UInt32(column)
        return tuple(self.vertex(i, j) for i in (row, row + 1) for j in (column, column + 1))

    def vertex(self, row, column):
        """Index of the stored vertex at a row and a column (``mi.UInt32``)."""
        row, column = mi.UInt32(row), mi.UInt32(column)
        in_row = ((column >> 2) << 3) + (column & 3)
        return (row >> 1) * self.row_pitch + ((row & 1) << 2) + in_row

    def corner_values(self, vertices, row, column, active):
        """The four ``mi.Vector2f`` at a stored quad's vertices, of the flat array ``vertices``.

        Gathered number by number: as vectors they take a third more of a query's time on LLVM.
        """
        return [
            mi.Vector2f(
                *(dr.gather(mi.Float, vertices, 2 * mi.UInt32(i) + k, active) for k in (0, 1))
            )
            for i in self.corners(row, column)
        ]
