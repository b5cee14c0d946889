"""Clusters of the manifold: their fit, their cuts, and the P-NDF and BSDF with clusters."""

from __future__ import annotations

from dataclasses import replace

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest

from glintbsdf import NormalMap, maps
from glintbsdf.check import suite
from glintbsdf.check.derivatives import check_value_derivatives
from glintbsdf.check.reference import normal_bounds
from glintbsdf.check.suite import EXTREME_VIEWS, View
from glintbsdf.core.errors import ParameterError
from glintbsdf.footprint.gaussian import Footprint
from glintbsdf.pndf import ClusteredManifold, Manifold
from glintbsdf.pndf.index.lists import every_quad
from glintbsdf.pndf.manifold.cluster_fit import PHI, fit_clusters
from glintbsdf.pndf.manifold.clustered import (
    ClusterLattice,
    Ladder,
    choose_cuts,
    element_count,
    on_cut,
)
from glintbsdf.pndf.manifold.mesh import quad_density

THRESHOLDS = (1e-4, 1e-3, 1e-2)

# --------------------------------------------------------------------------------------------------
#  The fit (Eq. 7, 8)
# --------------------------------------------------------------------------------------------------


def vertices_of(normals):
    return np.pad(normals, ((0, 1), (0, 1), (0, 0)), mode="wrap")


def cluster_corners(vertices, level):
    side = 1 << level
    corners = vertices[::side, ::side]
    return np.stack([corners[:-1, :-1], corners[:-1, 1:], corners[1:, :-1], corners[1:, 1:]], -2)


def test_fit_is_exact_where_the_map_is_linear():
    i, j = np.indices((33, 17))
    vertices = np.stack([0.01 * j + 0.002 * i - 0.2, 0.01 * i - 0.003 * j], -1)
    for level, (normals, residual) in enumerate(fit_clusters(vertices, 1e-6, 4), 1):
        assert normals.shape == (32 >> level, 16 >> level, 4, 2)
        # Rounding of float64, and of the float32 result. An error of 1e-4 texels
        # everywhere would give a residual of 1e-8 · 4^l.
        assert np.allclose(normals, cluster_corners(vertices, level), atol=3e-8)
        assert residual.max() < 1e-10 * 4**level


def test_fit_keeps_the_fold_along_the_diagonal():
    """A cluster represents two planes exactly if they meet in its diagonal."""
    i, j = np.indices((9, 9))
    fold = np.abs(i + j - 8)
    vertices = np.stack([0.01 * j + 0.004 * fold, 0.01 * i - 0.002 * fold], -1)
    *_, (normals, residual) = fit_clusters(vertices, 1e-6, 3)
    assert np.allclose(normals, cluster_corners(vertices, 3), atol=3e-8)
    assert residual.max() < 1e-8


@pytest.mark.parametrize("epsilon", [1e-6, 1e-12, 0.01])
def test_fit_minimises_eq_7(epsilon):
    """Each cluster agrees with the least-squares solution of a dense quadrature of Eq. 7."""
    normals = maps.isotropic((10, 12), seed=3).normals.astype(np.float64)
    vertices = vertices_of(normals)
    vertices[4:7, 4:7] = 0.1  # flat: the Jacobian is clamped
    fits = list(fit_clusters(vertices, epsilon, 3))
    assert [f[1].shape for f in fits] == [(5, 6), (2, 3), (1, 1)]
    for level, (fitted, residual) in enumerate(fits, 1):
        side = 1 << level
        for row, column in np.ndindex(residual.shape):
            patch = vertices[row * side : (row + 1) * side + 1,
                             column * side : (column + 1) * side + 1]  # fmt: skip
            phi, n, weight = midpoints(patch, epsilon)
            root = np.sqrt(weight)[:, None]
            solution = np.linalg.lstsq(root * phi, root * n, rcond=None)[0]
            least = (weight * ((phi @ solution - n) ** 2).sum(1)).sum()
            ours = (weight * ((phi @ fitted[row, column] - n) ** 2).sum(1)).sum()
            # The accuracy of float32 normals, at weights up to 1/epsilon.
            rounding = weight.sum() * 1e-14
            assert ours <= least * (1 + 1e-5) + rounding
            assert np.isclose(residual[row, column], least, rtol=1e-5, atol=rounding)


