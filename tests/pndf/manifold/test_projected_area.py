"""Projected areas: one triangle against the paper's closed form in float64, and whole
footprints."""

from __future__ import annotations

from dataclasses import replace
from math import cos, pi, sin

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest

from glintbsdf import Footprint, NormalMap, maps
from glintbsdf.check import suite
from glintbsdf.check.derivatives import check_value_derivatives
from glintbsdf.check.suite import EXTREME_VIEWS, View
from glintbsdf.footprint.kernels import KERNELS
from glintbsdf.footprint.query import Query
from glintbsdf.pndf.manifold.mesh import TexelMesh
from glintbsdf.pndf.manifold.projected_area import (
    MANY_QUADS,
    ORDER,
    Corners,
    GgxFit,
    ProjectedArea,
    ProjectedAreaMasking,
    clipped_mean,
    degenerate_triangles,
    mean_facing,
    mean_over_points,
)

# --------------------------------------------------------------------------------------------------
#  The reference: Eq. 11, 12 and Algorithm 1 as printed, in float64, with any number of arcs
# --------------------------------------------------------------------------------------------------


def arc(p: float) -> float:
    p = np.clip(p, -1, 1)
    return np.arcsin(p) + p * np.sqrt(1 - p * p)


def line_integral(a: np.ndarray, b: np.ndarray, w_x: float, w_z: float) -> float:
    """Eq. 12 for a straight part of the boundary."""
    length = np.hypot(*(b - a))
    if length == 0:
        return 0.0
    d = (b - a) / length
    r2 = max(1 - (d[1] * a[0] - d[0] * a[1]) ** 2, 0)
    r = np.sqrt(r2)
    value = w_z / 2 * (b[1] - a[1]) * (b[0] + a[0])
    return value - (w_x / 2 * r2 * d[1] * (arc(d @ b / r) - arc(d @ a / r)) if r > 0 else 0)


def closed_form(triangle: np.ndarray, w: np.ndarray) -> float:
    """Mean of max(m̃·ω, 0)/m_z over a triangle (3, 2), for a direction (3,)."""
    w_x, w_z = np.hypot(w[0], w[1]), w[2]
    turn = np.array([[w[0], w[1]], [-w[1], w[0]]]) / w_x
    corners = triangle @ turn.T
    e1, e2 = corners[1] - corners[0], corners[2] - corners[0]
    det = e1[0] * e2[1] - e1[1] * e2[0]
    if det < 0:
        corners, det = corners[[0, 2, 1]], -det

    def q(m):
        return w_x * m[0] + w_z * np.sqrt(max(1 - m @ m, 0))

    pieces = []
    for i in range(3):
        a, d = corners[i], corners[(i + 1) % 3] - corners[i]
        quadratic = (
            w_z**2 * d[1] ** 2 + d[0] ** 2,
            2 * (w_z**2 * a[1] * d[1] + a[0] * d[0]),
            w_z**2 * (a[1] ** 2 - 1) + a[0] ** 2,
        )
        roots = np.roots(quadratic)
        cuts = np.sort([0, 1, *(r.real for r in roots if r.imag == 0 and 0 < r.real < 1)])
        seen = [
            (s, t) for s, t in zip(cuts[:-1], cuts[1:], strict=True) if q(a + d * (s + t) / 2) > 0
        ]
        if seen:
            pieces.append((a + d * seen[0][0], a + d * seen[-1][1]))
    total = 0.0
    for (start, end), (following, _) in zip(pieces, pieces[1:] + pieces[:1], strict=True):
        total += line_integral(start, end, w_x, w_z)
        total += 0.5 * (arc(end[1]) - arc(following[1])) if (following != end).any() else 0
    return 2 * total / det


def random_disk(rng, count: int, radius=1.0) -> np.ndarray:
    r, phi = radius * np.sqrt(rng.random(count)), 2 * np.pi * rng.random(count)
    return np.stack([r * np.cos(phi), r * np.sin(phi)], -1)


