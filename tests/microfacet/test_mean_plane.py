"""Masking over the mean plane: the areas, and that no more light is reflected than received."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest

from glintbsdf.microfacet.mean_plane import (
    area_of_moments,
    mean_plane_area,
    slope_along,
    variance_along,
    visibility,
)


def directions(rng, count: int) -> np.ndarray:
    """Unit vectors (3, N) of the upper hemisphere, half of them within 6° of the horizon."""
    z = np.where(rng.random(count) < 0.5, rng.random(count), 0.1 * rng.random(count))
    phi = 2 * np.pi * rng.random(count)
    r = np.sqrt(1 - z * z)
    return np.stack([r * np.cos(phi), r * np.sin(phi), z])


def vector(v: np.ndarray) -> mi.Vector3f:
    return mi.Vector3f(np.ascontiguousarray(v, np.float32))


def reflected(slopes: np.ndarray, wi: np.ndarray, correlated: bool) -> float:
    """Energy of uniform light that facets with these slopes (2, N), which are mirrors, reflect. It
    is computed in float64 except for V, whose areas are those of the same facets."""
    m = np.concatenate([slopes, np.ones((1, slopes.shape[1]))])
    cosine = m.T @ wi  # ω·m/m_z
    m = m / np.linalg.norm(m, axis=0)
    wo = 2 * (wi @ m) * m - wi[:, None]
    up = (cosine > 0) & (wo[2] > 0)
    mean = slopes.mean(axis=1)

    def areas(w):
        every = np.maximum(w[2] + slopes.T @ w[:2], 0).mean(axis=0)
        plane = mean_plane_area(vector(w), mi.Vector2f(*mean.tolist()))
        return mi.Float(every.astype(np.float32)), plane

    p_i, plane_i = areas(wi[:, None])
    p_o, plane_o = areas(np.where(up, wo, [[0], [0], [1]]))
    v = np.array(visibility(p_i, plane_i, p_o, plane_o, correlated))
    return float(np.where(up, cosine * v, 0).mean())


@pytest.mark.parametrize("correlated", [True, False])
def test_no_more_is_reflected_than_is_received(variant, correlated):
    # Patches of all kinds: lean up to 45°, slopes of two facets, Gaussian and skewed.
    rng = np.random.default_rng(1)
    worst = 0.0
    for _ in range(100):
        count = rng.choice([2, 5, 200])
        slopes = rng.normal(size=(2, count)) ** rng.choice([1, 3]) * 10 ** rng.uniform(-3, -0.5)
        slopes += rng.uniform(-1, 1, (2, 1))
        worst = max(worst, *(reflected(slopes, w, correlated) for w in directions(rng, 4).T))
    assert worst <= 1 + 1e-5
    assert worst > 0.98


def test_a_leaning_mirror_hides_nothing_of_itself(variant):
    slopes = np.array([[0.3], [-0.1]])
    for w, energy in (((0, 0, 1), 1), ((0.8, 0, 0.6), 1), ((-0.9, 0, np.sqrt(0.19)), 0)):
        # The last direction sees it, but its reflection goes below the horizon.
        assert reflected(slopes, np.array(w, np.float64), True) == pytest.approx(energy, abs=1e-6)


def test_a_level_surface_has_smiths_masking(variant):
    rng = np.random.default_rng(2)
    wi, wo = (vector(directions(rng, 1000)) for _ in range(2))
    p_i, p_o = (w.z * mi.Float(1 + rng.random(1000).astype(np.float32)) for w in (wi, wo))
    plane_i, plane_o = (mean_plane_area(w, mi.Vector2f(0)) for w in (wi, wo))
    lambda_i, lambda_o = p_i / wi.z - 1, p_o / wo.z - 1
    joint = visibility(p_i, plane_i, p_o, plane_o) * wi.z
    assert dr.allclose(joint, 1 / (1 + lambda_i + lambda_o), rtol=1e-4)
    product = visibility(p_i, plane_i, p_o, plane_o, height_correlated=False) * wi.z
    assert dr.allclose(product, 1 / ((1 + lambda_i) * (1 + lambda_o)), rtol=1e-4)


@pytest.mark.parametrize("correlated", [True, False])
def test_visibility_is_smooth_where_the_plane_turns_away(variant, correlated):
    p_i, p_o, plane_o = 0.05, 0.8, 0.7
    plane_i = mi.Float([1e-3, 1e-6, 1e-20, 0])
    v = np.array(visibility(p_i, plane_i, p_o, plane_o, correlated))
    assert np.allclose(v, v[-1], rtol=0.03) and np.isfinite(v).all() and v[-1] > 0
    # Light from behind does not reach it, and facets that face away are not visible.
    plane_o = mi.Float([1e-2, 1e-4, 1e-6, 0])
    v = np.array(visibility(p_i, mi.Float(0.05), p_o, plane_o, correlated))
    assert (np.diff(v) < 0).all() and v[-1] == 0
    assert visibility(mi.Float(0), mi.Float(0), p_o, mi.Float(0.7), correlated)[0] == 0


def test_variance_along_a_direction(variant):
    rng = np.random.default_rng(3)
    slopes, w = rng.normal(size=(2, 500)) * [[0.2], [0.4]], directions(rng, 20)
    (xx, xy), (_, yy) = np.cov(slopes, ddof=0)
    along = np.var(w[:2].T @ slopes, axis=1)
    assert np.allclose(np.array(variance_along(vector(w), (xx, xy, yy))), along, rtol=1e-4)
    mean = mi.Vector2f(*slopes.mean(axis=1).tolist())
    expected = w[2] + w[:2].T @ slopes.mean(axis=1)
    assert np.allclose(np.array(slope_along(vector(w), mean)), expected, atol=1e-6)


def test_area_of_moments(variant):
    from scipy.stats import norm

    u = (np.arange(20_000) + 0.5) / 20_000
    shapes = {"gaussian": norm.ppf(u), "even": np.sqrt(12) * (u - 0.5)}
    mean = np.linspace(-1.7, 8, 98)
    for sigma in (1.0, 0.1, 1e-4):
        area = np.array(area_of_moments(mi.Float(mean * sigma), mi.Float(sigma**2))) / sigma
        for name, x in shapes.items():
            exact = np.maximum(mean[:, None] + x, 0).mean(axis=1)
            # Not below, except by 0.3 % at the rim of the even one; at most 9 % above in front.
            assert (area >= exact * (1 - 3e-3) - 1e-6).all(), name
            assert (area <= 1.09 * exact + 1e-6)[mean > 0].all(), name
        # Never above that of two facets, nor below the mean plane's own.
        two = 0.5 * (mean + np.sqrt(mean**2 + 1))
        assert (area <= two * (1 + 1e-3)).all()
        assert (area >= np.maximum(mean, 0) * (1 - 1e-6)).all()
    # Value and slope are continuous at the direction that sees the plane edge on.
    near = np.array(area_of_moments(mi.Float([-1e-3, 0, 1e-3]), mi.Float(1)))
    assert np.allclose(np.diff(near), 0.5e-3, rtol=2e-2)
    assert area_of_moments(mi.Float([-1, 0, 1]), mi.Float(0)).numpy() == pytest.approx(
        [0, 0, 1], abs=1e-9
    )
