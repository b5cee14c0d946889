"""The plugin glint_manifold: the shared suite, its own parameters, and use in Mitsuba."""

from __future__ import annotations

from dataclasses import replace

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
import skimage.io

from glintbsdf import Footprint, NormalMap, maps
from glintbsdf.check import suite
from glintbsdf.check.reference import normal_bounds
from glintbsdf.check.suite import EXTREME_VIEWS, View
from glintbsdf.footprint.kernels import KERNELS

MAPS = {
    "isotropic": maps.isotropic((29, 36), seed=1),
    "brushed": maps.brushed((24, 40), streak_length=20, streak_width=3),
    "scratched": maps.scratched(48, length=30),
}
STIFF_MAPS = {
    "flat": maps.flat(16),
    "tilted": maps.tilted(7),
    "one_texel": maps.tilted(1),
    "clamp": NormalMap(MAPS["isotropic"].normals, "clamp"),
    "mirror": NormalMap(MAPS["isotropic"].normals, "mirror"),
}
ALL_MAPS = MAPS | STIFF_MAPS

# A rotated footprint of about one texel by half a texel, seen at an angle from which nothing is
# reflected below the horizon. For a map of one texel, the footprint has the map's size.
RESOLVED = View(du=(0.04, 0.03), dv=(-0.015, 0.02), wi=(0.3, 0.1, 1))
RESOLVED_ONE_TEXEL = replace(RESOLVED, du=(0.6, 0), dv=(0, 0.6))
# Large enough for the suite's bins to resolve the highlight of a clamped triangle.
EPSILON = 1e-3
DENSITY_TESTS = 2 * (len(KERNELS) * len(MAPS) + len(STIFF_MAPS))


def describe(normal_map: NormalMap, **parameters) -> dict:
    return {
        "type": "glint_manifold",
        "data": mi.TensorXf(normal_map.normals),
        "wrap_mode": normal_map.wrap_mode,
        "footprint_sigma": 1.0,
        "masking": "none",
        **parameters,
    }


def load(normal_map: NormalMap, **parameters) -> mi.BSDF:
    return mi.load_dict(describe(normal_map, **parameters))


# --------------------------------------------------------------------------------------------------
#  Densities
# --------------------------------------------------------------------------------------------------


def check_density(normal_map: NormalMap, kernel: str, view: View) -> None:
    bsdf = load(normal_map, kernel=kernel, epsilon=EPSILON)
    suite.check_chi2(bsdf, view, normal_bounds(normal_map, EPSILON), DENSITY_TESTS)
    suite.check_against_reference(
        bsdf, normal_map, view, DENSITY_TESTS, kernel=kernel, epsilon=EPSILON
    )


@pytest.mark.parametrize("kernel", KERNELS)
@pytest.mark.parametrize("name", MAPS)
def test_density(variant, name, kernel):
    check_density(MAPS[name], kernel, RESOLVED)


@pytest.mark.parametrize("name", STIFF_MAPS)
def test_density_of_stiff_maps(variant, name):
    view = RESOLVED_ONE_TEXEL if name == "one_texel" else RESOLVED
    check_density(STIFF_MAPS[name], "gaussian", view)


def test_value_of_a_mirror_is_the_density(variant):
    bsdf = load(MAPS["isotropic"])
    si, bs, _ = suite.sample(bsdf, RESOLVED, 1000)
    m = dr.normalize(si.wi + bs.wo)
    footprint = Footprint(si.uv, si.duv_dx, si.duv_dy)
    expected = bsdf.pndf.eval(mi.Vector2f(m.x, m.y), footprint, bs.pdf > 0)
    value = bsdf.eval(mi.BSDFContext(), si, bs.wo)
    assert dr.max(expected)[0] > 0
    assert dr.allclose(4 * si.wi.z * value, expected, rtol=1e-5)


