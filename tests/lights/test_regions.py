"""Bright regions of environments: where they are, what they emit, and images lit by them."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest

from glintbsdf.lights.regions import (
    MAX_REGIONS,
    BrightRegions,
    Region,
    find_regions,
    samples_of,
)
from glintbsdf.lights.small import SmallLights
from tests.plugins.test_glint_path_convergence import assert_same_mean, glints, images, transform

# ------------------------------------------------------------------------------------------------
#  Finding regions among samples
# ------------------------------------------------------------------------------------------------


def unit(*d):
    return np.array(d) / np.linalg.norm(d)


def frame(d):
    x = unit(*np.cross(d, [0.3, 0.5, -0.2]))
    return x, np.cross(d, x)


def spot(rng, d, a, b, count):
    """Uniform directions in an ellipse with half axes a and b about d, and its solid angle."""
    x, y = frame(d)
    radius, angle = np.sqrt(rng.random(count)), 2 * np.pi * rng.random(count)
    p, q = a * radius * np.cos(angle), b * radius * np.sin(angle)
    z = np.sqrt(1 - p * p - q * q)
    directions = p[:, None] * x + q[:, None] * y + z[:, None] * d
    return directions, np.pi * a * b / z / count


def environment(spots, sky=1.0, count=4000):
    """Samples of a uniform sky and of ``spots`` (direction, half axes, radiance)."""
    rng = np.random.default_rng(5)
    sphere = rng.standard_normal((count, 3))
    parts = [(sphere / np.linalg.norm(sphere, axis=1)[:, None], sky, 4 * np.pi / count)]
    for d, a, b, radiance in spots:
        directions, solid_angle = spot(rng, d, a, b, count)
        parts.append((directions, radiance, solid_angle))
    directions = np.concatenate([part[0] for part in parts])
    radiance, solid_angle = (
        np.concatenate([np.broadcast_to(part[k], len(part[0])) for part in parts]) for k in (1, 2)
    )
    return directions, radiance, solid_angle


SUN, LAMP = unit(1, 2, 0.5), unit(-1, 0.3, 2)


def test_ellipses():
    """Two uniform ellipses: centres, axes and variances, a²/4 and b²/4."""
    found = find_regions(*environment([(SUN, 0.005, 0.005, 1e6), (LAMP, 0.2, 0.06, 2000.0)]))
    assert len(found) == 2
    for region, d, a, b in zip(found, (SUN, LAMP), (0.005, 0.2), (0.005, 0.06), strict=True):
        assert region.elliptic
        assert np.allclose(region.axes @ region.axes.T, np.eye(3), atol=1e-12)
        assert np.linalg.norm(region.axes[2] - d) < 0.05 * b
        assert np.allclose(np.sort(region.variances), np.sort([a * a, b * b]) / 4, rtol=0.05)
        inside = spot(np.random.default_rng(6), d, a, b, 1000)[0]
        assert region.contains(inside).mean() > 0.98
        assert not region.contains(-inside).any()
    assert abs(found[1].axes[np.argmax(found[1].variances)] @ frame(LAMP)[0]) > 0.999


def test_a_sun_without_its_halo():
    """A sun in a halo, and this in a bright cloud: the sun is a region of its own."""
    layers = [(SUN, 0.3, 0.3, 100.0), (SUN, 0.03, 0.03, 2e3), (SUN, 0.005, 0.005, 1e6)]
    found = find_regions(*environment(layers))
    assert np.allclose(found[0].variances, 0.005**2 / 4, rtol=0.05)


def test_a_rectangle_is_not_elliptic():
    rng = np.random.default_rng(7)
    x, y = frame(SUN)
    p = rng.uniform(-0.05, 0.05, (2, 8000))
    d = SUN + p[0][:, None] * x + p[1][:, None] * y
    d /= np.linalg.norm(d, axis=1)[:, None]
    sky = environment([])
    light = d, np.full(8000, 1e5), np.full(8000, 0.01 / 8000)
    (region,) = find_regions(*(np.concatenate(pair) for pair in zip(sky, light, strict=True)))
    assert not region.elliptic
    assert np.allclose(region.variances, 0.05**2 / 3, rtol=0.05)


def sphere_of_spots(count):
    """``count`` directions all around (Fibonacci)."""
    z = 1 - 2 * (np.arange(count) + 0.5) / count
    angle = np.arange(count) * np.pi * (3 - np.sqrt(5))
    r = np.sqrt(1 - z * z)
    return np.column_stack([r * np.cos(angle), r * np.sin(angle), z])


@pytest.mark.parametrize(("count", "expected"), [(1, 1), (12, 12), (40, 0), (1000, 0)])
def test_many_lights(count, expected):
    """A few lights are regions. Of many, each makes too little of the noise to be worth one."""
    lights = [(d, 0.01, 0.01, 1e4) for d in sphere_of_spots(count)]
    assert len(find_regions(*environment(lights, count=16000 // count + 10))) == (
        0 if 16000 // count + 10 < 32 else expected
    )
    assert expected <= MAX_REGIONS


def test_environments_without_regions():
    nothing = np.empty((0, 3)), np.empty(0), np.empty(0)
    assert find_regions(*nothing) == []
    assert find_regions(*environment([])) == []
    assert find_regions(*environment([(SUN, 0.3, 0.3, 8.0)])) == []  # a softbox
    assert find_regions(*environment([(SUN, 0.9, 0.9, 1.0)], sky=1e-4)) == []  # half of the sky
    assert find_regions(SUN[None], np.array([9.0]), np.array([1e-3])) == []  # one sample
    same = np.tile(SUN, (500, 1)), np.full(500, 9.0), np.full(500, 1e-6)
    for region in find_regions(*same):  # one direction
        assert np.isfinite(region.axes).all() and (region.half_axes >= 1e-4).all()


# ------------------------------------------------------------------------------------------------
#  Environments of Mitsuba
# ------------------------------------------------------------------------------------------------


def sky(direction=(0.1, 0.2, 1), **parameters):
    """A sun of 5 degrees in a sky, as seen by :func:`glints`, whose zenith is z."""
    return {
        "type": "sunsky",
        "sun_direction": list(direction),
        "sun_aperture": 10.0,
        **parameters,
    }


def studio(rotation=0.0, size=64, **parameters):
    """A map with a sun of a few texels, a lamp of a single one, and a dim sky; the sun is above
    the plate of :func:`glints`."""
    rng = np.random.default_rng(3)
    data = rng.uniform(0.1, 0.3, (size, 2 * size, 3)).astype(np.float32)
    data[size // 2 - 1 : size // 2 + 2, size - 1 : size + 2] = (400, 300, 200)
    data[size // 3, size + 9] = 500
    to_world = transform().rotate([0, 0, 1], rotation)
    return {"type": "envmap", "bitmap": mi.Bitmap(data), "to_world": to_world, **parameters}


def lights_of(environment):
    scene = glints(sky=environment)
    return scene, SmallLights(scene).regions


def test_the_sun_of_sunsky(variant):
    """Its direction and its aperture."""
    found = find_regions(*samples_of(mi.load_dict(sky())))
    assert len(found) == 1 and found[0].elliptic
    assert np.linalg.norm(found[0].axes[2] - unit(0.1, 0.2, 1)) < 5e-3
    assert np.allclose(found[0].variances, np.sin(np.radians(5)) ** 2 / 4, rtol=0.1)


def test_moved_maps(variant):
    """Regions turn with the map. Its scale and the observer's place change nothing."""
    regions = [
        find_regions(*samples_of(mi.load_dict(studio(rotation, scale=scale))))
        for rotation, scale in ((0, 1.0), (0, 50.0), (40, 0.01))
    ]
    assert [len(found) for found in regions] == [2, 2, 2]
    turn = np.array(transform().rotate([0, 0, 1], 40).matrix)[:3, :3]
    for one, scaled, turned in zip(*regions, strict=True):
        assert np.allclose(one.half_axes, scaled.half_axes, rtol=1e-3)
        assert np.allclose(one.axes[2], scaled.axes[2], atol=1e-4)
        assert np.allclose(turn @ one.axes[2], turned.axes[2], atol=1e-4)
        assert np.allclose(one.half_axes, turned.half_axes, rtol=1e-2)


