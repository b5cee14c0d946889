"""The P-NDF of Gaussian elements: against float64, and against the binned reference; flakes."""

from __future__ import annotations

from functools import cache

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
import scipy.spatial

from glintbsdf import Footprint, NormalMap, maps
from glintbsdf.check.reference import binned_pndf, texel_covariance
from glintbsdf.core.errors import ParameterError
from glintbsdf.core.tuning import tuning
from glintbsdf.maps.poisson_disk import balanced_areas, cells_for, poisson_disk
from glintbsdf.pndf import Elements, Flakes
from glintbsdf.pndf.elements import elements
from glintbsdf.pndf.elements.flakes import MIN_SIGMA_OF_LISTS
from glintbsdf.pndf.gaussian_elements import SIGMA_H

MAP = maps.isotropic(48, seed=1)
UV = (0.37, 0.61)


def footprint(sigma, size=48, aspect=1.0, angle=0.5):
    """A footprint of ``sigma`` by ``aspect`` times ``sigma`` texels."""
    c, s = float(np.cos(angle) / size), float(np.sin(angle) / size)
    major = aspect * sigma
    return Footprint(
        mi.Point2f(UV), mi.Vector2f(major * c, major * s), mi.Vector2f(-sigma * s, sigma * c)
    )


def draw(pndf, seen, count, seed=1):
    u = np.random.default_rng(seed).random((3, count), dtype=np.float32)
    m = pndf.sample(seen, mi.Float(u[0]), mi.Point2f(mi.Float(u[1]), mi.Float(u[2])))
    dr.eval(m)
    return m


# --------------------------------------------------------------------------------------------------
#  float64
# --------------------------------------------------------------------------------------------------


def mixture(normal_map, step, sigma_r, curved, m, sigma_p):
    """D(m) by its definition: all seeds near ``UV``, in texels, float64; m is (N, 2)."""
    size = normal_map.width
    centre = np.array(UV) * size - 0.5
    offset = min(step, 1) / 2
    t = sigma_p + (step * SIGMA_H) ** 2 * np.eye(2)
    s2 = (step * SIGMA_H) ** 2
    reach = int(6 * np.sqrt(np.linalg.eigvalsh(t)[1]) / step) + 2
    k = np.floor((centre - offset) / step)[:, None, None] + np.mgrid[-reach : reach + 1][None]
    x, y = (v.ravel() * step + offset for v in np.meshgrid(k[0], k[1]))
    column, row = np.floor(x).astype(int), np.floor(y).astype(int)
    fx, fy = (x - column)[:, None], (y - row)[:, None]
    normals = normal_map.normals.astype(np.float64)
    n0, n1, n2, n3 = (
        normals[(row + i) % size, (column + j) % size] for i, j in ((0, 0), (0, 1), (1, 0), (1, 1))
    )
    side = np.where(np.abs(fx + fy - 1) < 1e-9, 0.5, (fx + fy > 1).astype(float))
    first = n0 + fx * (n1 - n0) + fy * (n2 - n0)
    second = n3 + (1 - fx) * (n2 - n3) + (1 - fy) * (n1 - n3)
    normal = np.where(fx + fy > 1, second, first)
    jacobian = np.stack(
        [(1 - side) * (n1 - n0) + side * (n3 - n2), (1 - side) * (n2 - n0) + side * (n3 - n1)], -1
    )
    jacobian = jacobian if curved else 0 * jacobian

    d = centre - np.stack([x, y], 1)
    rho2 = np.einsum("ni,ij,nj->n", d, np.linalg.inv(t), d)
    sigma = np.sqrt(np.linalg.eigvalsh(t)[0]) / step
    small = 10 - 6 * SIGMA_H**2 / sigma**2
    touched = (2 * np.sqrt(small * np.diag(t)) + 1).prod()
    few = touched <= tuning().few_cells  # with cells of one texel
    cut = small if few else 10 + 3.5 * max(np.log2(2.5 / sigma), 0)
    w = np.exp(-0.5 * rho2) * np.clip((cut - rho2) / 2, 0, 1)
    w /= w.sum()
    mean = normal + np.einsum("nij,nj->ni", jacobian, s2 * d @ np.linalg.inv(t))
    c = s2 * sigma_p @ np.linalg.inv(t)
    covariance = sigma_r**2 * np.eye(2) + jacobian @ c @ jacobian.transpose(0, 2, 1)
    delta = m[:, None] - mean
    form = np.einsum("kni,nij,knj->kn", delta, np.linalg.inv(covariance), delta)
    peak = 1 / (2 * np.pi * np.sqrt(np.linalg.det(covariance)))
    return (w * peak * np.exp(-0.5 * form)).sum(1)


