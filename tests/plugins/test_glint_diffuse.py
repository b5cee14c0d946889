"""The plugin glint_diffuse: its integral, the shared suite as far as it applies, its errors."""

from __future__ import annotations

from dataclasses import replace

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest

from glintbsdf import Footprint, NormalMap, maps
from glintbsdf.check import suite
from glintbsdf.check.suite import EXTREME_VIEWS, View
from glintbsdf.pndf.manifold.diffuse import oren_nayar

METHODS = ("manifold", "oren_nayar")
MAPS = {
    "isotropic": maps.isotropic((29, 36), alpha=0.4, seed=1),
    "flat": maps.flat(16),
    "tilted": maps.tilted(7, tilt=0.5, azimuth=0.3),
    "one_texel": maps.tilted(1),
    "clamp": NormalMap(maps.isotropic((29, 36), alpha=0.4, seed=1).normals, "clamp"),
}
RESOLVED = View(du=(0.04, 0.03), dv=(-0.015, 0.02), wi=(0.3, 0.1, 1))


def describe(normal_map: NormalMap, **parameters) -> dict:
    return {
        "type": "glint_diffuse",
        "data": mi.TensorXf(normal_map.normals),
        "wrap_mode": normal_map.wrap_mode,
        "footprint_sigma": 1.0,
        **parameters,
    }


def load(normal_map: NormalMap, **parameters) -> mi.BSDF:
    return mi.load_dict(describe(normal_map, **parameters))


# --------------------------------------------------------------------------------------------------
#  Values
# --------------------------------------------------------------------------------------------------


def hemisphere(count: int) -> mi.Vector3f:
    u = suite.random_numbers(count, 2, seed=3)
    return mi.warp.square_to_uniform_hemisphere(mi.Point2f(*u))


def test_value_is_the_projected_area(variant):
    # Eq. 14: f_d cosθ = P(ω)/π, from random points of the map under the footprint.
    bsdf = load(MAPS["isotropic"], reflectance=0.8)
    wo = hemisphere(40)
    value = np.array(bsdf.eval(mi.BSDFContext(), RESOLVED.interaction(40), wo))[0]
    mesh = bsdf.mesh
    kernel = mesh.texel_kernel(
        Footprint(mi.Point2f(RESOLVED.uv), mi.Vector2f(RESOLVED.du), mi.Vector2f(RESOLVED.dv))
    )
    side = 400
    u = np.float32((np.mgrid[:side, :side].reshape(2, -1) + 0.5) / side)
    m = np.array(mesh.normal_at(kernel.mean + kernel.sample(mi.Point2f(u))), np.float64)
    n = np.concatenate([m, np.sqrt(1 - (m**2).sum(0, keepdims=True))])
    expected = [0.8 / np.pi * np.mean(np.maximum(w @ n, 0) / n[2]) for w in np.array(wo).T]
    # The kernel is constant on each triangle. Measured: 5e-4.
    assert np.allclose(value, expected, atol=2e-3)


def test_a_plane_is_diffuse_about_its_normal(variant):
    # A single facet: "manifold" counts its area per area of the surface; "oren_nayar" equals
    # Mitsuba's diffuse inside normalmap, whose normal counts with the surface's area.
    tilt, azimuth = 0.5, 0.3
    n = np.array([np.sin(tilt) * np.cos(azimuth), np.sin(tilt) * np.sin(azimuth), np.cos(tilt)])
    wo = hemisphere(200)
    cosine = np.maximum(n @ np.array(wo), 0)
    si = RESOLVED.interaction(200)
    facets, mean = (
        np.array(
            load(MAPS["tilted"], method=method, reflectance=0.5).eval(mi.BSDFContext(), si, wo)
        )[0]
        for method in METHODS
    )
    assert np.allclose(facets, 0.5 * cosine / np.cos(tilt) / np.pi, atol=1e-3)
    assert np.allclose(mean, 0.5 * cosine / np.pi, atol=1e-5)


@pytest.mark.parametrize("method", METHODS)
def test_flat_is_mitsubas_diffuse(variant, method):
    ours, theirs = load(MAPS["flat"], method=method), mi.load_dict({"type": "diffuse"})
    si, wo, ctx = RESOLVED.interaction(100), hemisphere(100), mi.BSDFContext()
    value, pdf = ours.eval_pdf(ctx, si, wo)
    # Flat triangles become small ones (1e-6 of the disk), whose edges face a grazing light.
    assert dr.allclose(value, theirs.eval(ctx, si, wo), atol=1e-4)
    assert dr.allclose(pdf, theirs.pdf(ctx, si, wo))


