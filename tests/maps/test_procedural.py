"""Procedural maps: size, seed, tiling, and the statistics that their parameters determine."""

from __future__ import annotations

import numpy as np
import pytest

from glintbsdf import NormalMap, ParameterError, maps

ALL = ("flat", "tilted", "isotropic", "brushed", "scratched", "flakes", "leather")
ROUGH = ALL[2:]


def slopes(normal_map):
    """Slopes n_xy / n_z, H x W x 2."""
    normals = normal_map.normals.astype(np.float64)
    return normals / np.sqrt(1 - np.sum(normals**2, axis=2, keepdims=True))


@pytest.mark.parametrize("name", ALL)
@pytest.mark.parametrize("size", [1, 2, 48, (1, 9), (31, 64)])
def test_any_size(name, size):
    normal_map = getattr(maps, name)(size)
    assert isinstance(normal_map, NormalMap) and normal_map.wrap_mode == "repeat"
    assert normal_map.normals.shape[:2] == ((size, size) if isinstance(size, int) else size)


@pytest.mark.parametrize("name", ROUGH)
def test_seed_decides(name):
    make = getattr(maps, name)
    assert make(128, seed=1).content_hash == make(128, seed=1).content_hash
    assert make(128, seed=1).content_hash != make(128, seed=2).content_hash


@pytest.mark.parametrize("name", ROUGH)
def test_tiles_without_a_seam(name):
    for axis in (0, 1):
        ratios = []
        for seed in range(8):
            normals = getattr(maps, name)((192, 256), seed=seed).normals.astype(np.float64)
            step = np.abs(np.roll(normals, -1, axis) - normals).sum(axis=2).mean(axis=1 - axis)
            ratios.append(step[-1] / step.mean())  # the last step crosses the seam
        # Measured: at most 1.46; quarters of larger maps, which do not tile, at least 1.83.
        assert np.mean(ratios) < 1.6


@pytest.mark.parametrize("name, alpha", [("isotropic", 0.05), ("isotropic", 0.3), ("leather", 0.2)])
@pytest.mark.parametrize("shape", [(128, 128), (96, 200)])
def test_roughness_of_the_whole_map_is_exact(name, alpha, shape):
    alpha_u, alpha_v = getattr(maps, name)(shape, alpha=alpha).roughness()
    # Scaled in float32; the normals are stored in float32 as well.
    assert np.sqrt((alpha_u**2 + alpha_v**2) / 2) == pytest.approx(alpha, rel=1e-5)
    # How the two axes share it is chance: measured up to 8 % over eight seeds.
    assert alpha_u == pytest.approx(alpha_v, rel=0.15)


@pytest.mark.parametrize("name", ROUGH)
def test_mean_slope_is_level(name):
    normal_map = getattr(maps, name)(256)
    # Periodic heights have a mean slope of zero. Flakes are independent: 1024 of them here, of
    # deviation alpha/√2 each; four standard errors.
    limit = 4 * 0.2 / np.sqrt(2 * 1024) if name == "flakes" else 1e-8
    assert np.abs(slopes(normal_map).mean(axis=(0, 1))).max() < limit


def test_flat_and_tilted():
    assert not maps.flat(4).normals.any()
    normal = maps.tilted(3, tilt=0.3, azimuth=2.0).normals
    np.testing.assert_allclose(
        normal - np.sin(0.3) * np.array([np.cos(2.0), np.sin(2.0)]), 0, atol=1e-7
    )


def test_isotropic_correlation_length():
    length = 6
    slope = slopes(maps.isotropic(512, alpha=0.1, correlation_length=length))
    for component in (0, 1):
        values = slope[..., component]
        for lag in (3, 6, 9):
            # Across its own direction, a slope has the autocorrelation of the height itself.
            shifted = np.roll(values, lag, axis=component)
            correlation = np.mean(values * shifted) / np.mean(values**2)
            # Measured over eight seeds: a standard deviation of up to 0.016; four of them.
            assert correlation == pytest.approx(np.exp(-((lag / length) ** 2)), abs=0.065)


@pytest.mark.parametrize("angle", [0.0, 0.5, np.pi / 2])
def test_brushed_direction(angle):
    slope = slopes(maps.brushed(256, alpha=0.2, streak_length=60, streak_width=5, angle=angle))
    along = slope @ [np.cos(angle), np.sin(angle)]
    across = slope @ [-np.sin(angle), np.cos(angle)]
    assert np.sqrt(2 * np.mean(across**2)) == pytest.approx(0.2, rel=1e-5)
    # Measured over eight seeds: 0.077 to 0.093 (expected 5/60 = 0.083).
    assert np.std(along) / np.std(across) == pytest.approx(5 / 60, rel=0.2)


def test_scratches_cover_what_they_should():
    polished = slopes(maps.scratched(512, coverage=0.0, alpha=0.02))
    assert np.sqrt(np.mean(polished**2) * 2) == pytest.approx(0.02, rel=1e-5)
    for coverage in (0.1, 0.4):
        scratched = []
        for seed in range(8):
            slope = slopes(maps.scratched(512, coverage, slope=0.3, alpha=0.0, seed=seed))
            steepness = np.linalg.norm(slope, axis=2)
            scratched.append(np.mean(steepness > 0))
            # Measured 0.25 to 0.27: central differences round off the steepest spots.
            assert 0.2 < steepness.max() <= 0.3
        # Independent scratches leave exp(-coverage) free. Central differences widen a scratch of
        # six texels by up to two: measured 1.44 and 1.29 times, with a standard error of 0.1.
        assert 1 < np.mean(scratched) / (1 - np.exp(-coverage)) < 1.8


def test_flakes_are_facets():
    alpha, flake_size, size = 0.2, 8, 256
    normal_map = maps.flakes(size, alpha=alpha, flake_size=flake_size)
    count = len(np.unique(normal_map.normals.reshape(-1, 2), axis=0))
    assert 0.95 * (size / flake_size) ** 2 <= count <= (size / flake_size) ** 2
    # Measured over eight seeds: a standard deviation of 1.6 %, and a largest deviation of 3.3 %.
    np.testing.assert_allclose(normal_map.roughness(), alpha, rtol=0.07)


@pytest.mark.parametrize("size", [0, -3, 2.5, (4,), (4, 0), (4, 4, 4), None])
def test_bad_size(size):
    for name in ALL:
        with pytest.raises(ParameterError, match=f'^maps.{name}: "size" must be a positive int'):
            getattr(maps, name)(size)


@pytest.mark.parametrize(
    "name, parameter, value",
    [
        ("tilted", "tilt", np.pi / 2),
        ("tilted", "tilt", -0.1),
        ("tilted", "azimuth", np.inf),
        ("isotropic", "alpha", -0.1),
        ("isotropic", "alpha", np.nan),
        ("isotropic", "correlation_length", -1),
        ("brushed", "streak_length", np.nan),
        ("brushed", "streak_width", -1),
        ("brushed", "angle", np.nan),
        ("scratched", "coverage", -1),
        ("scratched", "length", 0),
        ("scratched", "width", 0.5),
        ("scratched", "slope", -1),
        ("flakes", "flake_size", 0),
        ("leather", "grain_size", 1),
        ("leather", "crease_width", -1),
    ],
)
def test_bad_parameters(name, parameter, value):
    with pytest.raises(ParameterError, match=f'^maps.{name}: "{parameter}" must be '):
        getattr(maps, name)(8, **{parameter: value})