def random_directions(rng, count: int) -> np.ndarray:
    """Directions, half of them uniform on the hemisphere, half grazing, down to ω_z = 1e-6."""
    z = np.where(rng.random(count) < 0.5, rng.random(count), 10 ** rng.uniform(-6, 0, count))
    phi, r = 2 * np.pi * rng.random(count), np.sqrt(1 - z * z)
    return np.stack([r * np.cos(phi), r * np.sin(phi), z], -1)


def random_triangles(kind: str, rng, count: int) -> np.ndarray:
    """Triangles (count, 3, 2): anywhere in the disk, of a given size, or of a given thinness."""
    name, _, size = kind.partition(" ")
    if name == "anywhere":
        return np.stack([random_disk(rng, count, 0.999) for _ in range(3)], 1)
    size = float(size)
    if name == "size":
        centre = random_disk(rng, count, 0.99 - size)
        return centre[:, None] + size * np.stack([random_disk(rng, count) for _ in range(3)], 1)
    a, b = (random_disk(rng, count, 0.98) for _ in range(2))
    t = rng.random((count, 1))
    return np.stack([a, b, a * t + b * (1 - t) + size * random_disk(rng, count)], 1)


def as_corners(triangles: np.ndarray, w: np.ndarray) -> tuple[Corners, np.ndarray]:
    """Corners in float32, and the same triangles in float64."""
    a, b, c = (mi.Vector2f(np.ascontiguousarray(triangles[:, i].T, np.float32)) for i in range(3))
    corners = Corners(a, b - a, c - a, mi.Vector3f(np.ascontiguousarray(w.T, np.float32)))
    first, e1, e2 = (np.array(v, np.float64).T for v in (a, b - a, c - a))
    return corners, np.stack([first, first + e1, first + e2], 1)


KINDS = [
    "anywhere",
    "size 0.25",
    "size 0.05",
    "size 0.01",
    "size 0.001",
    "thin 1e-2",
    "thin 1e-4",
    "thin 1e-6",
]


@pytest.mark.parametrize("kind", KINDS)
def test_triangles(variant, kind):
    # Relative error ≤ 1e-3 of every triangle, however little of it is visible, down to P = 1e-6,
    # where float32 has lost the digits of the visible corner. Measured: 6.4e-4.
    rng = np.random.default_rng(KINDS.index(kind))
    count = 1000
    w = random_directions(rng, count).astype(np.float32).astype(np.float64)
    w /= np.linalg.norm(w, axis=1, keepdims=True)
    corners, triangles = as_corners(random_triangles(kind, rng, count), w)
    expected = np.array([closed_form(*pair) for pair in zip(triangles, w, strict=True)])
    w_z = mi.Float(np.ascontiguousarray(w[:, 2], np.float32))
    seen = expected > 1e-6
    assert seen.sum() > count / 3
    partly = seen & (np.array(corners.lowest) < 0)
    assert kind.startswith("size 0.0") or partly.sum() > count / 10
    whole = mean_facing(
        corners.q,
        corners.z,
        (corners.chords[0], corners.chords[2], corners.chords[1]),
        w_z,
        ORDER,
    )
    clipped = np.array(clipped_mean(corners, w_z, ORDER))
    for value, where in ((clipped, seen), (np.array(whole), seen & ~partly)):
        error = np.abs(value[where] / expected[where] - 1)
        assert (error <= 1e-3).all(), error.max()
    assert not (expected > 0)[~np.array(corners.may_be_seen(w_z))].any()


