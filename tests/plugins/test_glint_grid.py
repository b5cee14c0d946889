"""The plugin glint_grid and its P-NDF: counts, coverage, the mean surface, and use in Mitsuba."""

from __future__ import annotations

from dataclasses import replace

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
import scipy.stats

from glintbsdf import Footprint
from glintbsdf.check import suite
from glintbsdf.check.suite import EXTREME_VIEWS, View
from glintbsdf.core.hashing import pcg3d
from glintbsdf.footprint.query import Query
from glintbsdf.pndf import Grid
from glintbsdf.pndf.colors import Wheel
from glintbsdf.pndf.grid.ellipse import Part
from glintbsdf.pndf.grid.microdetails import SHORTENING, CoveredCells, ReflectingCount

GROOVES = {"detail_alpha_u": 0.3, "detail_alpha_v": 0.03}
SURFACES = {
    "isotropic": {},
    "anisotropic": {"alpha_u": 0.4, "alpha_v": 0.1, "detail_alpha": 0.04},
    "grooves": GROOVES,
    "wheel": {"colors": "wheel"},
    "one_lobe": {"detail_alpha": 0.3},
    "wide_light": {"light_spread": 0.2},
    "varied": {"size_variation": 2.0},
    "equal": {"size_variation": 0.0},
}
# Options, a deviation of half vectors along u, and the tolerance of D averaged over this ellipse.
# Measured: 0.007, 0.08, 0.29, 0.03 and 0.05; a part of the ellipse of many cells is seen as one.
BOUNDS = ((-0.4, -0.4), (0.4, 0.4))
SPREADS = {
    "small": ({}, 0.0025, 0.01),
    "lamp": ({"detail_alpha": (0.02, 0.02)}, 0.02, 0.1),
    "many cells": ({"detail_alpha": (0.02, 0.02)}, 0.1, 0.36),
    "grooves": ({"detail_alpha": (0.3, 0.03)}, 0.02, 0.04),
    "wheel": ({"colors": Wheel()}, 0.02, 0.06),
}
# A rotated footprint with a few microdetails, whose reflections stay above the horizon.
RESOLVED = View(du=(4e-4, 3e-4), dv=(-1.5e-4, 2e-4), wi=(0.3, 0.1, 1))


def describe(**parameters) -> dict:
    return {"type": "glint_grid", "footprint_sigma": 1.0, **parameters}


def load(**parameters) -> mi.BSDF:
    return mi.load_dict(describe(**parameters))


def beckmann(alpha_u: float = 0.3, alpha_v: float = 0.3, **_) -> mi.BSDF:
    """The mean surface of ``load`` with the same parameters."""
    return mi.load_dict(
        {
            "type": "roughconductor",
            "distribution": "beckmann",
            "alpha_u": alpha_u,
            "alpha_v": alpha_v,
        }
    )


def scattered_interactions(count: int, extent: float, sigma: float, wi=(0.3, 0.1, 1), seed=1):
    """Interactions at random positions in the square [0, extent]², with round footprints."""
    si = replace(RESOLVED, du=(sigma, 0), dv=(0, sigma), wi=wi).interaction(count)
    si.uv = extent * mi.Point2f(*suite.random_numbers(count, 2, seed))
    return si


def relative_values(bsdf: mi.BSDF, smooth: mi.BSDF, si, wo=(0.1, -0.2, 1)) -> np.ndarray:
    """Values of ``bsdf`` relative to the smooth surface, channels × interactions."""
    ctx, wo = mi.BSDFContext(), dr.normalize(mi.Vector3f(wo))
    value, expected = (
        np.array(suite.intensity(b.eval(ctx, si, wo)), np.float64) for b in (bsdf, smooth)
    )
    return np.atleast_2d(value / expected)


# --------------------------------------------------------------------------------------------------
#  The number of reflecting microdetails
# --------------------------------------------------------------------------------------------------


