"""A large normal map put together from patches of a small sample, without storing it.

Tan, Zhu, Xu, Meng, Wang and Yan, "Real-Time Microstructure Rendering with MIP-mapped Normal Map
Samples" (2022), section 5.1.1, which follows the image quilting of Efros and Freeman (2001). The
method puts together the lobes of the sample's texels: each has a normal and its Jacobian. The large
map is divided into cells. Each cell shows a patch of the sample, which reaches into the next cells
by the overlap. There, a cut of least error (Eq. 7) decides to which patch each texel belongs.

The map itself never exists: it follows from the patch of every cell and, for the texels of the
overlaps, from whose patch they belong to. Arrays are indexed (row, column), in texels.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from itertools import product
from math import ceil, sqrt
from pathlib import Path

import numpy as np

from glintbsdf.core.errors import check, check_whole
from glintbsdf.core.progress import progress
from glintbsdf.maps.normalmap import NormalMap

#: Patches to choose from, in sample areas: each texel of the sample is in so many of them.
REUSE = 24

#: Cells up to which patches may not repeat what others show.
APART = 2

#: What the owner of a texel in an overlap is called: the cell before in x, in y, or both.
BEFORE_X, BEFORE_Y = 1, 2


def mesh_lobes(normals: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Mean normals and Jacobians of the lobes of a map, H×W×2 and H×W×2×2, per texel.

    One lobe per texel, in the middle between it and the next texels in x, in y and in both: there
    the triangle mesh of :mod:`~glintbsdf.reference` has the normal (n1 + n2)/2, and the mean
    Jacobian of the two triangles that meet. The last axis of Jacobians is (x, y) of the position.
    What lies beyond the last row and column is taken to be like them.
    """
    n = np.pad(normals, ((0, 1), (0, 1), (0, 0)), mode="edge")
    n0, n1, n2, n3 = n[:-1, :-1], n[:-1, 1:], n[1:, :-1], n[1:, 1:]
    jacobian = np.stack((n1 - n0 + n3 - n2, n2 - n0 + n3 - n1), axis=-1) / 2
    return (n1 + n2) / 2, jacobian


def lobe_features(normals: np.ndarray, balance: float) -> np.ndarray:
    """Vectors whose squared distance is Eq. 7, ``α |n_i − n_j|² + (1 − α) |J_i − J_j|²``: H×W×6."""
    mean, jacobian = mesh_lobes(normals)
    gradients = jacobian.reshape(*mean.shape[:2], 4)
    return np.concatenate((sqrt(balance) * mean, sqrt(1 - balance) * gradients), axis=2)


def minimum_error_cut(error: np.ndarray) -> np.ndarray:
    """The connected path of least total error down a strip, by dynamic programming.

    Args:
        error: N×L×W, the error of N strips, L texels long and W wide.

    Returns:
        N×L, the place of the path across the strip, in [0, W), which moves by at most one texel
        from each row to the next.
    """
    count, length, width = error.shape
    steps = np.empty((length, count, width), np.int8)
    total = error[:, 0]
    around = np.full((3, count, width), np.inf)  # straight on where it makes no difference
    for k in range(1, length):
        around[0], around[1, :, 1:], around[2, :, :-1] = total, total[:, :-1], total[:, 1:]
        steps[k] = np.array((0, -1, 1), np.int8)[around.argmin(axis=0)]
        total = error[:, k] + around.min(axis=0)
    path = np.empty((count, length), np.int64)
    path[:, -1] = total.argmin(axis=1)
    for k in range(length - 1, 0, -1):
        path[:, k - 1] = path[:, k] + steps[k][np.arange(count), path[:, k]]
    return path