@pytest.mark.parametrize(
    "triangle",
    [
        [(-0.2, 0.9), (-0.2, -0.9), (-0.9, 0.0)],  # an edge crosses, no visible corner
        [(-0.2, 0.9), (-0.2, -0.9), (-0.31, 0.3)],  # two edges cross
        [(-0.2, 0.9), (-0.2, -0.9), (-0.31, 0.0)],  # three
        [(0.3, 0.0), (-0.6, 0.7), (-0.6, -0.7)],  # a corner, and the middle of the opposite edge
        [(0.3, 0.9), (0.3, -0.9), (-0.9, 0.0)],  # two corners
        [(-0.31, 0.02), (-0.29, 0.01), (-0.3, -0.03)],  # around the ellipse's tip
        [(0.9, 0.4), (0.5, 0.8), (0.2, -0.1)],  # all of it
    ],
)
def test_cases_of_clipping(variant, triangle):
    w = np.array([np.sqrt(1 - 0.3**2), 0, 0.3])
    expected = closed_form(np.array(triangle, np.float64), w)
    assert expected > 0
    for turn in range(3):
        corners, _ = as_corners(np.roll(triangle, turn, axis=0)[None], w[None])
        assert clipped_mean(corners, mi.Float(0.3), 6)[0] == pytest.approx(expected, rel=1e-5)


def test_horizontal_and_hidden(variant):
    # ω_z = 0: the ellipse is a line. A triangle behind it has no projected area.
    w = np.array([[1.0, 0, 0]])
    triangle = np.array([[(0.2, 0.1), (-0.3, 0.3), (-0.1, -0.4)]])
    corners, _ = as_corners(triangle, w)
    almost = np.array([np.sqrt(1 - 1e-12), 0, 1e-6])
    expected = closed_form(triangle[0], almost)
    assert clipped_mean(corners, mi.Float(0), 3)[0] == pytest.approx(expected, rel=1e-3)
    corners, _ = as_corners(triangle - [0.5, 0], w)
    assert clipped_mean(corners, mi.Float(0), 3)[0] == 0
    assert not corners.may_be_seen(mi.Float(0))[0]


def test_closed_form_against_monte_carlo():
    rng = np.random.default_rng(1)
    u = rng.random((2, 400_000))
    u = np.where(u.sum(0) > 1, 1 - u, u)
    for triangle, w in zip(
        random_triangles("anywhere", rng, 20), random_directions(rng, 20), strict=True
    ):
        m = (
            triangle[0]
            + u[:1].T * (triangle[1] - triangle[0])
            + u[1:].T * (triangle[2] - triangle[0])
        )
        z = np.sqrt(1 - (m**2).sum(1))
        values = np.maximum(m @ w[:2] + z * w[2], 0) / z
        error = values.std() / np.sqrt(u.shape[1])
        assert abs(closed_form(triangle, w) - values.mean()) <= 4 * error + 1e-9


# --------------------------------------------------------------------------------------------------
#  Footprints
# --------------------------------------------------------------------------------------------------


def direction(theta: float, phi: float = 0.7) -> mi.Vector3f:
    x, y, z = np.sin(theta) * np.cos(phi), np.sin(theta) * np.sin(phi), np.cos(theta)
    return mi.Vector3f(float(x), float(y), float(z))


def quad_triangles(normals: np.ndarray, row: int, column: int) -> list[np.ndarray]:
    """The two triangles of a quad of a repeated map."""
    height, width, _ = normals.shape
    n0, n1, n2, n3 = (
        normals[(row + i) % height, (column + j) % width].astype(np.float64)
        for i in (0, 1)
        for j in (0, 1)
    )
    return [np.array([n0, n1, n2]), np.array([n3, n2, n1])]


@pytest.mark.parametrize("alpha", [0.1, 0.5])
def test_box_over_whole_quads_is_exact(variant, alpha):
    # A box from the centre of texel (3, 2) to that of texel (11, 14): 8 × 12 quads.
    normal_map = maps.isotropic(16, alpha=alpha, correlation_length=4, seed=2)
    area = ProjectedArea(TexelMesh(normal_map, "box", epsilon=1e-9))
    footprint = Footprint(
        mi.Point2f(8.5 / 16, 7.5 / 16), mi.Vector2f(12 / 3 / 16, 0), mi.Vector2f(0, 8 / 3 / 16)
    )
    triangles = [
        t
        for i in range(3, 11)
        for j in range(2, 14)
        for t in quad_triangles(normal_map.normals, i, j)
    ]
    for theta in (0.3, 1.0, 1.4, 1.55, np.pi / 2 - 1e-4):
        w = direction(theta)
        expected = np.mean([closed_form(t, np.ravel(w)) for t in triangles])
        assert area.eval(w, footprint)[0] == pytest.approx(expected, rel=2e-4)


