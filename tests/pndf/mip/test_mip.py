"""Tan22's P-NDF: against sums in double precision, continuous over levels, small and cheap."""

from __future__ import annotations

import mitsuba as mi
import numpy as np
import pytest

from glintbsdf import Footprint, NormalMap, maps
from glintbsdf.check import suite
from glintbsdf.footprint.kernels import SIGMA_MIN
from glintbsdf.maps.quilting import synthesise
from glintbsdf.pndf import Mip
from glintbsdf.pndf.gaussian_elements import SIGMA_H
from glintbsdf.pndf.mip.levels import texel_lobes

SAMPLE = maps.isotropic(64, alpha=0.15, seed=1)
SIZES = {"output_size": 160, "patch_size": 30, "clusters": 16}
RES = 48  # points along each axis of a grid over the normals


def make(sample: NormalMap = SAMPLE, sigma_r: float = 0.02, **parameters) -> Mip:
    return Mip(sample, **{**SIZES, **parameters}, sigma_r=sigma_r)


def grid(reach: float = 0.6) -> np.ndarray:
    """Projected normals, RES²×2."""
    axis = np.linspace(-reach, reach, RES, dtype=np.float32)
    return np.stack(np.meshgrid(axis, axis), axis=-1).reshape(-1, 2)


def round_footprint(mip: Mip, uv, sigma: float) -> Footprint:
    return Footprint.isotropic(mi.Point2f(uv), sigma / mip.synthesis.size)


def density(mip: Mip, footprint: Footprint, normals: np.ndarray) -> np.ndarray:
    return mip.eval(mi.Vector2f(normals.T), footprint).numpy().astype(np.float64)


def sum_of_texels(mip: Mip, uv, sigma: float, normals: np.ndarray) -> np.ndarray:
    """D under a round footprint, of the lobes of all texels of the map, in double precision."""
    synthesis, sigma_r = mip.synthesis, float(mip.sigma_r[0])
    size, variance = synthesis.size, sigma**2 + SIGMA_MIN**2
    centre = np.array(uv) * size
    reach = int(4 * sigma) + 4
    x, y = (v.ravel() for v in np.mgrid[-reach : reach + 1, -reach : reach + 1])
    x, y = x + int(centre[0]), y + int(centre[1])
    lobes = texel_lobes(synthesis.normals)[synthesis.source(y % size, x % size)]
    d = centre - np.stack((x, y), axis=1) - lobes.mean[:, :2]
    total = variance + SIGMA_H**2
    weight = np.exp(-0.5 * (d**2).sum(axis=1) / total)
    seen = weight > 1e-4  # all but 1e-4 of the mass
    lobes, d, weight = lobes[seen], d[seen], weight[seen]
    jacobian = lobes.covariance[:, 2:, :2] / SIGMA_H**2
    mean = lobes.mean[:, 2:] + SIGMA_H**2 / total * np.einsum("ijk,ik->ij", jacobian, d)
    spread = SIGMA_H**2 * variance / total * jacobian @ jacobian.transpose(0, 2, 1)
    covariance = spread + sigma_r**2 * np.eye(2)
    result = np.zeros(len(normals))
    for w, m, c in zip(weight / weight.sum(), mean, covariance, strict=True):
        offset = normals - m
        form = np.einsum("ij,jk,ik->i", offset, np.linalg.inv(c), offset)
        result += w * np.exp(-0.5 * form) / (2 * np.pi * np.sqrt(np.linalg.det(c)))
    return result


# --------------------------------------------------------------------------------------------------
#  Against sums in double precision
# --------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("sigma", [0.0, 0.3, 1.5])
@pytest.mark.parametrize("uv", [(0.371, 0.612), (0.999, 0.002), (40 / 160, 80 / 160)])
def test_texels_are_summed(variant, sigma, uv):
    mip, normals = make(), grid()
    footprint = round_footprint(mip, uv, sigma)
    assert mip.level(mip.texel_kernel(footprint))[1][0] == 0
    expected = sum_of_texels(mip, uv, sigma, normals)
    # The cut at three standard deviations: measured up to 0.9 %
    assert suite.relative_l1(density(mip, footprint, normals), expected) < 0.02


@pytest.mark.parametrize("sigma_r", [1e-2, 1e-4])
def test_stiff_lobes_are_exact_in_single_precision(variant, sigma_r):
    # At the normals where density is: those of the texels around, and a little off
    mip = make(sigma_r=sigma_r, seed=3)
    uv, sigma = (0.371, 0.612), 0.5
    texel = np.array(uv) * 160
    rows, columns = (np.arange(int(v) - 2, int(v) + 3) for v in (texel[1], texel[0]))
    normals = mip.synthesis.explicit()[np.ix_(rows, columns)].reshape(-1, 2).astype(np.float64)
    normals = np.float32(normals + sigma_r * np.random.default_rng(0).normal(size=normals.shape))
    actual = density(mip, round_footprint(mip, uv, sigma), normals)
    expected = sum_of_texels(mip, uv, sigma, normals.astype(np.float64))
    # Packed Jacobians have three digits; the cut is on top
    strong = expected > 1e-3 * expected.max()
    assert np.median(np.abs(actual / expected - 1)[strong]) < 0.02


def test_clusters_of_every_level_are_near_the_texels(variant):
    mip, normals, uv = make(clusters=32), grid(), (0.43, 0.28)
    for sigma in (6.0, 9.0, 14.0):
        actual = density(mip, round_footprint(mip, uv, sigma), normals)
        error = suite.relative_l1(actual, sum_of_texels(mip, uv, sigma, normals))
        assert error < 0.15, (sigma, error)  # measured 0.05 to 0.10