@dataclass(frozen=True)
class Synthesis:
    """The look-up table: which texel of the sample each texel of the large map shows.

    Attributes:
        normals: h×w×2, projected normals of the sample, float32.
        size: texels of the map along each axis.
        overlap: texels by which patches reach into the next cells.
        toroidal: whether the map fits to itself when it is repeated.
        origins: P×2, places in the sample of the patches in use.
        patch: n×n, the patch of each cell.
        owners: n×n×L, for the texels of a cell's overlaps, whose patch they belong to: 0 for the
            cell's own, or the sum of :data:`BEFORE_X` and :data:`BEFORE_Y`. The texels are the
            first ``overlap`` rows of the cell, then the first columns of its other rows; L is
            their number in the largest cell.
        best_only: number of cells for which no patch was within the tolerance, so that the best
            was taken.
    """

    normals: np.ndarray
    size: int
    overlap: int
    toroidal: bool
    origins: np.ndarray
    patch: np.ndarray
    owners: np.ndarray
    best_only: int

    @classmethod
    def from_arrays(cls, normals, size: int, overlap: int, arrays) -> Synthesis:
        """The table again from :meth:`arrays`, for the same sample."""
        toroidal, best_only = (int(v) for v in arrays["numbers"])
        origins, patch, owners = (arrays[name] for name in ("origins", "patch", "owners"))
        return cls(normals, size, overlap, bool(toroidal), origins, patch, owners, best_only)

    def arrays(self) -> dict[str, np.ndarray]:
        """What to keep of the table, besides the sample, size and overlap."""
        return {
            "origins": self.origins,
            "patch": self.patch,
            "owners": self.owners,
            "numbers": np.array([self.toroidal, self.best_only]),
        }

    @cached_property
    def starts(self) -> np.ndarray:
        """Borders of the cells along an axis, n + 1 texel indices."""
        return cell_borders(self.size, len(self.patch))

    @cached_property
    def cell_of(self) -> np.ndarray:
        """Index along an axis of the cell that holds each texel row or column."""
        return np.repeat(np.arange(len(self.patch)), np.diff(self.starts))

    def source(self, row: np.ndarray, column: np.ndarray) -> np.ndarray:
        """Index (row · w + column) of the sample's texel that the map shows, for indices alike."""
        cell_y, cell_x = self.cell_of[row], self.cell_of[column]
        y, x = row - self.starts[cell_y], column - self.starts[cell_x]
        step = self.starts[cell_x + 1] - self.starts[cell_x]
        place = overlap_index(y, x, step, self.overlap)
        owner = np.where(place >= 0, self.owners[cell_y, cell_x, place], 0)
        cell_y, y = self._owner_axis(cell_y, y, owner & BEFORE_Y)
        cell_x, x = self._owner_axis(cell_x, x, owner & BEFORE_X)
        origin = self.origins[self.patch[cell_y, cell_x]]
        return (origin[..., 0] + y) * self.normals.shape[1] + origin[..., 1] + x

    def _owner_axis(self, cell, offset, before):
        """Cell of the owner, and the offset from its start, along one axis."""
        owner = np.where(before, (cell - 1) % len(self.patch), cell)
        step = self.starts[owner + 1] - self.starts[owner]
        return owner, np.where(before, offset + step, offset)

    def explicit(self) -> np.ndarray:
        """The whole map, size×size×2 projected normals: as large as what is saved by not storing
        it."""
        index = np.arange(self.size)
        texels = self.normals.reshape(-1, 2)
        result = np.empty((self.size, self.size, 2), np.float32)
        for rows in np.array_split(index, len(self.patch)):
            result[rows] = texels[self.source(*np.broadcast_arrays(rows[:, None], index))]
        return result

    def normal_map(self) -> NormalMap:
        """The whole map, repeating where it was made to."""
        return NormalMap(self.explicit(), "repeat" if self.toroidal else "mirror")

    def write(self, filename: str | Path) -> None:
        """Write the whole map to an OpenEXR file, channels R, G, B = (x, y, z), float32."""
        import OpenEXR

        normals = self.explicit()
        z = np.sqrt(1 - np.einsum("ijk,ijk->ij", normals, normals, dtype=np.float64))
        channels = {"RGB": np.dstack((normals, z.astype(np.float32)))}
        header = {"compression": OpenEXR.ZIP_COMPRESSION, "type": OpenEXR.scanlineimage}
        with OpenEXR.File(header, channels) as file:
            file.write(str(filename))

    @property
    def nbytes(self) -> int:
        """Memory of the table, bytes, with the owners packed to two bits each."""
        return self.origins.size * 4 + self.patch.size * 4 + self.owners.size // 4

    def __str__(self) -> str:
        height, width, _ = self.normals.shape
        return (
            f"{width}×{height} texels made {self.size}×{self.size} by {self.patch.size} cells "
            f"with {len(self.origins)} patches; in {self.best_only} cells "
            f"({self.best_only / self.patch.size:.0%}) no patch was within the tolerance, and the "
            "best was taken"
        )


def cell_borders(size: int, count: int) -> np.ndarray:
    """Borders of ``count`` cells as equal as whole texels allow: ``count + 1`` indices."""
    return np.arange(count + 1) * size // count


def overlap_index(y, x, step_x, overlap: int):
    """Place of a cell's texel in the cell's list of overlap texels, or −1 inside.

    ``y``, ``x``: from the cell's first texel; ``step_x``: the cell's width. See
    :attr:`Synthesis.owners`.
    """
    beside = np.where(x < overlap, overlap * step_x + (y - overlap) * overlap + x, -1)
    return np.where(y < overlap, y * step_x + x, beside)


