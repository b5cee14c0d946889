"""The turn and the spread that an integrator passes to a BSDF: through Mitsuba's wrappers, and
against half vectors at neighbouring points."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest

from glintbsdf.bridge.carried import Carried, half_vector_turn
from glintbsdf.footprint.raycone import curved_interaction
from glintbsdf.maps import procedural


def interaction(count=64, seed=3):
    """An interaction on a tilted surface whose shading normal differs from the geometric one."""
    rng = np.random.default_rng(seed)
    si = dr.zeros(mi.SurfaceInteraction3f, count)
    si.t = dr.ones(mi.Float, count)
    si.n = dr.normalize(mi.Normal3f(0.2, -0.1, 1))
    si.sh_frame = mi.Frame3f(dr.normalize(mi.Normal3f(0.1, 0.1, 1)))
    si.uv = mi.Point2f(rng.random((2, count), dtype=np.float32))
    si.dp_du, si.dp_dv = mi.Vector3f(1, 0, -0.2), mi.Vector3f(0, 1, 0.1)
    si.duv_dx, si.duv_dy = mi.Vector2f(0.02, 0.003), mi.Vector2f(-0.002, 0.03)
    si.wi = dr.normalize(mi.Vector3f(0.1, 0.05, 1))
    return si


def test_round_trip(variant):
    si = interaction()
    assert Carried.of(dr.zeros(mi.SurfaceInteraction3f)) is None
    w_u, w_v = mi.Vector3f(3, -20, 1), mi.Vector3f(0.5, 0.1, 7)
    for variance in (0.0, 1e-7, 1e-2):
        told = Carried(w_u, w_v, mi.Float(variance)).put(si)
        found = Carried.of(told)
        assert np.allclose(found.variance, variance, rtol=1e-3)
        expected, turn = Carried(w_u, w_v, mi.Float(0)).turn(si), found.turn(told)
        for i in range(2):
            for j in range(2):
                assert np.allclose(turn[i, j], expected[i, j], rtol=1e-4, atol=1e-4)


def test_curvature_is_not_mistaken_for_a_turn(variant):
    """An integrator that leaves the derivatives of normals in the interaction passes no turn."""
    scene = mi.load_dict({"type": "scene", "ball": {"type": "sphere"}})
    si = curved_interaction(
        scene.ray_intersect_preliminary(mi.Ray3f([0.1, 0.2, 5], [0, 0, -1])),
        mi.Ray3f([0.1, 0.2, 5], [0, 0, -1]),
    )
    found = Carried.of(si)
    assert np.all(np.array(found.variance) == 0)
    assert all(np.all(np.array(found.turn(si)[i, j]) == 0) for i in range(2) for j in range(2))


@pytest.mark.parametrize("to_uv", [None, "scaled"])
def test_wrappers_pass_it_on(variant, to_uv):
    """``twosided``, ``mask``, ``blendbsdf`` and a flat ``normalmap`` pass it to the glint BSDF
    inside."""
    transform = mi.ScalarTransform4f()
    data = mi.TensorXf(procedural.isotropic(32, seed=2).normals)
    glints = {"type": "glint_elements", "data": data, "sigma_r": 0.05, "masking": "none"}
    if to_uv:
        glints["to_uv"] = transform.rotate([0, 0, 1], 30).scale([2, 3, 1])
    plain = mi.load_dict(glints)
    flat = mi.TensorXf(np.full((1, 1, 3), [0.5, 0.5, 1], np.float32))
    wrappers = [
        {"type": "twosided", "nested": glints},
        {"type": "mask", "opacity": 1.0, "nested": glints},
        {"type": "blendbsdf", "weight": 0.0, "a": glints, "b": {"type": "diffuse"}},
        {
            "type": "normalmap",
            "normalmap": {"type": "bitmap", "data": flat, "raw": True},
            "nested": glints,
        },
    ]
    si = interaction()
    si.sh_frame = mi.Frame3f(si.sh_frame.n)
    si.sh_frame.s = dr.normalize(si.dp_du - si.sh_frame.n * dr.dot(si.sh_frame.n, si.dp_du))
    si.sh_frame.t = dr.cross(si.sh_frame.n, si.sh_frame.s)
    told = Carried(mi.Vector3f(3, -2, 1), mi.Vector3f(0.5, 0.1, 2), mi.Float(1e-2)).put(si)
    wo = dr.normalize(mi.Vector3f(-0.1, 0.1, 1))
    context = mi.BSDFContext()
    expected = np.array(plain.eval(context, told, wo))
    untold = np.array(plain.eval(context, si, wo))
    assert np.abs(untold - expected).mean() > 0.05 * expected.mean()
    for wrapper in wrappers:
        value = np.array(mi.load_dict(wrapper).eval(context, told, wo))
        assert np.allclose(value, expected, rtol=2e-3, atol=1e-3 * expected.max()), wrapper["type"]


@pytest.mark.parametrize("inverse_distance", [0.0, 1 / 3])
def test_turn_of_the_half_vector(variant, inverse_distance):
    """On a sphere near its equator, where the frame does not turn about the normal, the turn agrees
    with half vectors at neighbouring points, for a near camera."""
    scene = mi.load_dict({"type": "scene", "ball": {"type": "sphere", "radius": 1.3}})
    camera = mi.Point3f(4, 0.3, 0.2)
    direction = dr.normalize(mi.Vector3f(1, 0.4, 0.3))

    def at(du=0.0, dv=0.0):
        target = mi.Point3f(1, 0.1, 0.02)
        ray = mi.Ray3f(camera, dr.normalize(target - camera))
        si = scene.ray_intersect(ray)
        moved = si.p + si.dp_du * du + si.dp_dv * dv
        ray = mi.Ray3f(camera, dr.normalize(mi.Point3f(dr.normalize(moved) * 1.3) - camera))
        return curved_interaction(scene.ray_intersect_preliminary(ray), ray)

    si = at()
    light = si.p + direction / inverse_distance if inverse_distance else None

    def half_vector(si):
        wo = dr.normalize(light - si.p) if light is not None else direction
        h = dr.normalize(si.to_world(si.wi) + wo)
        m = si.to_local(h)
        return np.array([m.x, m.y]).ravel(), np.array(si.uv).ravel()

    to_camera = camera - si.p
    distance = dr.norm(to_camera)
    d = to_camera / distance
    dwi = [(d * dr.dot(d, dp) - dp) / distance for dp in (si.dp_du, si.dp_dv)]
    turn = Carried(
        *half_vector_turn(si, direction, *dwi, mi.Float(inverse_distance)), mi.Float(0)
    ).turn(si)
    found = np.array([[turn[i, j].numpy()[0] for j in (0, 1)] for i in (0, 1)])

    step = 2e-3
    differences = []
    for moved in ((step, 0), (0, step)):
        (s1, uv1), (s0, uv0) = half_vector(at(*moved)), half_vector(at(*(-v for v in moved)))
        differences.append((s1 - s0, uv1 - uv0))
    ds, duv = (np.stack(x, -1) for x in zip(*differences, strict=True))
    expected = ds @ np.linalg.inv(duv)
    assert np.abs(found - expected).max() < 0.02 * np.abs(expected).max(), (found, expected)


def test_spread_of_the_half_vector(variant):
    """The spread agrees with half vectors of random directions about the light's direction."""
    wi = dr.normalize(mi.Vector3f(0.3, -0.2, 1))
    wo = dr.normalize(mi.Vector3f(-0.5, 0.4, 0.8))
    sigma = 0.02
    zero = mi.Vector3f(0)
    a, b = Carried(zero, zero, mi.Float(sigma**2)).spread(wi, wo)
    found = sum(np.outer(v, v) for v in (np.array(a).ravel(), np.array(b).ravel()))
    s, t = mi.coordinate_system(wo)
    x, y = np.random.default_rng(4).normal(size=(2, 200_000)).astype(np.float32) * sigma
    h = dr.normalize(wi + dr.normalize(wo + s * mi.Float(x) + t * mi.Float(y)))
    expected = np.cov(np.array(h)[:2])
    assert np.abs(found - expected).max() < 0.02 * expected.max()


