"""``glint_path``: footprints and samples share the pixel's filter, and every small light is sampled
at every hit.

In expectation, images equal those of ``path``, which does neither.
"""

from __future__ import annotations

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest

from glintbsdf.core.errors import ParameterError
from glintbsdf.footprint.pixel_filter import PixelFilter, automatic_share
from glintbsdf.lights.small import MAX_SAMPLED, SmallLights, automatic_shares
from glintbsdf.maps import procedural
from glintbsdf.scene import passes, rendering

FILTERS = ("gaussian", "box", "tent", "mitchell")


def transform():
    return mi.ScalarTransform4f()


def sensor(rfilter="gaussian", size=(12, 8), **film):
    return {
        "type": "perspective",
        "fov": 20,
        "to_world": transform().look_at([0, 0, 5], [0, 0, 0], [0, 1, 0]),
        "film": {
            "type": "hdrfilm",
            "width": size[0],
            "height": size[1],
            "rfilter": {"type": rfilter},
            **film,
        },
        "sampler": {"type": "independent", "sample_count": 16},
    }


def board(**sensor_parameters):
    """A checkerboard that emits light, finer than pixels: only the filter makes a difference."""
    squares = {"type": "checkerboard", "to_uv": transform().scale([11, 11, 1])}
    board = {"type": "rectangle", "emitter": {"type": "area", "radiance": squares}}
    return mi.load_dict({"type": "scene", "board": board, "sensor": sensor(**sensor_parameters)})


def glints(sigma_r=0.05, **nodes):
    """A square with small glints of a rough map: several elements are under a pixel."""
    normals = procedural.isotropic(64, seed=3).normals
    z = np.sqrt(1 - (normals**2).sum(-1, keepdims=True))
    data = mi.TensorXf(np.concatenate([normals, z], -1).astype(np.float32))
    return mi.load_dict(
        {
            "type": "scene",
            "sensor": sensor(),
            "plate": {
                "type": "rectangle",
                "to_world": transform().scale(3),
                "bsdf": {
                    "type": "glint_elements",
                    "data": data,
                    "map_type": "normal",
                    "sigma_r": sigma_r,
                    "to_uv": transform().scale([3, 3, 1]),
                    "masking": "none",
                },
            },
            **nodes,
        }
    )


def ball_light(position=(0, 0, 8), radius=0.5, radiance=30.0):
    return {
        "type": "sphere",
        "center": list(position),
        "radius": radius,
        "emitter": {"type": "area", "radiance": radiance},
    }


def images(scene, integrator, spp, count, **parameters):
    integrator = mi.load_dict({"type": integrator, **parameters})
    return np.array(
        [mi.render(scene, integrator=integrator, spp=spp, seed=k).numpy() for k in range(count)]
    )


def assert_same_mean(a, b, sigmas=4.5, of_image=True, bias=0.0):
    """Images (N, …) with the same expectation: their means agree within a number of standard errors
    and a relative ``bias``, over the whole image without its border, or pixel by pixel."""
    if of_image:
        a, b = (x[:, 2:-2, 2:-2].reshape(len(x), -1).mean(1) for x in (a, b))
    error = np.sqrt(sum(x.var(0, ddof=1) / len(x) for x in (a, b)))
    difference = np.abs(a.mean(0) - b.mean(0))
    scale = np.abs(b.mean(0)).max()
    assert scale > 0
    assert np.all(difference < sigmas * error + (1e-5 + bias) * scale), (
        a.mean(0),
        b.mean(0),
        error,
    )


# ------------------------------------------------------------------------------------------------
#  The pixel's filter
# ------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("name", (*FILTERS, "catmullrom", "lanczos"))
def test_samples_of_a_filter(variant, name):
    """Moments of weighted samples are those of the filter, with its negative lobes."""
    rfilter = mi.load_dict({"type": name})
    found = PixelFilter(rfilter)
    x = np.linspace(-rfilter.radius(), rfilter.radius(), 200_001)
    profile = np.array(rfilter.eval(mi.Float(x.astype(np.float32))), np.float64)
    profile /= profile.sum()
    assert abs(found.variance - (profile * x * x).sum()) < 1e-3
    random = np.random.default_rng(1).random((2, 400_000), dtype=np.float32)
    offset, sign = (np.array(v) for v in found.sample(mi.Point2f(random)))
    sign = np.broadcast_to(sign, offset.shape[1:])
    for power in (0, 2, 4):
        value = sign * offset[0] ** power
        expected = (profile * x**power).sum() * found.weight**2
        assert abs(value.mean() - expected) < 5 * value.std() / np.sqrt(value.size) + 1e-3


