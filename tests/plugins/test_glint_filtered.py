"""The plugin glint_filtered: the shared suite for each method, the definition of each filter, its
errors."""

from __future__ import annotations

from dataclasses import replace

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest

from glintbsdf import Footprint, NormalMap, maps
from glintbsdf.check import suite
from glintbsdf.check.suite import EXTREME_VIEWS, View
from glintbsdf.check.truth import refined
from glintbsdf.pndf import Filtered
from glintbsdf.pndf.filters.filters import METHODS

MAP = maps.isotropic((29, 36), seed=1)
STIFF_MAPS = {
    "isotropic": MAP,
    "brushed": maps.brushed((24, 40), streak_length=20, streak_width=3),
    "flat": maps.flat(16),
    "tilted": maps.tilted(7),
    "one_texel": maps.tilted(1),
    "clamp": NormalMap(MAP.normals, "clamp"),
    "steep": maps.tilted(3, tilt=np.pi / 2 - 2e-3),  # slopes of 500
}
# Every method with every distribution that it is defined for.
LOBES = [(name, kind) for name, method in METHODS.items() for kind in method.distributions]
# A rotated footprint of about one texel by half a texel.
RESOLVED = View(du=(0.04, 0.03), dv=(-0.015, 0.02), wi=(0.3, 0.1, 1))
# Bins cover a square inside of the disk.
REACH = 0.7
DENSITY_TESTS = len(LOBES) + len(STIFF_MAPS) - 1


def describe(normal_map: NormalMap = MAP, **parameters) -> dict:
    return {
        "type": "glint_filtered",
        "data": mi.TensorXf(normal_map.normals),
        "alpha": 0.2,
        "wrap_mode": normal_map.wrap_mode,
        "footprint_sigma": 1.0,
        **parameters,
    }


def load(normal_map: NormalMap = MAP, **parameters) -> mi.BSDF:
    return mi.load_dict(describe(normal_map, **parameters))


# --------------------------------------------------------------------------------------------------
#  The shared suite
# --------------------------------------------------------------------------------------------------


def check_chi2(bsdf: mi.BSDF, view: View, samples: int = 100_000, res: int = 25) -> None:
    """``sample`` draws from ``pdf``. The lobe reaches the horizon, so invalid samples count as one
    more bin."""
    si, bs, _ = suite.sample(bsdf, view, samples)
    m = np.array(dr.normalize(si.wi + bs.wo))[:2, np.array(bs.pdf) > 0]
    counts, _, _ = np.histogram2d(m[1], m[0], res, ((-REACH, REACH), (-REACH, REACH)))
    bounds = ((-REACH, -REACH), (REACH, REACH))
    mass, error = suite.mass_in_bins(bsdf, view, bounds, res)
    lost = samples - counts.sum()
    counts, mass, error = (
        np.append(x, y)
        for x, y in (
            (counts, lost),
            (mass, max(0, 1 - mass.sum())),
            (error, np.sqrt((error**2).sum())),
        )
    )
    suite.assert_distributed(counts, samples, mass, error, DENSITY_TESTS)


@pytest.mark.parametrize(("method", "distribution"), LOBES)
def test_density(variant, method, distribution):
    check_chi2(load(method=method, distribution=distribution), RESOLVED)


@pytest.mark.parametrize(
    "name", [name for name in STIFF_MAPS if name not in ("isotropic", "steep")]
)
def test_density_of_stiff_maps(variant, name):
    check_chi2(load(STIFF_MAPS[name], method="lean"), replace(RESOLVED, wi=(-1, 0.4, 0.5)))


@pytest.mark.parametrize(("method", "distribution"), LOBES)
def test_consistency(variant, method, distribution):
    bsdf = load(method=method, distribution=distribution, material="Au", alpha=0.05)
    for view in (RESOLVED, replace(RESOLVED, wi=(-1, 1, 0.2)), EXTREME_VIEWS["1000:1"]):
        suite.check_eval_pdf(bsdf, view)
        suite.check_weights(bsdf, view)
        suite.check_horizon(bsdf, view)
        suite.check_adjoint(bsdf, view)


@pytest.mark.parametrize(("method", "distribution"), LOBES)
def test_extremes_are_finite(variant, method, distribution):
    bsdf = load(STIFF_MAPS["steep"], method=method, distribution=distribution, alpha=1e-3)
    for view in EXTREME_VIEWS.values():
        suite.check_finite(bsdf, view)


