"""Footprint kernels: integrals, samplers, extents, and stiff footprints."""

from __future__ import annotations

from math import cos, sin

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest

from glintbsdf.core.errors import ParameterError
from glintbsdf.footprint.gaussian import Footprint
from glintbsdf.footprint.kernels import (
    KERNELS,
    SIGMA_MIN,
    TexelKernel,
    gaussian_like,
    limit_extent,
)

WIDTH, HEIGHT = 128, 64

# Axes in texels: round, stretched and rotated, and a line, whose width is SIGMA_MIN.
FOOTPRINTS = {
    "round": ((2, 0), (0, 2)),
    "rotated": ((6, 3), (-0.5, 1)),
    "1000:1": ((20, 10), (-0.01, 0.02)),
    "line": ((4, 2), (0, 0)),
}


def footprint_of(axes, uv=(0.4, 0.6)):
    du, dv = ((x / WIDTH, y / HEIGHT) for x, y in axes)
    return Footprint(mi.Point2f(uv), mi.Vector2f(du), mi.Vector2f(dv))


def texel_kernel(kernel, axes, uv=(0.4, 0.6), wrap_mode="repeat"):
    return TexelKernel(kernel, footprint_of(axes, uv), HEIGHT, WIDTH, wrap_mode)


def covariance(axes):
    return sum(np.outer(a, a) for a in np.array(axes, float)) + SIGMA_MIN**2 * np.eye(2)


def samples(kernel, count=100_000):
    u = np.random.default_rng(1).random((2, count), dtype=np.float32)
    return np.array(kernel.sample(mi.Point2f(mi.Float(u[0]), mi.Float(u[1]))), np.float64)


@pytest.mark.parametrize("axes", FOOTPRINTS.values(), ids=FOOTPRINTS)
@pytest.mark.parametrize("kernel", KERNELS)
def test_samples_have_the_covariance_and_stay_inside(variant, kernel, axes):
    k = texel_kernel(kernel, axes)
    offset = samples(k)
    sigma = covariance(axes)
    # Variance per axis of the whitened kernel; the box uses only the map's axes.
    scale = {
        "gaussian": 1 - 4.5 * np.exp(-4.5) / (1 - np.exp(-4.5)),
        "disk": 2.25 / 4,
        "box": 2.25 / 3,
    }[kernel]
    expected = scale * (np.diag(np.diag(sigma)) if kernel == "box" else sigma)
    factor = np.linalg.cholesky(expected)
    whitened = np.linalg.solve(factor, offset)
    # Covariance of n samples: standard error √(2/n) on the diagonal; 5 sigma. float32 noise of
    # the axes reaches the narrow direction of the 1000:1 footprint, 3e-3 at the most.
    assert np.allclose(np.cov(whitened), np.eye(2), atol=5 * np.sqrt(2 / offset.shape[1]) + 3e-3)
    assert np.all(np.abs(offset[0]) <= k.reach_u.numpy() * (1 + 1e-5))
    assert np.all(np.abs(offset[1]) <= k.reach_v.numpy() * (1 + 1e-5))


@pytest.mark.parametrize("axes", FOOTPRINTS.values(), ids=FOOTPRINTS)
@pytest.mark.parametrize("kernel", KERNELS)
def test_integral_is_one(variant, kernel, axes):
    """E[1/k] over samples is the area of the support, and the mean of k over the support is
    1/area."""
    k = texel_kernel(kernel, axes)
    offset = samples(k)
    value = k.value(mi.Vector2f(*(mi.Float(np.float32(x)) for x in offset))).numpy()
    positive = value > 0  # rounding may put a sample on the edge just outside
    assert positive.mean() > 0.999
    determinant = np.sqrt(np.linalg.det(covariance(axes)))
    area = {
        "gaussian": 9 * np.pi * determinant,
        "disk": 2.25 * np.pi * determinant,
        "box": 9 * np.sqrt(np.prod(np.diag(covariance(axes)))),
    }[kernel]
    inverse = 1 / value[positive].astype(np.float64)
    error = inverse.std() / np.sqrt(len(inverse))
    # 2e-3: rounding at the edge as above, and of the determinant of 1000:1.
    assert abs(inverse.mean() - area) < 5 * error + 2e-3 * area