def monte_carlo(mesh: TexelMesh, footprint: Footprint, w: np.ndarray, side: int = 700) -> float:
    """Mean over jittered points of the kernel; the error is about 1/side² for a smooth
    integrand."""
    jitter = np.random.default_rng(9).random((2, side, side))
    u = np.float32((jitter + np.mgrid[:side, :side]) / side).reshape(2, -1)
    dr.make_opaque(footprint.uv, footprint.du, footprint.dv)  # one kernel for all
    kernel = mesh.texel_kernel(footprint)
    m = np.array(mesh.normal_at(kernel.mean + kernel.sample(mi.Point2f(u))), np.float64)
    z = np.sqrt(1 - (m**2).sum(0))
    return np.mean(np.maximum(w[0] * m[0] + w[1] * m[1] + w[2] * z, 0) / z)


@pytest.mark.parametrize("kernel", KERNELS)
def test_footprints(variant, kernel):
    # The kernel is constant on each triangle, so the error is largest at a few texels. Measured,
    # absolute: 1.4e-3.
    mesh = TexelMesh(maps.isotropic((96, 128), alpha=0.15, seed=3), kernel)
    area = ProjectedArea(mesh)
    rng = np.random.default_rng(4)
    for sigma in (1e-3, 0.3, 0.66, 0.68, 1.5, 6):
        for theta in (0.0, 0.9, 1.35, 1.57):
            w = direction(theta, 6 * rng.random())
            turn, size = 6 * rng.random(), sigma / 128
            axes = [
                mi.Vector2f(float(size * np.cos(t)), float(size * 0.7 * np.sin(t)))
                for t in (turn, turn + np.pi / 2)
            ]
            footprint = Footprint(mi.Point2f(*rng.random(2).tolist()), *axes)
            expected = monte_carlo(mesh, footprint, np.ravel(w))
            dr.make_opaque(w)
            assert area.eval(w, footprint)[0] == pytest.approx(expected, abs=3e-3)


def test_large_footprints_are_sampled(variant):
    # 16 times as many quads as are evaluated. Measured: 1.2e-3 absolute.
    mesh = TexelMesh(maps.isotropic(256, alpha=0.15, seed=3))
    footprint = Footprint.isotropic(mi.Point2f(0.3, 0.6), 40 / 256)
    assert mesh.texel_kernel(footprint).touched_quads()[0] > 8 * MANY_QUADS
    for theta in (0.0, 0.9, 1.35, 1.57):
        expected = monte_carlo(mesh, footprint, np.ravel(direction(theta)))
        actual = ProjectedArea(mesh).eval(direction(theta), footprint)[0]
        assert actual == pytest.approx(expected, abs=3e-3)


def test_planes_are_exact(variant):
    slope = np.array([0.3, -0.2])
    normals = np.broadcast_to(slope / np.sqrt(1 + slope @ slope), (5, 7, 2))
    angles = [(theta, phi) for theta in (0, 1.5, np.pi / 2) for phi in (0.1, 3.3)]
    w = np.stack([np.ravel(direction(*pair)) for pair in angles], axis=1)
    for estimate in (ProjectedArea, GgxFit):
        # Triangles without area become small ones, which blur the plane by 6e-5 of slope.
        for wrap_mode in ("repeat", "mirror", "clamp"):
            area = estimate(TexelMesh(NormalMap(normals, wrap_mode), epsilon=1e-8))
            for sigma in (0, 0.6, 10):
                footprint = Footprint.isotropic(mi.Point2f(0.4, -3), sigma / 7)
                expected = np.maximum(w[2] + slope @ w[:2], 0)
                actual = np.array(area.eval(mi.Vector3f(np.float32(w)), footprint))
                assert actual == pytest.approx(expected, abs=1e-4)