@pytest.mark.parametrize("name", STIFF_MAPS)
def test_extremes_of_stiff_maps_are_finite(variant, name):
    bsdf = load(STIFF_MAPS[name], method="leadr", material="Al")
    for view in EXTREME_VIEWS.values():
        suite.check_finite(bsdf, view)


@pytest.mark.parametrize(("method", "distribution"), LOBES)
def test_furnace(variant, method, distribution):
    bsdf = load(method=method, distribution=distribution)
    whole = View(du=(1, 0), dv=(0, 1))
    for wi in ((0, 0, 1), (1, 0, 1), (0, 1, 0.3), (1, 1, 0.1)):
        suite.check_furnace(bsdf, replace(whole, wi=wi))
        suite.check_furnace(bsdf, replace(RESOLVED, wi=wi))


def test_a_leaning_map_reflects_no_more_than_arrives(variant):
    tilted = load(maps.tilted(4, tilt=0.6), method="lean")
    lean = load(maps.tilted(4, tilt=0.6), method="lean", masking="smith")
    gained = 0.0
    for wi in ((1, 0, 1), (0.4, 0.2, 1), (1, 0, 0.1), (-0.3, 1, 0.5)):
        view = View(du=(0.1, 0), dv=(0, 0.1), wi=wi)
        suite.check_furnace(tilted, view)
        gained = max(gained, np.mean(suite.intensity(suite.sample(lean, view, 5000)[2])))
    assert gained > 1.1  # with respect to the geometric surface it does


# --------------------------------------------------------------------------------------------------
#  Values of the filters
# --------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(("method", "distribution"), LOBES)
def test_flat_map_is_a_roughconductor(variant, method, distribution):
    bsdf = load(maps.flat(4), method=method, distribution=distribution, height_correlated=False)
    stock = mi.load_dict({"type": "roughconductor", "alpha": 0.2, "distribution": distribution})
    for wi in ((0.1, 0, 1), (1, 0.5, 0.4)):
        si, bs, weight = suite.sample(bsdf, replace(RESOLVED, wi=wi), 500)
        ctx = mi.BSDFContext()
        # Mitsuba's masking of Beckmann is a rational fit, to about 0.4 % per direction.
        assert dr.allclose(bsdf.eval(ctx, si, bs.wo), stock.eval(ctx, si, bs.wo)[0], rtol=1e-2)
        assert dr.allclose(bsdf.pdf(ctx, si, bs.wo), stock.pdf(ctx, si, bs.wo), rtol=1e-2)


def slope_moments(pndf: Filtered, footprint: Footprint, count: int = 1_000_000) -> tuple:
    """Mean and covariance of the slopes of normals that are drawn from the lobe."""
    u = suite.random_numbers(count, 3, seed=2)
    s = np.array(pndf.sample(footprint, u[0], mi.Point2f(u[1], u[2])), np.float64)
    slopes = s / np.sqrt(1 - (s**2).sum(axis=0))
    return slopes.mean(axis=1), np.cov(slopes)


@pytest.mark.parametrize("method", METHODS)
def test_moments_of_the_lobe(variant, method):
    """Mean and variance of slopes under a footprint, by the definition of each method, in
    float64."""
    alpha, normal_map = 0.1, maps.brushed(64, alpha=0.15, streak_length=30, angle=0.6, seed=3)
    whole = Footprint.isotropic(mi.Point2f(0.5), 1.0)
    mean, covariance = slope_moments(Filtered(normal_map, method, alpha), whole)

    s = refined(normal_map, 5).reshape(-1, 2).astype(np.float64)
    z = np.sqrt(1 - (s**2).sum(axis=1, keepdims=True))
    slopes = s / z
    full = np.cov(slopes.T)
    length = np.linalg.norm(np.hstack([s, z]).mean(axis=0))
    exponent = 2 / alpha**2 - 2
    toksvig = length * exponent / (length + exponent * (1 - length))
    variance = {
        "lean": full,
        "leadr": full,
        "clean": np.eye(2) * np.trace(full) / 2,
        "variance": np.diag(np.diag(full)),
        "toksvig": np.eye(2) * (1 / (toksvig + 2) - alpha**2 / 2),
    }[method]
    # 1 % of the map's variance; measured 0.4 %.
    assert np.allclose(covariance, variance + np.eye(2) * alpha**2 / 2, atol=0.01 * np.trace(full))
    assert np.allclose(mean, 0, atol=1e-3)
    assert abs(full[0, 1]) > 0.2 * np.trace(full)  # so that the methods differ