def counts(n: float, p: float, size: int = 1 << 18) -> tuple[np.ndarray, float]:
    """Counts for ``size`` stratified random numbers, and p rounded to float32."""
    low_bits = pcg3d(dr.arange(mi.UInt32, size), 0, 0)[0] >> 18
    bits = (dr.arange(mi.UInt32, size) << 14) + low_bits
    draw = ReflectingCount(mi.Float(p)).draw(bits, mi.Float(n), mi.Bool(True))
    return np.array(draw, np.float64), float(np.float32(p))


@pytest.mark.parametrize("p", [1e-11, 1e-4, 0.03, 0.4, 0.5, 0.8, 0.999, 1.0])
@pytest.mark.parametrize("n", [1, 2, 7, 100, 10_000, 1_000_000, 1e12])
def test_count_has_mean_and_variance_of_the_binomial(variant, n, p):
    count, p = counts(n, p)
    mean, variance = n * p, n * p * (1 - p)
    assert count.min() >= 0 and count.max() <= n
    # Measured: at most 8e-4 of the rarer outcome, where the Gaussian begins. The strata find events
    # down to a few times their number; beyond 2^24, float32 rounds the counts.
    rarer = min(mean, n - mean)
    resolution = 4 * np.sqrt(variance) / len(count) + 4 / len(count) + n * 2.0**-24
    assert abs(count.mean() - mean) <= 1e-3 * rarer + resolution
    if rarer > 0.01 and n < 1e7:
        # Measured: 1 % where the Gaussian begins.
        assert np.isclose(count.var(), variance, rtol=0.015)


@pytest.mark.parametrize(("n", "p"), [(3, 0.2), (8, 0.5), (12, 0.9), (50, 0.07), (1e6, 3.9e-6)])
def test_small_counts_are_exactly_binomial(variant, n, p):
    count, p = counts(n, p)
    assert (count == np.round(count)).all()
    values = np.arange(10) if p < 0.5 else n - np.arange(10)
    values = values[values >= 0]
    frequency = [(count == k).mean() for k in values]
    expected = scipy.stats.binom.pmf(values, n, p)
    # The tail begins after ten terms. Each frequency has an error of one stratum, plus rounding of
    # float32 in ten products.
    assert np.allclose(frequency, expected, rtol=1e-5, atol=4 / len(count))


# --------------------------------------------------------------------------------------------------
#  Covered cells
# --------------------------------------------------------------------------------------------------


def random_footprints(count: int, seed: int = 3) -> Footprint:
    """Footprints of sizes from 1e-5 to 0.1, with ratios up to 1:100, in all directions."""
    u = suite.random_numbers(count, 5, seed)
    size, ratio, angle = dr.exp(-11.5 + 9.2 * u[0]), dr.exp(4.6 * u[1]), 2 * np.pi * u[2]
    s, c = dr.sincos(angle)
    return Footprint(
        mi.Point2f(u[3], u[4]), mi.Vector2f(c, s) * size, mi.Vector2f(-s, c) * size / ratio
    )


def covered(footprint: Footprint, stretch=(1.0, 1.0), max_anisotropy: float = 16.0) -> CoveredCells:
    return CoveredCells(footprint, mi.Float(1e4), mi.Vector2f(*stretch), mi.Float(max_anisotropy))


@pytest.mark.parametrize("stretch", [(1.0, 1.0), (0.2, 1.0), (1.0, 0.0)])
def test_weights_are_a_partition_about_the_centre(variant, stretch):
    footprint = random_footprints(20_000)
    footprint.uv = footprint.uv / 100  # sums of small coordinates lose few digits
    cells = covered(footprint, stretch)

    def moments(x, y, level, active, along):
        spacing = dr.exp2(mi.Float(level))
        return dr.select(active, mi.Vector3f(1, mi.Float(x) * spacing, mi.Float(y) * spacing), 0)

    moments = np.array(cells.sum(moments, mi.Vector3f(0), mi.Bool(True)), np.float64)
    # Rounding of the tent's integral (6e-8) over the shortest median (2e-3)
    assert np.allclose(moments[0], 1, atol=1e-4)
    centre = 1e4 * np.array(stretch)[:, None] * np.array(footprint.uv)
    spacing = np.exp2(np.array(cells.level))
    # Both ends of a median that is not flat shift the mean across it by a fraction of a cell.
    assert (np.abs(moments[1:] - centre) / spacing).max() < 0.3
    along_axes = np.abs(np.array(cells.slope)) < 1e-3
    assert (np.abs(moments[1:] - centre) / spacing)[:, along_axes].max(initial=0) < 0.01