@pytest.mark.parametrize("rfilter", FILTERS)
def test_without_footprints_the_filter_is_that_of_the_film(variant, rfilter):
    """With a share of 0, the image equals that of ``path`` pixel by pixel."""
    scene = board(rfilter=rfilter)
    assert_same_mean(
        images(scene, "glint_path", 64, 24, pixel_share=0),
        images(scene, "path", 64, 24),
        of_image=False,
    )


@pytest.mark.parametrize("film", [{"crop_offset_x": 3, "crop_offset_y": 2, "crop_width": 5}, {}])
def test_crops_alpha_and_further_channels(variant, film):
    crop = {**film, "crop_height": 4} if film else {}
    scene = board(pixel_format="rgba", **crop)
    for parameters in ({"separate": True}, {"hide_emitters": True}):
        a = images(scene, "glint_path", 64, 8, pixel_share=0, **parameters)
        b = images(scene, "glint_path", 64, 8, pixel_share="auto", **parameters)
        assert a.shape == b.shape and a.shape[-1] == (10 if "separate" in parameters else 4)
        if "separate" in parameters:
            assert np.allclose(a[..., :3], a[..., 4:7] + a[..., 7:], rtol=1e-5, atol=1e-5)
            assert_same_mean(a, b, of_image=False)
        else:
            assert np.all(a == 0)


def test_each_variant(each_variant):
    """Monochromatic, spectral and polarised colours."""
    scene = board()
    assert_same_mean(
        images(scene, "glint_path", 64, 6, pixel_share=0), images(scene, "path", 64, 6)
    )


@pytest.mark.parametrize("sampler", ["stratified", "multijitter", "ldsampler"])
def test_samplers(variant, sampler):
    scene = board()
    expected = images(scene, "path", 64, 16)
    scene.sensors()[0].sampler()
    other = mi.load_dict(
        {
            "type": "scene",
            "board": {
                "type": "rectangle",
                "emitter": {
                    "type": "area",
                    "radiance": {"type": "checkerboard", "to_uv": transform().scale([11, 11, 1])},
                },
            },
            "sensor": {**sensor(), "sampler": {"type": sampler, "sample_count": 64}},
        }
    )
    assert_same_mean(
        images(other, "glint_path", 64, 16, pixel_share=0), expected, 5, of_image=False
    )


def test_low_discrepancy_converges_faster(variant):
    """16 samples per pixel leave no gaps: their variance is less than half of that of random
    samples."""
    scene = board()

    def variance(spp):
        return images(scene, "glint_path", spp, 12, pixel_share=0).var(0, ddof=1).mean()

    assert variance(64) < 0.5 * variance(1) / 64


def test_one_sample_of_the_whole_filter_has_no_noise(variant):
    """One sample per pixel, the whole filter in the footprint, and a point light: nothing is
    random."""
    scene = glints(light={"type": "point", "position": [0.1, 0.2, 8], "intensity": 100.0})
    found = images(scene, "glint_path", 1, 3, max_depth=2)
    assert found.max() > 0
    assert np.allclose(found[0], found[1], rtol=1e-4, atol=1e-5 * found.max())


@pytest.mark.parametrize("abrupt", [False, True])
def test_shares(abrupt):
    shares = [automatic_share(n, abrupt) for n in (1, 4, 16, 1024)]
    assert shares[0] == 1 and shares == sorted(shares, reverse=True) and shares[-1] > 1e-3


@pytest.mark.parametrize("name", ["gaussian", "box", "tent", "mitchell"])
def test_a_box_ends_abruptly(variant, name):
    assert PixelFilter(mi.load_dict({"type": name})).abrupt == (name == "box")


