"""Separated illumination: the smooth lobes of glint BSDFs, and the separate images of
``glint_path``."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest

from glintbsdf import NormalMap, maps
from glintbsdf.bridge.separation import SMOOTH_LOBES, asks_for_smooth_lobes, smooth_context
from glintbsdf.check import suite
from glintbsdf.core.errors import ParameterError

MAP = maps.brushed(64, alpha=0.2, streak_length=20, seed=3)
VIEW = suite.View(du=(0.01, 0), dv=(0, 0.02), wi=(0.4, -0.2, 1))


def manifold(**parameters) -> dict:
    return {"type": "glint_manifold", "data": mi.TensorXf(MAP.normals), **parameters}


def rough(normal_map: NormalMap = MAP, **parameters) -> dict:
    """Mitsuba's BSDF with the roughness of the whole map."""
    alpha_u, alpha_v = normal_map.roughness()
    return {"type": "roughconductor", "alpha_u": alpha_u, "alpha_v": alpha_v, **parameters}


def textured(channels: int) -> dict:
    values = np.random.default_rng(1).uniform(0.4, 0.6, (16, 16, channels)).astype(np.float32)
    values[..., 2:] = 1  # normals that point up
    return {"type": "bitmap", "bitmap": mi.Bitmap(values), "raw": True}


def wrapped(name: str, bsdf: dict) -> dict:
    return {
        "itself": lambda: bsdf,
        "twosided": lambda: {"type": "twosided", "nested": bsdf},
        "blendbsdf": lambda: {
            "type": "blendbsdf",
            "weight": 0.3,
            "first": {"type": "diffuse"},
            "second": bsdf,
        },
        "mask": lambda: {"type": "mask", "opacity": 0.6, "nested": bsdf},
        "bumpmap": lambda: {
            "type": "bumpmap",
            "texture": textured(1),
            "scale": 0.02,
            "nested": bsdf,
        },
        "normalmap": lambda: {"type": "normalmap", "normalmap": textured(3), "nested": bsdf},
        "all": lambda: wrapped("twosided", wrapped("bumpmap", wrapped("blendbsdf", bsdf))),
    }[name]()


def everything(bsdf: dict, ctx: mi.BSDFContext, view: suite.View = VIEW) -> list[np.ndarray]:
    """Direction, density and weight of samples, zero if they are invalid; and value and density for
    other directions."""
    bsdf = mi.load_dict(bsdf)
    u = suite.random_numbers(500, 5, seed=2)
    si = view.interaction(500)
    bs, weight = bsdf.sample(ctx, si, u[0], mi.Point2f(u[1], u[2]))
    value, pdf = bsdf.eval_pdf(ctx, si, mi.warp.square_to_uniform_hemisphere(mi.Point2f(*u[3:])))
    weight, value = suite.intensity(weight), suite.intensity(value)
    valid = dr.any(weight > 0)
    sampled = [dr.select(valid, x, 0) for x in (bs.wo, bs.pdf, weight)]
    return [np.array(x) for x in (*sampled, value, pdf)]


def assert_same(ours: dict, theirs: dict) -> None:
    for a, b in zip(
        everything(ours, smooth_context()), everything(theirs, mi.BSDFContext()), strict=True
    ):
        # Measured: 3e-3, from the rational function by which Mitsuba approximates Beckmann's
        # masking.
        assert np.allclose(a, b, rtol=5e-3, atol=1e-5)


# ------------------------------------ BSDFs ------------------------------------


@pytest.mark.parametrize(
    "name", ["itself", "twosided", "blendbsdf", "mask", "bumpmap", "normalmap", "all"]
)
def test_smooth_lobe_is_that_of_roughconductor(variant, name):
    """At any nesting of the BSDF, the smooth context gives the lobe of roughconductor, and an
    ordinary context still gives glints."""
    metal = {"material": "Au"}
    assert_same(wrapped(name, manifold(**metal)), wrapped(name, rough(**metal)))
    glints, smooth = (
        everything(wrapped(name, manifold(**metal)), ctx)[1]
        for ctx in (mi.BSDFContext(), smooth_context())
    )
    assert not np.allclose(glints, smooth, rtol=0.1)


def test_smooth_lobe_in_each_variant(each_variant):
    assert_same(manifold(material="Au"), rough(material="Au"))


@pytest.mark.parametrize("masking", ["none", "ggx_fit"])
def test_smooth_lobe_has_its_own_masking(variant, masking):
    assert_same(manifold(masking=masking), rough())