def black(size=(4, 8)):
    return {"type": "envmap", "bitmap": mi.Bitmap(np.zeros((*size, 3), np.float32))}


def few_texels():
    """The smallest map that Mitsuba allows, with one bright texel."""
    data = np.zeros((3, 2, 3), np.float32)
    data[1, 0] = 1000
    return {"type": "envmap", "bitmap": mi.Bitmap(data)}


def many_texels():
    data = np.random.default_rng(4).random((64, 128, 1)).astype(np.float32)
    data = np.repeat(np.where(data > 0.5, 1000.0, 0.01), 3, axis=-1).astype(np.float32)
    return {"type": "envmap", "bitmap": mi.Bitmap(data)}


@pytest.mark.parametrize(
    "environment",
    [{"type": "constant", "radiance": 0.0}, {"type": "constant"}, black, few_texels, many_texels],
    ids=["dark", "constant", "black", "few texels", "many texels"],
)
def test_poor_environments(variant, environment):
    """They have no regions, and their images are finite."""
    scene, regions = lights_of(environment() if callable(environment) else environment)
    assert regions is None
    assert np.isfinite(images(scene, "glint_path", 4, 1, max_depth=2)).all()


def test_lights_of_no_use(variant):
    """An environment that is never sampled, and lights that are not integrated."""
    never = glints(sky=studio(sampling_weight=0.0), light={"type": "point"})
    assert SmallLights(never).regions is None
    scene, regions = lights_of(studio())
    assert regions is not None
    assert SmallLights(scene, extents=False).regions is None
    assert SmallLights(scene, every=False).regions is None