def test_to_uv_moves_the_footprint(variant):
    to_uv = mi.ScalarTransform4f().translate([0.2, -0.3, 0]).rotate([0, 0, 1], 30).scale([2, 3, 1])
    moved, plain = load(MAPS["isotropic"], to_uv=to_uv), load(MAPS["isotropic"])
    matrix = np.array(to_uv.matrix)
    linear, offset = matrix[:2, :2], matrix[:2, 3]
    view = replace(
        RESOLVED,
        uv=tuple((linear @ RESOLVED.uv + offset).tolist()),
        du=tuple((linear @ RESOLVED.du).tolist()),
        dv=tuple((linear @ RESOLVED.dv).tolist()),
    )
    si, bs, _ = suite.sample(plain, view, 500)
    expected = plain.pdf(mi.BSDFContext(), si, bs.wo)
    actual = moved.pdf(mi.BSDFContext(), RESOLVED.interaction(500), bs.wo)
    # Float32 rounding of the footprint's place: far below its size, yet D is steep.
    assert np.median(np.abs(actual / expected - 1)) < 1e-4
    assert np.mean(np.abs(actual / expected - 1) > 1e-2) < 0.01


# --------------------------------------------------------------------------------------------------
#  Consistency
# --------------------------------------------------------------------------------------------------

MATERIALS = {
    "mirror": {},
    "gold": {"material": "Au", "masking": "beckmann"},
    "separable": {"eta": 1.2, "k": 3.0, "masking": "beckmann", "height_correlated": False},
    "glass": {"int_ior": "bk7", "ext_ior": 1.0, "specular_reflectance": 0.7},
}


@pytest.mark.parametrize("material", MATERIALS)
def test_consistency(variant, material):
    bsdf = load(MAPS["scratched"], **MATERIALS[material])
    for view in (RESOLVED, replace(RESOLVED, wi=(-1, 1, 0.2)), EXTREME_VIEWS["1000:1"]):
        suite.check_eval_pdf(bsdf, view)
        suite.check_weights(bsdf, view)
        suite.check_horizon(bsdf, view)
        suite.check_adjoint(bsdf, view)


@pytest.mark.parametrize("name", ["isotropic", "brushed", "flat", "one_texel", "clamp"])
def test_extremes_are_finite(variant, name):
    bsdf = load(ALL_MAPS[name], masking="beckmann", material="Al")
    for view in EXTREME_VIEWS.values():
        suite.check_finite(bsdf, view)


def test_furnace(variant):
    # A footprint that covers the whole map has the map's roughness, for which masking is derived.
    # Smaller ones have mean slopes towards the light or away from it, which at normal incidence
    # does not matter.
    for name in ("isotropic", "brushed", "flat"):
        bsdf = load(ALL_MAPS[name], masking="beckmann")
        for wi in ((0, 0, 1), (1, 0, 1), (0, 1, 0.3), (1, 1, 0.1)):
            suite.check_furnace(bsdf, View(du=(1, 0), dv=(0, 1), wi=wi))
    for masking in ("none", "beckmann"):
        bsdf = load(MAPS["scratched"], masking=masking)
        suite.check_furnace(bsdf, replace(RESOLVED, wi=(0, 0, 1)))


def test_masking_is_part_of_the_value(variant):
    view = replace(RESOLVED, wi=(1, 0, 0.1))
    unmasked = load(MAPS["isotropic"])
    si, bs, _ = suite.sample(unmasked, view, 500)
    value = unmasked.eval(mi.BSDFContext(), si, bs.wo)
    correlated, separable = (
        load(MAPS["isotropic"], masking="beckmann", height_correlated=flag).eval(
            mi.BSDFContext(), si, bs.wo
        )
        for flag in (True, False)
    )
    assert dr.all((separable <= correlated) & (correlated <= value), axis=None)
    assert dr.any(separable < 0.9999 * correlated, axis=None)


def test_albedo(variant):
    si = View(wi=(1, 0, 1)).interaction()
    assert dr.allclose(load(MAPS["isotropic"]).eval_diffuse_reflectance(si), 1)
    gold = load(MAPS["isotropic"], material="Au", specular_reflectance=0.5)
    albedo = gold.eval_diffuse_reflectance(si)
    params = mi.traverse(mi.load_dict({"type": "conductor", "material": "Au"}))
    expected = [
        mi.fresnel_conductor(si.wi.z, mi.Complex2f(eta, k))[0]
        for eta, k in zip(params["eta.value"], params["k.value"], strict=True)
    ]
    assert dr.allclose(albedo, 0.5 * mi.Color3f(expected))


# --------------------------------------------------------------------------------------------------
#  Parameters
# --------------------------------------------------------------------------------------------------

