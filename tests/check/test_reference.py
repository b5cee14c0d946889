"""The binned reference, against cases with a known closed form."""

from __future__ import annotations

import numpy as np
import pytest

from glintbsdf import NormalMap, ParameterError, maps
from glintbsdf.check.reference import binned_pndf, normal_bounds, texel_covariance

SIZE = 64
GRADIENT = np.array([[4e-3, 1e-3], [-2e-3, 6e-3]])  # projected normal per texel (x, y)
MIDDLE = (0.5, 0.5)


def linear_map():
    """Normals that are a linear function of position, and zero in the middle of the map."""
    position = np.arange(SIZE) - (SIZE - 1) / 2
    x, y = np.meshgrid(position, position)
    return NormalMap(np.stack((x, y), axis=2) @ GRADIENT.T, "clamp")


def bin_centres(binned):
    """Centres of the bins, an array of shape (res, res, 2)."""
    x, y = (0.5 * (edges[1:] + edges[:-1]) for edges in binned.edges)
    return np.stack(np.meshgrid(x, y), axis=2)


def mean_density(density, bounds, res, subdivision=8):
    """Means over bins of a density that is given by a formula, from subdivision² points in each
    bin."""
    (x_min, y_min), (x_max, y_max) = bounds
    fraction = (np.arange(res * subdivision) + 0.5) / (res * subdivision)
    x, y = np.meshgrid(x_min + (x_max - x_min) * fraction, y_min + (y_max - y_min) * fraction)
    return (
        density(np.stack((x, y), axis=2))
        .reshape(res, subdivision, res, subdivision)
        .mean(axis=(1, 3))
    )


# -------------------------------------------------------------------------------------------------
# Known densities
# -------------------------------------------------------------------------------------------------


def test_gaussian_footprint_on_linear_normals():
    normal_map = linear_map()
    sigma, angle, res = (5.0, 2.0), 0.7, 24
    axes = np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]]) * sigma
    image = GRADIENT @ axes

    def density(m):
        rho = np.linalg.norm(m @ np.linalg.inv(image).T, axis=2)
        inside = np.exp(-(rho**2) / 2) * (rho <= 3)
        return inside / (2 * np.pi * abs(np.linalg.det(image)) * (1 - np.exp(-4.5)))

    bounds = ((-0.07, -0.1), (0.07, 0.1))
    expected = mean_density(density, bounds, res, 32)
    statistics = []
    for seed in range(8):
        found, error = binned_pndf(
            normal_map,
            MIDDLE,
            texel_covariance(normal_map, sigma, angle),
            res=res,
            bounds=bounds,
            samples=200_000,
            seed=seed,
        )
        certain = expected * 200_000 * np.prod(np.diff(bounds, axis=0)) / res**2 > 10
        statistics.append(((found - expected) / error)[certain])
    # Standard errors are calibrated: the mean square of 8 x K normal deviates is 1 with a standard
    # deviation of √(2 / 8K). Allow four, and 2 % for the one sample added to counts of ten on.
    statistics = np.concatenate(statistics)
    assert statistics.size > 1000
    assert np.mean(statistics**2) == pytest.approx(1, abs=4 * np.sqrt(2 / statistics.size) + 0.02)
    assert np.mean(statistics) == pytest.approx(0, abs=4 / np.sqrt(statistics.size))


def test_disk_footprint_on_linear_normals():
    normal_map = linear_map()
    image = GRADIENT * 6.0

    def density(m):
        rho = np.linalg.norm(m @ np.linalg.inv(image).T, axis=2)
        return (rho <= 1.5) / (np.pi * 1.5**2 * abs(np.linalg.det(image)))

    bounds, res, samples = ((-0.06, -0.08), (0.06, 0.08)), 20, 1_000_000
    found, error = binned_pndf(
        normal_map,
        MIDDLE,
        texel_covariance(normal_map, 6.0),
        kernel="disk",
        res=res,
        bounds=bounds,
        samples=samples,
    )
    expected = mean_density(density, bounds, res, 64)
    assert np.abs((found - expected) / error).max() < 4.5  # 400 bins: one in 400 runs by chance
    assert np.count_nonzero(found) < res**2 and np.all(found[expected == 0] == 0)