def test_shift_of_a_wide_light(variant):
    """The shift leads to the mean of the half vectors of a light of 0.2 radians."""
    wi = dr.normalize(mi.Vector3f(0.3, -0.2, 1))
    wo = dr.normalize(mi.Vector3f(-0.9, 0.6, 0.5))
    zero, radius = mi.Vector3f(0), 0.2
    shift = np.array(Carried(zero, zero, mi.Float(0.25 * radius**2)).shift(wi, wo)).ravel()
    centre = np.array(dr.normalize(wi + wo)).ravel()[:2]
    s, t = mi.coordinate_system(wo)
    random = np.random.default_rng(4).random((2, 400_000), dtype=np.float32)
    disk = radius * mi.warp.square_to_uniform_disk_concentric(mi.Point2f(random))
    h = np.array(dr.normalize(wi + dr.normalize(wo + s * disk.x + t * disk.y)))[:2]
    expected, noise = h.mean(1) - centre, h.std(1).max() / len(h[0]) ** 0.5
    assert np.linalg.norm(expected) > 20 * noise
    assert np.abs(shift - expected).max() < 4 * noise + 0.03 * np.linalg.norm(expected)
    assert np.all(np.array(Carried(zero, zero, mi.Float(0)).shift(wi, wo)) == 0)