@pytest.mark.parametrize("axes", FOOTPRINTS.values(), ids=FOOTPRINTS)
@pytest.mark.parametrize("kernel", KERNELS)
def test_row_extent_is_tight(variant, kernel, axes):
    k = texel_kernel(kernel, axes)
    x, y = samples(k, 400_000)
    for top in np.linspace(y.min(), y.max(), 6)[:-1]:
        bottom = top + np.ptp(y) / 5
        inside = (y >= top) & (y <= bottom)
        left, right = (v.numpy().item() for v in k.row_extent(mi.Float(top), mi.Float(bottom)))
        slack = 1e-4 * (right - left) + 1e-4
        assert left - slack <= x[inside].min() and x[inside].max() <= right + slack
        if kernel != "gaussian":  # whose tails are thinly sampled
            assert x[inside].min() - left < 0.1 * (right - left)
            assert right - x[inside].max() < 0.1 * (right - left)


@pytest.mark.parametrize("kernel", KERNELS)
def test_gaussian_in_place_of_a_kernel_has_its_covariance(variant, kernel):
    axes = FOOTPRINTS["rotated"]
    of_samples = np.cov(samples(texel_kernel(kernel, axes)))
    footprint = gaussian_like(kernel, footprint_of(axes))
    ours = [np.array(axis).ravel() * (WIDTH, HEIGHT) for axis in (footprint.du, footprint.dv)]
    assert np.allclose(covariance(ours), of_samples, atol=0.02 * of_samples.max())


def test_limit_extent_keeps_the_width_of_a_long_footprint(variant):
    angle = 0.7
    along, across = (cos(angle), sin(angle)), (-sin(angle), cos(angle))
    du, dv = limit_extent(50 * mi.Vector2f(along), 0.03 * mi.Vector2f(across))
    sigma = sum(np.outer(v, v) for v in (np.array(du)[:, 0], np.array(dv)[:, 0]))
    wide, narrow = np.linalg.eigvalsh(sigma)[::-1] ** 0.5
    # The direction of the major axis is known to 1e-7 of 50 maps.
    assert abs(wide - 1) < 1e-4 and abs(narrow - 0.03) < 1e-4


@pytest.mark.parametrize("length", [1e3, 1e8, 1e15])
def test_limit_extent_of_parallel_axes(variant, length):
    # The footprint of a ray cone at a grazing angle: the narrow axis is lost in rounding, and the
    # footprint must not grow with the noise.
    along = mi.Vector2f(cos(2.4), sin(2.4)) * length
    for du, dv in ((along, -0.876 * along), (0.3 * along, along), (along, mi.Vector2f(0))):
        du, dv = (np.array(v, np.float64)[:, 0] for v in limit_extent(du, dv))
        assert np.sqrt(np.linalg.norm(np.outer(du, du) + np.outer(dv, dv), 2)) <= 1 + 1e-6


@pytest.mark.parametrize("size", [1.0, 3.0])
def test_limit_extent_of_a_round_footprint(variant, size):
    du, dv = limit_extent(mi.Vector2f(size, 0), mi.Vector2f(0, size))
    du, dv = (np.array(v, np.float64)[:, 0] for v in (du, dv))
    assert np.allclose(np.outer(du, du) + np.outer(dv, dv), np.eye(2), atol=1e-6)


def test_derivatives_of_limit_extent_are_finite(variant):
    for width in (0.0, 0.5, 1.0, 3.0):
        scale = dr.opaque(mi.Float, width)
        dr.enable_grad(scale)
        du, dv = limit_extent(mi.Vector2f(scale, 0), mi.Vector2f(0, scale))
        dr.backward(dr.squared_norm(du) + dr.squared_norm(dv))
        assert dr.all(dr.isfinite(dr.grad(scale)))