def test_clamped_triangles_count(variant):
    # A flat map whose triangles all become equilateral ones of Jacobian ε (Wu24, section 4.1).
    epsilon = 0.05
    area = ProjectedArea(TexelMesh(maps.flat(8), "box", epsilon=epsilon))
    radius = np.sqrt(2 * epsilon / (3 * np.sqrt(3)))
    angles = np.pi / 2 + np.array([0, 2, 4]) * np.pi / 3
    triangle = radius * np.stack([np.cos(angles), np.sin(angles)], 1)
    for theta in (0.5, 1.5, 1.57):
        footprint = Footprint.isotropic(mi.Point2f(0.5, 0.5), 0.3)
        expected = closed_form(triangle, np.ravel(direction(theta)))
        assert area.eval(direction(theta), footprint)[0] == pytest.approx(expected, rel=1e-4)


@pytest.mark.parametrize("estimate", [ProjectedArea, GgxFit])
def test_extremes(variant, estimate):
    area = estimate(TexelMesh(maps.scratched((24, 36), length=20)))
    for view in EXTREME_VIEWS.values():
        si = view.interaction()
        footprint = Footprint.from_interaction(si, 1.0)
        assert area.eval(mi.Vector3f(0, 0, 1), footprint)[0] == pytest.approx(1, abs=1e-5)
        value = area.eval(si.wi, footprint)[0]
        assert np.isfinite(value) and 0 <= value < 2


def test_fit_of_two_facets(variant):
    # Facets of slope ±s side by side have P = (|ω_z + s·ω| + |ω_z − s·ω|)/2. The fit knows their
    # variance only, and at grazing angles assumes an even distribution of slopes, √3/4 of its root,
    # while two facets have ½. The footprint is wide enough to cover equal areas of both facets; but
    # the MIP chain also averages the triangles between them, which are less steep.
    slope = np.array([0.3, 0.1])
    normals = np.where(np.arange(64)[:, None] // 32 == 0, slope, -slope) / np.sqrt(
        1 + slope @ slope
    )
    area = GgxFit(TexelMesh(NormalMap(np.broadcast_to(normals, (4, 64, 2)))))
    footprint = Footprint.isotropic(mi.Point2f(0.5, 0.5), 2.0)
    for phi in (0, 0.5, 1.2, 2.5):
        expected = np.sqrt(3) / 4 * abs(slope @ [np.cos(phi), np.sin(phi)])
        actual = area.eval(direction(np.pi / 2, phi), footprint)[0]
        assert actual == pytest.approx(expected, abs=0.01)


@pytest.mark.parametrize("name", ["isotropic", "brushed", "scratched"])
def test_ggx_fit_is_close(variant, name):
    # Root mean square of the difference from the analytic area, over directions from the normal to
    # the horizon. Measured: 0.0033, 0.0044 and 0.0003.
    mesh = TexelMesh(getattr(maps, name)(128, seed=5))
    fit, exact = GgxFit(mesh), ProjectedArea(mesh)
    rng = np.random.default_rng(6)
    w = mi.Vector3f(np.ascontiguousarray(random_directions(rng, 200).T, np.float32))
    for sigma in (2, 6):
        footprint = Footprint.isotropic(mi.Point2f(np.float32(rng.random((2, 200)))), sigma / 128)
        difference = np.array(fit.eval(w, footprint) - exact.eval(w, footprint))
        assert np.sqrt(np.mean(difference**2)) < 0.008