def midpoints(patch, epsilon):
    """Barycentric weights of a cluster, normals and weights at the midpoints of all fine edges."""
    side = len(patch) - 1
    rows = []
    for i, j in np.ndindex(side, side):
        for triangle in (((i, j), (i, j + 1), (i + 1, j)),
                         ((i + 1, j + 1), (i + 1, j), (i, j + 1))):  # fmt: skip
            points = np.array(triangle, float)
            n = np.array([patch[p] for p in triangle])
            (a, b), (c, d) = n[1:] - n[0]
            weight = 0.5 / 3 / max(abs(a * d - b * c), epsilon)
            for k in range(3):
                y, x = (points[k] + points[k - 1]) / (2 * side)
                upper = points.mean(0).sum() < side
                rows.append((PHI[0 if upper else 1] @ [1, x, y], (n[k] + n[k - 1]) / 2, weight))
    return tuple(np.array(v) for v in zip(*rows, strict=True))


def test_fit_of_a_flat_map_is_flat():
    for normals, residual in fit_clusters(np.full((17, 17, 2), 0.3), 1e-6, 4):
        assert np.array_equal(normals, np.full_like(normals, 0.3)) and residual.max() == 0


# --------------------------------------------------------------------------------------------------
#  Cuts
# --------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("shape", [(64, 64), (37, 53), (16, 100)])
def test_cuts_tile_the_lattice(shape):
    rng = np.random.default_rng(1)
    residuals = [rng.random((shape[0] >> k, shape[1] >> k)) * 4**k for k in range(1, 5)]
    for threshold in (0, 0.5, 3, 20, 1e9):
        cut = on_cut(residuals, threshold)
        covered = np.zeros(shape, int)
        for level, on in enumerate(cut, 1):
            assert (residuals[level - 1][on] <= threshold).all()
            parts = on.repeat(1 << level, 0).repeat(1 << level, 1)
            covered[: parts.shape[0], : parts.shape[1]] += parts
        assert covered.max() <= 1
        count = sum(int(on.sum()) for on in cut) + (covered == 0).sum()
        assert count == element_count(shape[0] * shape[1], cut)
        # Coarsest first: no cluster of the cut lies in an acceptable larger one.
        for level in range(1, len(cut)):
            child = cut[level - 1]
            small = (residuals[level] <= threshold).repeat(2, 0).repeat(2, 1)
            rows, columns = (min(a, b) for a, b in zip(child.shape, small.shape, strict=True))
            assert not (child[:rows, :columns] & small[:rows, :columns]).any()


def test_ladder_climbs():
    rng = np.random.default_rng(2)
    residuals = [rng.random((128 >> k, 128 >> k)) * 64**k for k in range(1, 8)]
    cuts = choose_cuts(128**2, residuals, 4, np.inf)
    thresholds = [threshold for threshold, _, _ in cuts]
    assert len(cuts) == 3 and thresholds == sorted(thresholds)
    for rung, (_, cut, shift) in enumerate(cuts, 2):
        assert element_count(128**2, cut) <= 128**2 / 4**rung
        assert len(cut) <= shift
    limited = choose_cuts(128**2, residuals, 4, thresholds[1])
    assert [threshold for threshold, _, _ in limited] == thresholds[:2]


# --------------------------------------------------------------------------------------------------
#  The P-NDF
# --------------------------------------------------------------------------------------------------

MAPS = {
    "isotropic": maps.isotropic((72, 100), seed=1),
    "brushed": maps.brushed((64, 50), streak_length=20, streak_width=3),
    "scratched": maps.scratched(64, length=30),
    "mirror": NormalMap(maps.isotropic((40, 52), seed=1).normals, "mirror"),
    "clamp": NormalMap(maps.isotropic(512, seed=1).normals, "clamp"),
    "flat": maps.flat(64),
    "tilted": maps.tilted(50),
}

# Coarse cuts, so that every rung is used: the residuals of these maps are 1e-2 to 1e5 texels⁴.
COARSE = 10.0


def footprints(normal_map, count, seed=2):
    """Rotated footprints of 0.5 to 20 texels, at most two maps away."""
    rng = np.random.default_rng(seed)
    sigma = np.exp(rng.uniform(np.log(0.5), np.log(20), (2, count)))
    turn = 2 * np.pi * rng.random(count)
    size = np.array([[normal_map.width], [normal_map.height]])
    du = np.stack([np.cos(turn), np.sin(turn)]) * sigma[0] / size
    dv = np.stack([-np.sin(turn), np.cos(turn)]) * sigma[1] / size
    uv = rng.random((2, count)) * 4 - 2
    return Footprint(mi.Point2f(uv.astype(np.float32)), mi.Vector2f(du.astype(np.float32)),
                     mi.Vector2f(dv.astype(np.float32)))  # fmt: skip