def test_number_of_cells_is_bounded(variant):
    footprint = random_footprints(20_000)
    for max_anisotropy, bound in ((16.0, (33, 18)), (4.0, (9, 6))):
        cells = covered(footprint, max_anisotropy=max_anisotropy)
        for level, most in zip((cells.level, cells.level + 1), bound, strict=True):
            columns = np.array(cells.grid(level, 1.0)[-1])
            # A median of K − 1 pixel widths, each up to two cells of the finer grid, and its ends
            assert 2 <= columns.min() and columns.max() <= most


def test_nothing_pops_where_the_level_changes(variant):
    # Sizes from just below a power of two to just above, 1:1 and 1:16, in all directions
    n = 2000
    u = suite.random_numbers(n, 3, 9)
    s, c = dr.sincos(2 * np.pi * u[0])
    grid = Grid(density=8.0)
    for ratio in (1, 16):

        def values(size, c=c, s=s, ratio=ratio):
            footprint = Footprint(
                mi.Point2f(u[1], u[2]), mi.Vector2f(c, s) * size * ratio, mi.Vector2f(-s, c) * size
            )
            return np.array(grid.eval(mi.Vector2f(0.1, 0.05), footprint), np.float64)

        # The pixel is two standard deviations wide: eight cells of 1e-4
        boundary = 4e-4
        below, above = values(boundary * (1 - 1e-4)), values(boundary * (1 + 1e-4))
        elsewhere = values(boundary * 1.3), values(boundary * 1.3 * (1 + 2e-4))
        jump, step = (np.abs(a - b).mean() / a.mean() for a, b in ((below, above), elsewhere))
        # Measured: 0.9 to 1.2 times the change elsewhere; independent levels would differ by 0.2.
        assert jump < 2 * step and jump < 1e-3, (jump, step)


def test_anisotropy_is_limited(variant):
    long = Footprint(mi.Point2f(0.3, 0.7), mi.Vector2f(3.2e-2, 0), mi.Vector2f(0, 1e-4))
    assert covered(long, max_anisotropy=16.0).level[0] == 5  # 2 · 320 cells / 16 = 40
    assert covered(long, max_anisotropy=64.0).level[0] == 3
    assert covered(long, max_anisotropy=1e6).level[0] == 1


# --------------------------------------------------------------------------------------------------
#  Lights
# --------------------------------------------------------------------------------------------------


def test_moments_of_parts_of_a_disk(variant):
    """Share, mean and mean square of the part between two lines, against counted points."""
    x = suite.golden_spiral(1_000_000)[0]
    for a, b in ((-1.5, 0.3), (-0.2, -0.1), (0.9, 2.0), (-3.0, 3.0)):
        found = [np.array(v)[0] for v in Part.between(mi.Float(a), mi.Float(b))]
        inside = x[(x > a) & (x < b)]
        expected = inside.size / x.size, inside.mean(), (inside**2).mean()
        assert np.allclose(found, expected, atol=1e-4)


@pytest.mark.parametrize("name", SPREADS)
def test_spread_of_few_microdetails(variant, name):
    """Under a light, the very microdetails are seen that are seen under its points."""
    options, size, tolerance = SPREADS[name]
    grid = Grid(density=7.0, **options)
    spread = (size, 0.3 * size), (0.0, 0.8 * size)
    footprint = Footprint.isotropic(mi.Point2f(0.37, 0.61), 4e-4)
    options = {"mass": tolerance, "res": 20, "points": 4}
    suite.check_spread(grid, footprint, spread, BOUNDS, tolerance, **options)