@pytest.mark.parametrize("method", METHODS)
@pytest.mark.parametrize("name", ["isotropic", "tilted"])
def test_light_tracing_meets_the_same_surface(variant, method, name):
    suite.check_adjoint(load(MAPS[name], method=method), RESOLVED)


def test_oren_nayar(variant):
    # Oren and Nayar's worked-out cases: no roughness is Lambert; at σ² = 0.33·0.45 … the factors A
    # and B of Eq. 30 themselves, for light and view in one plane.
    theta_i, theta_o, variance = 1.0, 0.4, 0.25
    wi = mi.Vector3f(float(np.sin(theta_i)), 0, float(np.cos(theta_i)))
    same, opposite = (
        mi.Vector3f(s * float(np.sin(theta_o)), 0, float(np.cos(theta_o))) for s in (1, -1)
    )
    a, b = 1 - 0.5 * 0.25 / 0.58, 0.45 * 0.25 / 0.34
    cosine = np.cos(theta_o) / np.pi
    expected = (a + b * np.sin(theta_i) * np.tan(theta_o)) * cosine
    assert oren_nayar(wi, same, mi.Float(variance))[0] == pytest.approx(expected, rel=1e-5)
    assert oren_nayar(wi, opposite, mi.Float(variance))[0] == pytest.approx(a * cosine, rel=1e-5)
    assert oren_nayar(wi, same, mi.Float(0))[0] == pytest.approx(cosine, rel=1e-5)
    f = oren_nayar(wi, same, mi.Float(variance))[0] / np.cos(theta_o)
    assert oren_nayar(same, wi, mi.Float(variance))[0] / np.cos(theta_i) == pytest.approx(f)


@pytest.mark.parametrize("method", METHODS)
def test_furnace(variant, method):
    # A facet has the area 1/m_z, and sees the fraction (1 + m_z)/2 of the upper
    # hemisphere, so the whole reflects the mean of (1 + 1/m_z)/2. Oren and Nayar's model loses the
    # light that facets reflect to each other.
    bsdf = load(MAPS["isotropic"], method=method, reflectance=1.0)
    view = View(du=(1, 0), dv=(0, 1))
    _, _, weight = suite.sample(bsdf, view, 20_000)
    weight = np.array(weight)[0]
    m_z = np.sqrt(1 - (MAPS["isotropic"].normals.astype(np.float64) ** 2).sum(2))
    most = np.mean((1 + 1 / m_z) / 2)
    error = 4 * weight.std() / np.sqrt(len(weight))
    if method == "manifold":
        # 0.5 %: between texels the normals of the triangles are a little less steep.
        assert most > 1.01 and weight.mean() == pytest.approx(most, abs=error + 0.005)
    else:
        assert 0.8 < weight.mean() < 1 + error


def test_importance_is_the_reverse(variant):
    # f_d depends on the light's direction only, which is the other one when importance is
    # transported.
    bsdf = load(MAPS["isotropic"])
    si, wo = RESOLVED.interaction(50), hemisphere(50)
    importance = bsdf.eval(mi.BSDFContext(mi.TransportMode.Importance), si, wo)
    reverse = RESOLVED.interaction(50)
    wi, reverse.wi = si.wi, wo
    radiance = bsdf.eval(mi.BSDFContext(mi.TransportMode.Radiance), reverse, wi)
    assert dr.allclose(importance / wo.z, radiance / wi.z, rtol=1e-4)


# --------------------------------------------------------------------------------------------------
#  The shared suite
# --------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("method", METHODS)
def test_consistency(variant, method):
    bsdf = load(MAPS["isotropic"], method=method)
    for view in (RESOLVED, replace(RESOLVED, wi=(-1, 1, 0.2)), EXTREME_VIEWS["1000:1"]):
        suite.check_eval_pdf(bsdf, view, 500)
        suite.check_weights(bsdf, view, 500)
    suite.check_horizon(bsdf, RESOLVED)