def test_lean_is_the_convolved_distribution_of_a_gaussian_map(variant):
    """Over many bumps, LEAN's lobe is the distribution of the map's normals, convolved with
    alpha."""
    normal_map = maps.isotropic(512, alpha=0.15, correlation_length=5, seed=5)
    alpha = 0.05
    footprint = Footprint.isotropic(mi.Point2f(0.4, 0.7), 128 / 512)
    pndf = Filtered(normal_map, "lean", alpha)
    # Every slope of the map is a small lobe; the mean of the lobes is the convolution.
    rng = np.random.default_rng(1)
    place = (0.4, 0.7) * np.array(512) - 0.5 + 128 * rng.standard_normal((60_000, 2))
    column, row = np.rint(place).astype(int).T % 512
    s = normal_map.normals[row, column].astype(np.float64)
    slopes = s / np.sqrt(1 - (s**2).sum(axis=1, keepdims=True))
    grid = np.linspace(-0.35, 0.35, 41)
    kernels = [np.exp(-((grid[:, None] - slopes[:, i]) ** 2) / alpha**2) for i in (0, 1)]
    expected = kernels[1] @ kernels[0].T
    x, y = np.meshgrid(grid, grid)
    z = 1 / np.sqrt(1 + x**2 + y**2)
    s = mi.Vector2f(np.float32((x * z).ravel()), np.float32((y * z).ravel()))
    actual = np.array(pndf.eval(s, footprint)).reshape(x.shape) * z**4
    expected *= actual.sum() / expected.sum()
    # Measured 0.022, of which 0.01 is the noise of 60,000 points.
    assert np.abs(actual - expected).sum() / expected.sum() < 0.05


def test_variance_mapping_ignores_variance_between_lookups(variant):
    """At a point there is no variance, however rough the map is."""
    footprint = Footprint.isotropic(mi.Point2f(0.31, 0.57), 0.0)
    stored = Filtered(MAP, "variance", 0.1).lobe(footprint)
    assert np.isclose(stored.uu[0], 0.01, rtol=1e-3) and np.isclose(stored.vv[0], 0.01, rtol=1e-3)
    assert Filtered(MAP, "lean", 0.1).lobe(footprint).uu[0] > 0.0101


# --------------------------------------------------------------------------------------------------
#  Parameters
# --------------------------------------------------------------------------------------------------

BAD_OWN_PARAMETERS = [
    ({"method": "lod"}, "method"),
    ({"method": 2}, "method"),
    ({"distribution": "phong"}, "distribution"),
    ({"method": "lean", "distribution": "ggx"}, "distribution"),
    ({"method": "clean", "distribution": "ggx"}, "distribution"),
    ({"method": "leadr", "distribution": "ggx"}, "distribution"),
    ({"alpha": 0.0}, "alpha"),
    ({"alpha": -0.1}, "alpha"),
    ({"alpha": "rough"}, "alpha"),
    ({"alpha": suite.NAN}, "alpha"),
    ({"method": "toksvig", "alpha": 1.5}, "alpha"),
    ({"max_anisotropy": 0.5}, "max_anisotropy"),
    ({"max_anisotropy": float("inf")}, "max_anisotropy"),
    ({"masking": "beckmann"}, "masking"),
    ({"method": "leadr", "masking": "none"}, "masking"),
    ({"height_correlated": "yes"}, "height_correlated"),
]


@pytest.mark.parametrize(
    ("changes", "parameter"), suite.BAD_PARAMETERS + BAD_OWN_PARAMETERS, ids=str
)
def test_bad_parameters(variant, changes, parameter):
    suite.check_rejects(describe(), changes, parameter)


def test_slopes_that_are_too_steep_are_counted(variant):
    normals = maps.flat(5).normals.copy()
    normals[3, 1] = normals[4, 4] = (0, 0.9999999)
    with pytest.raises(Exception, match=r'glint_filtered: "data" .*2 steeper.*row 3, column 1'):
        mi.load_dict({"type": "glint_filtered", "data": mi.TensorXf(normals)})


def test_unknown_parameter(variant):
    with pytest.raises(RuntimeError, match="metod"):
        load(metod="lean")