def check_sizes(
    sample: tuple[int, int], output_size: int, patch_size: int, overlap: int | None, owner: str
) -> int:
    """Raise :class:`~.ParameterError` unless patches of that size fit.

    Returns the overlap: that given, or a tenth of a patch.
    """
    check_whole(
        patch_size,
        lambda size: 3 <= size < min(sample),
        owner,
        "patch_size",
        f"≥ 3 and smaller than the sample of {sample[1]} x {sample[0]} texels",
    )
    if overlap is None:
        overlap = max(1, patch_size // 10)
    check_whole(
        overlap,
        lambda size: 1 <= size < patch_size / 2,
        owner,
        "overlap",
        f"≥ 1 and smaller than half a patch of {patch_size} texels",
    )
    check_whole(
        output_size,
        lambda size: patch_size < size <= 1 << 16,
        owner,
        "output_size",
        f"larger than a patch of {patch_size} texels and at most {1 << 16}",
    )
    cell = output_size // cell_count(output_size, patch_size, overlap)
    check(
        overlap < cell,
        owner,
        "overlap",
        f"smaller than the {cell} texels of the cells that {output_size} texels are divided into",
        overlap,
    )
    return overlap


def cell_count(output_size: int, patch_size: int, overlap: int) -> int:
    """Cells along an axis: as few as patches can fill."""
    return ceil(output_size / (patch_size - overlap))


def synthesise(
    sample: NormalMap,
    output_size: int = 4096,
    patch_size: int = 64,
    overlap: int | None = None,
    balance: float = 0.9,
    tolerance: float = 1.0,
    toroidal: bool = True,
    seed: int = 0,
    owner: str = "synthesise",
) -> Synthesis:
    """Make a large map from patches of a sample (section 5.1.1, steps 1 to 6).

    Patches are chosen from :data:`REUSE` × sample area / patch area places in the sample, drawn at
    random, or from all places where there are fewer. Structures that are built per patch, as
    :class:`~.Mip` builds them, then stay small whatever the output's size. No cell shows much of
    what cells nearby show, for the eye is quick to find what repeats side by side.

    Args:
        sample: the small map.
        output_size: texels of the large map along each axis, larger than a patch.
        patch_size: texels of a patch along each axis, fewer than the sample's.
        overlap: texels that neighbouring patches share, 1 ≤ overlap < patch_size/2. The default is
            a tenth of a patch. (The paper has 2 texels of 64; then seams of smooth maps show.)
        balance: α of Eq. 7, in [0, 1]: 1 compares normals alone, 0 their Jacobians.
        tolerance: patches are chosen at random among those whose mean error over the overlap is at
            most this multiple of the mean error between neighbouring texels of the sample; where
            there is none, the best is taken.
        toroidal: make the map's opposite edges fit.
        seed: another one gives another map, in [0, 2⁶³).
        owner: the name that errors give.

    Raises :class:`~.ParameterError`.
    """
    overlap = check_sizes((sample.height, sample.width), output_size, patch_size, overlap, owner)
    check(0 <= balance <= 1, owner, "balance", "a number in [0, 1]", balance)
    check(0 <= tolerance < np.inf, owner, "tolerance", "a finite number ≥ 0", tolerance)
    check_whole(seed, lambda value: 0 <= value < 1 << 63, owner, "seed", "in [0, 2⁶³)")
    quilt = _Quilt(sample.normals, output_size, patch_size, overlap, balance, toroidal, seed)
    fronts = quilt.fronts()
    with progress("Synthesising the map") as report:
        for done, cells in enumerate(fronts):
            quilt.place(cells, tolerance)
            report((done + 1) / len(fronts))
    return quilt.result()


class _Quilt:
    """A map in the making: cells are filled front by front, none of whose cells touch."""

    def __init__(self, normals, size, patch_size, overlap, balance, toroidal, seed) -> None:
        self.normals, self.size, self.overlap, self.toroidal = normals, size, overlap, toroidal
        self.count = cell_count(size, patch_size, overlap)
        self.starts = cell_borders(size, self.count)
        self.steps = np.diff(self.starts)
        # Patches are cut to what the largest cell needs.
        self.side = int(self.steps.max()) + overlap

        rng = np.random.default_rng(seed)
        # The last row and column have no lobes of their own.
        places = (normals.shape[0] - self.side, normals.shape[1] - self.side)
        total = places[0] * places[1]
        wanted = ceil(REUSE * normals.shape[0] * normals.shape[1] / patch_size**2)
        chosen = rng.choice(total, min(total, wanted), replace=False)
        self.origins = np.stack(np.unravel_index(np.sort(chosen), places), axis=1)
        self.random = rng.random((self.count, self.count))

        self.features = lobe_features(normals, balance).astype(np.float32)
        inside = [np.diff(self.features, axis=axis) for axis in (0, 1)]
        self.inside_error = np.mean([np.mean((d**2).sum(axis=2)) for d in inside])

        self.patch = np.full((self.count, self.count), -1)
        self.owner = np.zeros((size, size), np.uint8)
        self.best_only = 0
        self.errors = [self.mean_errors(axis) for axis in (0, 1)]

    def mean_errors(self, axis: int) -> np.ndarray:
        """How any two patches fit side by side, by their mean error (Eq. 7) over the overlap.

        The result is an array (length, patch before, patch after): a patch is cut to one of two
        lengths. All that either patch shows there counts, though cuts with others may take a corner
        away. As these errors are known once and for all, choosing patches costs nothing.
        """
        first = self.overlaps(axis, 0)
        lengths = range(self.steps.min(), self.steps.max() + 1)
        squares, result = (first**2).sum(axis=1), []
        for last in (self.overlaps(axis, length) for length in lengths):
            # |a|² − 2 a·b + |b|²
            result.append((last**2).sum(axis=1)[:, None] - 2 * last @ first.T + squares)
        return np.maximum(result, 0) / (self.overlap * self.side)

    def overlaps(self, axis: int, start: int) -> np.ndarray:
        """Features that patches show in an overlap that starts so far along the axis, P × all."""
        extent = [np.arange(self.side)] * 2
        extent[axis] = start + np.arange(self.overlap)
        y, x = (self.origins[:, k, None] + extent[k] for k in (0, 1))
        return self.features[y[:, :, None], x[:, None, :]].reshape(len(self.origins), -1)

    def fronts(self) -> list[np.ndarray]:
        """Cells in an order in which those above, to the left and above right come first.

        The cells of one front are more than :data:`APART` cells from each other, also around the
        edges, and do not depend on each other. Where there are few cells, they come one by one.
        """
        y, x = np.indices((self.count, self.count)).reshape(2, -1)
        slope = APART + 1 if self.count > APART * (APART + 2) else self.count
        key = slope * y + x
        return [np.stack((y, x), axis=1)[key == k] for k in np.unique(key)]

    def place(self, cells: np.ndarray, tolerance: float) -> None:
        """Steps 3 to 5: choose patches for some cells, cut them to fit, and put them in place."""
        y, x = cells.T
        rows, columns = (self.starts[v, None] + np.arange(self.side) for v in (y, x))
        # (axis, whether the other cell comes after this one): the cells that overlap there
        sides = {(axis, False): np.flatnonzero(cells[:, axis] > 0) for axis in (0, 1)}
        if self.toroidal:
            last = cells == self.count - 1
            sides |= {(axis, True): np.flatnonzero(last[:, axis]) for axis in (0, 1)}

        error, count = np.zeros((len(cells), len(self.origins))), np.zeros(len(cells))
        for (axis, after), these in sides.items():
            error[these] += self.errors_beside(cells[these], axis, after)
            count[these] += 1
        mean = error / np.maximum(count, 1)[:, None]
        mean[self.repeats(y, x)] = np.inf
        allowed = mean <= tolerance * self.inside_error
        none = ~allowed.any(axis=1)
        self.best_only += int(none.sum())
        nth = (self.random[y, x] * allowed.sum(axis=1)).astype(int)
        chosen = np.where(
            none, mean.argmin(axis=1), (allowed.cumsum(axis=1) > nth[:, None]).argmax(axis=1)
        )

        # A cell may be a texel smaller than the patch allows for: what is beyond is not placed.
        in_rows = np.arange(self.side) < self.steps[y, None] + self.overlap
        in_columns = np.arange(self.side) < self.steps[x, None] + self.overlap
        if not self.toroidal:
            in_rows &= rows < self.size
            in_columns &= columns < self.size
        rows, columns = rows % self.size, columns % self.size
        window = in_rows[:, :, None] & in_columns[:, None, :]

        source = self.origins[chosen, 0, None] + np.arange(self.side)
        source = source[:, :, None] * self.normals.shape[1] + self.origins[chosen, 1, None, None]
        source = source + np.arange(self.side)
        features = self.features.reshape(-1, 6)
        mine = window.copy()
        for (axis, after), these in sides.items():
            start = int(self.steps[-1]) if after else 0
            sides_of_part = [slice(self.side), slice(self.side)]
            sides_of_part[axis] = slice(start, start + self.overlap)
            part = (these, *sides_of_part)
            there = self.source(rows[these, part[1], None], columns[these, None, part[2]])
            error = ((features[there] - features[source[part]]) ** 2).sum(axis=3)
            mine[part] &= _on_new_side(np.where(window[part], error, 0), axis, after)
        self.patch[y, x] = chosen
        code = (np.arange(self.side) >= self.steps[y, None])[:, :, None] * np.uint8(BEFORE_Y)
        code = code + (np.arange(self.side) >= self.steps[x, None])[:, None, :] * np.uint8(BEFORE_X)
        cell, i, j = np.nonzero(mine)
        self.owner[rows[cell, i], columns[cell, j]] = code[cell, i, j]

    def errors_beside(self, cells: np.ndarray, axis: int, after: bool) -> np.ndarray:
        """Mean errors of all patches in cells, against what the cells before or ``after`` show."""
        other = cells.copy()
        other[:, axis] = (other[:, axis] + (1 if after else -1)) % self.count
        patch = self.patch[tuple(other.T)]
        length = self.steps[(cells if after else other)[:, axis]] - self.steps.min()
        return self.errors[axis][length, :, patch] if after else self.errors[axis][length, patch]

    def repeats(self, y: np.ndarray, x: np.ndarray) -> np.ndarray:
        """Which patches show much of what cells nearby show already: N×P.

        Such a patch has a place in the sample that is less than half a patch off, along both axes,
        from the place of a neighbour; or less than a quarter from the places of the next cells but
        one, and so on up to :data:`APART` cells. Where no choice would be left, there is none.
        """
        result = np.zeros((len(y), len(self.origins)), bool)
        for above, beside in product(range(-APART, APART + 1), repeat=2):
            neighbour = self.patch[(y + above) % self.count, (x + beside) % self.count]
            offset = np.abs(self.origins[neighbour][:, None] - self.origins)
            near = (offset < self.side / 2 ** max(abs(above), abs(beside))).all(axis=2)
            result |= near & (neighbour >= 0)[:, None]
        return result & ~result.all(axis=1, keepdims=True)

    def source(self, row, column) -> np.ndarray:
        """Index of the sample's texel that a texel shows by now; any index where none is placed."""
        row, column = np.broadcast_arrays(row, column)
        owner = self.owner[row, column]
        place = []
        for index, before in ((row, BEFORE_Y), (column, BEFORE_X)):
            cell = np.searchsorted(self.starts, index, side="right") - 1
            owning = np.where(owner & before, (cell - 1) % self.count, cell)
            place.append((owning, (index - self.starts[owning]) % self.size))
        (cell_y, y), (cell_x, x) = place
        origin = self.origins[self.patch[cell_y, cell_x]]
        source = (origin[..., 0] + y) * self.normals.shape[1] + origin[..., 1] + x
        return np.minimum(source, self.normals.shape[0] * self.normals.shape[1] - 1)

    def result(self) -> Synthesis:
        """The finished map, with the patches that are in use only."""
        used, patch = np.unique(self.patch, return_inverse=True)
        longest = int(self.steps.max())
        owners = np.zeros((self.count, self.count, 2 * longest * self.overlap), np.uint8)
        for y in range(self.count):
            for x in range(self.count):
                block = self.owner[
                    self.starts[y] : self.starts[y + 1], self.starts[x] : self.starts[x + 1]
                ]
                strips = np.concatenate(
                    (block[: self.overlap].ravel(), block[self.overlap :, : self.overlap].ravel())
                )
                owners[y, x, : len(strips)] = strips
        return Synthesis(
            self.normals,
            self.size,
            self.overlap,
            self.toroidal,
            self.origins[used].astype(np.int32),
            patch.reshape(self.patch.shape).astype(np.int32),
            owners,
            self.best_only,
        )


def _on_new_side(error: np.ndarray, axis: int, after: bool) -> np.ndarray:
    """Which texels of overlaps (N × rows × columns) lie on the new patch's side of the least cut,
    the cut included; the old patch comes ``after`` the new one along the axis, or before."""
    error = np.moveaxis(error, 1 + axis, 2)
    path = minimum_error_cut(error)[:, :, None]
    place = np.arange(error.shape[2])
    return np.moveaxis(place <= path if after else place >= path, 2, 1 + axis)