# ------------------------------------------------------------------------------------------------
#  What regions emit
# ------------------------------------------------------------------------------------------------


def random_numbers(count, dimensions=2, seed=1):
    return np.random.default_rng(seed).random((dimensions, count), dtype=np.float32)


def from_regions(regions, count=200_000):
    """Samples of each region."""
    it = dr.zeros(mi.Interaction3f)
    for k in range(int(regions.count[0])):
        yield regions.sample_direction(
            mi.UInt32(k), it, mi.Point2f(random_numbers(count, seed=k)), mi.Bool(True)
        )


def assert_close(values, expected, sigmas=4.5, error=0.0):
    error = np.hypot(error, values.std() / np.sqrt(len(values)))
    assert abs(values.mean() - expected) < sigmas * error


@pytest.mark.parametrize("environment", [sky, studio], ids=["sky", "map"])
def test_regions_and_the_rest_are_the_whole(variant, environment):
    """Light from regions is what is missing when their directions are dropped from samples of the
    emitter, and all their samples are inside."""
    scene, regions = lights_of(environment())
    random = mi.Point2f(random_numbers(400_000, seed=9))
    ds, weight = scene.environment().sample_direction(dr.zeros(mi.Interaction3f), random)
    dropped = np.where(np.array(regions.contain(ds.d)), np.array(weight).mean(0), 0)
    whole = np.array(weight).mean()
    total, variance = 0.0, 0.0
    for ds, weight in from_regions(regions):
        assert np.array(regions.contain(ds.d)).mean() > 0.9999
        weight = np.array(weight).mean(0)
        total, variance = total + weight.mean(), variance + weight.var() / len(weight)
    assert 0.2 * whole < total < whole
    assert_close(dropped, total, error=np.sqrt(variance))


def test_density_of_samples(variant):
    """The mean of 1/density is the solid angle that a uniform sphere of directions finds."""
    _, regions = lights_of(sky(sun_aperture=40.0))
    ((ds, _),) = from_regions(regions)
    sphere = mi.warp.square_to_uniform_sphere(mi.Point2f(random_numbers(1_000_000, seed=2)))
    share = np.array(regions.contain(sphere)).mean()
    error = 4 * np.pi * np.sqrt(share / 1_000_000)
    assert_close(1 / np.array(ds.pdf, np.float64), 4 * np.pi * share, error=error)


def test_overlapping_regions(variant):
    """What is in two regions counts once."""
    scene = glints(sky={"type": "constant", "radiance": 2.0})
    pair = []
    for angle in (0.0, 0.3):
        axes = np.array([[np.cos(angle), 0, -np.sin(angle)], [0, 1, 0]])
        axes = np.array([*axes, np.cross(*axes)])
        pair.append(Region(axes, np.array([0.3, 0.2]), np.array([0.02, 0.01]), True))
    regions = BrightRegions(scene, scene.emitters_dr(), pair)
    total = [np.array(weight)[0] for _, weight in from_regions(regions)]
    sphere = mi.warp.square_to_uniform_sphere(mi.Point2f(random_numbers(1_000_000, seed=2)))
    share = np.array(regions.contain(sphere)).mean()
    assert share > 1.3 * 0.25 * 0.3 * 0.2
    error = 8 * np.pi * np.sqrt(share / 1_000_000)
    assert_close(sum(total), 8 * np.pi * share, error=error)


