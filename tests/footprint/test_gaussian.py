"""The footprint: its covariance, its sources, and degenerate cases."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest

from glintbsdf.footprint.gaussian import Footprint, project_along, tangent_to_uv


def covariance(footprint: Footprint) -> np.ndarray:
    """Covariance matrices, shape (N, 2, 2), UV² units."""
    axes = np.stack([np.array(footprint.du), np.array(footprint.dv)], axis=-1)  # (2, 2, N) or so
    axes = np.moveaxis(axes, 1, 0)
    return axes @ np.swapaxes(axes, 1, 2)


def interactions(seed: int, count: int) -> mi.SurfaceInteraction3f:
    """Random slanted parameterisations, viewed at up to 80 degrees from the normal."""
    rng = np.random.default_rng(seed)

    def uniform(low, high):
        return mi.Float(rng.uniform(low, high, count).astype(np.float32))

    si = dr.zeros(mi.SurfaceInteraction3f, count)
    si.n = mi.Normal3f(dr.normalize(mi.Vector3f(rng.normal(size=(3, count)).astype(np.float32))))
    si.sh_frame = mi.Frame3f(si.n)
    si.uv = mi.Point2f(uniform(0, 1), uniform(0, 1))
    si.dp_du = si.sh_frame.s * uniform(0.1, 10)
    slant_sin, slant_cos = dr.sincos(uniform(0.5, 2.5))  # angle between dp_du and dp_dv
    si.dp_dv = (si.sh_frame.s * slant_cos + si.sh_frame.t * slant_sin) * uniform(0.1, 10)
    theta_sin, theta_cos = dr.sincos(uniform(0, np.radians(80)))
    phi_sin, phi_cos = dr.sincos(uniform(0, 2 * np.pi))
    si.wi = mi.Vector3f(theta_sin * phi_cos, theta_sin * phi_sin, theta_cos)
    si.t = uniform(0.1, 100)
    return si


def test_partials_give_the_full_covariance(variant):
    si = dr.zeros(mi.SurfaceInteraction3f)
    si.duv_dx, si.duv_dy = mi.Vector2f(0.03, 0.01), mi.Vector2f(-0.02, 0.04)
    expected = 0.5**2 * np.array(
        [
            [0.03**2 + 0.02**2, 0.03 * 0.01 - 0.02 * 0.04],
            [0.03 * 0.01 - 0.02 * 0.04, 0.01**2 + 0.04**2],
        ]
    )
    assert np.allclose(covariance(Footprint.from_interaction(si, 0.5, 0.1)), expected, rtol=1e-6)


def test_isotropic_and_to_uv(variant):
    footprint = Footprint.isotropic(mi.Point2f(0.25, 0.5), 0.1)
    assert np.allclose(covariance(footprint), 0.01 * np.eye(2), rtol=1e-6)

    to_uv = mi.ScalarTransform4f().translate([0.1, 0.2, 0]).rotate([0, 0, 1], 90).scale([2, 3, 1])
    moved = footprint.transformed(to_uv.extract())
    assert np.allclose(np.array(moved.uv).ravel(), [0.1 - 1.5, 0.2 + 0.5], atol=1e-6)
    assert np.allclose(covariance(moved), np.diag([0.09, 0.04]), rtol=1e-5, atol=1e-8)


def test_cone_is_the_ellipse_of_a_round_beam(variant):
    """It has the closed form w² (I + a aᵀ/cos²), with a the tangential part of the direction."""
    si = interactions(seed=1, count=500)
    cone = covariance(Footprint.from_interaction(si, 1.0, 1e-3))

    # All in float64 and in the local frame, where the tangent plane is z = 0.
    wi = np.array(si.wi, dtype=np.float64).T
    ellipse = np.eye(2) + wi[:, :2, None] * wi[:, None, :2] / wi[:, 2, None, None] ** 2
    ellipse *= (1e-3 * np.array(si.t, dtype=np.float64))[:, None, None] ** 2
    jacobian = np.stack([np.array(si.to_local(p))[:2].T for p in (si.dp_du, si.dp_dv)], axis=-1)
    inverse = np.linalg.inv(jacobian.astype(np.float64))
    expected = inverse @ ellipse @ np.swapaxes(inverse, 1, 2)

    # Largest error measured: 1.4e-6 of the largest entry
    scale = np.abs(expected).max(axis=(1, 2), keepdims=True)
    assert (np.abs(cone - expected) / scale).max() < 1e-5


def test_cone_agrees_with_ray_differentials(variant):
    """In the middle of an oblique image, a square pixel is the cone of its own angle."""
    scene = mi.load_dict(
        {
            "type": "scene",
            "plane": {"type": "rectangle", "to_world": mi.ScalarTransform4f().scale([3, 2, 1])},
            "sensor": {
                "type": "perspective",
                "fov": 20,
                "near_clip": 1e-3,
                "to_world": mi.ScalarTransform4f().look_at([0, -4, 2], [0, 0, 0], [0, 0, 1]),
                "film": {"type": "hdrfilm", "width": 512, "height": 512},
            },
        }
    )
    ray, _ = scene.sensors()[0].sample_ray_differential(0.0, 0.5, mi.Point2f(0.5), mi.Point2f(0.5))
    si = scene.ray_intersect(ray)
    spread = 2 * np.tan(np.radians(10)) / 512
    cone = covariance(Footprint.from_interaction(si, 0.5, float(spread)))
    si.compute_uv_partials(ray)
    partials = covariance(Footprint.from_interaction(si, 0.5, 0.0))
    # One pixel's finite difference against the derivative: 2.8e-3 measured
    assert np.allclose(cone, partials, rtol=4e-3, atol=4e-3 * partials.max())


def test_cone_from_either_side(variant):
    """``twosided`` passes a mirrored direction; the back has the same footprint."""
    si = interactions(seed=6, count=100)
    front = covariance(Footprint.from_interaction(si, 0.5, 1e-3))
    si.wi.z = -si.wi.z
    back = covariance(Footprint.from_interaction(si, 0.5, 1e-3))
    scale = front.max(axis=(1, 2), keepdims=True)
    assert (np.abs(front - back) / scale).max() < 1e-5  # 2e-6 measured


def test_source_is_chosen_per_lane(variant):
    si = interactions(seed=2, count=4)
    cone = covariance(Footprint.from_interaction(si, 0.5, 0.01))
    nan, inf = float("nan"), float("inf")
    si.duv_dx = mi.Vector2f([0.1, 0.0, nan, 0.0], [0.0, 0.0, 1.0, 0.0])
    si.duv_dy = mi.Vector2f([0.0, 0.0, 0.2, 0.0], [0.0, 0.0, 0.0, inf])
    mixed = covariance(Footprint.from_interaction(si, 0.5, 0.01))
    assert np.allclose(mixed[0], [[0.0025, 0], [0, 0]])  # partials, of rank one
    assert np.array_equal(mixed[1], cone[1])  # none: cone
    assert np.allclose(mixed[2], [[0.01, 0], [0, 0]])  # the finite one remains
    assert np.array_equal(mixed[3], cone[3])  # no finite one remains: cone


def test_mitsuba_footprint_where_it_exists(variant):
    """The 2×2 matrix of Mitsuba's next release, in an object with its columns."""

    class Interaction:
        pass

    si = Interaction()
    si.uv, si.duv_dx, si.duv_dy = mi.Point2f(0), mi.Vector2f(0), mi.Vector2f(0)
    si.footprint = mi.Matrix2f([[0.1, 0.2], [0.3, 0.4]])
    footprint = Footprint.from_interaction(si, 0.5, 0.0)
    assert np.allclose(np.array(footprint.du).ravel(), [0.05, 0.15])
    assert np.allclose(np.array(footprint.dv).ravel(), [0.1, 0.2])


