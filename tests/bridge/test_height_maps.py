"""Height maps give the facets of the displaced surface, on any UVs, in every plugin that takes
maps."""

from __future__ import annotations

import mitsuba as mi
import numpy as np
import pytest

from glintbsdf.check import suite
from glintbsdf.check.suite import View
from tests.small_scenes import write_plates

SIZE = 64
SLOPES = np.array([0.2, 0.1])  # along columns and rows, texels per texel
ROWS, COLUMNS = np.mgrid[:SIZE, :SIZE]
RAMP = (SLOPES[0] * COLUMNS + SLOPES[1] * ROWS).astype(np.float32)

PLUGINS = {
    "glint_filtered": {"alpha": 0.01},
    "glint_manifold": {"masking": "none"},
    "glint_elements": {"masking": "none"},
}


def tensor(height: np.ndarray) -> mi.TensorXf:
    return mi.TensorXf(np.ascontiguousarray(height[..., None], np.float32))


def surfaces(folder) -> dict:
    """Shapes and transforms of UV on which texels are turned, mirrored or stretched."""
    write_plates(folder)
    transform = mi.ScalarTransform4f
    mesh = {"type": "obj", "filename": str(folder / "plate.obj")}
    return {
        "rectangle": ({"type": "rectangle"}, transform()),
        "OBJ": (mesh, transform()),
        "mirrored UVs": (mesh | {"filename": str(folder / "mirrored.obj")}, transform()),
        "mirrored object": (mesh | {"to_world": transform().scale([-1, 1, 1])}, transform()),
        "turned": ({"type": "rectangle"}, transform().rotate([0, 0, 1], 90)),
        "stretched": ({"type": "rectangle"}, transform().scale([2, 1, 1])),
        "sheared": (
            {"type": "rectangle"},
            transform([[1, 0.5, 0, 0], [0.2, -0.8, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]]),
        ),
    }


def interaction(scene: mi.Scene, x, y) -> mi.SurfaceInteraction3f:
    return scene.ray_intersect(mi.Ray3f(mi.Point3f(x, y, 3), mi.Vector3f(0, 0, -1)))


def displaced_normal(shape: dict, to_uv, x: float, y: float) -> np.ndarray:
    """The normal of the plate that the ramp displaces, by finite differences of positions on the
    map."""
    scene = mi.load_dict({"type": "scene", "plate": dict(shape)})
    matrix = np.array(to_uv.matrix)[:2][:, [0, 1, 3]]

    def texel(x, y):
        uv = np.array(interaction(scene, x, y).uv).T[0]
        return matrix @ np.append(uv, 1) * SIZE

    step = 1e-2
    here = texel(x, y)
    texels = np.stack((texel(x + step, y) - here, texel(x, y + step) - here), axis=1) / step
    size = abs(np.linalg.det(texels)) ** -0.5  # of a texel, in the world
    normal = np.append(-size * texels.T @ SLOPES, 1)
    return normal / np.linalg.norm(normal)


def mean_facet(scene: mi.Scene, x: float, y: float, count: int = 2048) -> np.ndarray:
    """Mean direction, in world space, of the facets that reflect, by sampling from above."""
    si = interaction(scene, mi.Float(np.full(count, x, np.float32)), y)
    u = suite.random_numbers(count, 3, seed=1)
    bs, _ = si.bsdf().sample(mi.BSDFContext(), si, u[0], mi.Point2f(u[1], u[2]))
    half = np.array(si.to_world(bs.wo)).T + np.array(si.to_world(si.wi)).T
    half /= np.linalg.norm(half, axis=1, keepdims=True)
    mean = half[np.array(bs.pdf) > 0].mean(axis=0)
    return mean / np.linalg.norm(mean)


@pytest.mark.parametrize(
    "name",
    ["rectangle", "OBJ", "mirrored UVs", "mirrored object", "turned", "stretched", "sheared"],
)
def test_facets_are_those_of_the_displaced_surface(variant, tmp_path, name):
    shape, to_uv = surfaces(tmp_path)[name]
    x, y = -0.43, 0.21
    expected = displaced_normal(shape, to_uv, x, y)
    for plugin, options in PLUGINS.items():
        bsdf = {"type": plugin, "data": tensor(RAMP), "to_uv": to_uv, "pixel_spread": 0.01}
        scene = mi.load_dict({"type": "scene", "plate": {**shape, "bsdf": bsdf | options}})
        assert np.allclose(mean_facet(scene, x, y), expected, atol=0.01), (plugin, expected)