def test_box_footprint_fills_a_rectangle():
    position = np.arange(SIZE) - (SIZE - 1) / 2
    x, y = np.meshgrid(position * 4e-3, position * -6e-3)
    normal_map = NormalMap(np.stack((x, y), axis=2), "clamp")
    # Standard deviations (4, 2) texels: normals up to 1.5 x 4 x 4e-3 and 1.5 x 2 x 6e-3. A box
    # uses only the covariance's diagonal.
    covariance = texel_covariance(normal_map, (4.0, 2.0)) + np.array([[0, 1], [1, 0]]) * 1e-4
    corner = np.array([0.024, 0.018])
    found, error = binned_pndf(
        normal_map,
        MIDDLE,
        covariance,
        kernel="box",
        res=8,
        bounds=(-2 * corner, 2 * corner),
        samples=1_000_000,
    )
    expected = np.zeros((8, 8))
    expected[2:6, 2:6] = 1 / np.prod(2 * corner)
    assert np.abs((found - expected) / error).max() < 4
    assert np.all(found[expected == 0] == 0)


@pytest.mark.parametrize(
    "kernel, variance",
    [
        # of ρ² per axis: cut Gaussian 1 - (9/2) e^(-9/2) / (1 - e^(-9/2)), disk 1.5²/4, box 1.5²/3
        ("gaussian", 1 - 4.5 * np.exp(-4.5) / (1 - np.exp(-4.5))),
        ("disk", 0.5625),
        ("box", 0.75),
    ],
)
def test_moments_of_rotated_footprints(kernel, variance):
    normal_map = linear_map()
    covariance = texel_covariance(normal_map, (4.0, 1.5), 0.4)
    uv = np.array([0.55, 0.47])
    binned = binned_pndf(normal_map, uv, covariance, kernel=kernel, res=200, samples=400_000)
    weight = binned.density * binned.bin_area
    assert weight.sum() == pytest.approx(1, abs=1e-12)
    mean = np.tensordot(weight, bin_centres(binned))
    difference = bin_centres(binned) - mean
    found = np.einsum("ij,ijk,ijl->kl", weight, difference, difference)
    texel = covariance * SIZE**2 if kernel != "box" else np.diag(np.diag(covariance)) * SIZE**2
    # Moments of 400,000 samples: 0.2 % each; four of them, and bins add their width²/12.
    np.testing.assert_allclose(mean, GRADIENT @ (SIZE * (uv - 0.5)), atol=4e-4)
    np.testing.assert_allclose(
        found, variance * GRADIENT @ texel @ GRADIENT.T, rtol=0.02, atol=2e-6
    )


def test_roughness_widens():
    normal_map = maps.flat(4)
    binned = binned_pndf(
        normal_map, MIDDLE, np.zeros((2, 2)), epsilon=0, sigma_r=0.1, res=40, samples=100_000
    )
    weight = binned.density * binned.bin_area
    # Four standard errors of a variance from 100,000 samples: 1.8 %.
    np.testing.assert_allclose(np.tensordot(weight, bin_centres(binned) ** 2), 0.1**2, rtol=0.025)
    assert weight.sum() == pytest.approx(1, abs=2e-4)  # beyond four standard deviations


def test_mirror_is_a_point():
    normal_map = maps.tilted((1, 3), tilt=0.3)
    binned = binned_pndf(
        normal_map, MIDDLE, texel_covariance(normal_map, 5.0), epsilon=0, res=5, samples=1000
    )
    assert np.count_nonzero(binned.density) == 1
    assert binned.density[2, 2] * binned.bin_area == 1


# -------------------------------------------------------------------------------------------------
# The mesh
# -------------------------------------------------------------------------------------------------