def test_known_zero_records_nothing(variant):
    """Mitsuba's own integrators pass literal zeros, which are recognised without an evaluation."""
    si = interactions(seed=5, count=1)
    opaque_sigma = dr.opaque(mi.Float, 0.5)
    assert Footprint.from_interaction(si, opaque_sigma, 0.0).is_known_to_be_zero()
    assert Footprint.from_interaction(si, opaque_sigma, mi.Float(0)).is_known_to_be_zero()
    assert not Footprint.from_interaction(si, 0.5, 0.01).is_known_to_be_zero()
    si.duv_dx = dr.opaque(mi.Vector2f, 0.0)  # zero, but only the kernel will know
    assert not Footprint.from_interaction(si, 0.5, 0.0).is_known_to_be_zero()


@pytest.mark.parametrize("case", ["zero", "zero_v", "parallel", "nan", "grazing", "missed", "far"])
def test_degenerate_interactions(variant, case):
    """They give a point, never NaN, and finite derivatives; a healthy lane beside them is not
    affected."""
    si = interactions(seed=3, count=2)
    healthy = np.array([False, True])

    def first_lane(value, otherwise):
        return dr.select(mi.Bool(~healthy), value, otherwise)

    if case == "zero":
        si.dp_du = first_lane(mi.Vector3f(0), si.dp_du)
        si.dp_dv = first_lane(mi.Vector3f(0), si.dp_dv)
    elif case == "zero_v":
        si.dp_dv = first_lane(mi.Vector3f(0), si.dp_dv)
    elif case == "parallel":
        si.dp_dv = first_lane(si.dp_du * -3.7, si.dp_dv)
    elif case == "nan":
        si.dp_du = first_lane(mi.Vector3f(float("nan")), si.dp_du)
    elif case == "grazing":
        si.wi = first_lane(mi.Vector3f(1, 0, 0), si.wi)
    elif case == "missed":
        si.t = first_lane(float("inf"), si.t)
    elif case == "far":
        si.t = first_lane(1e20, si.t)

    sigma, spread = mi.Float(0.5, 0.5), mi.Float(0.01, 0.01)
    dr.enable_grad(sigma, spread)
    footprint = Footprint.from_interaction(si, sigma, spread)
    dr.backward(dr.sum(footprint.du + footprint.dv))
    result = covariance(footprint)
    assert np.all(np.isfinite(result[healthy])) and np.all(np.linalg.det(result[healthy]) > 0)
    assert np.all(np.isfinite(np.array(footprint.du))) and np.all(
        np.isfinite(np.array(footprint.dv))
    )
    assert np.all(np.isfinite(dr.grad(sigma).numpy())) and np.all(
        np.isfinite(dr.grad(spread).numpy())
    )
    assert dr.grad(spread).numpy()[1] != 0
    if case == "far":
        assert np.abs(np.array(footprint.du)[:, 0]).max() > 1e15
    elif case != "grazing":  # in float32 the rotated direction may miss the plane by a hair
        assert np.array_equal(result[0], np.zeros((2, 2)))