def test_half_vectors_turn_along_a_footprint(variant):
    """A long footprint equals round ones along its median, each with the half vector there."""
    grid, turn = Grid(density=6.0, detail_alpha=(0.03, 0.03)), np.array([[9.0, 3.0], [4.0, -5.0]])
    major, minor, count = 8e-3, 1e-3, 101
    half = major - SHORTENING * 2 * minor
    t = np.linspace(-1, 1, count)
    turned = np.outer(turn[:, 0], np.sqrt(3) * half * t)
    left = turn @ np.diag([np.sqrt(major**2 - half**2), minor])
    rng = np.random.default_rng(4)
    m, uv = 0.2 * rng.standard_normal((2, 300)), rng.random((2, 300))

    def values(moved, offset, du, **options):
        many = np.repeat(m, moved.shape[1], 1) + np.tile(moved, m.shape[1])
        place = np.repeat(uv, moved.shape[1], 1)
        place[0] += np.tile(offset, m.shape[1])
        footprint = Footprint(
            mi.Point2f(place.astype(np.float32)), mi.Vector2f(du, 0), mi.Vector2f(0, minor)
        )
        density = grid.eval(mi.Vector2f(many.astype(np.float32)), Query(footprint, **options))
        return np.array(density, np.float64).reshape(m.shape[1], -1).mean(1)

    whole = np.zeros((2, 1)), np.zeros(1), major
    spread = tuple(mi.Vector2f(*(float(x) for x in v)) for v in left.T)
    expected = values(turned, half * t, minor, spread=spread)
    found, reversed_ = (
        values(*whole, turn=mi.Matrix2f(np.float32(sign * turn))) for sign in (1, -1)
    )
    error, wrong = (np.abs(v - expected).sum() / expected.sum() for v in (found, reversed_))
    assert error < 0.1 and wrong > 3 * error, (error, wrong)


# --------------------------------------------------------------------------------------------------
#  The surface on average, and from afar
# --------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("name", SURFACES)
def test_mean_is_the_smooth_surface(variant, name):
    count = 1 << 19
    # On a square 2^9 times as large, two places rarely share a cell, even along grooves
    si = scattered_interactions(count, extent=512, sigma=2e-3)
    bsdf = load(density=5.0, **SURFACES[name])
    values = relative_values(bsdf, beckmann(**SURFACES[name]), si)
    error = values.std(axis=1) / np.sqrt(count)
    assert (error < 0.01).all()
    # roughconductor's masking is a rational approximation, off by up to 0.35 %.
    assert (np.abs(values.mean(axis=1) - 1) < 4 * error + 0.0035).all(), (values.mean(1), error)


def test_variance_falls_as_density_grows(variant):
    si = scattered_interactions(20_000, extent=1, sigma=1e-3)
    deviations = [relative_values(load(density=d), beckmann(), si).std() for d in (4, 6, 8, 10, 12)]
    # If pixels contain many microdetails, ten times as many reduce the noise by half a decade.
    assert (np.diff(deviations) < 0).all()
    assert np.allclose(np.array(deviations[2:-1]) / deviations[3:], 10, rtol=0.15)


def test_large_footprints_are_smooth(variant):
    for name, parameters in SURFACES.items():
        si = scattered_interactions(1000, extent=100, sigma=100.0)
        values = relative_values(load(density=14.0, **parameters), beckmann(**parameters), si)
        # Float32 rounding and roughconductor's masking
        assert np.abs(values - 1).max() < 4e-3, name


def test_one_microdetail_is_resolved(variant):
    # At vertices of the finest grid, no other grid point has a weight
    bsdf = load(density=2.0, size_variation=0.0)
    si = scattered_interactions(4000, extent=100, sigma=0.0)
    si.uv = 0.1 * dr.round(10 * si.uv)
    values = relative_values(bsdf, beckmann(), si, wo=(0.32, 0.1, 1))[0]
    peak = values.max()
    # A microdetail reflects or not: 0 or D_l(0)
    assert (
        np.isclose(values, 0, atol=1e-3 * peak).mean() + np.isclose(values, peak, rtol=1e-3).mean()
        > 0.99
    )
    share = (values > 0.5 * peak).mean()
    assert abs(share * peak - 1) < 4 * np.sqrt(share / len(values)) * peak