@pytest.mark.parametrize("sigma_r", [1e-2, 1e-5])
@pytest.mark.parametrize("curved", [True, False])
@pytest.mark.parametrize("step", [0.5, 1.0])
def test_mixture_in_float64(variant, step, curved, sigma_r):
    # Normals in steps of 2⁻¹⁴, and positions that float32 represents exactly, so that the rounding
    # of the input, which no formula can undo, does not count.
    normals = np.round(MAP.normals * 2**14) / 2**14
    normal_map = NormalMap(normals.astype(np.float32))
    pndf = Elements(normal_map, sigma_r, step, curved)
    for sigma, aspect in ((0.05, 1), (0.4, 3), (1.5, 1), (2.0, 4)):
        seen = footprint(sigma, aspect=aspect)
        m = np.array(draw(pndf, seen, 400)).T
        exact = mixture(
            normal_map, step, sigma_r, curved, m.astype(np.float64), covariance(seen) * 48**2
        )
        ours = pndf.eval(mi.Vector2f(m.T), seen).numpy()
        # Where lists are used, normals are cut: 4.3e-4 of the mass. Measured in L1: 5e-4.
        assert np.abs(ours / exact - 1).mean() < (2e-3 if sigma_r > 1e-4 else 2e-2)
        assert np.median(np.abs(ours / exact - 1)) < (1e-4 if sigma_r > 1e-4 else 5e-3)


def covariance(seen):
    du, dv = (np.array(v, np.float64).ravel() for v in (seen.du, seen.dv))
    return np.outer(du, du) + np.outer(dv, dv)


# --------------------------------------------------------------------------------------------------
#  The binned reference
# --------------------------------------------------------------------------------------------------


SIGMA = 8.0


@cache
def reference_of(name):
    normal_map = getattr(maps, name)(128, seed=1)
    options = {"epsilon": 0.0, "sigma_r": 0.005, "res": 48, "samples": 4_000_000}
    return normal_map, binned_pndf(normal_map, UV, texel_covariance(normal_map, SIGMA), **options)


def binned_error(name, step, curved=True, points=3):
    """Relative L1 difference to the reference, with its noise of 1 %."""
    normal_map, reference = reference_of(name)
    pndf, res = Elements(normal_map, 0.005, step, curved), len(reference.density)
    (x0, y0), (x1, y1) = reference.bounds
    g = (np.arange(res * points) + 0.5) / (res * points)
    x, y = np.meshgrid(x0 + (x1 - x0) * g, y0 + (y1 - y0) * g)
    m = mi.Vector2f(mi.Float(x.ravel()), mi.Float(y.ravel()))
    seen = Footprint.isotropic(mi.Point2f(UV), SIGMA / normal_map.width)
    density = pndf.eval(m, seen).numpy().reshape(res, points, res, points).mean(axis=(1, 3))
    return reference.relative_l1(density)


def test_binned_reference(variant):
    """The error is below 3 % at half a texel, and falls with the step; flat elements have a large
    error."""
    coarse, middle, fine = (binned_error("isotropic", h) for h in (2, 1, 0.5))
    # Measured: 16 %, 5.6 %, 2 %, of which 1 % is noise.
    assert fine < 0.03 and middle < 0.08
    assert coarse > 1.5 * middle > 1.5 * 1.5 * fine
    assert binned_error("isotropic", 0.5, curved=False) > 4 * fine


@pytest.mark.parametrize("name", ["brushed", "scratched"])
def test_binned_reference_of_other_maps(variant, name):
    assert binned_error(name, 0.5) < 0.03


# --------------------------------------------------------------------------------------------------
#  Normalisation
# --------------------------------------------------------------------------------------------------