BAD_OWN_PARAMETERS = [
    ({"kernel": "gauss"}, "kernel"),
    ({"epsilon": 0.0}, "epsilon"),
    ({"epsilon": -1e-6}, "epsilon"),
    ({"epsilon": 1.0}, "epsilon"),
    ({"epsilon": suite.NAN}, "epsilon"),
    ({"threshold": -0.004}, "threshold"),
    ({"threshold": 0.004, "max_error": 0.05}, "threshold"),
    ({"threshold": suite.NAN}, "threshold"),
    ({"max_error": -1.0}, "max_error"),
    ({"masking": "smith"}, "masking"),
    ({"height_correlated": "yes"}, "height_correlated"),
]


@pytest.mark.parametrize(
    ("changes", "parameter"), suite.BAD_PARAMETERS + BAD_OWN_PARAMETERS, ids=str
)
def test_bad_parameters(variant, changes, parameter):
    suite.check_rejects(describe(MAPS["isotropic"]), changes, parameter)


def test_bad_maps(variant):
    normals = MAPS["isotropic"].normals
    for fault, value in (("NaN", suite.NAN), ("infinite", float("inf")), ("outside", 1.5)):
        bad = normals.copy()
        bad[3, 4] = value
        with pytest.raises(Exception, match=rf'glint_manifold: "data" .*{fault}'):
            mi.load_dict({"type": "glint_manifold", "data": mi.TensorXf(bad)})
    for shape in ((4, 4, 5), (4, 4, 1, 1), (0, 4, 2)):
        with pytest.raises(Exception, match='glint_manifold: "data" must be'):
            mi.load_dict({"type": "glint_manifold", "data": mi.TensorXf(np.zeros(shape))})


def test_unknown_parameter(variant):
    with pytest.raises(RuntimeError, match="kernle"):
        load(MAPS["isotropic"], kernle="disk")


def test_message(variant):
    with pytest.raises(
        Exception,
        match=r'glint_manifold: "kernel" must be one of gaussian, disk, '
        r'box \(got "gauss"\)',
    ):
        load(MAPS["isotropic"], kernel="gauss")


def test_xml_and_dict_agree(variant, tmp_path):
    height = (np.random.default_rng(3).random((13, 17)) * 255).astype(np.uint8)
    skimage.io.imsave(tmp_path / "height.png", height, check_contrast=False)
    (tmp_path / "scene.xml").write_text(
        """<scene version="3.0.0">
            <bsdf type="glint_manifold" id="glints">
                <string name="filename" value="height.png"/>
                <float name="height_scale" value="0.5"/>
                <string name="wrap_mode" value="mirror"/>
                <transform name="to_uv"><scale x="2" y="3"/><translate x="0.25"/></transform>
                <string name="kernel" value="disk"/>
                <integer name="footprint_sigma" value="1"/>
                <string name="material" value="Cu"/>
                <rgb name="specular_reflectance" value="0.9, 0.8, 0.7"/>
                <boolean name="height_correlated" value="false"/>
            </bsdf>
            <shape type="rectangle"><ref id="glints"/></shape>
        </scene>"""
    )
    from_xml = mi.load_file(str(tmp_path / "scene.xml")).shapes()[0].bsdf()
    from_dict = mi.load_dict(
        {
            "type": "glint_manifold",
            "data": mi.TensorXf(height[..., None] / 255.0),
            "map_type": "height",
            "height_scale": 0.5,
            "wrap_mode": "mirror",
            "to_uv": mi.ScalarTransform4f().translate([0.25, 0, 0]).scale([2, 3, 1]),
            "kernel": "disk",
            "footprint_sigma": 1,
            "material": "Cu",
            "height_correlated": False,
            "specular_reflectance": {"type": "rgb", "value": [0.9, 0.8, 0.7]},
        }
    )
    si, bs, weight = suite.sample(from_dict, RESOLVED, 200)
    _, bs_xml, weight_xml = suite.sample(from_xml, RESOLVED, 200)
    assert dr.allclose(bs.wo, bs_xml.wo, atol=1e-5)
    assert dr.allclose(weight, weight_xml, rtol=1e-4)


