"""MIP levels of 4D lobes for a synthesised map (NumPy).

Tan et al., "Real-Time Microstructure Rendering with MIP-mapped Normal Map Samples" (2022), section
5.1.2. A lobe is a Gaussian in position × normal space: a mass, a mean and a 4×4 covariance of
(x, y, n_x, n_y). The lobes of a texel's grid cell are gathered to k clusters, each of which becomes
one lobe with the mass, mean and covariance of its members.

* *Texels*: one lobe per texel of the sample.
* *Inside patches*: every patch in use is divided into n×n grids, n = 2, 4, …, as far as no overlap
  can reach; each grid has k lobes. All cells of the map that show a patch share them.
* *Overlaps*: what is left of each cell of the map, where cuts decide what is seen, has k lobes of
  its own, in the order of the grids in which they lie.
* *Cells*: k lobes for each cell of the map, for each 2×2 cells, and so on to one grid for all.

So a cut is exact on all levels, and a footprint across patches needs no special treatment. (The
paper splits it into four, and falls back to unclustered lobes.)
"""

from __future__ import annotations

import warnings
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from glintbsdf.core.progress import progress
from glintbsdf.maps.quilting import Synthesis, mesh_lobes
from glintbsdf.pndf.gaussian_elements import SIGMA_H
from glintbsdf.pndf.mip import packing as packed_lobes

#: Smallest grid, texels. In much smaller grids, clusters would hold one or two texels each.
SMALLEST_GRID = 12

#: Iterations of k-means.
ITERATIONS = 8


@dataclass
class Lobes:
    """Gaussians in (x, y, n_x, n_y): ``mass`` N, ``mean`` N×4, ``covariance`` N×4×4 (float64)."""

    mass: np.ndarray
    mean: np.ndarray
    covariance: np.ndarray

    def __len__(self) -> int:
        return len(self.mass)

    def __getitem__(self, index) -> Lobes:
        return Lobes(self.mass[index], self.mean[index], self.covariance[index])

    def moved(self, offset: np.ndarray) -> Lobes:
        """The lobes, moved by ``offset`` (N×2 or 2, texels)."""
        mean = self.mean.copy()
        mean[:, :2] += offset
        return Lobes(self.mass, mean, self.covariance)

    def packed(self, extent: float) -> np.ndarray:
        """The lobes as :func:`~.pack` packs them."""
        return packed_lobes.pack(self.mass, self.mean, self.covariance, extent)

    @staticmethod
    def concatenate(parts: list[Lobes]) -> Lobes:
        return Lobes(
            *(
                np.concatenate([getattr(p, name) for p in parts])
                for name in ("mass", "mean", "covariance")
            )
        )


def texel_lobes(normals: np.ndarray) -> Lobes:
    """The lobes of a map (Eq. 4, 5), one per texel, from the texel's corner: H·W lobes.

    The covariance is S = σ_h² I for positions, J S between normals and positions, and J S Jᵀ for
    normals; evaluation adds the intrinsic roughness σ_r. Lobes stand where :func:`~.mesh_lobes`
    puts them, half a texel beyond the texel's centre, at (1, 1).
    """
    mean, jacobian = (v.reshape(-1, *v.shape[2:]) for v in mesh_lobes(normals.astype(np.float64)))
    count = len(mean)
    spread = np.concatenate((np.broadcast_to(np.eye(2), (count, 2, 2)), jacobian), axis=1)
    covariance = SIGMA_H**2 * spread @ spread.transpose(0, 2, 1)
    return Lobes(np.ones(count), np.concatenate((np.ones((count, 2)), mean), axis=1), covariance)


def merged(lobes: Lobes, label: np.ndarray, count: int) -> Lobes:
    """One lobe for each of ``count`` labels, with the mass, mean and covariance of its members.

    The moments are exact: the covariance is the mean of the members' covariances plus the
    covariance of their means. A label without members gives a lobe of no mass.
    """

    def total(values: np.ndarray) -> np.ndarray:
        flat = values.reshape(len(values), -1)
        sums = [np.bincount(label, column, count) for column in flat.T]
        return np.stack(sums, axis=-1).reshape(count, *values.shape[1:])

    mass = np.bincount(label, lobes.mass, count)
    share = lobes.mass / mass[label]
    mean = total(share[:, None] * lobes.mean)
    offset = lobes.mean - mean[label]
    second = lobes.covariance + offset[:, :, None] * offset[:, None, :]
    return Lobes(mass, mean, total(share[:, None, None] * second))


