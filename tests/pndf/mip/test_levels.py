"""MIP levels of lobes: moments are kept by merging, clustering and packing, on every level."""

from __future__ import annotations

import numpy as np
import pytest

from glintbsdf import maps
from glintbsdf.maps.quilting import synthesise
from glintbsdf.pndf.gaussian_elements import SIGMA_H
from glintbsdf.pndf.mip.levels import Clustering, Layout, Lobes, build, merged, morton, texel_lobes
from glintbsdf.pndf.mip.packing import factors, pack

SAMPLE = maps.isotropic(64, seed=1)
CLUSTERS = 8


@pytest.fixture(scope="module")
def synthesis():
    # Cells of 37 and 38 texels, in 2×2 grids; not toroidal, so that no cell is like another
    return synthesise(SAMPLE, output_size=150, patch_size=40, overlap=2, toroidal=False)


@pytest.fixture(scope="module")
def levels(synthesis):
    return build(synthesis, CLUSTERS, normal_weight=4.0, seed=0)


def random_lobes(count: int, seed: int = 0) -> Lobes:
    rng = np.random.default_rng(seed)
    spread = rng.normal(size=(count, 4, 4)) * np.array([1, 1, 0.1, 0.1])[:, None]
    mean = rng.normal(size=(count, 4)) * [10, 10, 0.2, 0.2]
    return Lobes(rng.uniform(0.5, 2, count), mean, spread @ spread.transpose(0, 2, 1))


def moments(lobes: Lobes) -> tuple[float, np.ndarray, np.ndarray]:
    """Mass, mean and covariance of a mixture."""
    share = lobes.mass / lobes.mass.sum()
    mean = share @ lobes.mean
    offset = lobes.mean - mean
    second = lobes.covariance + offset[:, :, None] * offset[:, None, :]
    return lobes.mass.sum(), mean, np.einsum("i,ijk->jk", share, second)


def unpacked(words: np.ndarray, extent: float) -> Lobes:
    """What :func:`pack` has packed, but for lobes of no mass."""
    low, high = (words & 0xFFFF).astype(np.uint16), (words >> 16).astype(np.uint16)
    halves = [[v[:, k].view(np.float16).astype(float) for v in (low, high)] for k in range(8)]
    real = halves[1][0] > 0
    x, y, n_x, n_y = (v[:, k] / 65535 for k in (0, 2) for v in (low, high))
    mean = np.stack((extent * x, extent * y, 2 * n_x - 1, 2 * n_y - 1), axis=1)
    zero = np.zeros(len(words))
    inverse = np.array([[halves[1][1], zero], halves[4]]).transpose(2, 0, 1)[real]
    q = np.array([[halves[3][1], zero], halves[5]]).transpose(2, 0, 1)[real]
    b = np.array([halves[6], halves[7]]).transpose(2, 0, 1)[real]
    root = np.linalg.inv(inverse)
    cross = b @ root.transpose(0, 2, 1)
    covariance = np.block(
        [
            [root @ root.transpose(0, 2, 1), cross.transpose(0, 2, 1)],
            [cross, b @ b.transpose(0, 2, 1) + q @ q.transpose(0, 2, 1)],
        ]
    )
    return Lobes(halves[1][0][real] * extent**2, mean[real], covariance)


def assert_same_moments(a: Lobes, b: Lobes, tolerance: float, size: float) -> None:
    """``size``: of the region, the unit in which errors of positions count."""
    unit = np.array([size, size, 1, 1])
    (mass_a, mean_a, cov_a), (mass_b, mean_b, cov_b) = moments(a), moments(b)
    assert abs(mass_a / mass_b - 1) < tolerance
    assert np.abs((mean_a - mean_b) / unit).max() < tolerance
    assert np.abs((cov_a - cov_b) / np.outer(unit, unit)).max() < tolerance


# --------------------------------------------------------------------------------------------------
#  Lobes
# --------------------------------------------------------------------------------------------------


def test_texels_become_the_lobes_of_equation_5():
    lobes, n = texel_lobes(SAMPLE.normals), SAMPLE.normals.astype(float)
    lobe, (n0, n1), (n2, n3) = lobes[20 * 64 + 30], *(n[y, 30:32] for y in (20, 21))
    assert np.allclose(lobe.mean, [1, 1, *(n1 + n2) / 2])
    assert np.allclose(lobe.covariance[:2, :2], SIGMA_H**2 * np.eye(2))
    assert np.allclose(lobe.covariance[2:, 0], SIGMA_H**2 * (n1 - n0 + n3 - n2) / 2)
    assert np.allclose(lobe.covariance[2:, 1], SIGMA_H**2 * (n2 - n0 + n3 - n1) / 2)
    # All that normals vary comes from the position
    assert np.allclose(factors(lobes.covariance)[2], 0, atol=1e-6)


def test_merging_keeps_all_moments():
    lobes = random_lobes(200)
    label = np.random.default_rng(1).integers(0, 7, 200)
    for k, one in enumerate(map(lambda k: merged(lobes, label, 8)[k : k + 1], range(7))):
        assert_same_moments(one, lobes[label == k], 1e-12, 1)
    assert merged(lobes, label, 8).mass[7] == 0