def test_changed_data_take_effect(variant):
    old, new = (maps.isotropic(16, alpha=alpha, seed=1) for alpha in (0.05, 0.5))
    footprint, w = Footprint.isotropic(mi.Point2f(0.3, 0.4), 0.1), direction(1.5)
    for estimate in (ProjectedArea, GgxFit):
        mesh = TexelMesh(old)
        area = estimate(mesh)
        before = area.eval(w, footprint)[0]
        mesh.data = mi.TensorXf(new.normals)
        mesh.parameters_changed(["data"])
        area.parameters_changed()
        expected = estimate(TexelMesh(new)).eval(w, footprint)[0]
        assert area.eval(w, footprint)[0] == expected != before


# --------------------------------------------------------------------------------------------------
#  Masking of glint_manifold
# --------------------------------------------------------------------------------------------------

MASKING_MAPS = {
    "isotropic": maps.isotropic((29, 36), seed=1),
    "rough": maps.isotropic(32, alpha=0.5, seed=1),
    "brushed": maps.brushed((24, 40), streak_length=20, streak_width=3),
    "flat": maps.flat(16),
    "scratched": maps.scratched(48, length=30),
    "flakes": maps.flakes(32, seed=1),
}


def glints(normal_map: NormalMap, **parameters) -> mi.BSDF:
    return mi.load_dict(
        {
            "type": "glint_manifold",
            "data": mi.TensorXf(normal_map.normals),
            "footprint_sigma": 1.0,
            **parameters,
        }
    )


@pytest.mark.parametrize("name", MASKING_MAPS)
def test_furnace(variant, name):
    # No footprint reflects more than it receives, at any angle, if P is not below the area of
    # the facets themselves. Worst of 1000 views of each kind, measured: 1.0015, of the brushed map.
    rng = np.random.default_rng(8)
    count, side = 120, 24
    z = np.where(rng.random(count) < 0.3, rng.random(count), 10 ** rng.uniform(-4, 0, count))
    phi, sigma = 2 * np.pi * rng.random(count), 10 ** rng.uniform(-2, 0.7, count) / 30
    views = []
    for u, v, s, c, t in np.stack([*rng.random((2, count)), sigma, z, phi]).T.tolist():
        r = (1 - c * c) ** 0.5
        views.append(View((u, v), (s, 0), (0, s), (r * cos(t), r * sin(t), c)))
    u = (np.mgrid[:side, :side, :count][:2] + rng.random((2, side, side, count))) / side
    u = np.minimum(np.float32(u), np.float32(1 - 2**-24)).transpose(0, 3, 1, 2).reshape(2, -1)
    for masking in ("analytic", "ggx_fit"):
        for height_correlated in (True, False):
            bsdf = glints(MASKING_MAPS[name], masking=masking, height_correlated=height_correlated)
            si = together(views, side * side)
            _, weight = bsdf.sample(mi.BSDFContext(), si, mi.Float(0.5), mi.Point2f(u))
            weight = np.array(weight)[0].reshape(count, -1)
            error = weight.std(axis=1) / side
            assert (weight.mean(axis=1) <= 1.002 + 3 * error).all()


def together(views: list[View], lanes: int) -> mi.SurfaceInteraction3f:
    """Interactions for several views, one after the other, with ``lanes`` of each."""
    si = views[0].interaction(lanes * len(views))

    def spread(vectors):
        return type(vectors[0])(
            np.repeat(np.array([np.ravel(v) for v in vectors]), lanes, axis=0).T
        )

    singles = [view.interaction() for view in views]
    for name in ("uv", "duv_dx", "duv_dy", "wi"):
        setattr(si, name, spread([getattr(single, name) for single in singles]))
    dr.make_opaque(si)
    return si