def test_grooves_run_along_their_axis(variant):
    bsdf = load(**GROOVES)
    si = replace(RESOLVED, du=(1e-4, 0), dv=(0, 1e-4)).interaction(1000)
    u, v = suite.random_numbers(2, 1, 5)[0], suite.random_numbers(1000, 1, 6)[0]
    along, across = mi.SurfaceInteraction3f(si), mi.SurfaceInteraction3f(si)
    along.uv, across.uv = mi.Point2f(v, u[0]), mi.Point2f(u[0], v)
    smooth = beckmann()
    assert relative_values(bsdf, smooth, along).std() < 1e-3
    assert relative_values(bsdf, smooth, across).std() > 0.5


def test_seed(variant):
    si = scattered_interactions(5000, extent=1, sigma=1e-4)
    first, second, again = (relative_values(load(seed=s), beckmann(), si)[0] for s in (1, 2, 1))
    assert (first == again).all()
    assert abs(np.corrcoef(first, second)[0, 1]) < 4 / np.sqrt(5000)


def test_result_does_not_depend_on_the_batch(variant):
    grid = Grid(size_variation=0.5)
    footprint = random_footprints(1000)
    whole = np.array(grid.eval(mi.Vector2f(0.1, 0.05), footprint))
    for k in range(0, 1000, 97):
        one = Footprint(
            mi.Point2f(footprint.uv.x[k], footprint.uv.y[k]),
            *(mi.Vector2f(d.x[k], d.y[k]) for d in (footprint.du, footprint.dv)),
        )
        # The compiler may fuse other products where the arguments are literals.
        assert np.isclose(np.array(grid.eval(mi.Vector2f(0.1, 0.05), one))[0], whole[k], rtol=1e-3)


# --------------------------------------------------------------------------------------------------
#  Colours
# --------------------------------------------------------------------------------------------------


def test_colors_of_single_microdetails_and_from_afar(variant):
    palette = np.array([[[0.9, 0.1, 0.1], [0.1, 0.2, 0.7]]], np.float32)
    bsdf = load(density=2.0, colors=mi.Bitmap(palette), size_variation=0.0)
    si = scattered_interactions(4000, extent=100, sigma=0.0)
    si.uv = 0.1 * dr.round(10 * si.uv)
    values = relative_values(bsdf, beckmann(), si, wo=(0.32, 0.1, 1))
    bright = values[:, values.sum(axis=0) > 0.5 * values.sum(axis=0).max()]
    shown = (bright / bright.sum(axis=0)).T
    expected = palette[0] / palette[0].sum(axis=1, keepdims=True)
    distance = np.abs(shown[:, None] - expected).max(axis=2)
    assert (distance.min(axis=1) < 0.01).mean() > 0.99
    assert 0.3 < (distance.argmin(axis=1) == 0).mean() < 0.7

    si = scattered_interactions(100, extent=1, sigma=100.0)
    values = relative_values(bsdf, beckmann(), si)
    assert np.allclose(values.mean(axis=1), palette[0].mean(axis=0), rtol=0.01)
    assert np.allclose(bsdf.eval_diffuse_reflectance(si), palette[0].mean(axis=0)[:, None])