def draw(pndf, footprint, count, seed=3):
    u = np.random.default_rng(seed).random((2, count), dtype=np.float32)
    m = pndf.sample(footprint, 0.0, mi.Point2f(mi.Float(u[0]), mi.Float(u[1])))
    dr.eval(m)
    return m


class WithinQuad:
    """A kernel that is restricted to one quad; offsets are in units of an element's side."""

    def __init__(self, kernel, side, corner) -> None:
        self.kernel, self.side, self.corner = kernel, side, corner

    def value(self, offset):
        u = offset * self.side
        inside = dr.all((u >= self.corner) & (u < self.corner + 1))
        return dr.select(inside, self.kernel.value(u), 0)


def sum_over_quads(pndf, m, footprint):
    """D from every quad in the kernel's box, each with its part of its element; no lists are
    used."""
    kernel = pndf.texel_kernel(footprint)
    rung = pndf.rung(kernel)

    def add(density, row, column, corner, active):
        level = pndf.ladder.level_at(row, column, rung, active)
        side = mi.Float(1 << level)
        inside = mi.Int(1 << level) - 1
        element = corner - mi.Vector2f(column & inside, row & inside)
        added = quad_density(m, element / side, WithinQuad(kernel, side, corner),
                             pndf.element_normals(row, column, level, active), pndf.epsilon,
                             active)  # fmt: skip
        return density + dr.select(active, side * side * added, 0)

    return every_quad(pndf.clusters, kernel, add, mi.Bool(True)).numpy()


@pytest.mark.parametrize(
    ("name", "kernel"),
    [*((name, "gaussian") for name in MAPS), ("isotropic", "box"), ("scratched", "disk")],
)
def test_lists_equal_the_loop_over_all_quads(variant, name, kernel):
    pndf = ClusteredManifold(MAPS[name], COARSE, kernel)
    footprint = footprints(MAPS[name], 1000)
    m = draw(pndf, footprint, 1000)
    density, expected = pndf.eval(m, footprint).numpy(), sum_over_quads(pndf, m, footprint)
    used = np.unique(pndf.rung(pndf.texel_kernel(footprint)).numpy())
    assert np.array_equal(used, np.arange(len(used))) and len(used) > 1
    # All except samples on the very edge of the kernel or of a clamped triangle.
    assert (density > 0).mean() > 0.995
    # Positions are rounded, so that a few terms are found in the quad beside their own.
    apart = np.abs(density - expected) > 1e-3 * (density + expected)
    assert apart.mean() < 0.01


def mass(pndf, footprint, bounds, res=128, repetitions=4):
    """Integral of D over the rectangle, from jittered points, and its standard error."""
    lower, upper = np.array(bounds)
    rng = np.random.default_rng(4)
    runs = []
    for _ in range(repetitions):
        row, column = (np.indices((res, res)) + rng.random((2, res, res))) / res
        m = [np.float32(lower[k] + (upper - lower)[k] * t.ravel())
             for k, t in enumerate((column, row))]  # fmt: skip
        runs.append(pndf.eval(mi.Vector2f(*m), footprint).numpy().mean(dtype=np.float64))
    runs = np.array(runs) * np.prod(upper - lower)
    return runs.mean(), runs.std(ddof=1) / np.sqrt(repetitions)


@pytest.mark.parametrize("name", MAPS)
def test_every_cut_has_mass_one(variant, name):
    """Also for a footprint larger than the map, and far outside of a clamped map."""
    normal_map = MAPS[name]
    pndf = ClusteredManifold(normal_map, COARSE, epsilon=1e-3)
    triangles = pndf.vertices.numpy().reshape(-1, 2)  # clusters may reach beyond the map's normals
    bounds = triangles.min(0) - 0.03, triangles.max(0) + 0.03
    for sigma, uv in ((0.05, (0.99, 0.02)), (0.3, (0.2, 1.4)), (3, (0.5, 0.5))):
        if sigma > 1 and name == "clamp":
            continue  # 300 million texels
        total, error = mass(pndf, Footprint.isotropic(mi.Point2f(uv), sigma), bounds)
        # Four standard errors; float32 rounding of the areas of triangles.
        assert abs(total - 1) < 4 * error + 1e-3, (sigma, total, error)