class Clustering:
    """K-means over position and normal (section 5.1.2).

    Distances are measured with positions in units of the standard deviation of a uniform grid,
    side/√12, and normals in units of the sample's own standard deviation (root mean square of x and
    y), times ``normal_weight``.
    """

    def __init__(self, clusters: int, normals: np.ndarray, normal_weight: float, seed: int) -> None:
        self.clusters = clusters
        deviation = float(np.sqrt(normals.reshape(-1, 2).var(axis=0).mean()))
        # In a sample without any variation, position alone counts.
        self.normal_scale = normal_weight / deviation if deviation > 0 else 0.0
        self.rng = np.random.default_rng(seed)

    def gather(self, lobes: Lobes, group: np.ndarray, groups: int, side: float) -> Lobes:
        """Gather the lobes of every group to ``clusters`` ones, stored group after group.

        ``group``: the group of every lobe, ascending. Groups with fewer lobes are filled up with
        lobes of no mass.
        """
        k = self.clusters
        scale = np.array([np.sqrt(12) / side] * 2 + [self.normal_scale] * 2)
        features = lobes.mean * scale
        borders = np.searchsorted(group, np.arange(groups + 1))
        label = np.empty(len(lobes), np.int64)
        with warnings.catch_warnings():  # a cluster that loses all members is no harm
            warnings.filterwarnings("ignore", message="One of the clusters is empty")
            for g, (first, last) in enumerate(zip(borders[:-1], borders[1:], strict=True)):
                label[first:last] = g * k + self._labels(features[first:last])
        return merged(lobes, label, groups * k)

    def _labels(self, features: np.ndarray) -> np.ndarray:
        count = len(features)
        if count <= self.clusters:
            return np.arange(count)
        begin = features[self.rng.choice(count, self.clusters, replace=False)]
        from scipy.cluster.vq import kmeans2  # half a second, which only building costs

        return kmeans2(features, begin, iter=ITERATIONS, minit="matrix")[1]


def morton(y, x, n: int):
    """Index of a grid among n×n ones, n a power of two, in Morton order.

    The grids that make up one of a coarser division lie side by side. Takes integers of NumPy or
    Dr.Jit.
    """
    result = 0
    for bit in range(n.bit_length() - 1):
        result |= ((y >> bit & 1) << (2 * bit + 1)) | ((x >> bit & 1) << (2 * bit))
    return result