def integral(pndf, seen, sigma_r):
    """∫D by the trapezoidal rule, which a mixture of Gaussians of width ≥ 2 steps makes exact."""
    lower, upper = (np.array(v) for v in (pndf.lists.cells.lower, pndf.lists.cells.upper))
    lower, upper = lower - 2 * sigma_r, upper + 2 * sigma_r
    nx, ny = np.ceil((upper - lower) / (0.5 * sigma_r)).astype(int)
    x, y = np.meshgrid(np.linspace(lower[0], upper[0], nx), np.linspace(lower[1], upper[1], ny))
    m = mi.Vector2f(*(mi.Float(v.ravel().astype(np.float32)) for v in (x, y)))
    area = np.prod((upper - lower) / (nx - 1, ny - 1))
    return pndf.eval(m, seen).numpy().astype(np.float64).sum() * area


PNDFS = {
    "half": lambda: Elements(MAP, 0.01, 0.5),
    "flat": lambda: Elements(MAP, 0.01, 1.0, False),
    "two": lambda: Elements(maps.isotropic(48, alpha=0.05, seed=1), 0.01, 2.0),
    "uneven": lambda: Elements(MAP, 0.01, 0.7),
    "quarter": lambda: Elements(maps.isotropic(12, seed=1), 0.01, 0.25),
    "clamp": lambda: Elements(NormalMap(MAP.normals, "clamp"), 0.01, 0.5),
    "one_texel": lambda: Elements(maps.tilted(1), 0.01, 0.5),
    "flakes": lambda: Flakes(2000, 0.1, 0.01),
}


@pytest.mark.parametrize("name", PNDFS)
def test_integral_is_one(variant, name):
    """∫D is 1 within 1e-3 everywhere, with the ripple of W (5e-4) and the cut of normals
    (4.3e-4)."""
    pndf = PNDFS[name]()
    for sigma, aspect in ((0, 1), (0.05, 1), (0.3, 1), (0.7, 1), (1.4, 1), (3, 1), (0.05, 60)):
        assert abs(integral(pndf, footprint(sigma, aspect=aspect), 0.01) - 1) < 1e-3, (
            sigma,
            aspect,
        )


def test_footprint_larger_than_the_map(variant):
    pndf = Elements(maps.isotropic(8, seed=1), 0.01, 0.5)
    assert abs(integral(pndf, Footprint.isotropic(mi.Point2f(UV), 5.0), 0.01) - 1) < 1e-3


def test_lists_leave_out_little(variant, monkeypatch, tune):
    """All cells against the lists, for the same cut: the lists miss at most the mass beyond
    NORMAL_REACH."""
    pndf = Elements(MAP, 0.01, 0.5)
    monkeypatch.setattr(elements, "cut_of_sums", lambda sigma, _: elements.cut_of_lists(sigma))
    seen = footprint(1.5)
    m = draw(pndf, seen, 3000)
    densities = {}
    for limit in (0, np.inf):
        tune(few_cells=limit)
        densities[limit] = pndf.eval(m, seen).numpy()
    # For normals drawn from D, the mean relative difference is the fraction of the mass.
    assert abs(np.mean(densities[0] / densities[np.inf]) - 1) < 1e-3


def test_mirroring_is_repetition_of_the_unfolded_map(variant):
    unfolded = np.concatenate([MAP.normals, MAP.normals[::-1]], axis=0)
    unfolded = np.concatenate([unfolded, unfolded[:, ::-1]], axis=1)
    mirrored = Elements(NormalMap(MAP.normals, "mirror"), 0.01)
    repeated = Elements(NormalMap(unfolded), 0.01)
    seen = Footprint.isotropic(mi.Point2f(0.99, 1.4), 2 / 48)
    half = Footprint.isotropic(mi.Point2f(0.495, 0.7), 1 / 48)
    m = draw(mirrored, seen, 1000)
    a, b = mirrored.eval(m, seen).numpy(), repeated.eval(m, half).numpy()
    # The cells of normals differ, and with them 6e-4 of the mass, as measured.
    assert np.abs(a / b - 1).mean() < 2e-3