@pytest.mark.parametrize("method", METHODS)
@pytest.mark.parametrize("name", ["isotropic", "one_texel", "clamp"])
def test_extremes_are_finite(variant, name, method):
    bsdf = load(MAPS[name], method=method)
    for view in EXTREME_VIEWS.values():
        suite.check_finite(bsdf, view, 30)


def test_sampling_is_by_the_cosine(variant):
    bsdf = load(MAPS["isotropic"])
    _, bs, _ = suite.sample(bsdf, RESOLVED, 20_000)
    assert dr.allclose(bs.pdf, bs.wo.z / np.pi)
    # Mean and variance of the cosine under the density 2 cosθ d(cosθ): 2/3 and 1/18.
    z = np.array(bs.wo.z)
    assert z.mean() == pytest.approx(2 / 3, abs=4 * np.sqrt(1 / 18 / len(z)))
    assert z.var() == pytest.approx(1 / 18, rel=0.05)


def test_albedo_and_description(variant):
    bsdf = load(MAPS["isotropic"], reflectance=0.25)
    assert dr.allclose(bsdf.eval_diffuse_reflectance(RESOLVED.interaction()), 0.25)
    for part in ("GlintDiffuse", "manifold", "36×29", "footprint_sigma = 1"):
        assert part in str(bsdf)


# --------------------------------------------------------------------------------------------------
#  Parameters
# --------------------------------------------------------------------------------------------------

# The shared parameters that a diffuse surface has, too.
SHARED = [
    (changes, name)
    for changes, name in suite.BAD_PARAMETERS
    if not set(changes) & {"material", "eta", "k", "int_ior", "ext_ior", "specular_reflectance"}
]
BAD_OWN_PARAMETERS = [
    ({"method": "lambert"}, "method"),
    ({"method": 1}, "method"),
    ({"reflectance": 1.5}, "reflectance"),
    ({"reflectance": -0.5}, "reflectance"),
    ({"reflectance": suite.NAN}, "reflectance"),
]


@pytest.mark.parametrize(("changes", "parameter"), SHARED + BAD_OWN_PARAMETERS, ids=str)
def test_bad_parameters(variant, changes, parameter):
    suite.check_rejects(describe(MAPS["isotropic"]), changes, parameter)


@pytest.mark.parametrize("parameters", [{"material": "Au"}, {"masking": "none"}, {"alpha": 0.1}])
def test_parameters_of_glossy_surfaces_are_unknown(variant, parameters):
    with pytest.raises(RuntimeError, match=next(iter(parameters))):
        load(MAPS["isotropic"], **parameters)


@pytest.mark.parametrize("method", METHODS)
def test_changed_parameters_take_effect(variant, method):
    bsdf = load(MAPS["isotropic"], method=method)
    params = mi.traverse(bsdf)
    params["data"] = mi.TensorXf(MAPS["tilted"].normals)
    params["footprint_sigma"] = 0.5
    params["reflectance.value"] = 0.7
    params.update()
    fresh = load(MAPS["tilted"], method=method, footprint_sigma=0.5, reflectance=0.7)
    si, wo, ctx = RESOLVED.interaction(50), hemisphere(50), mi.BSDFContext()
    assert dr.allclose(bsdf.eval(ctx, si, wo), fresh.eval(ctx, si, wo), rtol=1e-4)


# --------------------------------------------------------------------------------------------------
#  Inside Mitsuba
# --------------------------------------------------------------------------------------------------


def test_one_sided_unless_wrapped(variant):
    bsdf = describe(MAPS["isotropic"], pixel_spread=0.03, reflectance=0.5)
    assert 0.3 < suite.square(bsdf).mean() < 0.6
    assert suite.square(bsdf, from_below=True).max() == 0
    twosided = {"type": "twosided", "nested": bsdf}
    assert np.allclose(suite.square(twosided), suite.square(bsdf), rtol=1e-4)
    assert suite.square(twosided, from_below=True).mean() > 0.3


def test_each_variant(each_variant):
    for method in METHODS:
        bsdf = load(MAPS["isotropic"], method=method, reflectance=0.5)
        suite.check_eval_pdf(bsdf, RESOLVED, 50)
        suite.check_weights(bsdf, RESOLVED, 50)
        suite.check_finite(bsdf, RESOLVED, 50)
