"""Tables of a sample's normals, for large footprints on a map that is made of its patches.

The sample is divided into blocks of B×B quads. A table says how the normals of a block spread over
a grid of bins in the plane of projected normals, M_b(bin): those of the quads' triangles, as in
:mod:`~glintbsdf.pndf.manifold.tables`, spread once more by the intrinsic roughness σ_r. A footprint
of kernel k on the large map sees the blocks through the patches under it, and

    D(m) = Σ_patches Σ_b k(u_b − x) B² w_b M_b(bin of m) / area of a bin,

u_b the block's centre in the patch, and w_b the share of it that the patch owns. A quad on a seam
belongs to the owners of its corners, a quarter to each, so all shares add up to one.

Blocks widen the footprint, which is taken off its variance. What is left is the error of seams,
whose quads are not those of any patch, and that of a kernel which is constant over a block. Both
fall with the footprint's size, and are measured when the tables are built (:func:`calibrated`).
From some size on a footprint sees so much of the map that the table of the whole map does.

A sample takes a point of the footprint, the block there with the patch that owns it, a quad of the
block, a point of the quad, and a place in the bin of its normal, spread by σ_r: this density.
"""

from __future__ import annotations

from math import log2, pi, sqrt
from types import SimpleNamespace

import drjit as dr
import mitsuba as mi
import numpy as np

from glintbsdf.core.hashing import pcg3d, uniform
from glintbsdf.core.loops import symbolic_loop
from glintbsdf.core.opaque import opaque
from glintbsdf.footprint.gaussian import Footprint
from glintbsdf.footprint.kernels import TexelKernel
from glintbsdf.footprint.lattice import floor_int
from glintbsdf.maps.quilting import Synthesis
from glintbsdf.pndf.elements.elements import FADE, mass_under_fade
from glintbsdf.pndf.gaussian_elements import SIGMA_H
from glintbsdf.pndf.index.lists import Packed
from glintbsdf.pndf.manifold.mesh import normal_in_quad, triangles_of_quad
from glintbsdf.pndf.manifold.tables import BINS, MIN_BIN, Bins
from glintbsdf.pndf.mip.patches import PatchTable, owner_cells

#: Sides of the blocks of all levels, quads: of a small sample, and of one that has more texels than
#: :data:`LARGE`. Powers of two.
SIDES, SIDES_LARGE, LARGE = (1, 8), (2, 16), 1 << 17

#: Bits of an entry for the logarithm of its mass.
MASS = 7

#: Smallest |det J| of the triangles whose normals are spread.
EPSILON = 1e-6

#: Elements half a texel apart reach beyond their quad: to have the variance of their places, a
#: quad's triangles are enlarged so much about its middle.
ENLARGED = sqrt(12 * (SIGMA_H**2 / 4 + 1 / 16))

#: Smallest bins, in units of σ_r.
PER_ROUGHNESS = 3

#: Share of the roughness' Gaussian beyond the reach of its discrete kernel, at most.
TAIL = 0.1

#: ρ² at which blocks are cut.
CUT = 10.0

#: Variance over that of the footprint with which the sampler proposes points, and its attempts;
#: three in five succeed.
WIDER, MAX_ATTEMPTS = 1.3, 64

#: Standard deviations of footprints (texels) at which errors are measured, and number of places.
SIGMAS, PLACES = (2.0, 3.0, 4.5, 7.0, 10.0, 14.0, 20.0, 28.0, 40.0), 16

#: The smallest map, texels along an axis, at which errors can be measured.
SMALLEST = 32

#: What is predicted over what is measured against the map's mesh, as its elements differ from it.
MARGIN = 2.5


# ------------------------------------------------------------------------------------------------
#  Normals of quads, and their roughness
# ------------------------------------------------------------------------------------------------


def roughness_kernel(variance: float) -> np.ndarray:
    """Weights of a discrete kernel of this variance, in bins.

    They are e^−t I_k(t), the kernel that repeated steps to the next bin tend to, cut at
    :data:`TAIL`, with t such that the variance is right.
    """
    from scipy.special import ive

    reach = 1
    # An even kernel of this reach has at least a third more variance
    while (
        1 - ive(np.arange(-reach, reach + 1), variance).sum() > TAIL
        or reach * (reach + 1) < 4 * variance
    ):
        reach += 1
    steps = np.arange(-reach, reach + 1)
    low, high = variance, 100 * variance
    for _ in range(60):
        t = 0.5 * (low + high)
        weights = ive(np.abs(steps), t)
        weights = weights / weights.sum()
        low, high = (t, high) if (weights * steps**2).sum() < variance else (low, t)
    return weights