def normal_at(normal_map, row, column, epsilon=0.0):
    """The surface's normal at one point, (row, column) in texels, from bins of 1e-5."""
    uv = (column + 0.5) / normal_map.width, (row + 0.5) / normal_map.height
    binned = binned_pndf(
        normal_map,
        uv,
        np.zeros((2, 2)),
        epsilon=epsilon,
        samples=1,
        res=2000,
        bounds=normal_bounds(normal_map, epsilon),
    )
    return bin_centres(binned)[binned.density > 0][0]


def test_triangles_share_the_diagonal_from_n1_to_n2():
    normals = np.random.default_rng(2).uniform(-0.01, 0.01, (4, 5, 2))
    normal_map = NormalMap(normals)
    n0, n1, n2, n3 = normals[1, 2], normals[1, 3], normals[2, 2], normals[2, 3]
    for (s, t), expected in (
        ((0.2, 0.3), 0.5 * n0 + 0.2 * n1 + 0.3 * n2),
        ((0.9, 0.6), 0.5 * n3 + 0.4 * n1 + 0.1 * n2),
        ((0, 0), n0),
        ((0.25, 0.75), 0.25 * n1 + 0.75 * n2),
    ):
        np.testing.assert_allclose(normal_at(normal_map, 1 + t, 2 + s), expected, atol=1e-5)


def test_clamped_triangles():
    # Constant normals: every triangle is degenerate. Its equilateral substitute has twice the area
    # epsilon, and its corners at 90, 210 and 330 degrees in the order (n0, n1, n2), (n3, n2, n1).
    epsilon = 1e-4
    radius = np.sqrt(2 * epsilon / (3 * np.sqrt(3)))
    corners = radius * np.array([[0, 1], [-np.sqrt(3) / 2, -0.5], [np.sqrt(3) / 2, -0.5]])
    edges = corners[1:] - corners[0]
    assert abs(np.linalg.det(edges)) == pytest.approx(epsilon)
    normal_map = maps.tilted(3, tilt=0.1)
    centre = normal_map.normals[0, 0]
    for (s, t), weights in (((0.2, 0.3), (0.5, 0.2, 0.3)), ((0.9, 0.6), (0.5, 0.1, 0.4))):
        np.testing.assert_allclose(
            normal_at(normal_map, t, s, epsilon) - centre, np.array(weights) @ corners, atol=2e-5
        )
    # A box of whole texels covers the triangle evenly: the second moment is radius²/8 per axis.
    binned = binned_pndf(
        normal_map,
        MIDDLE,
        texel_covariance(normal_map, 2 / 3),
        kernel="box",
        epsilon=epsilon,
        samples=200_000,
        res=200,
    )
    weight = binned.density * binned.bin_area
    np.testing.assert_allclose(
        np.tensordot(weight, (bin_centres(binned) - centre) ** 2), radius**2 / 8, rtol=0.015
    )


def test_only_small_triangles_are_clamped():
    # One quad of a map with |det J| = 4e-6 throughout: epsilon below it changes nothing.
    position = np.arange(8) * 2e-3
    x, y = np.meshgrid(position, position)
    normal_map = NormalMap(np.stack((x, y), axis=2), "clamp")
    inside = normal_at(normal_map, 3.2, 4.1, epsilon=3.9e-6)
    np.testing.assert_allclose(inside, (4.1 * 2e-3, 3.2 * 2e-3), atol=1e-5)
    outside = normal_at(normal_map, 3.2, 4.1, epsilon=4.1e-6)
    assert np.abs(outside - inside).max() > 1e-4


@pytest.mark.parametrize(
    "wrap_mode, pad_mode", [("repeat", "wrap"), ("mirror", "symmetric"), ("clamp", "edge")]
)
def test_wrap_modes(wrap_mode, pad_mode):
    normals = maps.isotropic((12, 20), seed=5).normals
    padding = 3 * np.array(normals.shape[:2])
    small = NormalMap(normals, wrap_mode)
    large = NormalMap(np.pad(normals, [(n, n) for n in (*padding, 0)], mode=pad_mode), "clamp")
    options = {"res": 32, "samples": 50_000, "seed": 3, "bounds": normal_bounds(small)}
    row, column = -1.3, 21.7  # beyond the corner
    found = binned_pndf(
        small,
        ((column + 0.5) / 20, (row + 0.5) / 12),
        texel_covariance(small, (8.0, 4.0), 0.3),
        **options,
    )
    expected = binned_pndf(
        large,
        ((column + padding[1] + 0.5) / large.width, (row + padding[0] + 0.5) / large.height),
        texel_covariance(large, (8.0, 4.0), 0.3),
        **options,
    )
    # The same random numbers, rounded otherwise: a sample in a million changes its bin.
    assert expected.relative_l1(found.density) < 1e-4