def test_changed_parameters_take_effect(variant):
    new = maps.isotropic(16, alpha=0.3, seed=2)
    bsdf = load(method="leadr")
    params = mi.traverse(bsdf)
    params["data"] = mi.TensorXf(new.normals)
    params["alpha"] = 0.3
    params.update()
    fresh = load(new, method="leadr", alpha=0.3)
    si, bs, weight = suite.sample(bsdf, RESOLVED, 200)
    _, bs_fresh, weight_fresh = suite.sample(fresh, RESOLVED, 200)
    assert dr.allclose(bs.wo, bs_fresh.wo, atol=1e-6) and dr.allclose(weight, weight_fresh)
    params["alpha"] = -1.0
    with pytest.raises(ValueError, match='glint_filtered: "alpha" must be'):
        params.update()


@pytest.mark.parametrize("method", ["lean", "toksvig"])
def test_alpha_from_a_texture(variant, method):
    """At every place the lobe of the texture's value there, clipped to what is allowed."""
    values = np.array([[0.05, 0.4], [1e-9, 50.0]], np.float32)
    most = 1.0 if method == "toksvig" else 10.0
    texture = {
        "type": "bitmap",
        "bitmap": mi.Bitmap(values[..., None]),
        "raw": True,
        "filter_type": "nearest",
    }
    bsdf = load(method=method, alpha=texture, material="Au")
    for row, column in np.ndindex(values.shape):
        alpha = min(max(float(values[row, column]), 1e-4), most)
        view = replace(RESOLVED, uv=(0.25 + 0.5 * column, 0.25 + 0.5 * row))
        plain = load(method=method, alpha=alpha, material="Au")
        si, bs, weight = suite.sample(bsdf, view, 200)
        _, bs_plain, weight_plain = suite.sample(plain, view, 200)
        assert dr.allclose(bs.wo, bs_plain.wo, atol=1e-6) and dr.allclose(weight, weight_plain)
        for of, expected in zip(
            bsdf.eval_pdf(mi.BSDFContext(), si, bs.wo),
            plain.eval_pdf(mi.BSDFContext(), si, bs.wo),
            strict=True,
        ):
            assert dr.allclose(of, expected)
    assert "alpha=textured" in str(bsdf)


def test_derivative_by_the_texels_of_alpha(variant):
    """The sum over the texels of a texture is the derivative by one number in their place."""
    texture = {"type": "bitmap", "bitmap": mi.Bitmap(np.full((4, 4, 1), 0.2, np.float32))}
    derivatives = []
    for alpha, key in ((0.2, "alpha"), ({**texture, "raw": True}, "alpha.data")):
        bsdf = load(alpha=alpha)
        si, bs, _ = suite.sample(bsdf, RESOLVED, 100)
        wo = dr.detach(bs.wo)
        params = mi.traverse(bsdf)
        dr.enable_grad(params[key])
        params.update()
        dr.backward(dr.sum(bsdf.eval(mi.BSDFContext(), si, wo)[0]))
        derivatives.append(
            dr.sum(dr.grad(params[key]), axis=None).array[0]
            if key != "alpha"
            else dr.grad(params[key])[0]
        )
    assert np.isclose(*derivatives, rtol=1e-3) and derivatives[0] != 0


def test_only_the_moments_of_the_method_are_kept(variant):
    sizes = {name: Filtered(MAP, name).nbytes for name in METHODS}
    # Records of two words and of three.
    assert 1.5 * sizes["clean"] == pytest.approx(sizes["lean"], rel=0.1)
    assert sizes["toksvig"] == sizes["variance"] == sizes["lean"] == sizes["leadr"]


# --------------------------------------------------------------------------------------------------
#  Inside Mitsuba
# --------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("method", METHODS)
def test_renders(variant, method):
    assert 0.3 < suite.square(describe(pixel_spread=0.03, method=method)).max() < 1.5


def test_each_variant(each_variant):
    bsdf = load(method="leadr", material="Au", specular_reflectance=0.8)
    suite.check_eval_pdf(bsdf, RESOLVED, 200)
    suite.check_weights(bsdf, RESOLVED, 200)
    suite.check_finite(bsdf, RESOLVED)
    gold = describe(pixel_spread=0.03, method="toksvig", distribution="ggx", material="Au")
    assert 0.1 < suite.square(gold).max() < 2


def test_describes_itself(variant):
    text = str(load(method="leadr"))
    for part in ("GlintFiltered", "leadr", "36×29", "footprint"):
        assert part in text
