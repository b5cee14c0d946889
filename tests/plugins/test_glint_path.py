"""``glint_path``: it renders the image of ``path``, with a footprint at every hit."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest

from glintbsdf.core.errors import ParameterError
from glintbsdf.footprint.raycone import RayCone, lobe_width


def transform():
    return mi.ScalarTransform4f()


def load_scene(**overrides):
    """Diffuse, rough and smooth metal, glass, a mask; area, point and environment light."""
    environment = mi.TensorXf(np.linspace(0, 1, 8 * 16 * 3, dtype=np.float32).reshape(8, 16, 3))
    return mi.load_dict(
        {
            "type": "scene",
            "sensor": {
                "type": "perspective",
                "fov": 40,
                "to_world": transform().look_at([0, -6, 3], [0, 0, 0.5], [0, 0, 1]),
                "film": {"type": "hdrfilm", "width": 24, "height": 16, "pixel_format": "rgba"},
            },
            "floor": {
                "type": "rectangle",
                "to_world": transform().scale(4),
                "bsdf": {"type": "diffuse", "reflectance": {"type": "checkerboard"}},
            },
            "rough": {
                "type": "sphere",
                "center": [-1, 0, 0.7],
                "radius": 0.7,
                "bsdf": {"type": "roughconductor", "alpha": 0.2},
            },
            "glass": {
                "type": "sphere",
                "center": [1, 0, 0.7],
                "radius": 0.7,
                "bsdf": {"type": "dielectric"},
            },
            "mirror": {
                "type": "sphere",
                "center": [0, 1.5, 0.7],
                "radius": 0.7,
                "bsdf": {"type": "conductor"},
            },
            "mask": {
                "type": "sphere",
                "center": [0, -1.5, 0.4],
                "radius": 0.3,
                "bsdf": {"type": "mask", "opacity": 0.5, "nested": {"type": "plastic"}},
            },
            "lamp": {
                "type": "rectangle",
                "emitter": {"type": "area", "radiance": 5.0},
                "to_world": transform().translate([0, 0, 3]).rotate([1, 0, 0], 180).scale(0.7),
            },
            "point": {"type": "point", "position": [2, -2, 3], "intensity": 4.0},
            "environment": {"type": "envmap", "bitmap": mi.Bitmap(environment), "scale": 0.5},
            **overrides,
        }
    )


def render(scene, integrator, **parameters):
    return mi.render(
        scene, integrator=mi.load_dict({"type": integrator, **parameters}), spp=16, seed=7
    ).numpy()


def assert_same_image(scene, **parameters):
    expected = render(scene, "path", **parameters)
    image = render(scene, "glint_path", **parameters)
    assert np.any(expected > 0) or parameters.get("max_depth") == 0
    # Bit for bit in RGB and spectral variants; in mono the compiler contracts differently: 2e-7
    assert np.allclose(image, expected, rtol=1e-5, atol=1e-5)


@pytest.mark.parametrize(
    "parameters",
    [
        {},
        {"max_depth": 0},
        {"max_depth": 1},
        {"max_depth": 3},
        {"rr_depth": 1},
        {"hide_emitters": True},
    ],
    ids=str,
)
def test_equals_path_sample_by_sample(variant, parameters):
    """This is stronger than equality in expectation: the same random numbers give the same
    image."""
    assert_same_image(load_scene(), **parameters)


def test_equals_path_when_emitters_hide_others(variant):
    """Two lamps, one behind the other, and alpha where rays hit only lamps."""
    lamp = {"type": "rectangle", "emitter": {"type": "area", "radiance": 3.0}}
    scene = load_scene(
        front={**lamp, "to_world": transform().translate([1, -3, 1.5]).rotate([1, 0, 0], 90)},
        behind={**lamp, "to_world": transform().translate([1, -2.5, 1.5]).rotate([1, 0, 0], 90)},
    )
    assert_same_image(scene, hide_emitters=True, max_depth=4)


def test_equals_path_in_each_variant(each_variant):
    assert_same_image(load_scene(), max_depth=5, rr_depth=2)


def test_parameters(variant):
    assert "max_depth = 3" in str(mi.load_dict({"type": "glint_path", "max_depth": 3}))
    for name, value in (("max_depth", -2), ("rr_depth", 0)):
        with pytest.raises((ParameterError, RuntimeError), match=f'glint_path: "{name}" must be'):
            mi.load_dict({"type": "glint_path", name: value})
    with pytest.raises(
        RuntimeError, match='"max_dept" is not a parameter, did you mean "max_depth"'
    ):
        mi.load_dict({"type": "glint_path", "max_dept": 3})


@pytest.mark.parametrize("key", ["rough.bsdf.alpha.value", "lamp.emitter.radiance.value"])
def test_gradients_are_those_of_path(variant, key):
    """Reverse mode agrees with ``path`` for the same samples, and with forward mode."""
    scene = load_scene()
    parameters = mi.traverse(scene)

    def rendered(integrator):
        dr.enable_grad(parameters[key])
        dr.set_grad(parameters[key], 0)
        parameters.update()
        integrator = mi.load_dict({"type": integrator, "max_depth": 3})
        return mi.render(scene, parameters, integrator=integrator, spp=4, seed=1)

    def backward(integrator):
        dr.backward(dr.mean(rendered(integrator)))
        return dr.grad(parameters[key]).numpy()

    expected = backward("path")
    assert np.all(expected != 0)
    assert np.allclose(backward("glint_path"), expected, rtol=1e-4)

    image = rendered("glint_path")
    dr.forward(parameters[key])
    forward = dr.mean(dr.grad(image)).numpy()
    assert np.allclose(forward, expected.sum(), rtol=1e-3)


# ------------------------------------ Footprints ------------------------------------


def register_probe():
    """A BSDF that shows its input. A ray that leaves it towards an environment of radiance 1
    carries (x, y, 1), the components of ``quantity``: duv_dx, duv_dy or uv."""

    class Probe(mi.BSDF):
        def __init__(self, props):
            super().__init__(props)
            self.quantity = props["quantity"]
            self.m_components = [mi.BSDFFlags.DeltaReflection | mi.BSDFFlags.FrontSide]
            self.m_flags = self.m_components[0]

        def sample(self, ctx, si, sample1, sample2, active=True):
            bs = dr.zeros(mi.BSDFSample3f)
            bs.wo = mi.Vector3f(0, 0, 1)
            bs.pdf, bs.eta = 1, 1
            bs.sampled_type = mi.UInt32(+mi.BSDFFlags.DeltaReflection)
            value = getattr(si, self.quantity)
            return bs, mi.Color3f(value.x, value.y, 1)

        def eval(self, ctx, si, wo, active=True):
            return mi.Color3f(0)

        def pdf(self, ctx, si, wo, active=True):
            return mi.Float(0)

        def eval_pdf(self, ctx, si, wo, active=True):
            return mi.Color3f(0), mi.Float(0)

        def to_string(self):
            return f"Probe[{self.quantity}]"

    mi.register_bsdf("footprint_probe", lambda props: Probe(props))


def probe(shapes, ray, quantity, spp=1):
    """The values that ``glint_path`` passes to the BSDF of ``shapes["probe"]``, (N, 2), and where
    it does, (N,)."""
    register_probe()
    target = {**shapes["probe"], "bsdf": {"type": "footprint_probe", "quantity": quantity}}
    scene = mi.load_dict(
        {
            "type": "scene",
            **shapes,
            "probe": target,
            "sky": {"type": "constant"},
        }
    )
    sampler = mi.load_dict({"type": "independent", "sample_count": spp})
    sampler.seed(0, dr.width(ray))
    integrator = mi.load_dict({"type": "glint_path", "max_depth": 6})
    radiance, _, _ = integrator.sample(scene, sampler, ray, None, True)
    x, y, _ = np.array(radiance)
    return np.stack([x, y], axis=-1)


def partials(shapes, ray, spp=1):
    """UV partials (N, 2, 2), with the columns duv_dx and duv_dy."""
    return np.stack([probe(shapes, ray, f"duv_d{axis}", spp) for axis in "xy"], axis=-1)


def traced_partials(shapes, ray):
    """UV partials from traced neighbouring rays (central differences)."""

    def uv_at(offset_o, offset_d):
        moved = mi.Ray3f(ray.o + offset_o, dr.normalize(ray.d + offset_d))
        return probe(shapes, mi.RayDifferential3f(moved), "uv")

    offsets = [(ray.o_x - ray.o, ray.d_x - ray.d), (ray.o_y - ray.o, ray.d_y - ray.d)]
    return np.stack([(uv_at(o, d) - uv_at(-o, -d)) / 2 for o, d in offsets], axis=-1)


def sensor_rays(count):
    """Rays of a tilted camera above the origin, with the differentials of one pixel of 512²."""
    sensor = mi.load_dict(
        {
            "type": "perspective",
            "fov": 25,
            "near_clip": 1e-4,
            "to_world": transform().look_at([0.3, -2, 5], [0, 0, 0], [0, 1, 0.2]),
            "film": {"type": "hdrfilm", "width": 512, "height": 512},
        }
    )
    position = np.random.default_rng(11).uniform(0.45, 0.55, (2, count)).astype(np.float32)
    return sensor.sample_ray_differential(0.0, 0.5, mi.Point2f(position), mi.Point2f(0.5))[0]


def errors(actual, expected):
    """Largest error of a matrix entry, relative to the largest entry, for each ray that arrived."""
    scale = np.abs(expected).max(axis=(1, 2))
    arrived = (scale > 0) & (np.abs(actual).max(axis=(1, 2)) > 0)
    assert arrived.mean() > 0.5
    return np.abs(actual - expected)[arrived].max(axis=(1, 2)) / scale[arrived]


def tilted(angle_x, angle_y):
    return transform().rotate([1, 0, 0], angle_x).rotate([0, 1, 0], angle_y)


def overhead():
    """A large square above camera and mirrors, facing down."""
    return {
        "type": "rectangle",
        "to_world": transform().translate([0, 0, 7]) @ tilted(170, 10).scale(20),
    }


def bumpy_mesh(with_uv=True):
    """A smoothly shaded height field z = 0.2 cos 2x + 0.1 sin 3y over [-1, 1]², 64² quads."""
    count = 65
    x, y = (g.ravel() for g in np.meshgrid(*[np.linspace(-1, 1, count)] * 2))
    position = np.stack([x, y, 0.2 * np.cos(2 * x) + 0.1 * np.sin(3 * y)], -1)
    normal = np.stack([0.4 * np.sin(2 * x), -0.3 * np.cos(3 * y), np.ones_like(x)], -1)
    normal /= np.linalg.norm(normal, axis=-1, keepdims=True)
    corner = (np.arange(count - 1)[:, None] * count + np.arange(count - 1)).ravel()
    quad = corner[:, None] + np.array([0, 1, count, count + 1])
    faces = np.concatenate([quad[:, [0, 1, 2]], quad[:, [3, 2, 1]]])

    properties = mi.Properties()
    properties["bsdf"] = mi.load_dict({"type": "conductor"})
    mesh = mi.Mesh(
        "bumpy",
        len(position),
        len(faces),
        has_vertex_normals=True,
        has_vertex_texcoords=with_uv,
        props=properties,
    )
    parameters = mi.traverse(mesh)
    parameters["vertex_positions"] = position.ravel().astype(np.float32)
    parameters["vertex_normals"] = normal.ravel().astype(np.float32)
    if with_uv:
        parameters["vertex_texcoords"] = np.stack([x, y], -1).ravel().astype(np.float32)
    parameters["faces"] = faces.ravel().astype(np.uint32)
    parameters.update()
    return mesh


@pytest.mark.parametrize("shape", ["rectangle", "sphere"])
def test_first_hit_is_exact(variant, shape):
    """On an oblique plane and on a sphere, it equals compute_uv_partials."""
    shapes = {"probe": {"type": shape, "to_world": tilted(40, 30).scale(1.5)}}
    ray = sensor_rays(200)
    scene = mi.load_dict({"type": "scene", **shapes})
    si = scene.ray_intersect(ray)
    si.compute_uv_partials(ray)
    expected = np.stack([np.array(si.duv_dx).T, np.array(si.duv_dy).T], axis=-1)
    # Another kernel, other rounding of the differences: 1e-4 measured
    assert errors(partials(shapes, ray), expected).max() < 1e-3


@pytest.mark.parametrize("bounce", ["plane", "sphere", "cylinder", "mesh", "slab", "lens", "null"])
def test_footprint_behind_a_bounce(variant, bounce):
    """It agrees with traced neighbouring rays, for mirrors of every curvature, and for
    refraction."""
    mirror, glass = {"type": "conductor"}, {"type": "dielectric", "int_ior": 1.3}
    below = {
        "type": "rectangle",
        "to_world": transform().translate([0, 0, -1.5]) @ tilted(20, 10).scale(3),
    }
    tilt = tilted(25, 10)
    shapes = {
        "plane": {
            "bounce": {"type": "rectangle", "to_world": tilt.scale(2), "bsdf": mirror},
            "probe": overhead(),
        },
        "sphere": {
            "bounce": {"type": "sphere", "radius": 1.5, "bsdf": mirror},
            "probe": overhead(),
        },
        "cylinder": {
            "bounce": {
                "type": "cylinder",
                "p0": [-3, 0, 0],
                "p1": [3, 0.5, 0],
                "radius": 1.5,
                "bsdf": mirror,
            },
            "probe": overhead(),
        },
        "mesh": {"bounce": bumpy_mesh(), "probe": overhead()},
        "slab": {
            "bounce": {"type": "cube", "to_world": tilt.scale([2, 2, 0.4]), "bsdf": glass},
            "probe": below,
        },
        "lens": {"bounce": {"type": "sphere", "radius": 1, "bsdf": glass}, "probe": below},
        "null": {
            "bounce": {"type": "rectangle", "to_world": tilt, "bsdf": {"type": "null"}},
            "probe": below,
        },
    }[bounce]
    ray = sensor_rays(400)
    error = errors(partials(shapes, ray), traced_partials(shapes, ray))
    if bounce == "mesh":
        # It is exact on a facet (median 4e-4 measured), while neighbouring rays that hit another
        # facet find another plane (4e-2 measured).
        assert np.median(error) < 2e-3 and error.max() < 0.1
    else:
        assert error.max() < 1e-3  # 3e-4 measured: float32 differences of neighbouring rays


def test_footprint_behind_a_mesh_without_uv(variant):
    """A mirror needs no UVs for its curvature."""
    shapes = {"bounce": bumpy_mesh(with_uv=False), "probe": overhead()}
    ray = sensor_rays(400)
    assert np.median(errors(partials(shapes, ray), traced_partials(shapes, ray))) < 2e-3


def test_footprint_behind_an_instance(variant):
    """An instanced mesh reflects like a flat one: the footprint is finite and has the right
    size."""
    group = {"type": "shapegroup", "mesh": bumpy_mesh()}
    shapes = {
        "group": group,
        "probe": overhead(),
        "bounce": {
            "type": "instance",
            "to_world": transform().scale(2),
            "group": {"type": "ref", "id": "group"},
        },
    }
    result = partials(shapes, sensor_rays(100))
    flat = partials(
        {"bounce": {"type": "rectangle", "bsdf": {"type": "conductor"}}, "probe": overhead()},
        sensor_rays(100),
    )
    ratio = np.sqrt(np.abs(np.linalg.det(result) / np.linalg.det(flat)))
    assert np.all((ratio > 0.5) & (ratio < 2))


def test_sensor_without_differentials(variant):
    """The cone has no width, and a mirror does not change this."""
    ray = sensor_rays(50)
    ray.has_differentials = False
    mirror = {"type": "rectangle", "to_world": tilted(25, 10), "bsdf": {"type": "conductor"}}
    assert np.all(partials({"probe": {"type": "rectangle"}}, ray) == 0)
    shapes = {"bounce": mirror, "probe": overhead()}
    assert np.any(probe(shapes, ray, "uv") != 0) and np.all(partials(shapes, ray) == 0)


@pytest.mark.parametrize("spp", [25, 10_000])
def test_lobe_spreads_the_cone(variant, spp):
    """After a diffuse bounce, a footprint covers the solid angle 1/(N pdf), with pdf = cosθ/π."""
    count, height, scale = 500, 2.0, 30.0
    ray = mi.RayDifferential3f(mi.Ray3f(dr.zeros(mi.Point3f, count) + [0, 0, 1], [0, 0, -1]))
    shapes = {
        "bounce": {"type": "rectangle", "bsdf": {"type": "diffuse", "reflectance": 1.0}},
        "probe": {
            "type": "rectangle",
            "to_world": transform().translate([0, 0, height]).rotate([1, 0, 0], 180).scale(scale),
        },
    }
    offset = (probe(shapes, ray, "uv", spp) - 0.5) * 2 * scale
    squared_distance = height**2 + (offset**2).sum(axis=1)
    cosine = height / np.sqrt(squared_distance)
    uncapped = (cosine > 0.6) & (squared_distance < 1e3)  # below 1/2 the hemisphere is the limit
    assert uncapped.sum() > 100

    solid_angle = np.pi / (spp * cosine)
    expected = solid_angle * squared_distance / cosine / (2 * scale) ** 2
    area = np.abs(np.linalg.det(partials(shapes, ray, spp)))
    # 5e-5 measured, from reading the direction back out of float32 UVs
    assert np.allclose(area[uncapped], expected[uncapped], rtol=2e-4)


def test_widening_adds_to_every_axis(variant):
    """``widened`` with a cone of any shape and orientation: the widths add at a distance."""
    rng = np.random.default_rng(5)
    d, a, b = (mi.Vector3f(rng.normal(size=(3, 200)).astype(np.float32)) for _ in range(3))
    d = dr.normalize(d)
    a, b = (v - d * dr.dot(d, v) for v in (a, b))
    zero = mi.Vector3f(0)
    cone = RayCone(a, b, zero, zero).widened(d, mi.Float(0.5))
    x, y = np.array(cone.dd_x), np.array(cone.dd_y)
    assert np.allclose((x * x).sum(0), 0.25, rtol=1e-5)
    assert np.allclose((x * y).sum(0), 0, atol=1e-6)
    assert np.allclose((x * np.array(d)).sum(0), 0, atol=1e-6)

    def singular_values(cone, t):
        axes = np.stack([np.array(cone.dp_x + cone.dd_x * t), np.array(cone.dp_y + cone.dd_y * t)])
        return np.linalg.svd(np.moveaxis(axes, 2, 0), compute_uv=False)

    near, far = singular_values(cone, 0.0), singular_values(cone, 4.0)
    assert np.allclose(far, near + 4.0 * 0.5, rtol=1e-5)


def test_lobe_width(variant):
    """The side of a square of solid angle 1/(N pdf), and at most that of the hemisphere."""
    width = lobe_width(mi.Float(4.0, 1e-9, 0.0), 25)
    assert np.allclose(width.numpy(), np.sqrt([1 / 100, 2 * np.pi / 25, 2 * np.pi / 25]))