def test_smooth_lobe_of_a_hand_over(variant):
    assert_same(manifold(hand_over=4.0), rough())


@pytest.mark.parametrize("plugin", ["glint_elements", "glint_mip"])
def test_smooth_lobe_has_the_intrinsic_roughness(variant, plugin):
    """Squared roughnesses add: that of the map, and twice the variance of an element's normals."""
    sigma_r = 0.1
    ours = {"type": plugin, "data": mi.TensorXf(MAP.normals), "sigma_r": sigma_r}
    if plugin == "glint_mip":
        ours |= {"patch_size": 32, "output_size": 128}
    alpha = (np.sqrt(alpha**2 + 2 * sigma_r**2) for alpha in MAP.roughness())
    assert_same(
        ours, {**rough(), **dict(zip(("alpha_u", "alpha_v"), map(float, alpha), strict=True))}
    )


def test_smooth_lobe_of_flakes(variant):
    """The smooth lobe follows a change of the intrinsic roughness."""
    flakes = {"type": "glint_elements", "flake_density": 100.0, "flake_alpha": 0.2}
    theirs = {"type": "roughconductor", "alpha": float(np.sqrt(0.2**2 + 2 * 0.05**2))}
    assert_same({**flakes, "sigma_r": 0.05}, theirs)
    bsdf = mi.load_dict(flakes)
    parameters = mi.traverse(bsdf)
    parameters["sigma_r"] = 0.05
    parameters.update()
    wo = dr.normalize(mi.Vector3f(0.2, 0.1, 1))
    value = bsdf.eval(smooth_context(), VIEW.interaction(1), wo)
    expected = mi.load_dict(theirs).eval(mi.BSDFContext(), VIEW.interaction(1), wo)
    assert np.allclose(value, expected, rtol=5e-3)


def test_smooth_lobe_of_a_flat_map(variant):
    """It has Mitsuba's smallest roughness, 1e-4, and finite values."""
    flat = NormalMap(np.zeros((4, 4, 2), np.float32))
    ours = {"type": "glint_manifold", "data": mi.TensorXf(flat.normals), "masking": "none"}
    theirs = {"type": "roughconductor", "alpha": 1e-4}
    for a, b in zip(
        everything(ours, smooth_context()), everything(theirs, mi.BSDFContext()), strict=True
    ):
        assert np.isfinite(a).all() and np.allclose(a, b, rtol=1e-3, atol=1e-5)


def test_smooth_lobe_of_a_grid(variant):
    """It is the whole surface, with the mean colour of its microdetails."""
    grid = {"type": "glint_grid", "alpha_u": 0.3, "alpha_v": 0.2, "intensity": 0.7}
    theirs = {"type": "roughconductor", "alpha_u": 0.3, "alpha_v": 0.2}
    assert_same(grid, {**theirs, "specular_reflectance": 0.7})
    palette = np.array([[[1, 0, 0], [0, 0.5, 0]]], np.float32)
    ours = {**grid, "intensity": 1.0, "colors": mi.Bitmap(palette)}
    mean = {"type": "rgb", "value": [0.5, 0.25, 0]}
    assert_same(ours, {**theirs, "specular_reflectance": mean})


def test_filters_are_smooth_already(variant):
    bsdf = {"type": "glint_filtered", "data": mi.TensorXf(MAP.normals)}
    for a, b in zip(
        everything(bsdf, smooth_context()), everything(bsdf, mi.BSDFContext()), strict=True
    ):
        assert np.array_equal(a, b)


@pytest.mark.parametrize(
    "bsdf",
    ["diffuse", "roughconductor", "conductor", "dielectric", "plastic", "roughplastic", "null",
     "thindielectric", "roughdielectric", "pplastic", "principled"],
)  # fmt: skip
def test_other_bsdfs_ignore_the_smooth_context(variant, bsdf):
    for a, b in zip(
        everything({"type": bsdf}, smooth_context()),
        everything({"type": bsdf}, mi.BSDFContext()),
        strict=True,
    ):
        assert np.array_equal(a, b)


def test_context(variant):
    assert asks_for_smooth_lobes(smooth_context())
    assert not asks_for_smooth_lobes(mi.BSDFContext())
    # The bit must be unused in this version of Mitsuba; otherwise another one has to be chosen.
    flags = [int(flag) for flag in mi.BSDFFlags]
    assert not any(flag & SMOOTH_LOBES for flag in flags)


