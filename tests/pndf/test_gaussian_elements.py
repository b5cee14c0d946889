"""4D Gaussians under a footprint: float32 against the definitions in NumPy's float64."""

from __future__ import annotations

import mitsuba as mi
import numpy as np
import pytest

from glintbsdf.check import suite
from glintbsdf.pndf.gaussian_elements import (
    SIGMA_H,
    AveragedGaussian,
    Gaussian,
    Overlap,
    lattice_mass,
    point_of_ellipse,
)

COUNT = 2000
RNG = np.random.default_rng


def vectors(rng, scale, aspect=1.0, count=COUNT):
    """Two float32 vectors per lane: an ellipse with the given axes, in any rotation."""
    angle, roll = rng.uniform(0, 2 * np.pi, (2, count))
    axes = scale * np.stack([np.ones(count), np.broadcast_to(1 / aspect, count)])
    turned = (
        axes * np.stack([np.cos(roll), np.sin(roll)]),
        axes * np.stack([-np.sin(roll), np.cos(roll)]),
    )
    rotation = np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])
    return [np.einsum("ijn,jn->in", rotation, v).astype(np.float32) for v in turned]


def outer(*vs):
    """Σ v vᵀ, (N, 2, 2), float64."""
    return sum(np.einsum("in,jn->nij", v.astype(float), v.astype(float)) for v in vs)


def density(d, covariance):
    form = np.einsum("in,nij,jn->n", d, np.linalg.inv(covariance), d)
    return np.exp(-0.5 * form) / (2 * np.pi * np.sqrt(np.linalg.det(covariance)))


def drawn(rng, covariance):
    """Points (2, N) of N(0, covariance), float32."""
    root = np.linalg.cholesky(covariance)
    return np.einsum("nij,jn->in", root, rng.standard_normal((2, COUNT))).astype(np.float32)


def relative_error(ours, exact):
    return np.max(np.abs(np.array(ours, np.float64) - exact) / np.abs(exact))


@pytest.mark.parametrize("aspect", [1, 30, 1000])
@pytest.mark.parametrize("general", [False, True])
def test_overlap(variant, aspect, general):
    """Mass, mean and covariance of the product, for footprints from points to 1000:1."""
    rng = RNG(1)
    footprint = vectors(rng, 10 ** rng.uniform(-3, 3, COUNT), aspect)
    if general:
        lobe = vectors(rng, 10 ** rng.uniform(-1, 1, COUNT), 10.0)
        lobe_gaussian, s = Gaussian([mi.Vector2f(v) for v in lobe]), outer(*lobe)
    else:
        lobe_gaussian, s = Gaussian(variance=SIGMA_H**2), SIGMA_H**2 * np.eye(2)[None]
    sigma_p = outer(*footprint)
    total = sigma_p + s
    d = drawn(rng, total)
    overlap = Overlap(Gaussian([mi.Vector2f(v) for v in footprint]), lobe_gaussian)
    # The distance of a 1000:1 Gaussian magnifies float32's rounding of products a little.
    assert relative_error(overlap.mass(mi.Vector2f(d)), density(d, total)) < 1e-4
    gain = np.broadcast_to(s, total.shape) @ np.linalg.inv(total)
    mean = np.einsum("nij,jn->in", gain, d)
    offset = np.abs(np.array(overlap.mean(mi.Vector2f(d))) - mean).max(axis=0)
    assert (offset / np.linalg.norm(d, axis=0)).max() < 1e-6
    roots = [np.array(c) * np.ones((2, COUNT), np.float32) for c in overlap.root]
    covariance = gain @ sigma_p
    error = np.abs(outer(*roots) - covariance).max(axis=(1, 2))
    assert (error / np.trace(covariance, axis1=1, axis2=2)).max() < 1e-5