# --------------------------------------------------------------------------------------------------
#  Flakes
# --------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("count", [1, 2, 50, 3000])
def test_poisson_disk(count):
    places = poisson_disk(count, np.random.default_rng(1))
    n = cells_for(count)
    row, column = np.nonzero(~np.isnan(places[..., 0]))
    assert len(row) == count and places.shape == (n, n, 2)
    assert ((places[row, column] >= 0) & (places[row, column] < 1)).all()
    position = places[row, column] + np.stack([column, row], 1)
    difference = position[:, None] - position[None]
    difference -= n * np.round(difference / n)
    distance = np.linalg.norm(difference, axis=-1) + 100 * np.eye(count)
    assert distance.min() >= np.sqrt(2) - 1e-5
    assert np.isclose(balanced_areas(places).sum(), n * n, rtol=1e-5)


def test_no_gap_between_flakes_is_out_of_reach():
    count = 20_000
    places = poisson_disk(count, np.random.default_rng(3))
    n = cells_for(count)
    row, column = np.nonzero(~np.isnan(places[..., 0]))
    position = (places[row, column] + np.stack([column, row], 1)) % n
    tree = scipy.spatial.cKDTree(position, boxsize=n)
    distance, _ = tree.query(np.random.default_rng(4).random((200_000, 2)) * n)
    reach = np.sqrt(Flakes.point_cut) * SIGMA_H * n / np.sqrt(count)
    assert distance.max() < 0.8 * reach  # measured: 0.57


def test_balanced_flakes_cover_evenly(variant):
    """Under footprints of MIN_SIGMA_OF_LISTS mean distances, the flakes' mass is 1 within 1e-3."""
    count = 3000
    places = poisson_disk(count, np.random.default_rng(1))
    n, areas = cells_for(count), balanced_areas(places)
    row, column = np.nonzero(areas)
    position = (places[row, column] + np.stack([column, row], 1)).astype(np.float64)
    sigma = MIN_SIGMA_OF_LISTS * n / np.sqrt(count)
    x = np.random.default_rng(2).random((500, 2)) * n
    d = x[:, None] - position[None]
    d -= n * np.round(d / n)
    weights = np.exp(-0.5 * (d**2).sum(-1) / sigma**2) / (2 * np.pi * sigma**2)
    # Measured: 7e-4.
    assert np.abs(weights @ areas[row, column].astype(np.float64) - 1).max() < 1e-3
    assert np.abs(weights.sum(1) * (n * n / count) - 1).max() > 0.05


def test_flakes_have_the_requested_roughness(variant):
    pndf = Flakes(20_000, 0.2, 1e-4)
    slopes = pndf.flake_normals / np.sqrt(1 - (pndf.flake_normals**2).sum(1, keepdims=True))
    assert np.allclose(slopes.var(axis=0), 0.2**2 / 2, rtol=0.05)  # 20,000 draws: 1 %


# --------------------------------------------------------------------------------------------------
#  Memory, data, errors
# --------------------------------------------------------------------------------------------------


def test_memory(variant):
    """The paper's 2048² map takes 1120 MB at half a texel, and a quarter at one texel; here it
    takes less than half."""
    normal_map = maps.isotropic(256, seed=1)
    share = (2048 / 256) ** 2
    assert Elements(normal_map, step=0.5).nbytes * share < 560e6
    assert Elements(normal_map, step=1.0).nbytes * share < 280e6


def test_new_data_are_checked_and_used(variant):
    pndf, other = Elements(MAP), maps.isotropic(48, seed=2)
    pndf.data = mi.TensorXf(other.normals)
    pndf.parameters_changed(["data"])
    m, seen = draw(pndf, footprint(2), 200), footprint(2)
    assert np.array_equal(pndf.eval(m, seen).numpy(), Elements(other).eval(m, seen).numpy())
    pndf.sigma_r = mi.Float(-1)
    with pytest.raises(ParameterError, match='Elements: "sigma_r" must be a number in'):
        pndf.parameters_changed(["sigma_r"])


@pytest.mark.parametrize("value", [0.0, -1.0, float("nan"), float("inf")])
def test_bad_values(variant, value):
    with pytest.raises(ParameterError, match='"sigma_r"'):
        Elements(MAP, sigma_r=value)
    with pytest.raises(ParameterError, match='"step"'):
        Elements(MAP, step=value)
    with pytest.raises(ParameterError, match='"flake_density"'):
        Flakes(value)