def test_clustering_keeps_all_moments_and_tells_clusters_apart():
    rng = np.random.default_rng(2)
    # Four clusters that are far apart, two in position, two in normal
    centres = np.array([[3, 3, 0, 0], [12, 12, 0, 0], [8, 8, 0.4, 0], [8, 8, -0.4, 0]])
    which = np.repeat(np.arange(4), 50)
    mean = centres[which] + rng.normal(size=(200, 4)) * [0.1, 0.1, 0.005, 0.005]
    lobes = Lobes(np.ones(200), mean, np.tile(np.eye(4) * 1e-4, (200, 1, 1)))
    normals = mean[:, None, 2:]
    clusters = Clustering(16, normals, 1.0, seed=0).gather(lobes, np.zeros(200, int), 1, 15.0)
    assert len(clusters) == 16
    assert_same_moments(clusters[clusters.mass > 0], lobes, 1e-12, 1)
    # Of 16 clusters each lies in one of the four
    for one in clusters.mean[clusters.mass > 0]:
        assert np.abs((one - centres) / [1, 1, 0.05, 0.05]).max(axis=1).min() < 1


def test_fewer_lobes_than_clusters_are_kept_as_they_are():
    lobes = random_lobes(5)
    clusters = Clustering(8, lobes.mean[:, None, 2:], 1.0, 0).gather(
        lobes, np.array([0, 0, 1, 1, 1]), 2, 15.0
    )
    assert np.allclose(clusters.mass.reshape(2, 8) > 0, np.arange(8) < [[2], [3]])
    assert np.allclose(clusters.mean[[0, 1, 8, 9, 10]], lobes.mean)


def test_grids_of_a_coarser_division_are_neighbours_in_morton_order():
    y, x = (v.ravel() for v in np.indices((4, 4)))
    index = morton(y, x, 4)
    assert sorted(index) == list(range(16))
    assert np.array_equal(index >> 2, morton(y >> 1, x >> 1, 2))


# --------------------------------------------------------------------------------------------------
#  Packing
# --------------------------------------------------------------------------------------------------


def test_packing_keeps_three_digits():
    lobes = random_lobes(500, seed=3)
    lobes.mean[:, :2] = np.abs(lobes.mean[:, :2])
    lobes.mean[:, 2:] = np.clip(lobes.mean[:, 2:], -1, 1)
    extent = float(lobes.mean[:, :2].max())
    result = unpacked(pack(lobes.mass, lobes.mean, lobes.covariance, extent), extent)
    # Half precision has 11 bits, fixed point 16
    assert np.allclose(result.mass, lobes.mass, rtol=2**-11)
    assert np.allclose(result.mean, lobes.mean, atol=max(extent, 2) / 65535)
    deviation = np.sqrt(np.einsum("ijj->ij", lobes.covariance))
    error = (result.covariance - lobes.covariance) / (deviation[:, :, None] * deviation[:, None])
    assert np.abs(error).max() < 0.02  # of nearly degenerate S; the median is below 1e-3
    assert np.median(np.abs(error)) < 1e-3


# --------------------------------------------------------------------------------------------------
#  Levels
# --------------------------------------------------------------------------------------------------


def region(synthesis, first_cell, last_cell) -> Lobes:
    """Lobes of all texels of the cells from (y, x) to (y, x), from the first one's corner."""
    (y0, x0), (y1, x1) = synthesis.starts[list(first_cell)], synthesis.starts[list(last_cell)]
    y, x = (v.ravel() for v in np.mgrid[y0:y1, x0:x1])
    lobes = texel_lobes(synthesis.normals)[synthesis.source(y, x)]
    return lobes.moved(np.stack((x - x0, y - y0), axis=1))


def test_every_level_keeps_mass_mean_and_covariance(synthesis, levels):
    layout = Layout.of(synthesis)
    step = float(np.diff(synthesis.starts).max())
    first = 0
    for j, count in enumerate(layout.cells):
        words = levels["cells"][first * CLUSTERS : (first + count * count) * CLUSTERS]
        first += count * count
        for y, x in ((0, 0), (count - 1, 0), (count // 2, count - 1)):
            grid = y * count + x
            lobes = unpacked(words[grid * CLUSTERS : (grid + 1) * CLUSTERS], step * 2**j)
            ends = [min((v + 1) << j, len(synthesis.patch)) for v in (y, x)]
            expected = region(synthesis, (y << j, x << j), ends)
            # Half precision, of S⁻¹ too: measured 4e-4
            assert_same_moments(lobes, expected, 1e-3, step * 2**j)
    assert first * CLUSTERS == len(levels["cells"])


@pytest.mark.parametrize("cell", [(0, 0), (1, 2), (3, 3)])
def test_inside_and_overlaps_make_up_a_cell(synthesis, levels, cell):
    layout = Layout.of(synthesis)
    (n,) = layout.divisions
    step = float(np.diff(synthesis.starts).max())
    patch = synthesis.patch[cell]
    inside = levels["inside"].reshape(-1, n * n * CLUSTERS, 8)[patch]
    index = cell[0] * len(synthesis.patch) + cell[1]
    segments = levels["segments"].reshape(-1, n * n + 1)[index]
    overlaps = levels["overlaps"][segments[0] : segments[-1]]
    both = unpacked(np.concatenate((inside, overlaps)), step)
    expected = region(synthesis, cell, (cell[0] + 1, cell[1] + 1))
    assert_same_moments(both, expected, 1e-3, step)
    # Segments hold what lies in their grids
    for k in range(n * n):
        place = unpacked(levels["overlaps"][segments[k] : segments[k + 1]], step).mean
        assert (morton(*(layout.grid(place[:, a] + 1e-3, n) for a in (1, 0)), n) == k).all()