def test_derivatives(variant):
    """d Σ/dσ = 2 Σ/σ and d Σ/d spread = 2 Σ/spread, by Dr.Jit."""
    si = interactions(seed=4, count=1)
    for index in range(2):
        values = [mi.Float(0.4), mi.Float(0.02)]
        dr.enable_grad(values[index])
        footprint = Footprint.from_interaction(si, *values)
        variance = footprint.du.x**2 + footprint.dv.x**2
        dr.forward(values[index])
        expected = 2 * variance.numpy() / values[index].numpy()
        assert np.allclose(dr.grad(variance).numpy(), expected, rtol=1e-5)


def test_least_squares_inverse(variant):
    """A parameterisation slanted to 0.5 degrees, with lengths a million apart, keeps its digits."""
    dp_du = mi.Vector3f(1e-3, 0, 0)
    dp_dv = mi.Vector3f(dr.cos(np.pi / 360), dr.sin(np.pi / 360), 0) * 1e3
    uv = tangent_to_uv(dp_du, dp_dv, dp_du * 3.0 + dp_dv * 2e-6 + mi.Vector3f(0, 0, 5))
    # 2e-7 measured
    assert np.allclose(np.array(uv).ravel(), [3.0, 2e-6], rtol=2e-6)


def test_project_along(variant):
    d, n = mi.Vector3f(0.6, 0, -0.8), mi.Normal3f(0, 0, 1)
    moved = project_along(d, n, mi.Vector3f(1, 2, 3))
    assert np.allclose(np.array(moved).ravel(), [1 + 0.6 * 3 / 0.8, 2, 0], atol=1e-6)