def test_smooth_lobe_follows_the_map(variant):
    """New data give a new roughness, and derivatives reach the data."""
    bsdf = mi.load_dict(manifold())
    parameters = mi.traverse(bsdf)
    other = maps.isotropic(64, seed=4)
    parameters["data"] = mi.TensorXf(other.normals)
    dr.enable_grad(parameters["data"])
    parameters.update()
    si = VIEW.interaction(1)
    wo = dr.normalize(mi.Vector3f(0.2, 0.1, 1))
    value = bsdf.eval(smooth_context(), si, wo)
    expected = mi.load_dict(rough(other)).eval(mi.BSDFContext(), si, wo)
    assert np.allclose(value, expected, rtol=1e-4)
    dr.backward(value.x)
    gradient = dr.grad(parameters["data"]).numpy()
    assert np.isfinite(gradient).all() and np.any(gradient != 0)


# ------------------------------------ glint_path ------------------------------------


def room(
    metal: dict, size: int = 24, pixel_format: str = "rgb", sampler=None, **overrides
) -> mi.Scene:
    """A plate and a diffuse wall that light one another, an area light, and an environment."""
    transform = mi.ScalarTransform4f()
    return mi.load_dict(
        {
            "type": "scene",
            "sensor": {
                "type": "perspective",
                "fov": 40,
                "to_world": transform.look_at([0, -4, 3], [0, 0, 0.4], [0, 0, 1]),
                "film": {
                    "type": "hdrfilm",
                    "width": size,
                    "height": size,
                    "pixel_format": pixel_format,
                    "filter": {"type": "box"},
                },
                "sampler": sampler or {"type": "independent"},
            },
            "plate": {"type": "rectangle", "to_world": transform.scale(2), "bsdf": metal},
            "wall": {
                "type": "rectangle",
                "to_world": transform.translate([0, 2, 0]).rotate([1, 0, 0], 90).scale(2),
                "bsdf": {"type": "diffuse"},
            },
            "lamp": {
                "type": "rectangle",
                "to_world": transform.translate([0, 0, 3]).rotate([1, 0, 0], 180).scale(0.5),
                "emitter": {"type": "area", "radiance": 10.0},
            },
            "environment": {"type": "constant", "radiance": 0.2},
            **overrides,
        }
    )  # fmt: skip


def render(scene: mi.Scene, spp: int = 16, seed: int = 1, **parameters) -> np.ndarray:
    integrator = mi.load_dict({"type": "glint_path", **parameters})
    return np.array(mi.render(scene, integrator=integrator, spp=spp, seed=seed))


def parts(scene: mi.Scene, **parameters) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """The whole image, its direct light and its indirect light."""
    image = render(scene, separate=True, **parameters)
    return image[..., :-6], image[..., -6:-3], image[..., -3:]


def test_parts_add_up(variant):
    whole, direct, indirect = parts(room(manifold()))
    assert direct.mean() > 0 and indirect.mean() > 0
    assert np.allclose(direct + indirect, whole, rtol=1e-6, atol=1e-6)


def test_parts_add_up_in_each_variant(each_variant):
    whole, direct, indirect = parts(room(manifold()))
    # A monochromatic image has one channel, which equals every channel of the parts.
    assert np.allclose(direct + indirect, whole, rtol=1e-4, atol=1e-5)


def test_direct_light_is_that_of_paths_of_two_segments(variant):
    """All direct light has glints; with the same random numbers, it is equal sample by sample."""
    scene = room(manifold())
    _, direct, _ = parts(scene, max_depth=8)
    # Measured: 1e-6; other kernels round differently.
    assert np.allclose(direct, render(scene, max_depth=2), rtol=1e-4, atol=1e-5)


def test_indirect_light_is_that_of_the_smooth_metal(variant):
    """It has no glints: the scene with ``roughconductor`` gives the same indirect image."""
    # With the same random numbers and rays, whether or not a scene has glints: with another share,
    # footprints lie nearer to the pixel's centre than samples.
    alike = {"spp": 64, "pixel_share": 0.0, "light_share": 0.0, "emitters": "one"}
    _, _, indirect = parts(room(manifold()), **alike)
    _, _, expected = parts(room(rough()), **alike)
    # The two round differently, which changes a few paths. Measured: 3e-4.
    assert np.abs(indirect - expected).mean() < 2e-3 * expected.mean()