def test_masking_is_that_over_the_mean_plane(variant):
    mesh = TexelMesh(MASKING_MAPS["rough"])
    query = Query(Footprint.isotropic(mi.Point2f(0.3, 0.4), 0.1))
    radiance, importance = mi.TransportMode.Radiance, mi.TransportMode.Importance
    for area in (ProjectedArea(mesh), GgxFit(mesh)):
        correlated, separable = (ProjectedAreaMasking(area, flag) for flag in (True, False))
        wi, wo = direction(1.3, 0.4), direction(1.0, 2.0)
        areas, slope = area.projected_areas([wi, wo], query, mi.Bool(True))
        p_i, p_o = (p[0] for p in areas)
        plane_i, plane_o = (w.z[0] + slope.x[0] * w.x[0] + slope.y[0] * w.y[0] for w in (wi, wo))
        lambda_i, lambda_o = max(p_i / plane_i - 1, 0), max(p_o / plane_o - 1, 0)
        assert lambda_i > 5e-3 and abs(plane_i / wi.z[0] - 1) > 0.02
        g = correlated.eval(wi, wo, query, radiance, True)[0]
        assert g == pytest.approx(wi.z[0] / plane_i / (1 + lambda_i + lambda_o), rel=1e-4)
        g = separable.eval(wi, wo, query, radiance, True)[0]
        assert g == pytest.approx(wi.z[0] / plane_i / ((1 + lambda_i) * (1 + lambda_o)), rel=1e-4)
        g = separable.eval(wi, wo, query, importance, True)[0]
        assert g == pytest.approx(wo.z[0] / plane_o / ((1 + lambda_i) * (1 + lambda_o)), rel=1e-4)
        for w in (mi.Vector3f(1, 0, 1e-7), mi.Vector3f(1, 0, 1e-30)):
            assert 0 <= correlated.eval(w, wo, query, radiance, True)[0] <= 1


@pytest.mark.parametrize("kernel", KERNELS)
def test_masses_of_triangles(variant, kernel):
    # The halves of all quads under a kernel have its mass, each as much as random points in it.
    rng = np.random.default_rng(3)
    for sigma in (0.02, 0.3, 1.0, 2.5):
        axes = sigma * np.array([[1.0, 0.4], [-0.3, 0.8]]) / 64
        footprint = Footprint(mi.Point2f(0.51, 0.48), *(mi.Vector2f(*a.tolist()) for a in axes))
        seen = TexelMesh(maps.flat(64), kernel).texel_kernel(footprint)
        reach = int(np.ceil(3 * 1.5 * sigma)) + 1
        y, x = np.mgrid[-reach : reach + 1, -reach : reach + 1].reshape(2, -1) - [[0.37], [0.21]]
        corner = mi.Vector2f(np.float32(x), np.float32(y))
        masses = np.array(seen.masses_in_quad(corner), np.float64)
        assert masses.sum() == pytest.approx(1, abs=3e-3)
        u = np.float32(rng.random((2, 400_000)))
        offset = np.array(seen.sample(mi.Point2f(u)), np.float64) + [[0.21], [0.37]]
        cell = np.floor(offset).astype(int) + reach
        lower = (offset - np.floor(offset)).sum(axis=0) > 1
        found = np.zeros((2, 2 * reach + 1, 2 * reach + 1))
        np.add.at(found, (lower.astype(int), cell[1], cell[0]), 1 / u.shape[1])
        assert np.allclose(found.reshape(2, -1), masses, atol=4e-3)


@pytest.mark.parametrize("masking", ["analytic", "ggx_fit"])
def test_suite_with_masking(variant, masking):
    bsdf = glints(MASKING_MAPS["isotropic"], masking=masking, material="Al")
    resolved = View(du=(0.04, 0.03), dv=(-0.015, 0.02), wi=(0.3, 0.1, 1))
    for view in (resolved, replace(resolved, wi=(1, 1, 0.6))):
        suite.check_eval_pdf(bsdf, view, 500)
        suite.check_weights(bsdf, view, 500)
    suite.check_horizon(bsdf, resolved)
    for name in ("point", "1000:1", "one_map", "not_finite", "grazing", "almost_horizontal"):
        suite.check_finite(bsdf, EXTREME_VIEWS[name], 50)
    check_value_derivatives(
        glints(MASKING_MAPS["isotropic"], masking=masking), resolved, "footprint_sigma"
    )