def enlarged(corners) -> list:
    """A quad's corner normals n0…n3 :data:`ENLARGED` about its middle, (n1 + n2)/2."""
    middle = 0.5 * (corners[1] + corners[2])
    return [middle + ENLARGED * (n - middle) for n in corners]


def bins_of(normals: np.ndarray, sigma_r: float) -> tuple[Bins, list[np.ndarray]]:
    """Bins for the normals of a sample (h×w×2), and the roughness' kernels along x and y.

    Over the range of the normals there are :data:`~.BINS` of them along each axis, unless they
    would be too small; and more around it, as elements reach beyond.
    """
    lower, upper = (f(normals, axis=(0, 1)).astype(float) for f in (np.min, np.max))
    size = np.maximum((upper - lower) / BINS, max(MIN_BIN, sigma_r / PER_ROUGHNESS))
    kernels = [roughness_kernel((sigma_r / s) ** 2) for s in size]
    corners = np.stack(enlarged(np.moveaxis(quads_of(normals), 1, 0)))
    beyond = np.maximum(lower - corners.min(axis=(0, 1)), corners.max(axis=(0, 1)) - upper)
    # One more bin against rounding
    margin = size * (np.ceil(beyond / size) + [len(k) // 2 + 1 for k in kernels])
    return Bins((lower - margin, upper + margin), size), kernels


def roughened(bins: Bins, kernels: list[np.ndarray]) -> list:
    """The matrices (bins, bins) that spread rows of masses by the roughness, along x and y."""
    from scipy.sparse import diags, identity, kron

    def along(kernel, count):
        reach = len(kernel) // 2
        return diags(list(kernel), range(-reach, reach + 1), shape=(count, count), format="csr")

    across = kron(identity(bins.rows), along(kernels[0], bins.columns), format="csr")
    down = kron(along(kernels[1], bins.rows), identity(bins.columns), format="csr")
    return [across.astype(np.float32), down.astype(np.float32)]


def spread_of_quads(normals: np.ndarray, bins: Bins):
    """How the normals of quads (N×4×2, corners n0…n3) spread over the bins: (N, bins)."""
    corners = [mi.Vector2f(np.ascontiguousarray(normals[:, k].T)) for k in range(4)]

    def triangles(row, column, active):
        gathered = [dr.gather(mi.Vector2f, n, mi.UInt32(column), active) for n in corners]
        return triangles_of_quad(enlarged(gathered), EPSILON)

    index = np.arange(len(normals), dtype=np.int32)
    return bins.rasterize(triangles, np.zeros_like(index), index)


def quads_of(normals: np.ndarray) -> np.ndarray:
    """Corner normals of all quads of a sample (h×w×2), N×4×2."""
    corners = normals[:-1, :-1], normals[:-1, 1:], normals[1:, :-1], normals[1:, 1:]
    return np.stack(corners, axis=2).reshape(-1, 4, 2)


def shown(synthesis: Synthesis) -> np.ndarray:
    """How often the map shows every quad of the sample, as that of its first corner."""
    columns, shape = np.arange(synthesis.size), synthesis.normals.shape[:2]
    bands = np.array_split(columns, len(synthesis.patch))
    counts = np.zeros(np.prod(shape), np.int64)
    for band in bands:
        source = synthesis.source(*np.broadcast_arrays(band[:, None], columns))
        counts += np.bincount(source.ravel(), minlength=len(counts))
    return counts.reshape(shape)[:-1, :-1].ravel()


# ------------------------------------------------------------------------------------------------
#  Blocks
# ------------------------------------------------------------------------------------------------


def first_block(origin, side: int, shift: int | None = None):
    """The block with the quad before a patch's first; blocks begin ``side`` quads before the
    sample, whose border is repeated. On the device ``shift`` is log2 of the side."""
    return (origin + side - 1) // side if shift is None else (origin + side - 1) >> shift


def tile_of(side: int) -> tuple[int, int]:
    """Blocks of a tile along y and x, powers of two. Tiles of large blocks are no wider than
    patches are, of small ones as large as an entry can tell."""
    return (16, 32) if side <= 2 else (4, 8)


def octaves(side: int) -> float:
    """Octaves that the masses of blocks span; what is less is left out, 1e-3 of all. A larger block
    spreads its normals over more bins."""
    return 12.0 + 2 * log2(side)


class Tiles:
    """How the blocks of a level are numbered: tile by tile, row by row in each.

    Args:
        shape (pair of ints): quads of the sample along y and x.
        side (int): side of a block, quads.

    Attributes:
        blocks, tiles (pairs of ints): their numbers along y and x.
    """

    def __init__(self, shape: tuple[int, int], side: int) -> None:
        self.shape, self.side, self.tile = shape, side, tile_of(side)
        self.blocks = tuple(-(-(n + side) // side) for n in shape)
        self.tiles = tuple(-(-n // t) for n, t in zip(self.blocks, self.tile, strict=True))

    @property
    def count(self) -> int:
        """Numbers in use, and between them."""
        return int(np.prod(self.tiles) * np.prod(self.tile))

    def number(self, y: np.ndarray, x: np.ndarray) -> np.ndarray:
        """Number of the block in a row and a column."""
        height, width = self.tile
        tile = y // height * self.tiles[1] + x // width
        return (tile * height + y % height) * width + x % width

    def average(self, quads):
        """Mean masses of the quads of blocks, (blocks, bins), of those of ``quads``."""
        from scipy.sparse import csr_matrix

        rows, columns = (np.clip(np.arange(-self.side, n), 0, n - 1) for n in self.shape)
        y, x = np.meshgrid(np.arange(len(rows)), np.arange(len(columns)), indexing="ij")
        block = self.number(y // self.side, x // self.side).ravel()
        quad = (rows[y] * self.shape[1] + columns[x]).ravel()
        share = 1 / np.bincount(block)[block].astype(np.float32)
        return csr_matrix((share, (block, quad)), (self.count, quads.shape[0])) @ quads


def shares_of_cell(synthesis: Synthesis, cell: tuple[int, int], side: int) -> np.ndarray:
    """What of a block a cell's patch owns, k×k, in units of 1/:data:`ALL`.

    The first one is the :func:`first_block`.
    """
    starts, overlap, size = synthesis.starts, synthesis.overlap, synthesis.size
    blocks = blocks_of_patch(synthesis, side)
    reach = side * blocks
    rows, columns = (np.arange(starts[c], starts[c + 1] + overlap) % size for c in cell)
    owner = owner_cells(synthesis, rows, columns)
    mine = owner == cell[0] * len(synthesis.patch) + cell[1]
    origin = synthesis.origins[synthesis.patch[cell]]
    y, x = origin + side - side * first_block(origin, side)
    window = np.zeros((reach + 1, reach + 1), np.float32)
    window[y : y + mine.shape[0], x : x + mine.shape[1]] = mine
    # A corner that two quads of a block share along an axis counts twice
    weights = np.array([1, *[2] * (side - 1), 1], np.float32) / (2 * side)
    window = sum(w * window[k : k + reach : side] for k, w in enumerate(weights))
    window = sum(w * window[:, k : k + reach : side] for k, w in enumerate(weights))
    return np.round(ALL * window).astype(np.uint8)


#: The share that stands for a whole block; all shares of blocks of 2×2 quads are whole numbers.
ALL = 240


def blocks_of_patch(synthesis: Synthesis, side: int) -> int:
    """Blocks along an axis that a patch may touch."""
    longest = int(np.diff(synthesis.starts).max())
    return -(-(longest + synthesis.overlap + 2 * side) // side)


def packed_shares(synthesis: Synthesis, side: int) -> np.ndarray:
    """The shares of all cells, four to a word: (cells, words)."""
    cells, count = len(synthesis.patch), blocks_of_patch(synthesis, side) ** 2
    result = np.zeros((cells * cells, -(-count // 4)), np.uint32)
    shifts = 8 * np.arange(4, dtype=np.uint32)
    for k, cell in enumerate(np.ndindex(cells, cells)):
        shares = np.zeros(4 * result.shape[1], np.uint32)
        shares[:count] = shares_of_cell(synthesis, cell, side).ravel()
        result[k] = np.bitwise_or.reduce(shares.reshape(-1, 4) << shifts, axis=1)
    return result


def pack(tables, tiles: Tiles) -> dict[str, np.ndarray]:
    """The entries of tables (blocks, bins; CSR), ordered by bin, tile and place.

    An entry is the block's place in its tile, and the mass as a logarithm.
    """
    span = octaves(tiles.side)
    tables.data[tables.data < 2.0**-span] = 0
    tables.eliminate_zeros()
    total = np.asarray(tables.sum(axis=1)).ravel()
    by_bin = tables.tocsc()
    mass = by_bin.data / total[by_bin.indices]
    code = np.round(-np.log2(mass) * (((1 << MASS) - 1) / span))
    code = np.clip(code, 0, (1 << MASS) - 1).astype(np.uint16)
    tile, place = divmod(by_bin.indices, int(np.prod(tiles.tile)))
    per_bin, starts = int(np.prod(tiles.tiles)), by_bin.indptr
    bins = np.repeat(np.arange(len(starts) - 1), np.diff(starts))
    counts = np.bincount(bins * per_bin + tile, minlength=(len(starts) - 1) * per_bin)
    offsets = np.zeros((len(starts) - 1, per_bin + 1), np.int64)
    offsets[:, 1:] = np.cumsum(counts.reshape(-1, per_bin), axis=1)
    return {
        "starts": starts[:-1].astype(np.uint32),
        "offsets": offsets.astype(np.uint16 if offsets.max() < 1 << 16 else np.uint32),
        "entries": place.astype(np.uint16) << MASS | code,
    }


def build(synthesis: Synthesis, sigma_r: float) -> dict[str, np.ndarray]:
    """The arrays of :class:`Tables`.

    ``bounds`` (2, 2), ``size`` (2): of the bins; ``kernel_x``, ``kernel_y``: of the roughness;
    ``rows`` (bins): the number of a bin among the filled ones; ``whole`` (bins): masses of the
    whole map; ``sides`` (levels); ``errors`` (levels + 1, sigmas): see :func:`calibrated`; and for
    every level, with its side as suffix, what :func:`pack` returns, and, unless the side is 1,
    ``shares`` and ``blocks``, see :func:`packed_shares`.
    """
    sample = synthesis.normals
    shape = sample.shape[0] - 1, sample.shape[1] - 1
    bins, kernels = bins_of(sample, sigma_r)
    rough = roughened(bins, kernels)
    quads = spread_of_quads(quads_of(sample), bins)
    seen = shown(synthesis)
    whole = quads.T @ (seen / seen.sum())
    for matrix in rough:
        whole = matrix.T @ whole
    used = quads.T @ np.ones(quads.shape[0], np.float32)
    for matrix in rough:
        used = matrix.T @ used
    filled = np.flatnonzero(used > 0)
    rows = np.full(len(used), EMPTY, np.uint32)
    rows[filled] = np.arange(len(filled))

    arrays: dict[str, np.ndarray] = {}
    levels = []
    for side in SIDES_LARGE if sample.shape[0] * sample.shape[1] > LARGE else SIDES:
        tiles = Tiles(shape, side)
        normals = tiles.average(quads)
        levels.append(SimpleNamespace(side=side, normals=normals, tiles=tiles))
        packed = pack((normals @ rough[0] @ rough[1])[:, filled], tiles)
        if side > 1:
            packed["shares"] = packed_shares(synthesis, side)
            packed["blocks"] = np.array(blocks_of_patch(synthesis, side))
        arrays |= {f"{name}_{side}": value for name, value in packed.items()}
    return arrays | {
        "bounds": np.array([bins.lower, bins.lower + bins.size * (bins.columns, bins.rows)]),
        "size": bins.size,
        "kernel_x": kernels[0],
        "kernel_y": kernels[1],
        "rows": rows,
        "whole": whole.astype(np.float32),
        "sides": np.array([level.side for level in levels]),
        "errors": calibrated(synthesis, bins, quads, levels, rough, seen / seen.sum()),
    }


#: In place of the number of a bin that no normal falls into.
EMPTY = 0xFFFFFFFF


# ------------------------------------------------------------------------------------------------
#  Errors
# ------------------------------------------------------------------------------------------------


def calibrated(synthesis: Synthesis, bins: Bins, quads, levels, rough, seen) -> np.ndarray:
    """Predicted relative L1 errors over the bins of all levels, the whole map's table last: (levels
    + 1, sigmas), the mean under round footprints of the standard deviations :data:`SIGMAS` at some
    places, and a margin.

    The truth takes every quad of the large map with its own corners.
    """
    rng = np.random.default_rng(0)
    # Footprints that fit on the map; those of the largest one stand for larger ones
    sigmas = [s for s in SIGMAS if 2 * (s * CUT**0.5 + 3) < synthesis.size]
    footprints = [
        (rng.random(2) * synthesis.size, sigma) for sigma in sigmas for _ in range(PLACES)
    ]
    of_quads, corners, of_seams = zip(
        *(quads_under(synthesis, *f, quads.shape[0]) for f in footprints), strict=True
    )
    seams, ends = spread_of_quads(np.concatenate(corners), bins), np.cumsum([*map(len, of_seams)])
    truth = quads.T @ np.stack(of_quads, axis=1)
    for k, weights in enumerate(of_seams):
        truth[:, k] += seams[ends[k] - len(weights) : ends[k]].T @ weights
    difference = [
        level.normals.T @ np.stack([blocks_under(synthesis, *f, level) for f in footprints], axis=1)
        - truth
        for level in levels
    ]
    difference.append((quads.T @ seen)[:, None] - truth)
    errors = []
    for masses in difference:
        for matrix in rough:
            masses = matrix.T @ masses
        errors.append(np.abs(masses).sum(axis=0).reshape(len(sigmas), PLACES).mean(axis=1))
    larger = len(SIGMAS) - len(sigmas)
    return MARGIN * np.pad(errors, [(0, 0), (0, larger)], mode="edge")


def quads_under(synthesis: Synthesis, centre, sigma: float, count: int) -> tuple:
    """What a round footprint sees of the map: ``(masses of the sample's quads, corner normals of
    the quads on seams, their masses)``. ``centre`` (x, y): texels from the first one's centre."""
    size, (height, width, _) = synthesis.size, synthesis.normals.shape
    reach = int(sigma * CUT**0.5) + 2
    x, y = (np.arange(-reach, reach + 1) + int(c) for c in centre)
    weight = faded(y + 0.5 - centre[1], x + 0.5 - centre[0], sigma**2 + 1 / 12)
    weight = (weight / weight.sum()).astype(np.float32)
    at, beside, below, across = (
        synthesis.source(*np.broadcast_arrays((y[:, None] + j) % size, (x + i) % size))
        for j in (0, 1)
        for i in (0, 1)
    )
    seam = (beside != at + 1) | (below != at + width) | (across != at + width + 1)
    row, column = divmod(at, width)
    quad = np.minimum(row, height - 2) * (width - 1) + np.minimum(column, width - 2)
    texels = synthesis.normals.reshape(-1, 2)
    corners = np.stack([texels[v[seam]] for v in (at, beside, below, across)], axis=1)
    masses = np.bincount(quad[~seam], weight[~seam], count).astype(np.float32)
    return masses, corners, weight[seam]


def blocks_under(synthesis: Synthesis, centre, sigma: float, level) -> np.ndarray:
    """The masses of the sample's blocks under a round footprint, see :func:`quads_under`."""
    size, side = synthesis.size, level.side
    masses = np.zeros(level.tiles.count, np.float32)
    variance = sigma**2 + (2 - side**2) / 12
    if variance < 0.5 * sigma**2:  # too small a footprint for such blocks
        return masses
    reach = int(sigma * CUT**0.5) + side + 2
    margin = reach + synthesis.overlap
    cell_x, cell_y = (
        np.unique(synthesis.cell_of[(np.arange(-margin, reach + 1) + int(c)) % size])
        for c in centre
    )
    for cell in ((y, x) for y in cell_y for x in cell_x):
        code, index, offsets = shares_of_cell(synthesis, cell, side), [], []
        for k, u in enumerate(centre[::-1]):
            origin = synthesis.origins[synthesis.patch[cell], k]
            block = first_block(origin, side) + np.arange(len(code))
            index.append(np.minimum(block, level.tiles.blocks[k] - 1))  # nothing is owned beyond
            offset = (block - 0.5) * side - origin + synthesis.starts[cell[k]] - u
            offsets.append((offset + size / 2) % size - size / 2)
        weight = code / ALL * faded(offsets[0], offsets[1], variance)
        np.add.at(masses, level.tiles.number(index[0][:, None], index[1]), weight)
    return masses / masses.sum()


def faded(y: np.ndarray, x: np.ndarray, variance: float) -> np.ndarray:
    """The kernel at rows × columns, faded until it is cut, but for a factor."""
    distance = (y[:, None] ** 2 + x**2) / variance
    return np.exp(-0.5 * distance) * np.clip((CUT - distance) / FADE, 0, 1)


def smallest_with(errors: np.ndarray, allowed: float) -> float:
    """The standard deviation from which on errors, given at :data:`SIGMAS`, are allowed."""
    beyond = np.flatnonzero(errors > allowed)
    if len(beyond) == 0:
        return SIGMAS[0]
    k = int(beyond[-1])
    if k + 1 == len(SIGMAS):  # independent places average out
        return float(SIGMAS[k] * errors[k] / allowed)
    share = np.log(errors[k] / allowed) / np.log(errors[k] / errors[k + 1])
    return float(SIGMAS[k] * (SIGMAS[k + 1] / SIGMAS[k]) ** share)


def interpolated(errors: np.ndarray, sigma: mi.Float) -> mi.Float:
    """The error at a standard deviation, texels, from those at :data:`SIGMAS`."""
    logs, x = np.log(SIGMAS), dr.log(sigma)
    value = opaque(mi.Float, float(np.log(errors[0])))
    for k, step in enumerate(np.diff(logs)):
        part = dr.clip((x - float(logs[k])) * float(1 / step), 0, 1)
        value = dr.fma(part, opaque(mi.Float, float(np.log(errors[k + 1] / errors[k]))), value)
    return dr.exp(value - dr.maximum(x - float(logs[-1]), 0))


# ------------------------------------------------------------------------------------------------
#  Queries
# ------------------------------------------------------------------------------------------------


class Level:
    """The blocks of one size.

    Attributes:
        side (int): side of a block, quads.
        shift (int): its logarithm to the base 2.
    """

    def __init__(self, arrays: dict, shape: tuple[int, int], side: int) -> None:
        self.side, self.shift = side, int(log2(side))
        self.down, self.across = (int(log2(side * n)) for n in tile_of(side))
        take = {name: arrays.pop(f"{name}_{side}") for name in ("starts", "offsets", "entries")}
        self.starts = mi.UInt32(take["starts"])
        self.tiles = opaque(mi.UInt32, take["offsets"].shape[1])
        self.tiles_x = opaque(mi.Int, Tiles(shape, side).tiles[1])
        self.offsets, self.entries = (Packed(take[k].ravel()) for k in ("offsets", "entries"))
        self.nbytes = self.offsets.nbytes + self.entries.nbytes + 4 * dr.width(self.starts)
        self.shares = None
        if side > 1:
            shares = arrays[f"shares_{side}"]
            self.shares, self.words = mi.UInt32(shares.ravel()), opaque(mi.UInt32, shares.shape[1])
            self.blocks = opaque(mi.Int, int(arrays[f"blocks_{side}"]))
            self.nbytes += shares.nbytes

    def share(self, table: PatchTable, patch, block_y, block_x, active) -> mi.Float:
        """What of a block a patch owns."""
        if self.shares is None:
            return table.quarters(patch, block_y - 1, block_x - 1, active)
        y, x = (
            b - first_block(o, self.side, self.shift)
            for b, o in zip((block_y, block_x), patch.origin, strict=True)
        )
        inside = active & (y >= 0) & (x >= 0) & (y < self.blocks) & (x < self.blocks)
        index = mi.UInt32(y * self.blocks + x)
        word = mi.UInt32(patch.cell[0] * table.count + patch.cell[1]) * self.words + (index >> 2)
        word = dr.gather(mi.UInt32, self.shares, word, inside)
        return mi.Float(dr.select(inside, (word >> ((index & 3) << 3)) & 0xFF, 0)) * (1 / ALL)

    def mass(self, table: PatchTable, kernel: TexelKernel, row: mi.UInt32, active) -> mi.Float:
        """Σ k(u_b − x) B² w_b M_b of a bin, where k(0) = 1; ``row``: number of the bin."""
        mean, side, (height, width) = mi.Vector2f(kernel.mean), self.side, tile_of(self.side)
        start = dr.gather(mi.UInt32, self.starts, row, active)

        def visit(patch, group, first, last, active, mass):
            tile_y = (group + side) >> self.down
            last = (last + side) >> self.across
            first_of_row = row * self.tiles + mi.UInt32(tile_y * self.tiles_x)

            def add_tile(tile_x, mass):
                found = active & (tile_x <= last)
                begin, end = (
                    start + self.offsets[first_of_row + mi.UInt32(tile_x + k), found]
                    for k in (0, 1)
                )

                def add_entry(entry, mass):
                    inside = found & (entry < end)
                    word = self.entries[entry, inside]
                    place = word >> MASS
                    block_y = tile_y * height + mi.Int(place // width)
                    block_x = tile_x * width + mi.Int(place % width)
                    # From the middle of the block, as quads have their corners on texels
                    offset = patch.on_map((block_y - 1) * side, (block_x - 1) * side)
                    distance = dr.squared_norm(kernel.whitened(offset + 0.5 * side - mean))
                    weight = dr.exp(-0.5 * distance) * dr.clip((CUT - distance) / FADE, 0, 1)
                    weight = weight * self.share(table, patch, block_y, block_x, inside)
                    code = mi.Float(word & ((1 << MASS) - 1))
                    value = dr.exp2(code * (-octaves(side) / ((1 << MASS) - 1)))
                    return entry + 1, mass + dr.select(inside, weight * value, 0)

                _, mass = symbolic_loop(
                    (begin, mass), lambda entry, _: found & (entry < end), add_entry, "blocks"
                )
                return tile_x + 1, mass

            state = ((first + side) >> self.across, mass)
            return symbolic_loop(
                state, lambda tile_x, _: active & (tile_x <= last), add_tile, "tiles"
            )[1]

        mass = table.walk(kernel, self.down, side, (1, -1), visit, active, mi.Float(0))
        return side**2 * mass


class Tables:
    """The tables on the device, of the arrays that :func:`build` makes.

    Args:
        table (PatchTable): which patch owns what.
        shape (pair of ints): quads of the sample along y and x.
        max_error (float): relative L1 error allowed, > 0.

    Attributes:
        levels (list of Level): blocks from small to large.
        smallest (list of float): standard deviations of footprints (texels) from which on each of
            the levels is allowed, and then the table of the whole map.
    """

    def __init__(
        self, arrays: dict, table: PatchTable, shape: tuple[int, int], max_error: float
    ) -> None:
        self.table = table
        self.bins = Bins(arrays["bounds"], arrays["size"])
        self.rows, self.whole = mi.UInt32(arrays["rows"]), mi.Float(arrays["whole"])
        self.levels = [Level(arrays, shape, int(side)) for side in arrays["sides"]]
        self.errors = arrays["errors"]
        self.smallest = [smallest_with(errors, max_error) for errors in self.errors]
        self.cumulated = [mi.Float(np.cumsum(arrays[f"kernel_{axis}"])) for axis in "xy"]
        self.shape = [opaque(mi.Int, n) for n in shape]
        self.nbytes = sum(level.nbytes for level in self.levels)
        self.nbytes += 4 * (dr.width(self.rows) + dr.width(self.whole))
        # For kernels, which are the same for all maps
        self.thresholds = [opaque(mi.Float, s) for s in self.smallest]
        self.per_area = opaque(mi.Float, 1 / self.bins.area)

    def level(self, kernel: TexelKernel) -> mi.Int:
        """What answers a footprint (texels): the coarsest level that may, the number of levels for
        the table of the whole map, −1 for none of them."""
        minor = dr.sqrt(kernel.minor_variance)
        level = mi.Int(-1)
        for k, smallest in enumerate(self.thresholds[:-1]):
            level = dr.select(minor >= smallest, k, level)
        # As many places are seen under a long footprint as under a round one of its area
        mean = dr.sqrt(kernel.sigma_u_given_v * kernel.sigma_v)
        return dr.select((level >= 0) & (mean >= self.thresholds[-1]), len(self.levels), level)

    def error(self, kernel: TexelKernel) -> mi.Float:
        """The relative L1 error predicted for a footprint, 0 where no table answers."""
        level, error = self.level(kernel), mi.Float(0)
        minor = dr.sqrt(kernel.minor_variance)
        mean = dr.sqrt(kernel.sigma_u_given_v * kernel.sigma_v)
        for k, errors in enumerate(self.errors):
            sigma = mean if k == len(self.levels) else minor
            error = dr.select(level == k, interpolated(errors, sigma), error)
        return error

    def kernel(
        self, footprint: Footprint, wrap_mode: str, side: int | mi.Int, served
    ) -> TexelKernel:
        """The kernel of blocks of a side, narrower than the footprint by what they add.

        Where it is not ``served`` it may be any.
        """
        size = mi.Float(self.table.size)
        added = dr.select(served, (2 - mi.Float(side) * mi.Float(side)) * (1 / 12), 1)
        kernel = TexelKernel("gaussian", footprint, size, size, wrap_mode, (added, added))
        kernel.cut_at(CUT**0.5)
        return kernel

    def eval(self, m: mi.Vector2f, footprint: Footprint, wrap_mode: str, level, active) -> mi.Float:
        """D(m) where ``level`` says that tables answer."""
        index, inside = self.bins.index(m)
        active = active & inside & (level >= 0)
        density = dr.gather(mi.Float, self.whole, index, active & (level == len(self.levels)))
        row = dr.gather(mi.UInt32, self.rows, index, active)
        active = active & (row != EMPTY)
        for k, of_level in enumerate(self.levels):
            served = active & (level == k)
            kernel = self.kernel(footprint, wrap_mode, of_level.side, served)
            mass = of_level.mass(self.table, kernel, row, served)
            density = density + mass / normalisation(kernel)
        return density * self.per_area

    def sample(
        self, of_sample, footprint: Footprint, wrap_mode: str, level, sample2, active
    ) -> mi.Vector2f:
        """Draw a projected normal with the density of :meth:`eval`.

        A point of the footprint tells a block in proportion to its share, and is accepted such that
        the kernel at the block's centre counts in place of that at the point. ``of_sample``: the
        elements of the sample, for the normals of quads.
        """
        active = active & (level >= 0)
        of_blocks = active & (level < len(self.levels))
        side, shift = mi.Int(1), mi.Int(0)
        for k, of_level in enumerate(self.levels):
            here = level == k
            side, shift = (
                dr.select(here, of_level.side, side),
                dr.select(here, of_level.shift, shift),
            )
        kernel = self.kernel(footprint, wrap_mode, side, of_blocks)
        bits = [dr.reinterpret_array(mi.UInt32, mi.Float(v)) for v in sample2]

        def random(k):
            return [uniform(v) for v in pcg3d(bits[0], bits[1], mi.UInt32(k))]

        # Points within a block are at most so far from its middle
        apart = dr.square(mi.Float(side)) * (0.5 / kernel.minor_variance)
        bound = apart * (0.5 / (WIDER - 1))

        def attempt(count, row, column, active):
            first, second = random(4 * count), random(4 * count + 1)
            z = mi.warp.square_to_std_normal(mi.Point2f(first[0], first[1])) * WIDER**0.5
            v = kernel.sigma_v * z.y
            offset = mi.Vector2f(dr.fma(kernel.shear, v, kernel.sigma_u_given_v * z.x), v)
            quad_y, quad_x, y, x = self.quad_at(kernel.mean + offset, second[0], active)
            row, column = ((q + side) >> shift for q in (quad_y, quad_x))
            from_quad = mi.Vector2f((column - 1) * side - quad_x, (row - 1) * side - quad_y)
            middle = mi.Vector2f(x, y) + from_quad + 0.5 * mi.Float(side) - kernel.mean
            far = dr.squared_norm(kernel.whitened(middle))
            chance = dr.exp(0.5 * (dr.squared_norm(z) * (1 / WIDER) - far) - bound)
            chance = chance * dr.clip((CUT - far) * (1 / FADE), 0, 1)
            accepted = second[1] < chance
            count = count + 1
            return count, row, column, active & ~accepted & (count < MAX_ATTEMPTS)

        start = (mi.UInt32(0), mi.Int(0), mi.Int(0), mi.Bool(of_blocks))
        count, row, column, _ = symbolic_loop(start, lambda *s: s[3], attempt, "block")

        place, of_quad, of_bin = (random(4 * count + k) for k in (2, 3, 4))
        anywhere = mi.Point2f(place[0], place[1]) * mi.Float(self.table.size)
        whole_y, whole_x, _, _ = self.quad_at(anywhere, mi.Float(0), active & ~of_blocks)
        quads = []
        for k, (block, u, whole) in enumerate(
            ((row, place[0], whole_y), (column, place[1], whole_x))
        ):
            # Of the quads of a block, those that there are
            there = dr.minimum(side, self.shape[k] + side - block * side)
            quad = (block - 1) * side + mi.Int(u * mi.Float(there))
            quads.append(dr.clip(dr.select(of_blocks, quad, whole), 0, self.shape[k] - 1))
        normals = enlarged(of_sample.corner_normals(*quads, active))
        m = normal_in_quad(of_quad[0], of_quad[1], normals, EPSILON)
        position = dr.floor(self.bins.place(m))
        steps = [
            self.step(cumulated, u)
            for cumulated, u in zip(self.cumulated, (of_quad[2], place[2]), strict=True)
        ]
        position = position + mi.Vector2f(*steps) + mi.Vector2f(of_bin[0], of_bin[1])
        return self.bins.corner + self.bins.extent * position

    def quad_at(self, position, choice: mi.Float, active) -> tuple:
        """The sample's quad (row, column) that a quad of the map at a position is for the owner of
        one of its corners, by ``choice``; and the quad's own place on the map (y, x)."""
        x, y = floor_int(position.x), floor_int(position.y)
        corner = mi.Int(choice * 4)
        down, across = corner >> 1, corner & 1
        size = self.table.size
        texels = []
        for texel in (y + down, x + across):
            turn = floor_int((mi.Float(texel) + 0.5) / mi.Float(size))
            texels.append(texel - turn * size)
        row, column = self.table.source(texels[0], texels[1], active)
        return row - down, column - across, y, x

    def step(self, cumulated: mi.Float, u: mi.Float) -> mi.Float:
        """A step of the roughness' kernel, in bins."""
        count = dr.width(cumulated)
        last = opaque(mi.UInt32, count - 1)
        found = symbolic_loop(
            (mi.UInt32(0), mi.Bool(True)),
            lambda k, active: active,
            lambda k, active: (
                dr.select(u >= dr.gather(mi.Float, cumulated, k), k + 1, k),
                active & (u >= dr.gather(mi.Float, cumulated, k)) & (k + 1 < last),
            ),
            "step",
        )[0]
        return mi.Float(found) - 0.5 * mi.Float(last)


def normalisation(kernel: TexelKernel) -> mi.Float:
    """∫ k over the plane, faded until it is cut, where k(0) = 1."""
    return 2 * pi * mass_under_fade(mi.Float(CUT)) * kernel.sigma_u_given_v * kernel.sigma_v