@pytest.mark.openexr
def test_all_sources_give_the_same_map(variant, tmp_path):
    normals = np.concatenate(
        [
            MAPS["brushed"].normals,
            np.sqrt(1 - (MAPS["brushed"].normals ** 2).sum(2, keepdims=True)),
        ],
        2,
    )
    bitmap = mi.Bitmap(normals.astype(np.float32))
    bitmap.write(str(tmp_path / "map.exr"))
    bsdfs = [
        mi.load_dict({"type": "glint_manifold", "masking": "none", **source})
        for source in (
            {"data": mi.TensorXf(normals)},
            {"bitmap": bitmap},
            {"filename": str(tmp_path / "map.exr")},
        )
    ]
    for bsdf in bsdfs:
        assert np.allclose(np.array(mi.traverse(bsdf)["data"]), MAPS["brushed"].normals, atol=1e-6)


def test_changed_parameters_take_effect(variant):
    old, new = maps.isotropic(16, alpha=0.1, seed=1), maps.isotropic(16, alpha=0.3, seed=2)
    bsdf = load(old, masking="beckmann")
    before = np.array(suite.sample(bsdf, RESOLVED, 200)[1].wo)
    params = mi.traverse(bsdf)
    params["data"] = mi.TensorXf(new.normals)
    params["footprint_sigma"] = 0.5
    params["to_uv"] = mi.ScalarAffineTransform3f().scale([2, 1])
    params.update()
    fresh = load(
        new, masking="beckmann", footprint_sigma=0.5, to_uv=mi.ScalarTransform4f().scale([2, 1, 1])
    )
    view = replace(RESOLVED, wi=(1, 0, 0.5))
    si, bs, weight = suite.sample(bsdf, view, 200)
    _, bs_fresh, weight_fresh = suite.sample(fresh, view, 200)
    assert not np.allclose(before, np.array(suite.sample(bsdf, RESOLVED, 200)[1].wo))
    assert dr.allclose(bs.wo, bs_fresh.wo, atol=1e-6)
    assert dr.allclose(weight, weight_fresh)
    ctx = mi.BSDFContext()
    assert dr.allclose(bsdf.eval(ctx, si, bs.wo), fresh.eval(ctx, si, bs.wo), rtol=1e-4)


@pytest.mark.parametrize("key", ["footprint_sigma", "pixel_spread"])
def test_changed_parameters_are_checked(variant, key):
    params = mi.traverse(load(MAPS["isotropic"]))
    params[key] = -1.0
    with pytest.raises(ValueError, match=f'glint_manifold: "{key}" must be'):
        params.update()


# --------------------------------------------------------------------------------------------------
#  Inside Mitsuba
# --------------------------------------------------------------------------------------------------


def glints(**parameters) -> dict:
    return {
        **describe(MAPS["isotropic"], masking="beckmann", footprint_sigma=0.5, pixel_spread=0.03),
        **parameters,
    }


def texture(value: list[float]) -> dict:
    image = np.full((2, 2, len(value)), value, np.float32)
    return {"type": "bitmap", "raw": True, "bitmap": mi.Bitmap(image)}


def test_adapters_that_change_nothing(variant):
    plain = suite.square(glints())
    assert plain.mean() > 0.1
    for adapter in (
        {"type": "twosided", "nested": glints()},
        {"type": "normalmap", "normalmap": texture([0.5, 0.5, 1.0]), "nested": glints()},
        {"type": "bumpmap", "arbitrary": texture([0.5]), "nested": glints()},
        {"type": "blendbsdf", "weight": 0.0, "first": glints(), "second": {"type": "diffuse"}},
        {"type": "mask", "opacity": 1.0, "nested": glints()},
    ):
        assert np.allclose(suite.square(adapter), plain, rtol=1e-4), adapter["type"]


def test_one_sided(variant):
    assert suite.square(glints(), from_below=True).max() == 0
    assert suite.square({"type": "twosided", "nested": glints()}, from_below=True).mean() > 0.1


@pytest.mark.parametrize("integrator", ["direct", "volpath", "prb", "glint_path"])
def test_integrators(variant, integrator):
    extra = {} if integrator == "direct" else {"max_depth": 2}
    image = suite.square(glints(), {"type": integrator, "hide_emitters": True, **extra})
    # Four times the largest difference measured: a white sky leaves little noise.
    assert np.isclose(image.mean(), suite.square(glints()).mean(), rtol=0.01)


