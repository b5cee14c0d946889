"""Points at random, no two of them close together, on a square that repeats (NumPy).

Dart throwing (Dunbar and Humphreys, "A Spatial Data Structure for Fast Poisson-Disk Sample
Generation", SIGGRAPH 2006, is what Yan et al. 2016 use) on a grid whose cells are as wide as the
smallest distance over √2, so that a cell holds one point at most. Cells three apart cannot
disturb each other: a ninth of the grid is thrown at once.
"""

from __future__ import annotations

from math import ceil, sqrt

import numpy as np
import numpy.typing as npt

#: Points per cell. Many more throws would reach saturation, at about 0.33.
FILL = 0.29

#: Rounds of throws, at most. At this density twenty have been enough for a million points.
MAX_ROUNDS = 1000

#: Standard deviation of the neighbourhood in which areas are balanced, in mean distances √(1/N).
BALANCE = 1.1

#: Rounds of balancing: the remaining deviation has converged to 5 %.
BALANCE_ROUNDS = 30


def cells_for(count: int) -> int:
    """Cells along each side of the grid for ``count`` points: a multiple of three."""
    return 3 * ceil(sqrt(count / FILL) / 3)


def poisson_disk(count: int, rng: np.random.Generator) -> npt.NDArray[np.float32]:
    """Throw ``count`` ≥ 1 points on a square of n×n cells, n = ``cells_for(count)``, that repeats.

    Returns n×n×2 places (x, y), in [0, 1), within the cells (row, column); NaN in cells without a
    point. All distances are at least √2 cells.
    """
    n = cells_for(count)
    places = np.full((n, n, 2), np.nan, np.float32)
    near = [
        (i, j) for i in range(-2, 3) for j in range(-2, 3) if (i, j) != (0, 0) and abs(i * j) < 4
    ]
    missing = count
    for _ in range(MAX_ROUNDS):
        if not missing:
            return places
        for phase in rng.permutation(9):
            row, column = (
                v.ravel()
                for v in np.meshgrid(
                    np.arange(phase // 3, n, 3), np.arange(phase % 3, n, 3), indexing="ij"
                )
            )
            empty = np.isnan(places[row, column, 0])
            row, column = row[empty], column[empty]
            dart = rng.random((len(row), 2), dtype=np.float32)
            free = np.ones(len(row), bool)
            for i, j in near:
                other = places[(row + i) % n, (column + j) % n] + np.array((j, i), np.float32)
                # Comparisons with NaN are false: an empty cell is not close.
                free &= ~(np.square(other - dart).sum(axis=1) < 2)
            hits = np.flatnonzero(free)
            if len(hits) > missing:
                hits = rng.permutation(hits)[:missing]
            places[row[hits], column[hits]] = dart[hits]
            missing -= len(hits)
    raise RuntimeError(f"{missing} of {count} points found no place in {MAX_ROUNDS} rounds")


def balanced_areas(places: npt.NDArray[np.float32]) -> npt.NDArray[np.float32]:
    """Areas (cells) for the points of :func:`poisson_disk`, n×n, 0 in cells without a point.

    Seen through a Gaussian wider than ``BALANCE`` mean distances, points with these areas cover
    the square evenly. Through one of 2.6 mean distances, their mass differs from one by less than
    1e-3; points of equal areas would leave a tenth. The areas sum to n².
    """
    from scipy.ndimage import gaussian_filter, map_coordinates  # only flakes pay for it

    n = len(places)
    row, column = np.nonzero(~np.isnan(places[..., 0]))
    x, y = places[row, column].astype(np.float64).T
    position = np.stack([row + y, column + x]) - 0.5
    first = np.floor(position).astype(np.int64)
    fraction = position - first
    sigma = BALANCE * n / sqrt(len(row))

    def smoothed(areas):
        """Density at the points: areas spread over the four nearest cells, smoothed, read back."""
        grid = np.zeros(n * n)
        for i in (0, 1):
            for j in (0, 1):
                share = np.abs(1 - i - fraction[0]) * np.abs(1 - j - fraction[1])
                index = (first[0] + i) % n * n + (first[1] + j) % n
                grid += np.bincount(index, areas * share, n * n)
        grid = gaussian_filter(grid.reshape(n, n), sigma, mode="wrap")
        return map_coordinates(grid, position, order=1, mode="grid-wrap")

    areas = np.full(len(row), n * n / len(row))
    for _ in range(BALANCE_ROUNDS):
        areas /= smoothed(areas)
    areas *= n * n / areas.sum()
    result = np.zeros((n, n), np.float32)
    result[row, column] = areas
    return result