@pytest.mark.parametrize("name", ["pixel_share", "light_share"])
@pytest.mark.parametrize("value", [-0.1, 1.5, "all", True, float("nan")])
def test_bad_shares(variant, name, value):
    with pytest.raises((ParameterError, RuntimeError), match=f'glint_path: "{name}" must be auto'):
        mi.load_dict({"type": "glint_path", name: value})


def test_bad_choice_of_emitters(variant):
    with pytest.raises((ParameterError, RuntimeError), match='"emitters" must be one of all, one'):
        mi.load_dict({"type": "glint_path", "emitters": "some"})


def test_filters_without_variance_are_not_shared(variant):
    """If the filter has no variance to share, the film filters the image."""
    scene = board(rfilter="catmullrom")
    a = images(scene, "glint_path", 4, 1, pixel_share=0.5)
    assert np.allclose(a, images(scene, "path", 4, 1), rtol=1e-4, atol=1e-5)


def test_one_pass_or_sixteen(variant):
    """Footprints and positions of samples depend on the number of samples of the whole image."""
    scene = glints(light=ball_light(), integrator={"type": "glint_path", "max_depth": 2})
    camera = scene.sensors()[0]
    whole = passes.whole(camera.film())

    def rendered(spp, count, seed):
        total = 0
        with rendering.sharing(scene, camera, 16) as shared:
            for k in range(count):
                _, sums = passes.sums_of_samples(
                    scene, camera, scene.integrator(), whole, spp, 16, seed + k, shared
                )
                total = total + sums
        return total[..., :3] / total[..., 3:4]

    many = np.array([rendered(1, 16, 100 * k) for k in range(6)])
    one = np.array([rendered(16, 1, 100 * k + 77) for k in range(6)])
    assert_same_mean(many, one)
    expected = images(scene, "glint_path", 16, 1, max_depth=2)[0]
    assert np.allclose(rendered(16, 1, 0), expected, rtol=1e-3, atol=1e-4 * expected.max())


# ------------------------------------------------------------------------------------------------
#  Every light at every hit
# ------------------------------------------------------------------------------------------------


def many_lights(count):
    rng = np.random.default_rng(2)
    places = np.column_stack([rng.uniform(-3, 3, (count, 2)), rng.uniform(4, 8, count)])
    return {
        f"light{k}": ball_light(place, 0.3, 50.0 * (1 + k % 3) / count)
        for k, place in enumerate(places)
    }


def mixed_lights():
    """Lights of every kind: point, spot, directional, textured rectangle, disk, mesh,
    environment."""
    facing = transform().look_at([1, 1, 5], [0, 0, 0], [0, 1, 0])
    return {
        "point": {"type": "point", "position": [-1, 1, 4], "intensity": 20.0},
        "spot": {"type": "spot", "to_world": facing, "intensity": 30.0},
        "sun": {"type": "directional", "direction": [0.1, -0.1, -1], "irradiance": 2.0},
        "textured": {
            "type": "rectangle",
            "to_world": facing.scale(0.4),
            "emitter": {"type": "area", "radiance": {"type": "checkerboard", "color1": 60.0}},
        },
        "disk": {
            "type": "disk",
            "to_world": transform().look_at([-2, 0, 6], [0, 0, 0], [0, 1, 0]).scale(0.3),
            "emitter": {"type": "area", "radiance": 40.0},
        },
        "mesh": {
            "type": "cube",
            "to_world": transform().translate([0, 2, 6]).scale(0.2),
            "emitter": {"type": "area", "radiance": 30.0},
        },
        "sky": {"type": "constant", "radiance": 0.3},
    }


def window():
    """An environment with a window, too dim to be cut out as a light."""
    sky = np.full((16, 32, 3), 0.5, np.float32)
    sky[4:8, 8:16] = 5.0
    return {"type": "envmap", "bitmap": mi.Bitmap(sky)}