def test_normal_maps_stay_in_the_shading_frame(variant, tmp_path):
    """As in Mitsuba's ``normalmap``, normals do not depend on the UVs."""
    normal = np.append(-SLOPES, 1) / np.sqrt(1 + SLOPES @ SLOPES)
    data = mi.TensorXf(np.ascontiguousarray(np.broadcast_to(np.float32(normal), (8, 8, 3))))
    for shape, to_uv in surfaces(tmp_path).values():
        bsdf = {"type": "glint_filtered", "data": data, "to_uv": to_uv, "alpha": 0.01}
        scene = mi.load_dict({"type": "scene", "plate": {**shape, "bsdf": bsdf}})
        si = interaction(scene, -0.43, 0.21)
        expected = np.array(si.to_world(mi.Vector3f(*map(float, normal)))).T[0]
        assert np.allclose(mean_facet(scene, -0.43, 0.21), expected, atol=0.01)


def bumps(seed: int = 3) -> np.ndarray:
    from scipy.ndimage import gaussian_filter

    height = gaussian_filter(np.random.default_rng(seed).normal(size=(24, 36)), 2, mode="wrap")
    return 0.5 * height / height.std()


#: UVs that stretch and shear, by a factor of two in slopes.
STRETCHED = View(
    du=(0.04, 0.03),
    dv=(-0.015, 0.02),
    wi=(0.3, 0.1, 1),
    dp_du=(1.0, 0.3, 0.0),
    dp_dv=(0.4, -0.5, 0.0),
)
METHODS = [
    ("glint_manifold", {}),
    ("glint_manifold", {"masking": "beckmann"}),
    ("glint_elements", {"sigma_r": 0.02}),
    ("glint_filtered", {}),
    ("glint_filtered", {"method": "leadr"}),
]


def load(plugin: str, **options) -> mi.BSDF:
    return mi.load_dict(
        {"type": plugin, "data": tensor(bumps()), "footprint_sigma": 1.0, **options}
    )


@pytest.mark.parametrize(("plugin", "options"), METHODS, ids=str)
def test_stretched_facets_keep_the_contract(variant, plugin, options):
    bsdf = load(plugin, **options)
    suite.check_eval_pdf(bsdf, STRETCHED, 500)
    suite.check_weights(bsdf, STRETCHED, 500)
    suite.check_horizon(bsdf, STRETCHED, 200)
    suite.check_finite(bsdf, STRETCHED)
    suite.check_furnace(bsdf, STRETCHED, count=5000)
    suite.check_adjoint(bsdf, STRETCHED)


@pytest.mark.parametrize(
    ("plugin", "options"),
    [("glint_manifold", {"masking": "none"}), ("glint_elements", {"sigma_r": 0.05})],
)
def test_stretched_facets_are_drawn_from_their_density(variant, plugin, options):
    bsdf = load(plugin, **options, height_scale=0.5)
    view = View(du=STRETCHED.du, dv=STRETCHED.dv, dp_du=STRETCHED.dp_du, dp_dv=STRETCHED.dp_dv)
    suite.check_chi2(bsdf, view, ((-0.6, -0.6), (0.6, 0.6)), test_count=2, samples=20_000)


@pytest.mark.parametrize("method", ["manifold", "oren_nayar"])
def test_diffuse_facets_are_those_of_the_displaced_surface(variant, method):
    """For a plane, the facets are a diffuse surface about the displaced normal."""
    options = {"method": method, "reflectance": 0.5, "map_type": "height", "height_scale": 1.0}
    bsdf = mi.load_dict({"type": "glint_diffuse", "data": tensor(RAMP), **options})
    view = View(
        uv=(0.4, 0.4), du=(0.01, 0), dv=(0, 0.01), dp_du=STRETCHED.dp_du, dp_dv=STRETCHED.dp_dv
    )
    jacobian = np.array([STRETCHED.dp_du[:2], STRETCHED.dp_dv[:2]]).T / SIZE
    slope = abs(np.linalg.det(jacobian)) ** 0.5 * np.linalg.inv(jacobian).T @ SLOPES
    normal = np.append(-slope, 1) / np.sqrt(1 + slope @ slope)
    wo = np.array([[0.1, 0.2, 0.97], [-0.6, 0.3, 0.74], [0.5, -0.5, 0.7]]).T
    wo /= np.linalg.norm(wo, axis=0)
    si = view.interaction(3)
    world = np.array([[float(a[0]) for a in axis] for axis in (si.sh_frame.s, si.sh_frame.t)])
    local = np.stack((world[0] @ wo, world[1] @ wo, wo[2]))
    value = np.array(bsdf.eval(mi.BSDFContext(), si, mi.Vector3f(np.float32(local))))[0]
    cosine = np.maximum(normal @ wo, 0)
    area = 1 / normal[2] if method == "manifold" else 1
    assert np.allclose(value, 0.5 * cosine * area / np.pi, atol=3e-3)