def test_derivative_is_that_of_the_value(variant):
    # Against a central difference along a fixed direction, in steps small enough for the kinks of
    # max(s·ω, 0). Measured: 1e-3 relative. Averages of data with derivatives are floats; such
    # steps would be lost in the 16 bits of others.
    normal_map = MASKING_MAPS["rough"]
    step = np.random.default_rng(2).normal(size=normal_map.normals.shape).astype(np.float32)
    footprint, w = Footprint.isotropic(mi.Point2f(0.3, 0.4), 0.05), direction(1.5)
    for estimate in (ProjectedArea, GgxFit):

        def value(t, estimate=estimate):
            mesh = TexelMesh(normal_map, epsilon=1e-9)
            mesh.data = mi.TensorXf(normal_map.normals) + t * mi.TensorXf(step)
            dr.enable_grad(mesh.data)
            mesh.changed = True
            mesh.make_vertices()
            return estimate(mesh).eval(w, footprint)

        t = mi.Float(0)
        dr.enable_grad(t)
        dr.backward(value(t))
        h = 3e-4
        difference = (value(mi.Float(h)) - value(mi.Float(-h)))[0] / (2 * h)
        assert dr.grad(t)[0] == pytest.approx(difference, rel=5e-3)


def test_derivatives_beside_degenerate_triangles(variant):
    """With respect to the width of footprints that these triangles cover in part, against
    differences. Few footprints have a point that crosses an edge within a step. Measured: nine in
    ten differ by less than 2 % of the typical derivative."""
    mesh, rng, h = TexelMesh(maps.isotropic(64)), np.random.default_rng(1), 1e-3
    uv = mi.Point2f(rng.uniform(size=(2, 1000)).astype(np.float32))
    z, phi = rng.uniform(0.05, 1, 1000), rng.uniform(0, 2 * pi, 1000)
    w = dr.normalize(mi.Vector3f(np.cos(phi), np.sin(phi), z / np.sqrt(1 - z * z)))

    def value(change):
        kernel = mesh.texel_kernel(Query(Footprint.isotropic(uv, 2 / 64 * (1 + change))))
        (area,), _ = mean_over_points(mesh, kernel, [w], mi.Bool(True), jumps=True)
        return area, degenerate_triangles(mesh, kernel, [w], mi.Bool(True))[0]

    change = dr.zeros(mi.Float, 1000)
    dr.enable_grad(change)
    area, mass = value(change)
    dr.backward(area)
    difference = (value(mi.Float(h))[0] - value(mi.Float(-h))[0]).numpy() / (2 * h)
    partly = (mass.numpy() > 0) & (mass.numpy() < 1)
    error = np.abs(dr.grad(change).numpy() - difference)[partly]
    assert len(error) > 100
    assert np.quantile(error, 0.9) < 0.05 * np.median(np.abs(difference[partly]))


@pytest.mark.parametrize("parameters", [{"threshold": 3.0}, {"max_error": 0.2}], ids=str)
def test_analytic_masking_of_approximate_pndfs(variant, parameters):
    # Masking uses the map's own facets, whatever the P-NDF replaces them with.
    normal_map = maps.isotropic(128, seed=1)
    view = View(du=(0.12, 0.04), dv=(-0.04, 0.12), wi=(1, 0.5, 0.4))
    masked, unmasked = (
        glints(normal_map, masking=masking, height_correlated=False, **parameters)
        for masking in ("analytic", "none")
    )
    si, bs, weight = suite.sample(masked, view, 100)
    _, same, more = suite.sample(unmasked, view, 100)
    assert dr.allclose(bs.wo, same.wo) and dr.any(bs.pdf > 0)
    area = ProjectedArea(TexelMesh(normal_map))
    query = Query(Footprint(si.uv, si.duv_dx, si.duv_dy))
    g = ProjectedAreaMasking(area, False).eval(si.wi, bs.wo, query, mi.TransportMode.Radiance, True)
    assert dr.allclose(weight, dr.select(bs.pdf > 0, more * g, 0), rtol=1e-4)
    assert dr.mean(dr.abs(g - 1))[0] > 1e-3