def lit_by(name):
    """Lights, and an obstacle in front of them."""
    return {
        "one": {"light": ball_light()},
        "many": many_lights(2 * MAX_SAMPLED),
        "mixed": mixed_lights(),
        "window": {"light": ball_light(), "sky": window()},
        "occluded": {
            "light": ball_light((0, 0, 8), 1.0),
            "screen": {
                "type": "rectangle",
                "to_world": transform().translate([1, 0, 6.5]).scale([1, 3, 1]),
                "bsdf": {"type": "twosided", "bsdf": {"type": "diffuse", "reflectance": 0.0}},
            },
        },
        "mirror": {
            "light": ball_light((0, 0, 8), 0.5),
            "glass": {
                "type": "rectangle",
                "to_world": transform().translate([2.5, 0, 2]).rotate([0, 1, 0], -90).scale(3),
                "bsdf": {"type": "conductor"},
            },
            "ball": {"type": "sphere", "radius": 0.3, "bsdf": {"type": "roughconductor"}},
        },
    }[name]


@pytest.mark.parametrize(
    ("name", "emitters"),
    [(name, "all") for name in ("one", "many", "mixed", "window", "occluded", "mirror")]
    + [("mixed", "one")],
)
def test_mean_is_that_of_path(variant, name, emitters):
    """For every kind of light, in shadow and in mirrors, the energy of the image is the same,
    except for the error of flat footprints."""
    scene = glints(**lit_by(name))
    depth = 4 if name == "mirror" else 3
    assert_same_mean(
        images(scene, "glint_path", 32, 8, max_depth=depth, emitters=emitters),
        images(scene, "path", 256, 8, max_depth=depth),
        bias=0.01,
    )


def test_each_light_of_a_few_is_sampled(variant):
    """With four lights, there is no noise from their choice."""
    scene = glints(
        **{f"l{k}": ball_light((2 * k - 3, 0, 8), 0.02, 1000.0 * 4.0**k) for k in range(4)}
    )
    all_, one = (
        images(scene, "glint_path", 16, 12, max_depth=2, emitters=emitters)
        for emitters in ("all", "one")
    )
    assert_same_mean(all_, one)
    assert all_.var(0, ddof=1).mean() < 0.25 * one.var(0, ddof=1).mean()


def test_thousands_of_emitters(variant):
    """The :data:`MAX_SAMPLED` most powerful emitters are sampled, and one of the others."""
    weak = {
        f"w{k}": {"type": "point", "position": [k, 0, 9], "intensity": 1.0} for k in range(2000)
    }
    scene = glints(
        **weak,
        strong=ball_light(),
        sky={"type": "constant"},
    )
    lights = SmallLights(scene)
    assert lights.sampled_count == MAX_SAMPLED and lights.others_count == 2002 - MAX_SAMPLED
    image = images(scene, "glint_path", 4, 1, max_depth=2)
    assert np.all(np.isfinite(image)) and image.max() > 0


def test_probabilities_of_emitters(variant):
    """It is 1 for emitters sampled at every hit; the others share a sum of 1 by their weights."""
    scene = glints(**many_lights(MAX_SAMPLED + 3), sky={"type": "constant", "sampling_weight": 2.0})
    lights = SmallLights(scene)
    p = dr.gather(mi.Float, lights.probability, lights.registry_index(scene.emitters_dr())).numpy()
    assert (p == 1).sum() == MAX_SAMPLED and abs(p[p < 1].sum() - 1) < 1e-6
    assert abs(p[p < 1].max() - 2 / 5) < 1e-6


