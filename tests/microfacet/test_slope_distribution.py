"""Lobes of normals: densities, visible areas and visible normals, for any mean slope."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
import scipy.integrate
import scipy.special
import scipy.stats

from glintbsdf.check.suite import random_numbers
from glintbsdf.microfacet import slope_distribution as slope_lobe
from glintbsdf.microfacet.slope_distribution import DISTRIBUTIONS, SlopeLobe

# Mean slope, and entries uu, vv, uv of the roughness matrix.
LOBES = {
    "centred": ((0, 0), (0.04, 0.04, 0)),
    "narrow": ((0.2, -0.1), (1e-4, 4e-4, 1e-4)),
    "rotated": ((0.3, -0.5), (0.09, 0.04, -0.05)),
    "rough": ((-0.4, 0.2), (1.0, 0.25, 0.3)),
}
# From above, oblique, grazing, and from behind the mean facet of a lobe that leans away.
VIEWS = [(0, 0, 1), (0.6, -0.3, 1), (-1, 0.2, 0.2), (-1, 1.2, 0.05), (1, 0, 0.01)]


def make(name: str, distribution: str) -> SlopeLobe:
    mean, (uu, vv, uv) = LOBES[name]
    values = (mi.Float(x) for x in (uu, vv, uv, uu * vv - uv * uv))
    return SlopeLobe(mi.Vector2f(mean), *values, distribution)


def slope_density(name: str, distribution: str, x: np.ndarray, y: np.ndarray) -> np.ndarray:
    """P₂₂ by the formulas of the module's documentation, in float64."""
    mean, (uu, vv, uv) = LOBES[name]
    matrix = np.array([[uu, uv], [uv, vv]])
    d = np.stack([x - mean[0], y - mean[1]], axis=-1)
    distance = np.einsum("...i,ij,...j", d, np.linalg.inv(matrix), d)
    shape = np.exp(-distance) if distribution == "beckmann" else 1 / (1 + distance) ** 2
    return shape / (np.pi * np.sqrt(np.linalg.det(matrix)))


def area_by_quadrature(name: str, distribution: str, w: np.ndarray) -> float:
    """∫ max(0, w_z + w_xy·x) P₂₂(x) dx; the marginal of P₂₂ along w_xy has a closed form."""
    mean, (uu, vv, uv) = LOBES[name]
    a = w[2] + w[:2] @ np.array(mean)
    z = np.sqrt(uu * w[0] ** 2 + vv * w[1] ** 2 + 2 * uv * w[0] * w[1])
    if z == 0:
        return max(a, 0)
    if distribution == "beckmann":
        marginal = scipy.stats.norm(a, z / np.sqrt(2)).pdf
    else:

        def marginal(t: float) -> float:
            return 0.5 / (z * (1 + ((t - a) / z) ** 2) ** 1.5)

    edges = [0, *(max(0, a + k * z) for k in (-10, -1, 0, 1, 10)), np.inf]
    return sum(
        scipy.integrate.quad(lambda t: t * marginal(t), lower, upper)[0]
        for lower, upper in zip(edges, edges[1:], strict=False)
        if lower < upper
    )


def test_mills_ratio(variant):
    x = np.concatenate([np.linspace(0, 20, 4001), np.geomspace(20, 1e6, 500)]).astype(np.float32)
    expected = np.sqrt(np.pi / 2) * scipy.special.erfcx(x.astype(np.float64) / np.sqrt(2))
    assert np.abs(np.array(slope_lobe.mills_ratio(mi.Float(x))) / expected - 1).max() < 5e-7


@pytest.mark.parametrize("distribution", DISTRIBUTIONS)
@pytest.mark.parametrize("name", LOBES)
def test_density_is_that_of_the_slopes(variant, name, distribution):
    s = np.float32(np.random.default_rng(1).uniform(-0.7, 0.7, (2, 1000)))
    z = np.sqrt(1 - (s.astype(np.float64) ** 2).sum(axis=0))
    expected = slope_density(name, distribution, *(s / z)) / z**4
    actual = np.array(make(name, distribution).eval(mi.Vector2f(s)))
    # float32 rounding of the exponent, which reaches thousands for the narrow lobe.
    assert np.allclose(actual, expected, rtol=2e-3, atol=1e-6 * expected.max())