def test_palette_from_a_file(variant, tmp_path):
    colors = (np.random.default_rng(2).random((3, 4, 3)) * 255).astype(np.uint8)
    mi.Bitmap(colors).write(str(tmp_path / "palette.png"))
    (tmp_path / "scene.xml").write_text(
        """<scene version="3.0.0"><shape type="rectangle"><bsdf type="glint_grid">
            <float name="footprint_sigma" value="1"/>
            <string name="colors" value="palette.png"/>
            <float name="alpha_u" value="0.2"/>
            <integer name="density" value="7"/>
            <integer name="seed" value="5"/>
            <string name="material" value="Cu"/>
            <transform name="to_uv"><scale x="2" y="3"/></transform>
        </bsdf></shape></scene>"""
    )
    from_xml = mi.load_file(str(tmp_path / "scene.xml")).shapes()[0].bsdf()
    from_dict = load(
        colors=mi.Bitmap(colors),
        alpha_u=0.2,
        alpha_v=0.3,
        density=7.0,
        seed=5,
        material="Cu",
        to_uv=mi.ScalarTransform4f().scale([2, 3, 1]),
    )
    si = scattered_interactions(500, extent=1, sigma=1e-3)
    wo, ctx = dr.normalize(mi.Vector3f(0.1, -0.2, 1)), mi.BSDFContext()
    assert dr.allclose(from_xml.eval(ctx, si, wo), from_dict.eval(ctx, si, wo), rtol=1e-4)


def test_each_variant(each_variant):
    si = scattered_interactions(200, extent=1, sigma=100.0)
    for colors in ("none", "wheel"):
        bsdf = load(colors=colors, material="Au", specular_reflectance=0.8)
        suite.check_eval_pdf(bsdf, RESOLVED, 200)
        suite.check_weights(bsdf, RESOLVED, 200)
        suite.check_finite(bsdf, RESOLVED)
        # From afar white is white at all wavelengths: measured 1e-3, and roughconductor's masking
        values = relative_values(load(colors=colors), beckmann(), si)
        assert np.allclose(values, 1, atol=6e-3)


# --------------------------------------------------------------------------------------------------
#  The shared suite
# --------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "parameters", [{"alpha": 0.1}, {"alpha_u": 0.15, "alpha_v": 0.05}], ids=str
)
def test_samples_have_the_density_of_pdf(variant, parameters):
    bounds = ((-0.45, -0.45), (0.45, 0.45))  # 3.3 sigma of slopes and more; beyond, 1e-5 is lost
    suite.check_chi2(load(detail_alpha=0.02, **parameters), RESOLVED, bounds, test_count=2)


@pytest.mark.parametrize("name", SURFACES)
def test_consistency(variant, name):
    bsdf = load(material="Al", **SURFACES[name])
    for view in (RESOLVED, replace(RESOLVED, wi=(-1, 1, 0.2)), EXTREME_VIEWS["1000:1"]):
        suite.check_eval_pdf(bsdf, view)
        # If the half vector recomputed from wo falls into another cell, the count changes.
        suite.check_weights(bsdf, view)
        suite.check_horizon(bsdf, view)
        suite.check_adjoint(bsdf, view)


@pytest.mark.parametrize("name", SURFACES)
def test_extremes_are_finite(variant, name):
    bsdf = load(**SURFACES[name])
    for view in EXTREME_VIEWS.values():
        suite.check_finite(bsdf, view)


@pytest.mark.parametrize("density", [-20.0, 20.0])
def test_extreme_densities(variant, density):
    for view in EXTREME_VIEWS.values():
        suite.check_finite(load(density=density), view)


@pytest.mark.parametrize("name", ["isotropic", "grooves", "wheel"])
def test_furnace_on_average(variant, name):
    # A single place may reflect more than it receives; the average may not.
    count = 100_000
    bsdf = load(**SURFACES[name])
    for wi in ((0, 0, 1), (1, 0, 1), (1, 1, 0.1)):
        si = scattered_interactions(count, extent=512, sigma=1e-4, wi=wi)
        u = suite.random_numbers(count, 3, seed=4)
        _, weight = bsdf.sample(mi.BSDFContext(), si, u[0], mi.Point2f(u[1], u[2]))
        weight = np.atleast_2d(np.array(weight, np.float64))
        assert (weight.mean(axis=1) <= 1 + 3 * weight.std(axis=1) / np.sqrt(count)).all()


