"""The microfacet frame: half vectors, Fresnel reflectance and Mueller matrices, masking."""

from __future__ import annotations

from types import SimpleNamespace

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
import scipy.integrate
import scipy.stats

from glintbsdf import maps
from glintbsdf.microfacet import frame, fresnel, interface
from glintbsdf.microfacet.masking import BeckmannMasking, beckmann_lambda
from glintbsdf.pndf.base import map_alpha_squared


def directions(count: int, seed: int) -> mi.Vector3f:
    """Random directions of the upper hemisphere."""
    u = np.random.default_rng(seed).random((2, count)).astype(np.float32)
    return mi.warp.square_to_uniform_hemisphere(mi.Point2f(u))


def test_half_vector_reflects(variant):
    wi, wo = directions(1000, 1), directions(1000, 2)
    m = frame.half_vector(wi, wo)
    assert dr.allclose(mi.reflect(wi, mi.Normal3f(m)), wo, atol=2e-6)


def test_normal_from_projection(variant):
    s = mi.Vector2f([0, 0.6, 0.8, 1.0, 2.0], [0, 0, 0, 0, 1.0])
    assert dr.allclose(frame.normal_from_projection(s).z, [1, 0.8, 0.6, 0, 0])


def test_reflected_pdf_integrates_to_one(variant):
    # A uniform density on a disk of radius 0.3 about the origin: all of it is reflected upwards.
    # The mean over the sphere has a relative error of 4e-4 for these 4 million directions.
    n, radius = 4_000_000, 0.3
    wi = dr.normalize(mi.Vector3f(0.3, 0.2, 1))
    rng = mi.PCG32(size=n)
    wo = mi.warp.square_to_uniform_hemisphere(mi.Point2f(rng.next_float32(), rng.next_float32()))
    m = frame.half_vector(wi, wo)
    density = dr.select(m.x * m.x + m.y * m.y < radius**2, 1 / (np.pi * radius**2), 0)
    pdf = interface.Mirror().components[0].density_of_direction(density * m.z, wo, m)
    assert abs(dr.mean(pdf)[0] * 2 * np.pi - 1) < 5e-3


@pytest.mark.parametrize("alpha", [(0.1, 0.1), (0.5, 0.02), (1.5, 1.5)])
def test_beckmann_lambda_is_the_integral_that_defines_it(variant, alpha):
    # Λ(w) = 1/cot θ ∫_{cot θ}^∞ (x − cot θ) P(x) dx, P the slope density along w (Heitz 2014).
    angles = np.array([0.2, 0.8, 1.2, 1.45, 1.55, 1.57])
    phi = np.linspace(0, 3, 6)
    w = np.array([np.sin(angles) * np.cos(phi), np.sin(angles) * np.sin(phi), np.cos(angles)])
    ours = beckmann_lambda(mi.Vector3f(w), mi.Vector2f(np.square(alpha)))
    for theta, p, value in zip(angles, phi, np.array(ours), strict=True):
        sigma = np.hypot(alpha[0] * np.cos(p), alpha[1] * np.sin(p)) / np.sqrt(2)
        c = 1 / np.tan(theta)
        slopes = scipy.stats.norm(scale=sigma)
        integral, _ = scipy.integrate.quad(
            lambda x, c=c, p=slopes: (x - c) * p.pdf(x), c, c + 12 * sigma
        )
        # float32: the two terms of Λ cancel to 1e-7 of each.
        assert value == pytest.approx(integral / c, rel=2e-4, abs=2e-7)


def test_beckmann_lambda_at_the_limits(variant):
    assert dr.all(beckmann_lambda(directions(100, 3), mi.Vector2f(0)) == 0)
    grazing = mi.Vector3f(1, 0, [1e-3, 1e-6, 1e-30])
    value = beckmann_lambda(grazing, mi.Vector2f(0.01))
    assert dr.all(value > 10) and dr.all(dr.isfinite(value))