# ------------------------------------------------------------------------------------------------
#  Images
# ------------------------------------------------------------------------------------------------


def screen():
    return {
        "screen": {
            "type": "rectangle",
            "to_world": transform().translate([1, 0, 3]).scale([1, 3, 1]),
            "bsdf": {"type": "twosided", "bsdf": {"type": "diffuse", "reflectance": 0.2}},
        }
    }


def varnished():
    """A second plate, whose BSDF integrates lights only in part."""
    return {
        "board": {
            "type": "rectangle",
            "to_world": transform().translate([1.5, 0, 0.1]),
            "bsdf": {
                "type": "blendbsdf",
                "weight": 0.5,
                "one": {"type": "diffuse"},
                "other": {"type": "glint_particles"},
            },
        },
        "ball": {"type": "sphere", "radius": 0.3, "bsdf": {"type": "diffuse"}},
    }


@pytest.mark.parametrize(
    ("environment", "others"),
    [(sky, dict), (sky, screen), (studio, varnished)],
    ids=["sky", "occluded sky", "map and other materials"],
)
def test_mean_is_that_of_path(variant, environment, others):
    """Nothing counts twice, and nothing is lost; and there is less noise than without regions."""
    scene = glints(sky=environment(), **others())
    found = images(scene, "glint_path", 32, 8, max_depth=3)
    assert_same_mean(found, images(scene, "path", 256, 8, max_depth=3), bias=0.01)
    alone = images(scene, "glint_path", 32, 8, max_depth=3, light_share=0)
    assert found.var(0, ddof=1).mean() < 0.3 * alone.var(0, ddof=1).mean()


def test_separate(variant):
    """Direct and indirect light add up to the same image."""
    scene = glints(sky=sky(), **screen())
    separate = images(scene, "glint_path", 32, 6, max_depth=2, separate=True)
    whole = images(scene, "glint_path", 32, 6, max_depth=2)
    assert_same_mean(separate[..., :3], whole)


def test_each_variant(each_variant):
    """Monochromatic, spectral and polarised colours."""
    scene = glints(sky=studio())
    assert SmallLights(scene).regions is not None
    found = images(scene, "glint_path", 16, 6, max_depth=2, light_share=1)
    expected = images(scene, "path", 128, 6, max_depth=2)
    assert_same_mean(found, expected, bias=0.01)


def test_derivative_by_the_scale_of_a_map(variant):
    """The image is proportional to it."""
    scene = glints(sky=studio())
    parameters = mi.traverse(scene)
    integrator = mi.load_dict({"type": "glint_path", "max_depth": 2})
    expected = mi.render(scene, integrator=integrator, spp=4, seed=2).numpy()
    scale = mi.Float(1)
    dr.enable_grad(scale)
    parameters["sky.scale"] = scale
    parameters.update()
    image = mi.render(scene, parameters, integrator=integrator, spp=4, seed=1, seed_grad=2)
    dr.forward(scale)
    assert np.allclose(dr.grad(image), expected, rtol=1e-3, atol=1e-4 * expected.max())


@pytest.mark.parametrize("case", ["rough", "shares"])
def test_scenes_without_need_look_for_none(variant, monkeypatch, case):
    """Without BSDFs that integrate lights, environments are not searched for regions."""

    def fails(*_):
        raise AssertionError("searched")

    monkeypatch.setattr("glintbsdf.lights.small.find_regions", fails)
    ball = {"type": "sphere", "bsdf": {"type": "roughconductor"}}
    sensor = glints().sensors()[0]
    scene = glints(sky=studio()) if case == "shares" else None
    if scene is None:
        scene = mi.load_dict({"type": "scene", "ball": ball, "sky": studio(), "sensor": sensor})
    share = 0 if case == "shares" else "auto"
    assert images(scene, "glint_path", 1, 1, max_depth=2, light_share=share).max() > 0