def test_footprint_of_no_extent(variant):
    overlap = Overlap(Gaussian((mi.Vector2f(0), mi.Vector2f(0))), Gaussian(variance=0.25))
    d = mi.Vector2f(0.3, -0.2)
    assert np.allclose(np.array(overlap.mean(d)).ravel(), (0.3, -0.2))
    assert all(np.array(c).max() == 0 for c in overlap.root)
    assert np.allclose(overlap.mass(d), np.exp(-0.13 / 0.5) / (2 * np.pi * 0.25))


@pytest.mark.parametrize("sigma_r", [1e-1, 1e-2, 1e-3, 1e-4, 1e-5])
@pytest.mark.parametrize("slope", [0.0, 0.01, 1.0])
def test_normals_of_stiff_lobes(variant, sigma_r, slope):
    """Normals of curved lobes: relative error of the density at normals that are drawn from it."""
    rng = RNG(2)
    footprint = vectors(rng, 10 ** rng.uniform(-2, 2, COUNT), 10 ** rng.uniform(0, 2, COUNT))
    jacobian = (slope * rng.uniform(-1, 1, (2, 2, COUNT))).astype(np.float32)
    sigma_p, s = outer(*footprint), SIGMA_H**2 * np.eye(2)[None]
    c = np.broadcast_to(s, sigma_p.shape) @ np.linalg.inv(sigma_p + s) @ sigma_p
    sigma_r = float(np.float32(sigma_r))
    j = jacobian.astype(float).transpose(2, 0, 1)
    covariance = sigma_r**2 * np.eye(2) + j @ c @ j.transpose(0, 2, 1)
    delta = drawn(rng, covariance)
    overlap = Overlap(Gaussian([mi.Vector2f(v) for v in footprint]), Gaussian(variance=SIGMA_H**2))
    normals = overlap.normals(mi.Matrix2f(jacobian), Gaussian(variance=sigma_r**2))
    # Measured: 6e-4 at sigma_r = 1e-5 and a slope of 1 per step, below 1e-4 from 1e-4 on.
    assert relative_error(normals.eval(mi.Vector2f(delta)), density(delta, covariance)) < 1e-3


def appendix(d, s, jacobian, sigma_p, sigma_r):
    """The integral of Yan16, Eq. 11, by the paper's appendix, in the precision of ``d`` (2, N).

    ``d`` leads from the element's seed to the footprint's centre; ``s`` is the normal minus that of
    the seed.
    """
    one = d.dtype.type(1)
    sigma_h, sigma_r, eye = one * np.float32(SIGMA_H), one * sigma_r, np.eye(2, dtype=d.dtype)

    def inverse(m):
        adjugate = np.stack([m[:, 1, 1], -m[:, 0, 1], -m[:, 1, 0], m[:, 0, 0]], -1)
        return adjugate.reshape(m.shape) / determinant(m)[:, None, None]

    def determinant(m):
        return m[:, 0, 0] * m[:, 1, 1] - m[:, 0, 1] * m[:, 1, 0]

    def form(m, v):
        return np.einsum("in,nij,jn->n", v, m, v)

    def times(m, v):
        return np.einsum("nij,jn->in", m, v)

    a = eye / sigma_h**2 + jacobian.transpose(0, 2, 1) @ jacobian / sigma_r**2  # Eq. 14
    u = times(inverse(a) @ jacobian.transpose(0, 2, 1), s) / sigma_r**2  # Eq. 18
    slice_form = (s * s).sum(0) / sigma_r**2 - form(a, u)
    precision_p = inverse(sigma_p)
    covariance = inverse(a + precision_p)  # Eq. 19
    mean = times(covariance, times(a, u) + times(precision_p, d))
    exponent = slice_form + form(a, mean - u) + form(precision_p, mean - d)  # Eq. 20
    scale = one * (2 * np.pi) ** 2 * sigma_h**2 * sigma_r**2 * np.sqrt(determinant(sigma_p))
    return np.exp(-one / 2 * exponent) * np.sqrt(determinant(covariance)) / scale  # Eq. 21