# -------------------------------------------------------------------------------------------------
# The result
# -------------------------------------------------------------------------------------------------


def test_two_seeds_differ_by_their_noise():
    normal_map = maps.isotropic(128, seed=1)
    covariance = texel_covariance(normal_map, (10.0, 6.0), 1.0)
    first, second = (
        binned_pndf(normal_map, (0.3, 0.6), covariance, res=32, samples=1_000_000, seed=seed)
        for seed in (0, 1)
    )
    assert np.all(first.standard_error > 0)
    difference = (first.density - second.density) / np.hypot(
        *(b.standard_error for b in (first, second))
    )
    occupied = first.density * first.bin_area * 1_000_000 > 10
    assert np.mean(difference[occupied] ** 2) == pytest.approx(
        1, abs=4 * np.sqrt(2 / np.count_nonzero(occupied))
    )
    # Two noisy grids differ by √2 times the noise of one. Measured over eight pairs: 0.95 to 1.07,
    # a standard deviation of 0.035; four of them.
    assert first.relative_l1(second.density) == pytest.approx(
        np.sqrt(2) * first.noise_floor, rel=0.14
    )
    again = binned_pndf(normal_map, (0.3, 0.6), covariance, res=32, samples=1_000_000)
    np.testing.assert_array_equal(again.density, first.density)


def test_grid_is_row_y_column_x():
    normal_map = NormalMap(np.broadcast_to([0.6, -0.4], (2, 2, 2)))
    binned = binned_pndf(
        normal_map, MIDDLE, np.zeros((2, 2)), res=4, samples=10, bounds=((-1, -1), (1, 1))
    )
    assert np.argwhere(binned.density).tolist() == [[1, 3]]
    edges_x, edges_y = binned.edges
    np.testing.assert_array_equal(edges_x, [-1, -0.5, 0, 0.5, 1])
    assert binned.bin_area == 0.25 and edges_y.shape == (5,)


def test_texel_covariance():
    normal_map = maps.flat((50, 100))
    np.testing.assert_allclose(texel_covariance(normal_map, 2.0), np.diag([4e-4, 16e-4]))
    np.testing.assert_allclose(
        texel_covariance(normal_map, (2.0, 1.0), np.pi / 2), np.diag([1e-4, 16e-4]), atol=1e-18
    )
    turned = texel_covariance(normal_map, (2.0, 0.0), np.pi / 4)
    np.testing.assert_allclose(turned, [[2e-4, 4e-4], [4e-4, 8e-4]])


@pytest.mark.parametrize(
    "parameter, value",
    [
        ("kernel", "gauss"),
        ("epsilon", -1.0),
        ("epsilon", np.nan),
        ("sigma_r", -0.1),
        ("sigma_r", np.inf),
        ("res", 0),
        ("samples", 0),
        ("uv", (0.5, np.nan)),
        ("uv", 0.5),
        ("covariance", np.eye(3)),
        ("covariance", [[1, 2], [2, 1]]),
        ("covariance", [[1, 1], [0, 1]]),
        ("covariance", [[np.nan, 0], [0, 1]]),
        ("covariance", -np.eye(2)),
        ("bounds", ((0, 0), (0, 1))),
        ("bounds", (0, 1)),
        ("bounds", ((0, np.nan), (1, 1))),
    ],
)
def test_bad_parameters(parameter, value):
    arguments = {"uv": MIDDLE, "covariance": np.eye(2), "samples": 10, parameter: value}
    with pytest.raises(ParameterError, match=f'^binned_pndf: "{parameter}" must be '):
        binned_pndf(maps.flat(2), **arguments)