def test_a_small_threshold_is_exact(variant):
    normal_map = MAPS["isotropic"]
    exact, pndf = Manifold(normal_map), ClusteredManifold(normal_map, 1e-12)
    footprint = footprints(normal_map, 500)
    m = draw(exact, footprint, 500)
    assert pndf.ladder is None
    assert np.array_equal(np.array(m), np.array(draw(pndf, footprint, 500)))
    assert np.array_equal(exact.eval(m, footprint), pndf.eval(m, footprint))


def test_highlight_of_a_flat_map_keeps_its_size(variant):
    """Clusters without error are used at any threshold; their triangles are clamped, too."""
    pndf = ClusteredManifold(maps.flat(64), 1e-12)
    footprint = footprints(maps.flat(64), 2000)
    assert pndf.rung(pndf.texel_kernel(footprint)).numpy().max() == len(pndf.ladder.thresholds)
    m = np.array(draw(pndf, footprint, 2000))
    assert np.hypot(*m).max() < 6.21e-4  # circumradius at ε = 1e-6: 6.2040e-4


def test_clusters_converge_to_the_exact_density(variant):
    normal_map = maps.isotropic(128, seed=1)
    exact = Manifold(normal_map)
    footprint = Footprint.isotropic(mi.Point2f(0.37, 0.61), 20 / 128)
    lower, upper = np.array(normal_bounds(normal_map))
    grid = (np.indices((512, 512)) + 0.5) / 512
    m = mi.Vector2f(*(np.float32(lower[k] + (upper - lower)[k] * grid[1 - k].ravel())
                      for k in range(2)))  # fmt: skip

    def binned(pndf):
        return pndf.eval(m, footprint).numpy().reshape(64, 8, 64, 8).mean((1, 3))

    reference, errors = binned(exact), []
    for threshold in (1e-4, 1, 100):
        density = binned(ClusteredManifold(normal_map, threshold))
        errors.append(np.abs(density - reference).sum() / reference.sum())
    # Exact, then two rungs of the ladder: 0, 0.26, 1.0 were measured.
    assert errors[0] == 0 and np.all(np.diff(errors) > 0.1), errors


def test_small_maps_have_no_clusters(variant):
    for normal_map in (maps.isotropic((31, 40)), maps.tilted(1),
                       NormalMap(maps.isotropic(511).normals, "clamp")):  # fmt: skip
        assert ClusteredManifold(normal_map, 10).ladder is None


@pytest.mark.parametrize(
    ("size", "wrap_mode", "rungs"),
    [(31, "repeat", 0), (32, "repeat", 2), (1000, "repeat", 6), (16, "mirror", 2),
     (511, "clamp", 0), (1024, "clamp", 3)],
)  # fmt: skip
def test_rungs_that_fit(variant, size, wrap_mode, rungs):
    assert ClusterLattice(size, 2 * size, wrap_mode).rungs == rungs


@pytest.mark.parametrize("threshold", [0, -1e-3, float("nan"), float("inf")])
def test_threshold_must_be_positive(variant, threshold):
    with pytest.raises(ParameterError, match=r'M: "threshold" must be a finite number > 0'):
        ClusteredManifold(maps.flat(4), threshold, owner="M")


def test_memory(variant):
    """The clusters of 1024² may take 34 MB, besides the exact structure."""
    normal_map = maps.isotropic(1024, seed=1)
    assert ClusteredManifold(normal_map, 1e-2).nbytes - Manifold(normal_map).nbytes <= 34e6


def test_ladders_are_cached_and_equal(variant, monkeypatch, tmp_path):
    monkeypatch.setenv("GLINTBSDF_CACHE", str(tmp_path))
    normal_map = maps.isotropic(40, seed=5)
    first = ClusteredManifold(normal_map, COARSE)
    assert len(list(tmp_path.glob("*.npz"))) == 2  # the lists of quads, and the ladder

    def refuse(*args):
        raise AssertionError("built again")

    with monkeypatch.context() as patch:
        patch.setattr(Ladder, "build", refuse)
        second = ClusteredManifold(normal_map, COARSE, kernel="disk")
    footprint = footprints(normal_map, 500)
    m = draw(first, footprint, 500)
    assert second.ladder.thresholds == first.ladder.thresholds
    assert np.array_equal(second.vertices, first.vertices)
    second.kernel = "gaussian"
    assert np.array_equal(first.eval(m, footprint), second.eval(m, footprint))
    ClusteredManifold(normal_map, 2 * COARSE)
    assert len(list(tmp_path.glob("*.npz"))) == 3