@pytest.mark.parametrize("sigma_r, slope", [(1e-2, 1.0), (1e-3, 1.0), (1e-4, 0.1), (1e-5, 0.01)])
def test_the_papers_appendix_is_less_accurate_in_float32(variant, sigma_r, slope):
    """Its 4×4 matrices have entries like 1/σ_r², and in float32 their differences lose all
    digits."""
    rng = RNG(3)
    footprint = vectors(rng, 10 ** rng.uniform(-1, 1, COUNT), 10 ** rng.uniform(0, 1, COUNT))
    jacobian = (slope * rng.uniform(-1, 1, (COUNT, 2, 2))).astype(np.float32)
    sigma_p, s, j = outer(*footprint), SIGMA_H**2 * np.eye(2)[None], jacobian.astype(float)
    sigma_r = float(np.float32(sigma_r))
    d = drawn(rng, sigma_p + s)
    gain = np.broadcast_to(s, sigma_p.shape) @ np.linalg.inv(sigma_p + s)
    mean = np.einsum("nij,jn->in", j @ gain, d.astype(float))
    covariance = sigma_r**2 * np.eye(2) + j @ gain @ sigma_p @ j.transpose(0, 2, 1)
    normal = (mean + drawn(rng, covariance)).astype(np.float32)
    exact = density(d, sigma_p + s) * density(normal - mean, covariance)

    # In float64 the appendix is right; in float32 its errors, measured, are 0.2 to infinite.
    double = appendix(d.astype(float), normal.astype(float), j, sigma_p, sigma_r)
    assert np.median(np.abs(double / exact - 1)) < 1e-4
    with np.errstate(all="ignore"):
        single = appendix(d, normal, jacobian, sigma_p.astype(np.float32), sigma_r)
        lost = np.abs(single.astype(float) / exact - 1)
    assert not np.nanmax(lost) < 0.1

    overlap = Overlap(Gaussian([mi.Vector2f(v) for v in footprint]), Gaussian(variance=SIGMA_H**2))
    matrix = mi.Matrix2f(np.ascontiguousarray(jacobian.transpose(1, 2, 0)))
    offset = mi.Vector2f(d)
    delta = mi.Vector2f(normal) - matrix @ overlap.mean(offset)
    normals = overlap.normals(matrix, Gaussian(variance=sigma_r**2))
    # Measured: 9e-6, 3e-5, 2e-5 and 3e-5.
    assert relative_error(overlap.mass(offset) * normals.eval(delta), exact) < 1e-3


def test_general_roughness(variant):
    """R may be any covariance, like that of merged lobes."""
    rng = RNG(3)
    roughness = vectors(rng, 10 ** rng.uniform(-3, -1, COUNT), 50.0)
    footprint, lobe = vectors(rng, 2.0), vectors(rng, 1.0, 5.0)
    jacobian = (0.1 * rng.uniform(-1, 1, (2, 2, COUNT))).astype(np.float32)
    s, sigma_p = outer(*lobe), outer(*footprint)
    c = s @ np.linalg.inv(sigma_p + s) @ sigma_p
    j = jacobian.astype(float).transpose(2, 0, 1)
    covariance = outer(*roughness) + j @ c @ j.transpose(0, 2, 1)
    delta = drawn(rng, covariance)
    overlap = Overlap(*(Gaussian([mi.Vector2f(v) for v in vs]) for vs in (footprint, lobe)))
    normals = overlap.normals(mi.Matrix2f(jacobian), Gaussian([mi.Vector2f(v) for v in roughness]))
    assert relative_error(normals.eval(mi.Vector2f(delta)), density(delta, covariance)) < 1e-4


def test_samples_have_the_covariance(variant):
    gaussian = Gaussian((mi.Vector2f(1, 2), mi.Vector2f(-0.5, 0.1)), 0.01)
    z = RNG(4).standard_normal((2, 1_000_000)).astype(np.float32)
    expected = np.array([[1.26, 1.95], [1.95, 4.02]])
    assert np.allclose(np.cov(np.array(gaussian.sample(mi.Vector2f(z)))), expected, atol=0.03)


