"""The facets of a displaced surface, from the slopes of its height map."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest

from glintbsdf.microfacet.slope_frame import SlopeFrame

WIDTH, HEIGHT = 40, 25
RNG = np.random.default_rng(5)

# ∂p/∂u and ∂p/∂v in world units, with components along the shading normal, as for interpolated
# normals; and to_uv.
SURFACES = {
    "square": ([2, 0, 0], [0, 2, 0], [[1, 0], [0, 1]]),
    "left-handed": ([2, 0, 0], [0, -2, 0], [[1, 0], [0, 1]]),
    "mirrored": ([-2, 0, 0], [0, 2, 0], [[1, 0], [0, 1]]),
    "stretched": ([3, 0, 0], [0, 0.5, 0], [[1, 0], [0, 1]]),
    "sheared": ([1, 0.4, 0.2], [0.7, -1.5, -0.1], [[1, 0], [0, 1]]),
    "turned": ([2, 0, 0], [0, 2, 0], [[0.6, -0.8], [0.8, 0.6]]),
    "all of it": ([1, 0.4, 0.2], [0.7, 1.5, -0.1], [[2, 0.3], [-0.5, -1]]),
    "tiny": ([1e-18, 0, 0], [0, -2e-18, 0], [[1, 0], [0, 1]]),
}


def interaction(dp_du, dp_dv) -> mi.SurfaceInteraction3f:
    si = dr.zeros(mi.SurfaceInteraction3f)
    si.uv = mi.Point2f(0.3, 0.4)
    si.n = mi.Normal3f(0, 0, 1)
    si.dp_du, si.dp_dv = mi.Vector3f(dp_du), mi.Vector3f(dp_dv)
    s = dr.normalize(mi.Vector3f(dp_du[0], dp_du[1], 0))
    si.sh_frame = mi.Frame3f(s, dr.cross(mi.Vector3f(0, 0, 1), s), mi.Vector3f(0, 0, 1))
    return si


def to_uv(linear) -> mi.ScalarAffineTransform3f:
    matrix = np.eye(3)
    matrix[:2, :2] = linear
    return mi.ScalarAffineTransform3f(mi.ScalarMatrix3f(matrix))


def matrix_of(frame: SlopeFrame) -> np.ndarray:
    return np.array([[float(frame.matrix[i, j][0]) for j in range(2)] for i in range(2)])


def displaced_normal(dp_du, dp_dv, linear, slope) -> np.ndarray:
    """The facet's normal in world space by Mitsuba's formula, in double precision."""
    dp_du, dp_dv, n = np.array(dp_du, float), np.array(dp_dv, float), np.array([0, 0, 1.0])
    texels = np.diag([WIDTH, HEIGHT]) @ np.array(linear, float)
    flat_u, flat_v = dp_du - n * (n @ dp_du), dp_dv - n * (n @ dp_dv)
    texel_area = np.linalg.norm(np.cross(flat_u, flat_v)) / abs(np.linalg.det(texels))
    d_u, d_v = np.sqrt(texel_area) * (texels.T @ slope)
    normal = np.cross(flat_u + n * d_u, flat_v + n * d_v)
    return normal / np.linalg.norm(normal) * np.sign(normal[2])


@pytest.mark.parametrize("name", SURFACES)
def test_normals_are_those_of_the_displaced_surface(variant, name):
    dp_du, dp_dv, linear = SURFACES[name]
    si = interaction(dp_du, dp_dv)
    frame = SlopeFrame.from_interaction(si, to_uv(linear), WIDTH, HEIGHT)
    assert abs(abs(np.linalg.det(matrix_of(frame))) - 1) < 1e-5
    for slope in RNG.normal(size=(4, 2)):
        of_map = np.append(-slope, 1) / np.sqrt(1 + slope @ slope)
        m = frame.normal_from_map(mi.Vector3f(*map(float, of_map)))
        world = np.array(si.to_world(m)).T[0]
        assert np.allclose(world, displaced_normal(dp_du, dp_dv, linear, slope), atol=2e-6)
        back = frame.normal_to_map(m)
        assert np.allclose(np.array(back).T[0], of_map, atol=2e-6)


def test_conformal_uvs_need_no_jacobian(variant):
    for name in ("square", "left-handed", "mirrored", "turned"):
        dp_du, dp_dv, linear = SURFACES[name]
        frame = SlopeFrame.from_interaction(interaction(dp_du, dp_dv), to_uv(linear), 32, 32)
        matrix = matrix_of(frame)
        assert np.allclose(matrix @ matrix.T, np.eye(2), atol=1e-6)
        assert np.sign(np.linalg.det(matrix)) == (1 if name in ("square", "turned") else -1)
    identity = SlopeFrame.from_interaction(
        interaction(*SURFACES["square"][:2]), to_uv(np.eye(2)), 32, 32
    )
    assert np.allclose(matrix_of(identity), np.eye(2))


def test_degenerate_uvs_leave_slopes_as_they_are(variant):
    for dp_du, dp_dv in (([0, 0, 0], [0, 0, 0]), ([1, 0, 0], [2, 0, 0]), ([1, 0, 0], [0, 0, 0])):
        si = interaction([1, 0, 0], [0, 1, 0])
        si.dp_du, si.dp_dv = mi.Vector3f(dp_du), mi.Vector3f(dp_dv)
        frame = SlopeFrame.from_interaction(si, to_uv(np.eye(2)), WIDTH, HEIGHT)
        assert np.allclose(matrix_of(frame), np.eye(2))


def test_mirrored_copies_have_mirrored_slopes(variant):
    si = interaction([2, 0, 0], [0, 2, 0])
    for u, sign in ((0.3, 1), (1.3, -1), (2.9, 1), (-0.1, -1), (-1.1, 1)):
        si.uv = mi.Point2f(u, 0.5)
        frame = SlopeFrame.from_interaction(si, to_uv(np.eye(2)), 8, 8, mirrored=True)
        assert np.allclose(matrix_of(frame), np.diag([sign, 1]))


def skewed() -> SlopeFrame:
    dp_du, dp_dv, linear = SURFACES["all of it"]
    return SlopeFrame.from_interaction(interaction(dp_du, dp_dv), to_uv(linear), WIDTH, HEIGHT)


def test_densities_keep_their_integral(variant):
    """The integral of a density over the disk in the map's frame, and its mean facet, are kept."""
    frame, count = skewed(), 1500
    x, y = ((np.arange(count) + 0.5) / count * 1.9 - 0.95 for _ in range(2))
    x, y = (g.ravel() for g in np.meshgrid(x, y))
    inside = x**2 + y**2 < 0.95**2
    m = mi.Vector3f(
        *(np.float32(v[inside]) for v in (x, y, np.sqrt(np.maximum(1 - x**2 - y**2, 0))))
    )
    of_map = frame.normal_to_map(m)
    mean, sigma = np.array([0.1, -0.05]), 0.06
    density = np.exp(
        -((np.array(of_map.x) - mean[0]) ** 2 + (np.array(of_map.y) - mean[1]) ** 2)
        / (2 * sigma**2)
    ) / (2 * np.pi * sigma**2)
    density = density * np.array(SlopeFrame.density_ratio(m, of_map))
    area = (1.9 / count) ** 2
    assert density.sum() * area == pytest.approx(1, abs=2e-3)


def test_projected_area_is_kept(variant):
    frame = skewed()
    for _ in range(5):
        m = np.append(RNG.uniform(-0.5, 0.5, 2), 1)
        w = np.append(RNG.uniform(-0.7, 0.7, 2), 0)
        w[2] = np.sqrt(1 - w @ w) if w @ w < 1 else 0.1
        m, w = (mi.Vector3f(*map(float, v / np.linalg.norm(v))) for v in (m, w))
        of_map, seen = frame.normal_to_map(m), frame.direction_to_map(w)
        ours = dr.dot(w, m) / (m.z * w.z)
        theirs = dr.dot(seen, of_map) / (of_map.z * seen.z)
        assert dr.allclose(ours, theirs, rtol=1e-4)