def test_smith_g1_is_that_of_mitsuba(variant):
    # Mitsuba uses Walter's rational fit, 0.35 % from the exact function.
    w = directions(500, 4)
    distribution = mi.MicrofacetDistribution(mi.MicrofacetType.Beckmann, 0.4, 0.1)
    g1 = dr.rcp(1 + beckmann_lambda(w, mi.Vector2f(0.16, 0.01)))
    assert dr.max(dr.abs(g1 - distribution.smith_g1(w, mi.Vector3f(0, 0, 1))))[0] < 4e-3


def test_masking_takes_the_roughness_of_the_map(variant):
    normal_map = maps.brushed((40, 64), streak_length=30)
    pndf = SimpleNamespace(data=mi.TensorXf(normal_map.normals))
    masking = BeckmannMasking(lambda: map_alpha_squared(pndf.data))
    assert np.allclose(np.sqrt(np.ravel(masking.alpha_squared)), normal_map.roughness(), rtol=1e-4)
    pndf.data = mi.TensorXf(0 * normal_map.normals)
    radiance = mi.TransportMode.Radiance
    masking.parameters_changed(["pixel_spread"])
    assert not dr.all(masking.eval(directions(9, 5), directions(9, 6), None, radiance, True) == 1)
    masking.parameters_changed(["data"])
    assert dr.all(masking.eval(directions(9, 5), directions(9, 6), None, radiance, True) == 1)


def test_masking_is_differentiable_where_it_vanishes(variant):
    data = mi.TensorXf(np.zeros((2, 2, 2)))
    dr.enable_grad(data)
    masking = BeckmannMasking(lambda: map_alpha_squared(data))
    radiance = mi.TransportMode.Radiance
    dr.backward(dr.sum(masking.eval(directions(9, 5), directions(9, 6), None, radiance, True)))
    assert dr.all(dr.isfinite(dr.grad(data)), axis=None)


def test_dielectric_is_a_conductor_without_absorption(variant):
    si = dr.zeros(mi.SurfaceInteraction3f, 50)
    cosine = dr.linspace(mi.Float, 0.01, 1, 50)
    dielectric = interface.Dielectric(1.5).reflectance(cosine, si, True)
    eta, k = (mi.load_dict({"type": "uniform", "value": value}) for value in (1.5, 0.0))
    conductor = interface.Conductor(eta, k).reflectance(cosine, si, True)
    assert dr.allclose(dielectric, conductor, atol=1e-5)
    assert dr.allclose(dielectric.x[49], 0.04, atol=1e-6)


def test_mueller_matrix_is_that_of_roughconductor(each_variant):
    # All of roughconductor's factors but the Mueller matrix are scalars: normalised by their first
    # entry the matrices are equal, up to float32 rounding of the bases.
    if not mi.is_polarized:
        pytest.skip("needs a polarised variant")
    rough = mi.load_dict({"type": "roughconductor", "material": "Au", "alpha": 0.8})
    ours = mi.load_dict(
        {"type": "glint_manifold", "data": mi.TensorXf(maps.isotropic(8).normals), "material": "Au"}
    )
    wi, wo = directions(50, 7), directions(50, 8)
    m = frame.half_vector(wi, wo)
    si = dr.zeros(mi.SurfaceInteraction3f, 50)
    si.wi, si.wavelengths = wi, [450, 500, 550, 650]
    reflectance = np.array(ours.interface.reflectance(dr.dot(wo, m), si, True))
    for mode in (mi.TransportMode.Radiance, mi.TransportMode.Importance):
        expected = np.array(rough.eval(mi.BSDFContext(mode), si, wo))
        actual = np.array(
            fresnel.mueller_reflection(
                ours.interface.index(si, True), mi.UnpolarizedSpectrum(0.5), mode, wi, wo, m
            )
        )
        assert np.allclose(actual[0, 0], 0.5 * reflectance, rtol=1e-4)
        seen = expected[0, 0, 0] > 1e-6
        assert seen.sum() > 25
        actual, expected = actual[..., seen], expected[..., seen]
        assert np.allclose(actual / actual[0, 0], expected / expected[0, 0], atol=1e-4)