def test_smooth_scenes_look_the_same(variant):
    """Without glint BSDFs, separation changes only the use of random numbers."""
    scene = room(rough(material="Cr"))
    differences = [
        parts(scene, spp=64, seed=seed, rr_depth=2)[0] - render(scene, 64, seed + 100, rr_depth=2)
        for seed in range(4)
    ]
    means = np.array([d.mean() for d in differences])
    # Four independent differences whose mean should be zero; 3 sigma
    assert abs(means.mean()) < 3 * means.std(ddof=1) / 2, means


def test_glints_are_seen_in_mirrors(variant):
    """Surfaces in a mirror count as seen by the camera (cf. Tan et al. 2022, Fig. 18)."""
    transform = mi.ScalarTransform4f()
    mirror = {
        "type": "rectangle",
        "to_world": transform.translate([0, -1.5, 1.5]).rotate([1, 0, 0], 40).scale(4),
        "bsdf": {"type": "twosided", "nested": {"type": "conductor"}},
    }
    sky = {
        "type": "rectangle",
        "to_world": transform.translate([0, -6, 8]).scale(6),
        "bsdf": {"type": "twosided", "nested": manifold()},
    }
    scene = room(manifold(), mirror=mirror, plate=sky)
    _, direct, indirect = parts(scene, max_depth=3)
    expected = render(scene, max_depth=3)
    in_mirror = np.s_[4:-4, 4:-4]
    assert direct[in_mirror].mean() > 0.01
    assert np.all(indirect[in_mirror] == 0)
    assert np.allclose(direct[in_mirror], expected[in_mirror], rtol=1e-3, atol=1e-4)


def test_depths(variant):
    scene = room(manifold())
    for depth in (0, 1):
        whole, direct, indirect = parts(scene, max_depth=depth)
        assert np.allclose(whole, render(scene, max_depth=depth), rtol=1e-6)
        assert np.all(indirect == 0) and np.array_equal(direct, whole)
    assert np.all(parts(scene, max_depth=2)[2] == 0)


def test_without_separation_no_smooth_lobes_are_evaluated(variant):
    """Without ``separate``, a BSDF is traced only for its glints, and there are no AOVs."""
    seen = []

    class Spy(mi.BSDF):
        def __init__(self, props):
            super().__init__(props)
            self.m_flags = mi.BSDFFlags.DiffuseReflection | mi.BSDFFlags.FrontSide
            self.m_components = [self.m_flags]

        def sample(self, ctx, si, sample1, sample2, active=True):
            bs = dr.zeros(mi.BSDFSample3f)
            bs.wo, bs.pdf, bs.eta = mi.warp.square_to_uniform_hemisphere(sample2), dr.inv_two_pi, 1
            bs.sampled_type = mi.UInt32(+mi.BSDFFlags.DiffuseReflection)
            return bs, mi.Spectrum(0.5)

        def eval_pdf(self, ctx, si, wo, active=True):
            seen.append(asks_for_smooth_lobes(ctx))
            return mi.Spectrum(0.1), mi.Float(dr.inv_two_pi)

        def to_string(self):
            return "Spy[]"

    mi.register_bsdf("spy", Spy)
    scene = room({"type": "spy"})
    assert render(scene).shape[-1] == 3 and set(seen) == {False}
    once = len(seen)  # how often Dr.Jit records the loop
    assert render(scene, separate=True).shape[-1] == 3 + 6
    assert seen[once:] == [True, False] * once


@pytest.mark.parametrize("key", ["plate.bsdf.alpha_u.value", "lamp.emitter.radiance.value"])
def test_gradients_are_those_of_the_whole(variant, key):
    """Without glint BSDFs, the gradients of both parts add up, for the same samples and without
    russian roulette."""
    scene = room(rough())
    parameters = mi.traverse(scene)

    def backward(separate: bool) -> np.ndarray:
        dr.enable_grad(parameters[key])
        dr.set_grad(parameters[key], 0)
        parameters.update()
        integrator = mi.load_dict({"type": "glint_path", "max_depth": 3, "separate": separate})
        image = mi.render(scene, parameters, integrator=integrator, spp=4, seed=1)
        dr.backward(dr.mean(image[..., :3]))
        return dr.grad(parameters[key]).numpy()

    expected = backward(False)
    assert np.all(expected != 0)
    # Measured: 1e-6
    assert np.allclose(backward(True), expected, rtol=1e-4)


def test_separate_must_be_a_boolean(variant):
    assert "separate = True" in str(mi.load_dict({"type": "glint_path", "separate": True}))
    with pytest.raises((ParameterError, RuntimeError), match='glint_path: "separate" must be'):
        mi.load_dict({"type": "glint_path", "separate": 1})