def test_no_density_outside_the_disk(variant):
    lobe = make("rough", "ggx")
    assert dr.all(lobe.eval(mi.Vector2f([1.0, 0.8, 5.0], [0.0, 0.8, 0.0])) == 0)


@pytest.mark.parametrize("distribution", DISTRIBUTIONS)
@pytest.mark.parametrize("name", LOBES)
def test_visible_area(variant, name, distribution):
    lobe = make(name, distribution)
    for view in VIEWS:
        w = np.array(view) / np.linalg.norm(view)
        expected = area_by_quadrature(name, distribution, w)
        assert np.isclose(lobe.visible_area(mi.Vector3f(w))[0], expected, rtol=1e-4, atol=1e-10)


def test_centred_visible_area_is_that_of_mitsuba(variant):
    theta = np.linspace(0, 1.57, 20)
    w = mi.Vector3f(np.float32(np.sin(theta)), 0, np.float32(np.cos(theta)))
    for distribution in DISTRIBUTIONS:
        stock = mi.MicrofacetDistribution(
            getattr(mi.MicrofacetType, {"beckmann": "Beckmann", "ggx": "GGX"}[distribution]), 0.2
        )
        g1 = w.z / make("centred", distribution).visible_area(w)
        # Mitsuba's masking of Beckmann is a rational fit, to about 0.4 %.
        assert dr.allclose(g1, stock.smith_g1(w, mi.Vector3f(0, 0, 1)), atol=4e-3)


@pytest.mark.parametrize("a", [-6, -3, -1, -0.01, 0, 0.01, 0.5, 2, 5, 40, 1e6])
def test_weighed_gaussian_is_sampled_exactly(variant, a):
    count = 100_000
    u1, u2 = random_numbers(count, 2, seed=5)
    z = np.array(slope_lobe.sample_positive_part(dr.full(mi.Float, a, count), u1, u2), np.float64)
    assert np.isfinite(z).all() and (z >= -a).all()
    grid = np.linspace(max(-a, -9), max(-a, -9) + 18, 200_001)
    density = np.maximum(0, 1 + grid / a if a > 100 else a + grid) * scipy.stats.norm.pdf(grid)
    cumulative = scipy.integrate.cumulative_trapezoid(density, grid, initial=0)
    p_value = scipy.stats.kstest(
        z, lambda q: np.interp(q, grid, cumulative / cumulative[-1])
    ).pvalue
    assert p_value > 1e-3  # 11 fixed seeds; measured: 0.05 and more


@pytest.mark.parametrize("distribution", DISTRIBUTIONS)
@pytest.mark.parametrize("name", LOBES)
def test_visible_normals_are_distributed_as_their_density_says(variant, name, distribution):
    """Moments of bounded functions of the slopes, along two axes and together, agree between
    samples and a quadrature of the density."""
    lobe, count = make(name, distribution), 100_000
    u = random_numbers(count, 3, seed=6)
    mean, (uu, vv, _) = LOBES[name]
    n = 800
    tangent = np.tan(np.pi / 2 * (np.arange(n) + 0.5) / n * 2 - np.pi / 2)  # all slopes
    weight = np.pi / n * (1 + tangent**2)
    x, y = np.meshgrid(mean[0] + np.sqrt(uu) * tangent, mean[1] + np.sqrt(vv) * tangent)
    cell = np.sqrt(uu * vv) * weight * weight[:, None]

    def features(x: np.ndarray, y: np.ndarray) -> np.ndarray:
        a, b = np.arctan((x - mean[0]) / np.sqrt(uu)), np.arctan((y - mean[1]) / np.sqrt(vv))
        return np.stack([np.cos(k * a + j * b + k) for k in range(3) for j in range(-2, 3)])

    for view in VIEWS:
        w = np.array(view) / np.linalg.norm(view)
        if lobe.visible_area(mi.Vector3f(w))[0] == 0:
            continue  # turned away: samples have a pdf of 0
        m = lobe.sample_visible(dr.repeat(mi.Vector3f(w), count), u[0], mi.Point2f(u[1], u[2]))
        m = np.array(m, np.float64)
        assert np.isfinite(m).all() and np.allclose((m**2).sum(axis=0), 1, atol=1e-5)
        assert (w @ m > -1e-4).all() and (m[2] >= 0).all()
        z = np.maximum(m[2], 1e-12)  # normals may be horizontal
        sampled = features(m[0] / z, m[1] / z)
        # ∫ f(m) max(0, w·m) D(m)/P dω, with m_z dω D = P₂₂ dx.
        visible = (
            np.maximum(0, w[2] + w[0] * x + w[1] * y)
            * slope_density(name, distribution, x, y)
            * cell
            / area_by_quadrature(name, distribution, w)
        )
        quadrature_error = abs(visible.sum() - 1)  # of a kink at w·m = 0 and of GGX's tail
        assert quadrature_error < 0.03
        expected = (features(x, y) * visible).sum(axis=(1, 2)) / visible.sum()
        error = sampled.std(axis=1) / np.sqrt(count)
        # 15 features of 40 settings: 4.5 sigma; for the quadrature, its own error of the total 1.
        assert (
            np.abs(sampled.mean(axis=1) - expected) < 4.5 * error + quadrature_error + 1e-6
        ).all(), view