def test_albedo_image(variant):
    integrator = {"type": "aov", "aovs": "albedo:albedo", "nested": {"type": "path"}}
    image = suite.square(glints(specular_reflectance=0.5), integrator)
    assert np.allclose(image[12, 12, -3:], 0.5)


def test_prb_derivative(variant):
    scene = mi.load_dict(
        {
            "type": "scene",
            "sky": {"type": "constant"},
            "sensor": {
                "type": "perspective",
                "to_world": mi.ScalarTransform4f().look_at([0, -1, 2], [0, 0, 0], [0, 0, 1]),
                "film": {"type": "hdrfilm", "width": 8, "height": 8},
            },
            "square": {"type": "rectangle", "bsdf": glints(specular_reflectance=0.5, id="glints")},
        }
    )
    params = mi.traverse(scene)
    key = next(key for key in params.keys() if key.endswith("specular_reflectance.value"))
    dr.enable_grad(params[key])
    params.update()
    integrator = mi.load_dict({"type": "prb", "max_depth": 2, "hide_emitters": True})
    image = mi.render(scene, params, integrator=integrator, spp=64)
    dr.backward(dr.sum(image.array))
    # With one bounce the picture is proportional to the reflectance. Prime and derivative passes
    # draw different numbers: 5 % is five standard deviations of their noise.
    assert np.isclose(dr.grad(params[key])[0], dr.sum(image.array)[0] / 0.5, rtol=0.05)


def test_one_warning_of_a_point_footprint(variant, capfd):
    suite.square(glints(pixel_spread=0.0, id="a_plate"))
    captured = capfd.readouterr()
    text = captured.out + captured.err
    assert text.count("pixel_spread") == 2 and text.count("WARN") == 1
    assert "glintbsdf render" in text and "a_plate" in text
    suite.square(glints())
    captured = capfd.readouterr()
    assert "WARN" not in captured.out + captured.err


def test_each_variant(each_variant):
    bsdf = load(MAPS["scratched"], material="Au", specular_reflectance=0.8, masking="beckmann")
    suite.check_eval_pdf(bsdf, RESOLVED, 200)
    suite.check_weights(bsdf, RESOLVED, 200)
    suite.check_finite(bsdf, RESOLVED)
    suite.check_finite(load(MAPS["scratched"]), RESOLVED)
    suite.check_finite(load(MAPS["scratched"], int_ior=1.5), RESOLVED)
    value = suite.square(glints(material="Au"))
    assert 0.05 < value.mean() < 2


def test_plugin_survives_changes_of_variant(variant):
    means = []
    for name in (variant, variant.replace("rgb", "mono"), variant):
        mi.set_variant(name)
        means.append(suite.square(glints()).mean())
    # The sky's grey is the same in every variant.
    assert np.allclose(means, means[0], rtol=0.02)


def test_describes_itself(variant):
    text = str(load(MAPS["isotropic"], material="Al", masking="beckmann"))
    for part in ("GlintManifold", "36", "29", "beckmann", "Conductor", "footprint_sigma = 1"):
        assert part in text


def test_level_bump_map(variant):
    """Where Mitsuba's own frame is NaN, there is no light rather than NaN."""
    level = {"type": "bitmap", "bitmap": mi.Bitmap(np.zeros((2, 2, 1), np.float32)), "raw": True}
    glint = {"type": "glint_manifold", "data": mi.TensorXf(MAPS["isotropic"].normals)}
    bsdf = mi.load_dict({"type": "bumpmap", "texture": level, "nested": glint})
    si = RESOLVED.interaction(100)
    si.dp_du, si.dp_dv, si.n = mi.Vector3f(0, 0, 1), mi.Vector3f(1, 0, 0), mi.Normal3f(0, 1, 0)
    si.sh_frame = mi.Frame3f(si.dp_du, si.dp_dv, si.n)
    u = suite.random_numbers(100, 5, seed=3)
    bs, weight = bsdf.sample(mi.BSDFContext(), si, u[0], mi.Point2f(*u[1:3]))
    wo = mi.warp.square_to_uniform_hemisphere(mi.Point2f(*u[3:]))
    value, pdf = bsdf.eval_pdf(mi.BSDFContext(), si, wo)
    for x in (weight, bs.pdf, value, pdf):
        assert dr.all(x == 0, axis=None)