def test_centre_and_variances_of_lights(variant):
    """Centre and variances of directions agree with points of the lights themselves."""
    scene = glints(
        a=ball_light((1, 2, 8), 0.5),
        b={
            "type": "rectangle",
            "to_world": transform().look_at([-2, 0, 6], [0, 0.5, 0], [0, 1, 0]).scale([1, 0.2, 1]),
            "emitter": {"type": "area", "radiance": 1.0},
        },
    )
    lights = SmallLights(scene)
    p = mi.Point3f(0.1, 0.2, 0)
    rng = np.random.default_rng(3)
    for emitter in scene.emitters():
        view = lights.view(mi.EmitterPtr(emitter), p)
        si = dr.zeros(mi.Interaction3f)
        si.p = p
        ds, weight = emitter.sample_direction(
            si, mi.Point2f(rng.random((2, 200_000), dtype=np.float32))
        )
        w = np.array(dr.rcp(ds.pdf))
        d = np.array(ds.d)
        mean = (d * w).sum(1) / w.sum()
        mean /= np.linalg.norm(mean)
        assert np.abs(mean - np.array(view.d).ravel()).max() < 5e-3
        for axis, variance in ((view.x, view.variance_x), (view.y, view.variance_y)):
            along = (np.array(axis).ravel()[:, None] * d).sum(0)
            found = (w * along**2).sum() / w.sum() - ((w * along).sum() / w.sum()) ** 2
            assert abs(found / variance.numpy()[0] - 1) < 0.05
        assert view.small.numpy()[0]
        spread = view.spread(0.5)
        e = np.array(view.contracted(ds.d, spread))
        along = (np.array(view.y).ravel()[:, None] * e).sum(0)
        left = (w * along**2).sum() / w.sum() - ((w * along).sum() / w.sum()) ** 2
        assert abs(left + spread.numpy()[0] - view.variance_y.numpy()[0]) < 0.06 * left


def test_shares_of_lights_fall(variant):
    """Of rectangles sooner than of spheres; all is sampled in the end."""
    plate = {"type": "rectangle", "emitter": {"type": "area"}}
    scene = glints(a=ball_light((0, 0, 3), 0.2), b={**plate})
    lights = SmallLights(scene)
    p = mi.Point3f(0, 0, -9)
    elliptic = [bool(lights.view(mi.EmitterPtr(e), p).elliptic[0]) for e in scene.emitters()]
    shapes = [emitter.get_shape().class_name() for emitter in scene.emitters()]
    assert elliptic == [shape == "Sphere" for shape in shapes] and True in elliptic
    assert not all(elliptic)
    shares = np.array([automatic_shares(samples) for samples in (1, 16, 64, 1024, 1 << 20)])
    assert (shares[:2] == 1).all() and (shares[:4, 0] == 1).all()
    assert (np.diff(shares[1:, 1]) < 0).all() and (shares[-1] < (0.2, 0.005)).all()


def test_lights_without_a_view(variant):
    """From inside a light, from its centre, for a light without extent, or too wide a light: it is
    not small, and has no spread."""
    scene = glints(a=ball_light((0, 0, 3), 2.9), b={"type": "point", "position": [0, 0, 3]})
    lights = SmallLights(scene)
    for z in (3.0, 2.0, 0.0):
        view = lights.view(scene.emitters_dr(), mi.Point3f(0, 0, z))
        assert np.all(np.array(view.spread(1.0)) == 0)
        assert np.all(np.isfinite(np.array(view.d)))
        d = mi.Vector3f(0, 0, 1)
        assert np.all(np.array(view.contracted(d, view.spread(1.0))) == np.array(d))


@pytest.mark.parametrize("name", ["paint", "rough"])
def test_who_keeps_samples_of_the_environment(variant, name):
    """Glints of a map find the environment by samples of the BSDF alone. Beside a diffuse lobe, and
    where facets are rough and cheap, emitter sampling goes on: without it, the variance under a
    window is 1.6 and 6.6 times as large."""
    data = mi.TensorXf(procedural.isotropic(16, seed=3).normals)
    elements = {"type": "glint_elements", "data": data, "masking": "none", "sigma_r": 0.05}
    paint = {"type": "blendbsdf", "weight": 0.1, "paint": {"type": "diffuse"}, "glints": elements}
    bsdf = {"paint": paint, "rough": {"type": "glint_filtered", "data": data, "alpha": 1.0}}[name]
    scene = mi.load_dict(
        {
            "type": "scene",
            "sensor": sensor(),
            "board": {"type": "rectangle", "to_world": transform().scale(3), "bsdf": bsdf},
            "sky": window(),
        }
    )

    def variance(**parameters):
        found = images(scene, "glint_path", 16, 12, max_depth=2, hide_emitters=True, **parameters)
        return found.var(0, ddof=1).mean()

    # "one" chooses the environment, the only emitter, and weights as usual.
    assert variance() < 1.1 * variance(emitters="one")
