"""Ray cones: the curvature of surfaces, which bends them and turns half vectors."""

from __future__ import annotations

import mitsuba as mi
import numpy as np
import pytest

from glintbsdf.footprint.raycone import curved_interaction

#: Vertices of a bent quad, their normals, and texture coordinates that no axis is aligned with.
POSITIONS = [[-1, -1, 0], [1, -1, 0.1], [-1, 1, 0.2], [1, 1, -0.1]]
NORMALS = [[-0.3, -0.2, 1], [0.4, -0.1, 1], [-0.2, 0.3, 1], [0.3, 0.2, 1]]
TEXCOORDS = [[0.1, 0.2], [0.8, 0.0], [0.3, 0.9], [1.1, 0.6]]


def bent_quad() -> mi.Mesh:
    normals = np.array(NORMALS) / np.linalg.norm(NORMALS, axis=1, keepdims=True)
    mesh = mi.Mesh("bent", 4, 2, has_vertex_normals=True, has_vertex_texcoords=True)
    params = mi.traverse(mesh)
    for name, values in (
        ("vertex_positions", POSITIONS),
        ("vertex_normals", normals),
        ("vertex_texcoords", TEXCOORDS),
    ):
        params[name] = mi.Float(np.array(values, np.float32).ravel())
    params["faces"] = mi.UInt32([0, 1, 2, 3, 2, 1])
    params.update()
    return mesh


@pytest.mark.parametrize("shape", ["mesh", "sphere"])
def test_derivatives_of_the_normal(variant, shape):
    """``dn_du`` and ``dn_dv`` are those of the shading normal, by neighbouring points of the
    surface; of a mesh within a triangle."""
    one = bent_quad() if shape == "mesh" else {"type": "sphere", "radius": 1.5}
    scene = mi.load_dict({"type": "scene", "shape": one})
    rng = np.random.default_rng(5)
    places = np.float32(rng.uniform(-0.7, 0.7, (2, 64)))
    step = 4e-3

    def hit(dx=0.0, dy=0.0):
        ray = mi.Ray3f(mi.Point3f(places[0] + dx, places[1] + dy, 5), mi.Vector3f(0, 0, -1))
        return curved_interaction(scene.ray_intersect_preliminary(ray), ray)

    si = hit()
    for dx, dy in ((step, 0), (0, step)):
        before, after = hit(-dx, -dy), hit(dx, dy)
        du, dv = after.uv - before.uv
        found = np.array(si.dn_du * du + si.dn_dv * dv)
        expected = np.array(mi.Vector3f(after.sh_frame.n) - mi.Vector3f(before.sh_frame.n))
        same = np.array((before.prim_index == after.prim_index) & si.is_valid())
        assert same.sum() > 50
        error = np.linalg.norm(found - expected, axis=0)[same]
        assert error.max() < 2e-3 * np.linalg.norm(expected, axis=0)[same].max(), (dx, dy)