def test_more_clusters_are_nearer(variant):
    normals, uv, sigma = grid(), (0.43, 0.28), 8.0
    errors = []
    for clusters in (4, 64):
        mip = make(clusters=clusters)
        actual = density(mip, round_footprint(mip, uv, sigma), normals)
        errors.append(suite.relative_l1(actual, sum_of_texels(mip, uv, sigma, normals)))
    assert errors[1] < 0.5 * errors[0]


# --------------------------------------------------------------------------------------------------
#  Levels
# --------------------------------------------------------------------------------------------------


def test_levels_follow_equation_8(variant):
    mip = make(lod_scale=0.5)  # cells of 26 texels and more: 2×2 grids are level 4, cells 5
    for side, below, fraction in ((8, 0, 0), (2**3.25, 0, 0.25), (16, 1, 0), (2**4.75, 1, 0.75)):
        found, above, weight = mip.level(
            mip.texel_kernel(round_footprint(mip, (0.5, 0.5), side / 2))
        )
        assert above[0] == found[0] + (weight[0] > 0)
        # The smallest footprint is added to all, which moves λ by 1e-5 at most
        assert abs(found[0] + weight[0] - (below + fraction)) < 1e-4


def test_density_is_continuous_over_levels(variant):
    mip, normals, uv = make(), grid(), (0.43, 0.28)
    for sigma in (4.0, 8.0, 16.0, 32.0):
        just_below, just_above = (
            density(mip, round_footprint(mip, uv, sigma * f), normals) for f in (0.9999, 1.0001)
        )
        # The footprint itself grows by 2e-4
        assert suite.relative_l1(just_below, just_above) < 5e-3


def test_mirrored_maps_are_mirrored(variant):
    mip, normals = make(NormalMap(SAMPLE.normals, "mirror")), grid()
    for sigma in (0.7, 12.0):
        inside, beyond = (
            Footprint(
                mi.Point2f(side * 0.13, 0.22),
                mi.Vector2f(side * sigma / 160, 0.001),
                mi.Vector2f(0, 0.002),
            )
            for side in (1, -1)
        )
        assert (
            suite.relative_l1(density(mip, beyond, normals), density(mip, inside, normals)) < 1e-3
        )


def test_clamped_footprints_stay_inside(variant):
    mip, normals = make(NormalMap(SAMPLE.normals, "clamp")), grid()
    outside = density(mip, round_footprint(mip, (1.7, -0.4), 3.0), normals)
    assert (
        suite.relative_l1(outside, density(mip, round_footprint(mip, (1.0, 0.0), 3.0), normals))
        < 1e-5
    )


@pytest.mark.parametrize(
    ("sample", "sizes"),
    [
        ((4, 9), {"output_size": 50, "patch_size": 3, "overlap": 1, "clusters": 2}),
        ((40, 70), {"output_size": 91, "patch_size": 39, "overlap": 5, "clusters": 1}),
        ((64, 64), {"output_size": 65, "patch_size": 63, "clusters": 1024}),
    ],
)
def test_odd_sizes_are_normalised(variant, sample, sizes):
    mip, normals = make(maps.isotropic(sample, alpha=0.1, seed=1), sigma_r=0.04, **sizes), grid()
    size = mip.synthesis.size
    for sigma in (0.0, 0.5, 3.0, 20.0, 100 * size):
        footprint = Footprint(
            mi.Point2f(0.97, 0.41), mi.Vector2f(sigma / size, 0.3 * sigma / size), mi.Vector2f(0, 0)
        )
        values = density(mip, footprint, normals)
        assert np.isfinite(values).all() and (values >= 0).all()
        # Points 0.6 σ_r apart integrate Gaussians of σ_r exactly
        assert abs(values.sum() * (1.2 / (RES - 1)) ** 2 - 1) < 1e-3


# --------------------------------------------------------------------------------------------------
#  The table on the device, memory
# --------------------------------------------------------------------------------------------------


def test_the_device_finds_the_same_texels(variant):
    mip = make()
    y, x = np.random.default_rng(0).integers(0, 160, (2, 20_000))
    source, following = mip.grids.source(mi.UInt32(y), mi.UInt32(x), mi.Bool(True))
    assert np.array_equal(source.numpy(), mip.synthesis.source(y, x))
    # As far as a run goes, texels of the sample lie side by side
    last = x + following.numpy() - 1
    assert last.max() < 160
    assert np.array_equal(source.numpy() + last - x, mip.synthesis.source(y, last))


def test_memory_is_that_of_the_sample_not_of_the_map(variant):
    small, large = (make(output_size=size) for size in (200, 800))
    explicit = 32 * (800**2 - 200**2)  # bytes, were all texels' lobes stored
    # Measured: 0.061, with cells of 27 texels
    assert large.nbytes - small.nbytes < 0.07 * explicit
    assert f"{small.nbytes / 1e6:.1f} MB" in repr(small)


def test_the_cache_gives_the_same_map(variant):
    first, again = make(seed=11), make(seed=11)
    assert np.array_equal(first.words.numpy(), again.words.numpy())
    assert np.array_equal(first.normal_map.normals, again.normal_map.normals)
    expected = synthesise(SAMPLE, output_size=160, patch_size=30, seed=11)
    assert np.array_equal(again.normal_map.normals, expected.explicit())
    assert str(again.synthesis) == str(expected)