@dataclass(frozen=True)
class Layout:
    """How cells are divided and levels follow each other.

    Attributes:
        divisions: n of each level inside patches, finest first; each is a power of two.
        inner: side of the smallest cell, texels. Grids are ``inner / n`` wide; the last grid of a
            larger cell is wider.
        cells: number of grids along an axis of the levels from one cell per grid on.
    """

    divisions: tuple[int, ...]
    inner: int
    cells: tuple[int, ...]

    @classmethod
    def of(cls, synthesis: Synthesis) -> Layout:
        inner = int(np.diff(synthesis.starts).min())
        divisions: list[int] = []
        while inner / 2 ** (len(divisions) + 1) >= SMALLEST_GRID:
            divisions.insert(0, 2 ** (len(divisions) + 1))
        cells = [len(synthesis.patch)]
        while cells[-1] > 1:
            cells.append(-(-cells[-1] // 2))
        return cls(tuple(divisions), inner, tuple(cells))

    def grid(self, position: np.ndarray, n: int) -> np.ndarray:
        """Which of the ``n`` grids of a cell, along an axis, holds a position."""
        return np.clip((position * (n / self.inner)).astype(np.int64), 0, n - 1)


def build(
    synthesis: Synthesis, clusters: int, normal_weight: float, seed: int
) -> dict[str, np.ndarray]:
    """All levels of lobes of a synthesised map.

    Returns:
        ``texels``: packed lobes of the sample's texels; ``inside``: lobes inside patches, patch by
        patch, division by division, row by row of the grids; ``overlaps``: lobes of the cells'
        overlaps; ``segments``, (n² + 1) per cell: where in the overlaps each grid of the finest
        division begins, in Morton order; ``cells``: lobes of cells and groups of cells, level by
        level; ``normals``, per level: the rectangle (lower, upper) of the lobes' normals, to
        :data:`~.NORMAL_CUT` standard deviations.
        Unless there are divisions, ``inside``, ``overlaps`` and ``segments`` are empty.
    """
    layout = Layout.of(synthesis)
    clustering = Clustering(clusters, synthesis.normals, normal_weight, seed)
    texels = texel_lobes(synthesis.normals)
    steps = len(layout.divisions) + 1 + len(layout.cells)
    with progress("Clustering lobes") as report:
        inside, finest = _inside_patches(synthesis, layout, clustering, texels)
        report(len(layout.divisions) / steps)
        overlaps, segments, cells = _cells(synthesis, layout, clustering, texels, finest)
        report((len(layout.divisions) + 2) / steps)
        levels = [cells]
        for done, level in enumerate(_groups_of_cells(synthesis, layout, clustering, cells)):
            levels.append(level)
            report((len(layout.divisions) + 3 + done) / steps)
    step = float(np.diff(synthesis.starts).max())
    return {
        "texels": texels.packed(1.0),
        "inside": inside.packed(step),
        "overlaps": overlaps.packed(step),
        "segments": segments,
        "normals": np.array(
            [
                normal_bounds(texels),
                *(normal_bounds(inside, overlaps) for _ in layout.divisions),
                *(normal_bounds(level) for level in levels),
            ]
        ),
        "cells": np.concatenate([level.packed(step * 2**j) for j, level in enumerate(levels)]),
    }


def normal_bounds(*parts: Lobes) -> np.ndarray:
    """Lower and upper corner of a rectangle that holds the normals of lobes, 2×2."""
    lobes = Lobes.concatenate(list(parts))
    lobes = lobes[lobes.mass > 0]
    reach = packed_lobes.NORMAL_CUT * np.sqrt(np.einsum("ijj->ij", lobes.covariance)[:, 2:])
    mean = lobes.mean[:, 2:]
    return np.stack(((mean - reach).min(axis=0), (mean + reach).max(axis=0)))


def all_words(arrays: dict[str, np.ndarray]) -> np.ndarray:
    """The packed lobes that :func:`build` returns in one flat array, kind after kind."""
    kinds = ("texels", "inside", "overlaps", "cells")
    return np.concatenate([arrays[kind].ravel() for kind in kinds])


def _inside_patches(synthesis, layout, clustering, texels) -> tuple[Lobes, Lobes | None]:
    """Lobes inside patches, with positions from the patch's corner, and the lobes of the coarsest
    division (None where there is no division)."""
    patches = len(synthesis.origins)
    levels, members = [], None
    for n in layout.divisions:
        if members is None:
            inner = np.arange(synthesis.overlap, layout.inner)
            y, x = (v.ravel() for v in np.meshgrid(inner, inner, indexing="ij"))
            members = _texels_at(synthesis, texels, synthesis.origins, y, x)
            patch = np.repeat(np.arange(patches), len(y))
        grid = [layout.grid(members.mean[:, axis], n) for axis in (1, 0)]
        group = (patch * n + grid[0]) * n + grid[1]
        order = np.argsort(group, kind="stable")
        members = clustering.gather(members[order], group[order], patches * n * n, layout.inner / n)
        levels.append(members)
        patch = np.repeat(np.arange(patches), n * n * clustering.clusters)
        real = members.mass > 0
        members, patch = members[real], patch[real]
    if not levels:
        return _none(), None
    by_patch = [
        np.arange(len(level)).reshape(patches, -1) + sum(len(v) for v in levels[:i])
        for i, level in enumerate(levels)
    ]
    return Lobes.concatenate(levels)[np.concatenate(by_patch, axis=1).ravel()], levels[-1]


def _texels_at(synthesis, texels, origins, y, x) -> Lobes:
    """Lobes of the texels (y, x) of all patches, positions from the patch's corner."""
    width = synthesis.normals.shape[1]
    source = (origins[:, :1] + y) * width + origins[:, 1:] + x
    place = np.stack((x, y), axis=1)
    return texels[source.ravel()].moved(np.tile(place, (len(origins), 1)))


def _cells(synthesis, layout, clustering, texels, finest):
    """Lobes of the cells' overlaps with their segments, and lobes of whole cells."""
    count = len(synthesis.patch)
    n = layout.divisions[0] if layout.divisions else 1
    overlaps, segments, cells = [], [], []
    first = 0
    for y in range(count):
        lobes, cell = _cell_row(synthesis, layout, texels, y, whole=finest is None)
        lobes = clustering.gather(lobes, cell, count, layout.inner)
        if finest is None:
            cells.append(lobes)
            continue
        cell = np.repeat(np.arange(count), clustering.clusters)
        grid = morton(*(layout.grid(lobes.mean[:, axis], n) for axis in (1, 0)), n)
        # Lobes of no mass come last, behind all grids
        key = cell * (n * n + 1) + np.where(lobes.mass > 0, grid, n * n)
        order = np.argsort(key, kind="stable")
        lobes = lobes[order]
        overlaps.append(lobes)
        segments.append(first + np.searchsorted(key[order], np.arange(count * (n * n + 1))))
        first += len(lobes)

        per_patch = len(finest) // len(synthesis.origins)
        index = synthesis.patch[y][:, None] * per_patch + np.arange(per_patch)
        inside = finest[index.ravel()]
        both = Lobes.concatenate([lobes, inside])
        cell = np.concatenate((cell, np.repeat(np.arange(count), per_patch)))
        cells.append(_gather_real(clustering, both, cell, count, layout.inner))
    if finest is None:
        return _none(), np.empty(0, np.uint32), Lobes.concatenate(cells)
    return (
        Lobes.concatenate(overlaps),
        np.concatenate(segments).astype(np.uint32),
        Lobes.concatenate(cells),
    )


def _cell_row(synthesis, layout, texels, row: int, whole: bool) -> tuple[Lobes, np.ndarray]:
    """Lobes of the texels of a row of cells, all or in overlaps only, and their cells."""
    rows = np.arange(synthesis.starts[row], synthesis.starts[row + 1])
    y, x = (v.ravel() for v in np.meshgrid(rows, np.arange(synthesis.size), indexing="ij"))
    cell = synthesis.cell_of[x]
    local = np.stack((x - synthesis.starts[cell], y - rows[0]), axis=1)
    if not whole:
        outside = ((local < synthesis.overlap) | (local >= layout.inner)).any(axis=1)
        y, x, cell, local = (v[outside] for v in (y, x, cell, local))
    order = np.argsort(cell, kind="stable")
    y, x, cell, local = (v[order] for v in (y, x, cell, local))
    return texels[synthesis.source(y, x)].moved(local), cell


def _gather_real(clustering, lobes, group, groups, side) -> Lobes:
    """Gather lobes in any order, leaving out those of no mass."""
    real = np.flatnonzero(lobes.mass > 0)
    order = real[np.argsort(group[real], kind="stable")]
    return clustering.gather(lobes[order], group[order], groups, side)


def _groups_of_cells(synthesis, layout, clustering, members) -> Iterator[Lobes]:
    """Lobes of 2×2 cells, of 4×4 and so on, positions from the group's first texel."""
    starts = synthesis.starts
    for level, (finer, coarser) in enumerate(zip(layout.cells, layout.cells[1:], strict=False)):
        cell = np.repeat(np.arange(finer * finer), clustering.clusters)
        y, x = divmod(cell, finer)
        origin, group_origin = (
            np.stack([starts[(v >> up) << (level + up)] for v in (x, y)], axis=1) for up in (0, 1)
        )
        members = _gather_real(
            clustering,
            members.moved(origin - group_origin),
            (y >> 1) * coarser + (x >> 1),
            coarser * coarser,
            layout.inner * 2 ** (level + 1),
        )
        yield members


def _none() -> Lobes:
    return Lobes(np.empty(0), np.empty((0, 4)), np.empty((0, 4, 4)))