def test_small_footprints_are_not_limited(variant):
    du, dv = limit_extent(mi.Vector2f(0.9, 0.1), mi.Vector2f(0, 0.2))
    assert dr.allclose(du, [0.9, 0.1]) and dr.allclose(dv, [0, 0.2])


@pytest.mark.parametrize("kernel", KERNELS)
@pytest.mark.parametrize("wrap_mode", ["repeat", "mirror", "clamp"])
def test_extreme_footprints_are_finite(variant, kernel, wrap_mode):
    for axes in (((0, 0), (0, 0)), ((1e6, 0), (0, 1e-6)), ((1e7, 1e7), (1e7, 1e7))):
        k = texel_kernel(kernel, axes, uv=(1e5, -1e5), wrap_mode=wrap_mode)
        assert np.isfinite(samples(k, 100)).all()
        value = k.value(mi.Vector2f(0)).numpy()
        assert np.isfinite(value).all() and (value > 0).all()
        assert np.isfinite(np.array(k.mean)).all()


def test_unknown_kernel_is_refused(variant):
    with pytest.raises(ParameterError, match='"kernel" must be one of gaussian, disk, box'):
        texel_kernel("tent", FOOTPRINTS["round"])


@pytest.mark.parametrize("kernel", KERNELS)
def test_derivatives_of_averages(variant, kernel):
    """The derivatives of the integral (0) and of the variances, for a footprint that grows by a
    factor, and of the mean (1), for one that moves. They are correct although no value shows the
    moving edges."""
    n, extent = 900, 9.0  # jittered points of a square around the footprint
    rng = np.random.default_rng(0)
    x, y = (
        ((k + rng.random((n, n))) * (2 * extent / n) - extent).astype(np.float32).ravel()
        for k in np.meshgrid(np.arange(n), np.arange(n))
    )
    offset, area = mi.Vector2f(mi.Float(x), mi.Float(y)), (2 * extent / n) ** 2
    scale = dr.opaque(mi.Float, 1.0)
    dr.enable_grad(scale)
    axes = ((1.5, 0.5), (-0.3, 1.0))
    du, dv = (mi.Vector2f(u * scale / WIDTH, v * scale / HEIGHT) for u, v in axes)
    k = TexelKernel(kernel, Footprint(mi.Point2f(0.4, 0.6), du, dv), HEIGHT, WIDTH, "repeat")
    value = k.value(offset)
    derivatives = []
    for moment in (1, x * x, y * y):
        dr.backward(dr.sum(value * mi.Float(moment)) * area, dr.ADFlag.ClearVertices)
        derivatives.append(dr.grad(scale)[0])
        dr.set_grad(scale, 0)
    share = {"gaussian": 1 - 4.5 * np.exp(-4.5) / (1 - np.exp(-4.5)), "disk": 2.25 / 4,
             "box": 2.25 / 3}[kernel]  # fmt: skip
    variances = 2 * share * np.diag(covariance(axes))
    assert abs(derivatives[0]) < 0.01
    assert np.allclose(derivatives[1:], variances, rtol=0.02)

    place = dr.opaque(mi.Float, 0.0)
    dr.enable_grad(place)
    footprint = Footprint(mi.Point2f(0.4 + place / WIDTH, 0.6), dr.detach(du), dr.detach(dv))
    k = TexelKernel(kernel, footprint, HEIGHT, WIDTH, "repeat")
    value = k.value(offset - mi.Vector2f(place, 0))
    dr.backward(dr.sum(value * mi.Float(x)) * area)
    assert np.isclose(dr.grad(place)[0], 1, rtol=0.01)


def test_derivatives_of_a_round_kernel_are_finite(variant):
    sigma = dr.opaque(mi.Float, 0.02)
    dr.enable_grad(sigma)
    k = TexelKernel("gaussian", Footprint.isotropic(mi.Point2f(0.5), sigma), 64, 64, "repeat")
    dr.backward(k.minor_variance)
    assert dr.allclose(dr.grad(sigma), 2 * 0.02 * 64**2, rtol=1e-3)