@pytest.mark.parametrize("distribution", DISTRIBUTIONS)
def test_visible_pdf(variant, distribution):
    lobe = make("rough", distribution)
    m = mi.warp.square_to_uniform_hemisphere(mi.Point2f(*random_numbers(400_000, 2, seed=7)))
    for view in VIEWS:
        w = dr.normalize(mi.Vector3f(view))
        pdf = lobe.visible_pdf(w, m, lobe.eval(m.xy))
        integral = 2 * np.pi * np.array(pdf)
        assert abs(integral.mean() - 1) < 4 * integral.std() / np.sqrt(integral.size)


def test_derivative_of_a_sample(variant):
    """The derivative along the inverse function, also if the mean normal faces away."""
    u = mi.Float(0.3)
    for a in (-2.0, -0.5):
        x = mi.Float(a)
        dr.enable_grad(x)
        z = slope_lobe.sample_positive_part(x, mi.Float(0.2), u)
        dr.forward(x)
        step = 1e-2
        plus, minus = (
            slope_lobe.sample_positive_part(mi.Float(a + s), mi.Float(0.2), u)[0]
            for s in (step, -step)
        )
        assert np.isclose(dr.grad(z)[0], (plus - minus) / (2 * step), rtol=1e-2)


@pytest.mark.parametrize("distribution", DISTRIBUTIONS)
@pytest.mark.parametrize("turned", [False, True])
def test_thin_lobes_keep_their_digits(variant, distribution, turned):
    # Two planes meet under the footprint: all slopes are on a line, with a roughness of 1e-4.
    alpha, line = 1e-4, np.array([0.9, 0.1][:: -1 if turned else 1])
    uu, vv, uv = (*(alpha**2 + line**2), line[0] * line[1])
    determinant = alpha**2 * (alpha**2 + (line**2).sum())
    lobe = SlopeLobe(
        mi.Vector2f(0), *(mi.Float(x) for x in (uu, vv, uv, determinant)), distribution
    )
    along, across = np.meshgrid(np.linspace(-1, 1, 9), np.linspace(-1, 1, 9))
    normal = np.array([-line[1], line[0]]) / np.linalg.norm(line)
    x = along[..., None] * line + across[..., None] * alpha * normal
    s = np.float32(x / np.sqrt(1 + (x**2).sum(-1, keepdims=True)))
    value = np.array(lobe.eval(mi.Vector2f(*(mi.Float(c.ravel()) for c in np.moveaxis(s, -1, 0)))))
    distance = along**2 + across**2  # except for terms of alpha²
    shape = np.exp(-distance) if distribution == "beckmann" else 1 / (1 + distance) ** 2
    expected = shape * (1 + (x**2).sum(-1)) ** 2 / (np.pi * np.sqrt(determinant))
    # Normals and the direction of the line are rounded to 6e-8: 6e-4 of the width, twice.
    assert np.allclose(value, expected.ravel(), rtol=5e-3)
    u = random_numbers(1000, 3, seed=2)
    for w in (mi.Vector3f(0, 0, 1), mi.Vector3f(0.6, 0, 0.8), dr.normalize(mi.Vector3f(1, -9, 1))):
        m = np.array(lobe.sample_visible(w, u[0], mi.Point2f(u[1], u[2])))
        assert np.isfinite(m).all()
        assert np.median(np.abs(normal @ (m[:2] / m[2]))) < alpha  # GGX has wide tails