def test_derivative_of_the_mean(variant):
    def mean_density(alpha):
        grid.alpha_u = alpha
        grid.parameters_changed(["alpha_u"])
        return dr.mean(grid.eval(m, footprint))

    grid, m = Grid(density=5.0), mi.Vector2f(0.15, 0.05)
    si = scattered_interactions(1 << 18, extent=512, sigma=2e-3)
    footprint = Footprint(si.uv, si.duv_dx, si.duv_dy)
    alpha = mi.Float(0.3)
    dr.enable_grad(alpha)
    value = mean_density(alpha)
    dr.backward(value)
    # D_g ∝ exp(−x²/α²)/α
    x = 0.15 / np.sqrt(1 - 0.15**2 - 0.05**2)
    expected = value[0] * (2 * x**2 / 0.3**3 - 1 / 0.3)
    assert np.isclose(dr.grad(alpha)[0], expected, rtol=1e-4)


def test_far_uv_still_glints(variant):
    si = scattered_interactions(2000, extent=10, sigma=0.02)
    si.uv = si.uv + mi.Point2f(1e5, -1e5)
    values = relative_values(load(density=3.0), beckmann(), si)[0]
    assert values.std() > 0.3 and abs(values.mean() - 1) < 0.1


# --------------------------------------------------------------------------------------------------
#  Parameters
# --------------------------------------------------------------------------------------------------

NO_MAP = ("wrap_mode", "map_type", "height_scale", "filename", "data", "bitmap")
BAD_SHARED_PARAMETERS = [
    case for case in suite.BAD_PARAMETERS if case[1] not in NO_MAP and "data" not in case[0]
]
NEGATIVE, NOT_FINITE = (np.array([[[0.5, value, 0.5]]], np.float32) for value in (-0.1, suite.NAN))
BAD_OWN_PARAMETERS = [
    ({"alpha": 0.0}, "alpha"),
    ({"alpha": suite.NAN}, "alpha"),
    ({"alpha": 0.3, "alpha_u": 0.2}, "alpha"),
    ({"alpha_v": -0.1}, "alpha_v"),
    ({"detail_alpha": 0.31}, "detail_alpha"),
    ({"detail_alpha": 0.0}, "detail_alpha"),
    ({"alpha_v": 0.04}, "alpha_v"),
    ({"detail_alpha_v": "fine"}, "detail_alpha_v"),
    ({"density": suite.NAN}, "density"),
    ({"density": 20.5}, "density"),
    ({"density": 1e30}, "density"),
    ({"density": -21.0}, "density"),
    ({"size_variation": -0.1}, "size_variation"),
    ({"intensity": -1.0}, "intensity"),
    ({"intensity": float("inf")}, "intensity"),
    ({"light_spread": -0.1}, "light_spread"),
    ({"light_spread": np.pi / 2}, "light_spread"),
    ({"max_anisotropy": 0.5}, "max_anisotropy"),
    ({"max_anisotropy": suite.NAN}, "max_anisotropy"),
    ({"seed": -1}, "seed"),
    ({"seed": 0.5}, "seed"),
    ({"colors": "rainbow"}, "colors"),
    ({"colors": 3}, "colors"),
    ({"colors": NEGATIVE}, "colors"),
    ({"colors": NOT_FINITE}, "colors"),
]


@pytest.mark.parametrize(
    ("changes", "parameter"), BAD_SHARED_PARAMETERS + BAD_OWN_PARAMETERS, ids=str
)
def test_bad_parameters(variant, changes, parameter):
    if isinstance(changes.get("colors"), np.ndarray):
        changes = {"colors": mi.Bitmap(changes["colors"])}
    suite.check_rejects(describe(), changes, parameter)


def test_message(variant):
    with pytest.raises(
        Exception,
        match=r'glint_grid: "detail_alpha_v" must be at most "alpha_v" = 0.2 \(got 0.25\)',
    ):
        load(alpha_v=0.2, detail_alpha_v=0.25)


def test_maps_are_not_known(variant):
    with pytest.raises(RuntimeError, match="filename"):
        load(filename="map.exr")


