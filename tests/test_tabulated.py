"""The tables behind ``max_error``: their parts, their mass, their sampler, their error."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from bsdf_suite import EXTREME_VIEWS, View, check_chi2, check_finite, check_weights

from glintbsdf import maps
from glintbsdf.errors import ParameterError
from glintbsdf.footprint import Footprint
from glintbsdf.kernels import KERNELS
from glintbsdf.pndf import Manifold, TabulatedManifold
from glintbsdf.pndf.tabulated import ERROR, MIN_SPACING, Nodes, clipped_area, level_count

EPSILON = 1e-3  # so that bins resolve the clamped triangles


@pytest.fixture(scope="module")
def normal_map():
    return maps.isotropic((96, 128), correlation_length=3, seed=1)


@pytest.fixture
def pndf(variant, normal_map):
    return TabulatedManifold(normal_map, epsilon=EPSILON, max_error=0.05)


def footprint(sigma=14.0, aspect=1.5, turn=0.6, uv=(0.3, 0.8), size=(128, 96)):
    """Standard deviations in texels."""
    axes = (
        aspect * sigma * np.array([np.cos(turn), np.sin(turn)]),
        sigma * np.array([-np.sin(turn), np.cos(turn)]),
    )
    return Footprint(mi.Point2f(uv), *(mi.Vector2f(*map(float, a / size)) for a in axes))


def density_of_bins(pndf, footprint):
    tables = pndf.tables
    columns, rows = (int(n) for n in tables.bins)
    row, column = np.divmod(np.arange(rows * columns), columns)
    m = tables.lower + (np.stack([column, row], -1) + 0.5) * tables.size
    return pndf.eval(mi.Vector2f(m.T.astype(np.float32)), footprint).numpy().astype(np.float64)


def test_clipped_areas_tile_the_triangle(variant):
    """Over a grid that holds it they add up to its area, for random, thin and upright ones."""
    rng = np.random.default_rng(1)
    n = 3000
    corners = rng.uniform(1, 9, (3, 2, n))
    corners[2, :, :1000] = corners[1, :, :1000] + rng.normal(scale=1e-3, size=(2, 1000))
    corners[1, 0, 1000:2000] = corners[0, 0, 1000:2000]  # an edge straight up
    corners[2, 1, 1500:2000] = corners[0, 1, 1500:2000]  # and one level
    vertices = [mi.Vector2f(c.astype(np.float32)) for c in corners]
    parts = np.array(
        [clipped_area(vertices, mi.Int(x), mi.Int(y)).numpy() for x in range(10) for y in range(10)]
    )
    (ax, ay), (bx, by), (cx, cy) = (np.array(v, np.float64) for v in vertices)
    area = 0.5 * np.abs((bx - ax) * (cy - ay) - (by - ay) * (cx - ax))
    assert (parts >= 0).all() and (parts <= 1 + 1e-5).all()
    # float32 of coordinates up to 10, over up to 30 squares: 2e-5 was measured.
    assert np.allclose(parts.sum(0), area, rtol=1e-4, atol=5e-5)


@pytest.mark.parametrize("period, count", [(96, 12), (100, 7), (37, 5), (8, 1)])
def test_nodes(variant, period, count):
    depth = level_count([count])
    nodes = Nodes(period, count, depth)
    assert nodes.count[0] == count and nodes.count[-1] == 1
    for level in range(depth):
        edges = nodes.levels[level]
        assert edges[0] == 0 and edges[-1] == period and (np.diff(edges) > 0).all()
        assert np.isclose(nodes.totals(level).sum(), period)
        if level:
            assert np.isin(edges, nodes.levels[level - 1]).all()


@pytest.mark.parametrize("wrap_mode", ["repeat", "mirror"])
@pytest.mark.parametrize("shape", [(75, 131), (5, 300)])
def test_mass_is_one(variant, shape, wrap_mode):
    normal_map = maps.isotropic(shape, correlation_length=3, seed=2)
    normal_map = type(normal_map)(normal_map.normals, wrap_mode)
    pndf = TabulatedManifold(normal_map, epsilon=EPSILON, max_error=0.2)
    for sigma in (12, 30, 60):
        view = footprint(sigma, size=shape[::-1])
        if pndf.level(view).numpy().item() < 0:
            continue
        mass = density_of_bins(pndf, view).sum() * np.prod(pndf.tables.size)
        assert abs(mass - 1) < 2e-4  # half floats: 2e-5 was measured
        break
    else:
        assert min(shape) < MIN_SPACING  # too narrow for nodes


@pytest.mark.parametrize("kernel", KERNELS)
def test_samples_have_the_density_of_the_bins(variant, normal_map, kernel):
    pndf = TabulatedManifold(normal_map, kernel, EPSILON, max_error=0.3)
    view = footprint(20)
    assert pndf.level(view).numpy().item() >= 0
    count = 400_000
    u = np.random.default_rng(3).random((2, count), dtype=np.float32)
    m = np.array(pndf.sample(view, 0.0, mi.Point2f(mi.Float(u[0]), mi.Float(u[1]))), np.float64)
    tables = pndf.tables
    index = np.floor((m.T - tables.lower) / tables.size).astype(int)
    counts = np.bincount(
        index[:, 1] * tables.bins[0] + index[:, 0], minlength=int(np.prod(tables.bins))
    )
    expected = count * density_of_bins(pndf, view) * np.prod(tables.size)
    assert counts[expected == 0].sum() <= 1e-4 * count  # rounding at the edges of bins
    used = expected > 10
    assert used.sum() > 500
    z = ((counts - expected)[used] ** 2 / expected[used]).sum()
    degrees = used.sum()
    assert abs(z - degrees) < 4 * np.sqrt(2 * degrees)


@pytest.mark.parametrize("name", ["brushed", "flakes"])
def test_error_is_below_the_one_allowed(variant, name):
    """Against the exact P-NDF, averaged over larger bins so that points suffice."""
    normal_map = getattr(maps, name)(192, seed=1)
    exact = Manifold(normal_map, epsilon=EPSILON)
    pndf = TabulatedManifold(normal_map, epsilon=EPSILON, max_error=0.1)
    view = footprint(24, aspect=1.2, size=(192, 192))
    level = pndf.level(view).numpy().item()
    assert level >= 0
    coefficient, power = ERROR["gaussian"]
    assert coefficient * (pndf.tables.spacing(level) / 24) ** power <= 0.1
    lower, upper = (np.array(v) for v in exact.bounds())
    n = 192
    row, column = (np.indices((n, n)) + np.random.default_rng(1).random((2, n, n))) / n
    place = np.stack([column.ravel(), row.ravel()]) * (upper - lower)[:, None] + lower[:, None]
    m = mi.Vector2f(place.astype(np.float32))
    a, b = (p.eval(m, view).numpy().reshape(12, 16, 12, 16).mean((1, 3)) for p in (pndf, exact))
    # 256 points to a bin leave 0.03 of noise on the roughest of these.
    assert np.abs(a - b).sum() / b.sum() < 0.1 + 0.03


def test_small_footprints_and_clamped_maps_are_exact(variant, normal_map, pndf):
    exact = Manifold(normal_map, epsilon=EPSILON)
    m = mi.Vector2f(np.random.default_rng(1).normal(scale=0.1, size=(2, 500)).astype(np.float32))
    small = footprint(3)
    assert np.array_equal(pndf.eval(m, small).numpy(), exact.eval(m, small).numpy())
    clamped_map = type(normal_map)(normal_map.normals, "clamp")
    clamped = TabulatedManifold(clamped_map, epsilon=EPSILON, max_error=0.1)
    large = footprint(20)
    assert clamped.tables is None
    assert np.array_equal(
        clamped.eval(m, large).numpy(),
        Manifold(clamped_map, epsilon=EPSILON).eval(m, large).numpy(),
    )


def test_new_data_rebuild_the_tables(variant, normal_map, pndf):
    other = maps.isotropic((96, 128), correlation_length=3, seed=5)
    pndf.data = mi.TensorXf(other.normals)
    pndf.parameters_changed(["data"])
    fresh = TabulatedManifold(other, epsilon=EPSILON, max_error=0.05)
    view = footprint()
    m = mi.Vector2f(np.random.default_rng(1).normal(scale=0.1, size=(2, 500)).astype(np.float32))
    assert np.allclose(pndf.eval(m, view).numpy(), fresh.eval(m, view).numpy(), rtol=1e-3)


def test_derivatives_with_respect_to_the_footprint(variant, pndf):
    m = mi.Vector2f(np.random.default_rng(1).normal(scale=0.1, size=(2, 200)).astype(np.float32))

    def value(sigma):
        return dr.sum(pndf.eval(m, Footprint.isotropic(mi.Point2f(0.4, 0.6), sigma)))

    sigma = mi.Float(0.15)
    dr.enable_grad(sigma)
    dr.backward(value(sigma))
    reverse = sigma.grad[0]
    sigma = mi.Float(0.15)
    dr.enable_grad(sigma)
    total = value(sigma)
    dr.forward(sigma)
    assert np.isclose(total.grad[0], reverse, rtol=1e-3) and reverse != 0


@pytest.mark.parametrize("max_error", [0, -0.1, float("nan"), float("inf")])
def test_max_error_must_be_positive(variant, normal_map, max_error):
    with pytest.raises(ParameterError, match='"max_error" must be a finite number > 0'):
        TabulatedManifold(normal_map, max_error=max_error)


# ---------------------------------------------------------------------------------------------
#  The BSDF
# ---------------------------------------------------------------------------------------------


@pytest.mark.parametrize("max_error", [0.01, 0.05, 0.2])
def test_bsdf(variant, normal_map, max_error):
    bsdf = mi.load_dict(
        {
            "type": "glint_manifold",
            "data": mi.TensorXf(normal_map.normals),
            "epsilon": EPSILON,
            "max_error": max_error,
            "masking": "none",
            "footprint_sigma": 1.0,
        }
    )
    view = View(du=(0.15, 0.02), dv=(-0.02, 0.2))
    lower, upper = (tuple(map(float, v)) for v in bsdf.pndf.bounds())
    check_chi2(bsdf, view, (lower, upper), test_count=3)
    check_weights(bsdf, view)
    for extreme in EXTREME_VIEWS.values():
        check_finite(bsdf, extreme)
