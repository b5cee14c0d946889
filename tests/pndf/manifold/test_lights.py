"""The manifold under lights of some extent, and over footprints in which the half vector turns."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest

from glintbsdf.footprint.gaussian import Footprint
from glintbsdf.footprint.query import Query
from glintbsdf.maps.normalmap import NormalMap
from glintbsdf.pndf.manifold.exact import Manifold

SIZE, BINS = 64, 20
TURN = np.array([[1.5, -0.7], [0.4, 0.9]])


@pytest.fixture
def waves(variant):
    """Normals that vary over several texels."""
    u, v = np.meshgrid(*[np.arange(SIZE) * (2 * np.pi / SIZE)] * 2)
    n = 0.12 * np.stack([np.sin(3 * u + np.cos(2 * v)), np.cos(4 * v - np.sin(u))], -1)
    return NormalMap(n.astype(np.float32), "repeat")


def in_bins(x, y, bounds):
    return np.histogram2d(y, x, BINS, bounds[::-1])[0] / x.size


def masses(pndf, query, bounds, points=6):
    """Mass of D in each bin, by ``points``² points."""
    count = BINS * points
    axes = [lo + (np.arange(count) + 0.5) / count * (hi - lo) for lo, hi in bounds]
    m = mi.Vector2f(np.stack(np.meshgrid(*axes)).reshape(2, -1).astype(np.float32))
    density = pndf.eval(m, query).numpy().reshape(BINS, points, BINS, points)
    return density.sum((1, 3)) * np.prod([(hi - lo) / count for lo, hi in bounds])


# Measured: 0.032 to 0.036, of which 0.006 is noise.
@pytest.mark.parametrize(("sigma", "spread"), [(0.5, 0.01), (2.0, 0.04)])
def test_against_counted_normals(variant, waves, sigma, spread):
    """Evaluation and samples, against normals n(u) − H (u − u₀) at points of the kernel, each moved
    by a point of the ellipse."""
    pndf = Manifold(waves)
    pndf.prepare_for_lights()
    at = Footprint.isotropic(mi.Point2f(0.48, 0.53), mi.Float(sigma / SIZE))
    ellipse = spread * np.array([[1, 0], [0.3, 0.7]])
    vectors = tuple(mi.Vector2f(*(float(x) for x in column)) for column in ellipse.T)
    query = Query(at, mi.Matrix2f(TURN.astype(np.float32)), vectors)

    count, rng = 1_000_000, np.random.default_rng(1)
    kernel = pndf.texel_kernel(at)
    offset = kernel.sample(mi.Point2f(rng.random((2, count), dtype=np.float32)))
    normals = np.array(pndf.normal_at(kernel.mean + offset, True), np.float64)
    radius, angle = 2 * np.sqrt(rng.random(count)), 2 * np.pi * rng.random(count)
    point = np.stack([radius * np.cos(angle), radius * np.sin(angle)])
    normals += ellipse @ point - TURN @ (np.array(offset) / SIZE)

    bounds = np.stack([normals.min(1) - 0.01, normals.max(1) + 0.01], -1)
    expected, found = in_bins(*normals, bounds), masses(pndf, query, bounds)
    assert np.abs(found - expected).sum() < 0.05
    assert abs(found.sum() - 1) < 0.01
    random = rng.random((3, 200_000), dtype=np.float32)
    samples = np.array(pndf.sample(query, mi.Float(random[0]), mi.Point2f(random[1:])))
    assert np.abs(in_bins(*samples, bounds) - found).sum() < 0.1


def test_without_light_and_turn_all_is_exact(variant, waves):
    """Lanes with neither of them have the exact density to the last bit."""
    plain, prepared = Manifold(waves), Manifold(waves)
    prepared.prepare_for_lights()
    at = Footprint.isotropic(mi.Point2f(0.48, 0.53), mi.Float(1 / SIZE))
    m = mi.Vector2f(np.random.default_rng(2).uniform(-0.2, 0.2, (2, 2000)).astype(np.float32))
    spread = dr.select(dr.arange(mi.UInt32, 2000) % 2 == 0, mi.Float(0.01), 0)
    query = Query(at, spread=(mi.Vector2f(spread, 0), mi.Vector2f(0, spread)))
    expected, found = plain.eval(m, at).numpy(), prepared.eval(m, query).numpy()
    assert np.array_equal(found[1::2], expected[1::2])
    assert np.abs(found[::2] - expected[::2]).sum() > 0.1 * expected[::2].sum()
    assert "merged elements for lights" in prepared.parts()
    assert not any("lights" in part for part in plain.parts())