def test_new_data_are_used(variant):
    old, new = maps.isotropic(40, seed=5), maps.isotropic(40, seed=6)
    pndf, fresh = ClusteredManifold(old, COARSE), ClusteredManifold(new, COARSE)
    pndf.data = mi.TensorXf(new.normals)
    pndf.parameters_changed(["data"])
    footprint = footprints(new, 500)
    m = draw(fresh, footprint, 500)
    assert np.array_equal(pndf.eval(m, footprint), fresh.eval(m, footprint))


# --------------------------------------------------------------------------------------------------
#  The BSDF
# --------------------------------------------------------------------------------------------------

# Large enough for the thresholds of the paper to choose clusters.
LARGE_MAPS = {
    "isotropic": maps.isotropic(128, seed=1),
    "smooth": maps.isotropic(128, correlation_length=48, seed=1),
    "scratched": maps.scratched(64, length=30),
    "odd": maps.isotropic((100, 130), seed=2),
    "flat": maps.flat(64),
}
VIEW = View(du=(0.12, 0.05), dv=(-0.03, 0.09), wi=(0.3, 0.1, 1))
EPSILON = 1e-3


def load(normal_map: NormalMap, **parameters) -> mi.BSDF:
    return mi.load_dict({"type": "glint_manifold", "data": mi.TensorXf(normal_map.normals),
                         "wrap_mode": normal_map.wrap_mode, "footprint_sigma": 1.0,
                         "masking": "none", **parameters})  # fmt: skip


SUITE = [
    *(("smooth", threshold, 1e-6) for threshold in THRESHOLDS),
    ("isotropic", 10.0, EPSILON),
    ("scratched", 10.0, EPSILON),
    ("odd", 1.0, EPSILON),
    ("flat", 1e-3, EPSILON),
]


@pytest.mark.parametrize(("name", "threshold", "epsilon"), SUITE)
def test_shared_suite(variant, name, threshold, epsilon):
    bsdf = load(LARGE_MAPS[name], threshold=threshold, epsilon=epsilon)
    bounds = normal_bounds(LARGE_MAPS[name], epsilon)
    if bsdf.pndf.ladder is not None:  # a cluster may reach beyond the map's normals
        vertices = bsdf.pndf.vertices.numpy().reshape(-1, 2)
        bounds = tuple(np.minimum(bounds[0], vertices.min(0)).tolist()), tuple(
            np.maximum(bounds[1], vertices.max(0)).tolist())  # fmt: skip
    suite.check_chi2(bsdf, VIEW, bounds, len(SUITE), samples=30_000)
    for view in (VIEW, EXTREME_VIEWS["1000:1"]):
        suite.check_eval_pdf(bsdf, view, 500)
        suite.check_weights(bsdf, view, 500)
        suite.check_horizon(bsdf, view, 200)
    suite.check_furnace(bsdf, replace(VIEW, wi=(0, 0, 1)))


@pytest.mark.parametrize("name", ["isotropic", "flat"])
def test_extremes_are_finite(variant, name):
    bsdf = load(LARGE_MAPS[name], threshold=1.0)
    for view in EXTREME_VIEWS.values():
        suite.check_finite(bsdf, view)


@pytest.mark.parametrize(("name", "threshold", "epsilon"), SUITE[1:])
def test_clusters_are_used(variant, name, threshold, epsilon):
    """Otherwise the tests above would test the exact mode, as they do at 1e-4."""
    bsdf = load(LARGE_MAPS[name], threshold=threshold, epsilon=epsilon)
    kernel = bsdf.pndf.texel_kernel(bsdf.footprint(VIEW.interaction()))
    assert bsdf.pndf.rung(kernel)[0] > 0


def test_derivative_with_respect_to_the_footprint(variant):
    bsdf = load(LARGE_MAPS["isotropic"], threshold=1.0)
    check_value_derivatives(bsdf, VIEW, "footprint_sigma")


def test_other_variants(each_variant):
    bsdf = load(LARGE_MAPS["isotropic"], threshold=1.0)
    suite.check_weights(bsdf, VIEW, 500)
    suite.check_finite(bsdf, VIEW)