@pytest.mark.parametrize("aspect", [1, 10, 1000])
def test_lattice_mass(variant, aspect):
    """The closed form agrees with the sum itself."""
    rng = RNG(5)
    count = 20
    for scale in (0.0, 0.05, 0.3, 1.0):
        footprint = vectors(rng, scale, aspect, count)
        covariance = outer(*footprint) + SIGMA_H**2 * np.eye(2)
        x = rng.uniform(-1, 1, (2, count)).astype(np.float32)
        k = np.stack(np.meshgrid(*2 * [np.arange(-12, 13)]), -1).reshape(-1, 2)
        d = x.T[:, None] - k
        form = np.einsum("nki,nij,nkj->nk", d, np.linalg.inv(covariance), d)
        exact = np.exp(-0.5 * form).sum(1) / (2 * np.pi * np.sqrt(np.linalg.det(covariance)))
        xx, xy, yy = (
            mi.Float(covariance[:, i, j].astype(np.float32)) for i, j in ((0, 0), (0, 1), (1, 1))
        )
        # Measured: 2.6e-6, what the next frequency adds where the footprint is a point.
        assert relative_error(lattice_mass(mi.Vector2f(x), xx, xy, yy), exact) < 4e-6


# Measured: 0.0096, 0.0028 and 8e-5, which is the error of the points. A Gaussian of the covariance
# Σ + Λ is off by 0.30, 0.074 and 8e-5.
@pytest.mark.parametrize(("ratio", "tolerance"), [(0.2, 0.012), (0.5, 0.0035), (8.0, 1e-4)])
@pytest.mark.parametrize("aspect", [1, 20])
def test_average_over_an_ellipse(variant, ratio, tolerance, aspect):
    """A Gaussian ``ratio`` times as wide as the radius of a disk, both squeezed alike and sheared:
    relative L1 error against the mean over points of the ellipse, and mass."""
    shape = np.array([[1.0, 0.0], [0.4, 1 / aspect]])
    disk = 0.01 * shape  # columns: the vectors of the ellipse, whose radius is twice as large
    columns = [mi.Vector2f(*(float(x) for x in v)) for v in disk.T]
    gaussian = Gaussian(tuple(2 * ratio * v for v in columns))
    count, reach = 121, 2 + 8 * ratio
    x = (np.arange(count) + 0.5) / count * 2 * reach - reach
    place = np.stack(np.meshgrid(x, x), -1).reshape(-1, 2)  # where disk is the unit matrix
    d = (place @ disk.T).astype(np.float32)
    found = np.array(AveragedGaussian(gaussian, columns).eval(mi.Vector2f(d.T)), np.float64)
    area = np.linalg.det(disk) * (2 * reach / count) ** 2
    expected = np.zeros(len(d))
    for point in 2 * suite.golden_spiral(2000).T:  # the radius is twice the deviation
        expected += np.exp(-0.5 * ((place - point) ** 2).sum(1) / (2 * ratio) ** 2)
    expected /= expected.sum() * area
    assert abs(found.sum() * area - 1) < 2e-3
    assert np.abs(found - expected).sum() * area < tolerance


def test_points_of_an_ellipse(variant):
    """They have its covariance, and none is farther than twice the standard deviation."""
    u = RNG(3).random((2, 100_000), dtype=np.float32)
    disk = np.array([[0.2, 0.1], [0.0, 0.05]])
    ellipse = [mi.Vector2f(*(float(x) for x in v)) for v in disk.T]
    found = np.array(point_of_ellipse(ellipse, mi.Point2f(u)), np.float64)
    assert np.allclose(np.cov(found), disk @ disk.T, atol=3e-4)
    assert np.linalg.norm(np.linalg.solve(disk, found), axis=0).max() < 2.0001