def test_changed_parameters_take_effect(variant):
    changes = {
        "alpha_u": 0.4,
        "alpha_v": 0.2,
        "detail_alpha_u": 0.02,
        "density": 7.0,
        "size_variation": 0.8,
        "intensity": 0.5,
        "light_spread": 0.1,
        "max_anisotropy": 4.0,
    }
    bsdf, fresh = load(), load(**changes)
    params = mi.traverse(bsdf)
    for key, value in changes.items():
        params[key] = value
    params.update()
    si, bs, weight = suite.sample(bsdf, RESOLVED, 500)
    _, bs_fresh, weight_fresh = suite.sample(fresh, RESOLVED, 500)
    assert dr.allclose(bs.wo, bs_fresh.wo, atol=1e-5)
    assert (~np.isclose(weight, weight_fresh, rtol=1e-3)).mean() < 0.01
    value, expected = (np.array(b.eval(mi.BSDFContext(), si, bs.wo)) for b in (bsdf, fresh))
    assert (~np.isclose(value, expected, rtol=1e-3)).mean() < 0.01


@pytest.mark.parametrize(("key", "value"), [("density", suite.NAN), ("detail_alpha_u", 0.4)])
def test_changed_parameters_are_checked(variant, key, value):
    params = mi.traverse(load())
    params[key] = value
    with pytest.raises(ValueError, match=f'glint_grid: "{key}" must be'):
        params.update()


def test_describes_itself(variant):
    text = str(load(colors="wheel", density=7.5, material="Al"))
    for part in ("GlintGrid", "density=7.5", "wheel", "beckmann", "Conductor"):
        assert part in text


# --------------------------------------------------------------------------------------------------
#  Inside Mitsuba
# --------------------------------------------------------------------------------------------------


def render(bsdf: dict, integrator: str = "path", spp: int = 64) -> np.ndarray:
    """A square under a constant sky and a lamp."""
    lights = {
        "sky": {"type": "constant", "radiance": 0.5},
        "lamp": {"type": "point", "position": [0, 1, 2], "intensity": 2.0},
    }
    return suite.square(bsdf, {"type": integrator, "hide_emitters": True}, lights=lights, spp=spp)


@pytest.mark.parametrize("integrator", ["path", "direct", "prb", "volpath"])
def test_dense_is_roughconductor(variant, integrator):
    glints = describe(density=12.0, footprint_sigma=0.5, pixel_spread=3.6e-3, material="Cu")
    smooth = {"type": "roughconductor", "distribution": "beckmann", "alpha": 0.3, "material": "Cu"}
    glints, smooth = render(glints, integrator), render(smooth, integrator)
    # Equal random numbers give equal samples: measured 3e-3, which is roughconductor's
    # masking and the last microdetails' noise.
    assert np.abs(glints - smooth).max() < 0.02 * smooth.mean()
    assert np.isclose(glints.mean(), smooth.mean(), rtol=4e-3)


def test_dense_is_roughconductor_in_glint_path(variant):
    """The integrator places its samples in the pixels' filter itself, so its noise differs from
    that of ``path``."""
    glints = describe(density=12.0, footprint_sigma=0.5, material="Cu")
    smooth = {"type": "roughconductor", "distribution": "beckmann", "alpha": 0.3, "material": "Cu"}
    glints, smooth = render(glints, "glint_path", spp=1024), render(smooth, spp=1024)
    # Measured at 2048 samples: 0.09 at the edge of the square, where both are noisy; 9e-4.
    assert np.abs(glints - smooth).max() < 0.25 * smooth.mean()
    assert np.isclose(glints.mean(), smooth.mean(), rtol=4e-3)


def test_adapters(variant):
    glints = describe(footprint_sigma=0.5, pixel_spread=3.6e-3)
    plain = render(glints)
    assert plain.std() > 0.05
    assert np.allclose(render({"type": "twosided", "nested": glints}), plain, rtol=1e-3, atol=1e-3)
