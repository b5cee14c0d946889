"""The plugin glint_particles: the shared suite, colours, placement, and life in Mitsuba."""

from __future__ import annotations

from dataclasses import replace

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest

from glintbsdf.check import densities, robustness, suite
from glintbsdf.check.suite import EXTREME_VIEWS, View

SURFACES = {
    "default": {},
    "few": {"density": 5.5},
    "beckmann": {"distribution": "beckmann", "density": 6.0},
    "anisotropic": {"alpha_u": 0.4, "alpha_v": 0.1, "density": 7.0},
    "rough facets": {"micro_alpha": 0.14, "density": 6.0},
    "wheel": {"colors": "wheel", "density": 6.0},
    "object": {"space": "object", "density": 6.0},
}
# A rotated footprint of some facets, at a slant that reflects nothing below the horizon
RESOLVED = View(du=(1.2e-3, 9e-4), dv=(-4e-4, 6e-4), wi=(0.1, 0.05, 1))


def describe(**parameters) -> dict:
    return {"type": "glint_particles", "footprint_sigma": 1.0, **parameters}


def load(**parameters) -> mi.BSDF:
    return mi.load_dict(describe(**parameters))


def rough(alpha_u: float = 0.3, alpha_v: float = 0.3, distribution: str = "ggx", **_) -> mi.BSDF:
    """The surface that ``load`` of the same parameters is on average."""
    smooth = {"type": "roughconductor", "distribution": distribution}
    return mi.load_dict({**smooth, "alpha_u": alpha_u, "alpha_v": alpha_v})


def scattered(count: int, extent: float, sigma: float, wi=(0.3, 0.1, 1), seed=1):
    """Interactions at random places of the square [0, extent]², with round footprints."""
    si = replace(RESOLVED, du=(sigma, 0), dv=(0, sigma), wi=wi).interaction(count)
    si.uv = extent * mi.Point2f(*suite.random_numbers(count, 2, seed))
    si.p = mi.Point3f(si.uv.x, si.uv.y, 0)
    return si


def relative_values(bsdf: mi.BSDF, smooth: mi.BSDF, si, wo=(0.1, -0.2, 1)) -> np.ndarray:
    """Values of ``bsdf`` in units of the smooth surface's, channels × interactions."""
    ctx, wo = mi.BSDFContext(), dr.normalize(mi.Vector3f(wo))
    value, expected = (
        np.array(suite.intensity(b.eval(ctx, si, wo)), np.float64) for b in (bsdf, smooth)
    )
    return np.atleast_2d(value / expected)


# --------------------------------------------------------------------------------------------------
#  The surface on average, and from afar
# --------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("name", SURFACES)
def test_mean_is_roughconductor(variant, name):
    count = 1 << 20
    parameters = {**SURFACES[name], "density": 7.0}
    si = scattered(count, 512, 2e-3)
    values = relative_values(load(**parameters), rough(**parameters), si)
    error = values.std(axis=1) / np.sqrt(count)
    assert (error < 0.003).all()
    # GGX with rough facets, here 0.47 alpha: the page says 7 %.
    tolerance = 0.07 if name == "rough facets" else 0.005
    assert (np.abs(values.mean(axis=1) - 1) < 3 * error + tolerance).all(), values.mean(axis=1)


def test_far_away_all_is_smooth(variant):
    for name, parameters in SURFACES.items():
        parameters = {**parameters, "density": 14.0}
        values = relative_values(load(**parameters), rough(**parameters), scattered(1000, 9, 1.0))
        assert np.abs(values - 1).max() < 5e-3, name  # roughconductor's masking of Beckmann


@pytest.mark.parametrize("name", SURFACES)
def test_average_furnace(variant, name):
    """One place may reflect more than it receives; all places together may not."""
    count = 100_000
    for wi in ((0, 0, 1), (1, 0, 1), (1, 1, 0.1)):
        si = scattered(count, 512, 1e-3, wi)
        u = suite.random_numbers(count, 3, seed=4)
        _, weight = load(**SURFACES[name]).sample(
            mi.BSDFContext(), si, u[0], mi.Point2f(u[1], u[2])
        )
        weight = np.atleast_2d(np.array(weight, np.float64))
        assert (weight.mean(axis=1) <= 1 + 3 * weight.std(axis=1) / np.sqrt(count)).all()


# --------------------------------------------------------------------------------------------------
#  The shared suite
# --------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("name", SURFACES)
@pytest.mark.parametrize("scale", [0.0, 0.3, 3.0])
def test_samples_have_the_density_of_pdf(variant, name, scale):
    """Facets one by one, several, and many that are nearly smooth."""
    du, dv = ((scale * a, scale * b) for a, b in (RESOLVED.du, RESOLVED.dv))
    found = densities.density(load(**SURFACES[name]), replace(RESOLVED, du=du, dv=dv), 20_000)
    assert abs(found["mass"]) < 1e-3 + 3 * found["mass_error"], found
    assert found["p_value"] > 1 - (1 - suite.SIGNIFICANCE) ** (1 / 30), found


@pytest.mark.parametrize("view", ["1000:1", "far_uv", "line", "one_map"])
def test_samples_have_the_density_under_extreme_footprints(variant, view):
    view = replace(EXTREME_VIEWS[view], du=(0.003, 0.002))
    found = densities.density(load(density=6.5, micro_alpha=0.03), view, 20_000)
    assert abs(found["mass"]) < 1e-3 + 3 * found["mass_error"], found
    assert found["p_value"] > 1 - (1 - suite.SIGNIFICANCE) ** (1 / 30), found


@pytest.mark.parametrize("name", SURFACES)
def test_consistency(variant, name):
    bsdf = load(material="Al", **SURFACES[name])
    for view in (RESOLVED, replace(RESOLVED, wi=(-1, 1, 0.2)), EXTREME_VIEWS["1000:1"]):
        suite.check_eval_pdf(bsdf, view)
        suite.check_weights(bsdf, view)
        suite.check_horizon(bsdf, view)
        suite.check_adjoint(bsdf, view)


@pytest.mark.parametrize("name", SURFACES)
def test_extremes_are_finite(variant, name):
    bsdf = load(**SURFACES[name])
    for view in EXTREME_VIEWS.values():
        suite.check_finite(bsdf, view)


@pytest.mark.parametrize("density", [-8.0, 16.0])
@pytest.mark.parametrize("micro_alpha", [1e-6, 0.15])
def test_extreme_parameters(variant, density, micro_alpha):
    for view in EXTREME_VIEWS.values():
        suite.check_finite(load(density=density, micro_alpha=micro_alpha), view)


@pytest.mark.parametrize("parameters", [{"density": 16.0}, {"density": -8.0}, {"space": "object"}])
def test_combined_extremes_are_finite(variant, parameters):
    assert robustness.extremes(load(**parameters), 2048) == {"nan": 0, "negative": 0}


def test_furnace_from_above(variant):
    above = replace(RESOLVED, wi=(0, 0, 1))
    for name, parameters in SURFACES.items():
        if name != "wheel":  # whose colours are up to twice as bright as white
            suite.check_furnace(load(**parameters), above, View())


def test_each_variant(each_variant):
    si = scattered(200, 1, 1.0)
    for colors in ("none", "wheel"):
        bsdf = load(colors=colors, material="Au", specular_reflectance=0.8, density=6.0)
        suite.check_eval_pdf(bsdf, RESOLVED, 200)
        suite.check_weights(bsdf, RESOLVED, 200)
        suite.check_finite(bsdf, RESOLVED)
        values = relative_values(load(colors=colors, density=14.0), rough(), si)
        assert np.allclose(values, 1, atol=6e-3)


def test_far_uv_still_glints(variant):
    """At |uv| = 10⁶, where float32 coordinates are 0.06 apart."""
    si = scattered(4000, 100, 0.2)
    si.uv = si.uv + mi.Point2f(1e6, -1e6)
    values = relative_values(load(density=1.0, micro_alpha=0.1), rough(), si)[0]
    near = relative_values(load(density=1.0, micro_alpha=0.1), rough(), scattered(4000, 100, 0.2))[
        0
    ]
    assert np.isclose(values.std(), near.std(), rtol=0.15) and abs(values.mean() - 1) < 0.15


# --------------------------------------------------------------------------------------------------
#  Colours
# --------------------------------------------------------------------------------------------------


def test_colors_of_single_facets_and_from_afar(variant):
    palette = np.array([[[0.9, 0.1, 0.1], [0.1, 0.2, 0.7]]], np.float32)
    bsdf = load(density=4.0, micro_alpha=0.03, colors=mi.Bitmap(palette))
    values = relative_values(bsdf, rough(), scattered(40_000, 100, 0.0))
    bright = values[:, values.sum(axis=0) > 0.1 * values.sum(axis=0).max()]
    shown = (bright / bright.sum(axis=0)).T
    expected = palette[0] / palette[0].sum(axis=1, keepdims=True)
    distance = np.abs(shown[:, None] - expected).max(axis=2)
    # Up to three facets may overlap.
    assert (distance.min(axis=1) < 0.01).mean() > 0.9
    assert 0.3 < (distance.argmin(axis=1) == 0).mean() < 0.7

    values = relative_values(load(density=14.0, colors=mi.Bitmap(palette)), rough(),
                             scattered(100, 1, 1.0))  # fmt: skip
    assert np.allclose(values.mean(axis=1), palette[0].mean(axis=0), rtol=0.01)
    albedo = bsdf.eval_diffuse_reflectance(scattered(1, 1, 1.0))
    assert np.allclose(albedo, palette[0].mean(axis=0)[:, None])


def test_colors_vary_about_one(variant):
    red = {"type": "rgb", "value": [0.8, 0.2, 0.2]}
    albedo = np.array(load(color=red).eval_diffuse_reflectance(scattered(1, 1, 1.0)))
    assert np.allclose(albedo.ravel(), [0.8, 0.2, 0.2], atol=1e-3)
    si = scattered(40_000, 100, 0.0)
    values = relative_values(
        load(color=red, hue_variation=0.1, density=4.0, micro_alpha=0.03), rough(), si
    )
    bright = values[:, values.sum(axis=0) > 0.1 * values.sum(axis=0).max()]
    shares = bright / bright.sum(axis=0)
    assert shares[1].std() > 0.02 and shares[2].std() > 0.02
    assert (shares[0] > shares[1:].max(axis=0)).mean() > 0.95


# --------------------------------------------------------------------------------------------------
#  Placement
# --------------------------------------------------------------------------------------------------


def test_facets_in_space_do_not_depend_on_uvs(variant):
    view = replace(RESOLVED, du=(1e-3, 0), dv=(0, 1e-3))
    stretched = replace(
        view, du=(1e-4, 0), dp_du=(10.0, 0, 0), uv=(0.9, 0.1)
    )  # the same surface, other UVs
    bsdf, wo = load(space="object", density=6.0), mi.Vector3f(0.1, -0.2, 1)
    u = suite.random_numbers(1000, 2, 3)
    values = []
    for v in (view, stretched):
        si = v.interaction(1000)
        si.p = mi.Point3f(u[0], u[1], 0)
        values.append(np.array(bsdf.eval(mi.BSDFContext(), si, dr.normalize(wo))[0]))
    assert values[0].std() > 0.1 * values[0].mean()
    assert np.allclose(*values, rtol=1e-2, atol=1e-3)


def test_facets_move_with_the_object(variant):
    to_world = mi.ScalarTransform4f().translate([3, 1, -2]).rotate([0.6, 0.8, 0], 40)
    wo = dr.normalize(mi.Vector3f(0.1, -0.2, 1))
    u = suite.random_numbers(1000, 2, 3)
    si = replace(RESOLVED).interaction(1000)
    si.p = mi.Point3f(u[0], u[1], 0)
    still = np.array(load(space="object", density=6.0).eval(mi.BSDFContext(), si, wo)[0])
    si.p, si.dp_du, si.dp_dv = (
        mi.AffineTransform4f(to_world) @ x for x in (si.p, si.dp_du, si.dp_dv)
    )
    moved = load(space="object", density=6.0, to_object=to_world.inverse())
    assert np.allclose(
        np.array(moved.eval(mi.BSDFContext(), si, wo)[0]), still, rtol=0.02, atol=0.02
    )


def test_a_mesh_without_uvs(variant, tmp_path):
    mesh = mi.Mesh("bare", vertex_count=3, face_count=1)
    params = mi.traverse(mesh)
    params["vertex_positions"] = mi.Float([-1, -1, 0, 1, -1, 0, 0, 1, 0])
    params["faces"] = mi.UInt32([0, 1, 2])
    params.update()
    file = str(tmp_path / "bare.ply")
    mesh.write_ply(file)
    image = picture({"type": "ply", "filename": file, "bsdf": describe(space="object")})
    assert image.std() > 0.1 * image.mean()
    said = refused({"type": "ply", "filename": file, "bsdf": describe()})
    assert "has no UV coordinates" in said


def refused(shape: dict) -> str:
    """All that is said where a shape is refused: Dr.Jit wraps the error."""
    with pytest.raises(Exception) as caught:  # noqa: PT011
        picture(shape)
    told, error = "", caught.value
    while error is not None:
        told, error = told + str(error), error.__cause__ or error.__context__
    return told


def picture(shape: dict) -> np.ndarray:
    scene = mi.load_dict(
        {
            "type": "scene",
            "integrator": {"type": "glint_path", "max_depth": 2},
            "sensor": {
                "type": "perspective",
                "fov": 20,
                "to_world": mi.ScalarTransform4f().look_at([0, -0.2, 3], [0, -0.2, 0], [0, 1, 0]),
                "film": {"type": "hdrfilm", "width": 24, "height": 24},
            },
            "lamp": {"type": "point", "position": [0.3, 0.4, 3.0], "intensity": 3.0},
            "shape": shape,
        }
    )
    return np.array(mi.render(scene, spp=16, seed=1))


def test_curves_have_no_frame(variant, tmp_path):
    (tmp_path / "hair.txt").write_text("0 0 0 0.1\n0 1 0 0.1\n0 2 0 0.1\n0 3 0 0.1\n")
    curve = {"type": "bsplinecurve", "filename": str(tmp_path / "hair.txt")}
    said = refused({**curve, "bsdf": describe(space="object")})
    assert 'glint_particles: "space" must be uv on ' in said and ", a curve, " in said


# --------------------------------------------------------------------------------------------------
#  Parameters
# --------------------------------------------------------------------------------------------------

NO_MAP = ("wrap_mode", "map_type", "height_scale", "filename", "data", "bitmap")
BAD_SHARED_PARAMETERS = [
    case for case in suite.BAD_PARAMETERS if case[1] not in NO_MAP and "data" not in case[0]
]

NEGATIVE, NOT_FINITE = (np.array([[[0.5, value, 0.5]]], np.float32) for value in (-0.1, suite.NAN))
BAD_OWN_PARAMETERS = [
    ({"distribution": "phong"}, "distribution"),
    ({"masking": "smith"}, "masking"),
    ({"height_correlated": 1}, "height_correlated"),
    ({"alpha": 0.0}, "alpha"),
    ({"alpha": 0.3, "alpha_u": 0.2}, "alpha"),
    ({"alpha_v": -0.1}, "alpha_v"),
    ({"micro_alpha": 0.0}, "micro_alpha"),
    ({"micro_alpha": 1e-45}, "micro_alpha"),
    ({"micro_alpha": 0.16}, "micro_alpha"),
    ({"micro_alpha": 0.2, "distribution": "beckmann"}, "micro_alpha"),
    ({"alpha_v": 0.01, "micro_alpha": 0.01}, "micro_alpha"),
    ({"density": suite.NAN}, "density"),
    ({"density": 16.5}, "density"),
    ({"density": 1e30}, "density"),
    ({"density": -9.0}, "density"),
    ({"seed": -1}, "seed"),
    ({"seed": 0.5}, "seed"),
    ({"colors": "rainbow"}, "colors"),
    ({"colors": NEGATIVE}, "colors"),
    ({"colors": NOT_FINITE}, "colors"),
    ({"color": {"type": "rgb", "value": [0.5, -0.1, 0.5]}}, "color"),
    ({"color": {"type": "rgb", "value": [0.5, 0.1, 1.5]}}, "color"),
    ({"color": "red"}, "color"),
    ({"color": 0.5, "colors": "wheel"}, "colors"),
    ({"color": 0.5, "hue_variation": 0.6}, "hue_variation"),
    ({"color": 0.5, "saturation_variation": -0.1}, "saturation_variation"),
    ({"color": 0.5, "value_variation": suite.NAN}, "value_variation"),
    ({"space": "world"}, "space"),
    ({"space": "object", "to_object": 2.0}, "to_object"),
    ({"space": 3}, "space"),
]


@pytest.mark.parametrize(
    ("changes", "parameter"), BAD_SHARED_PARAMETERS + BAD_OWN_PARAMETERS, ids=str
)
def test_bad_parameters(variant, changes, parameter):
    if isinstance(changes.get("colors"), np.ndarray):
        changes = {"colors": mi.Bitmap(changes["colors"])}
    suite.check_rejects(describe(), changes, parameter)


def test_a_transform_of_space_must_be_invertible(variant):
    flat = mi.ScalarTransform4f(np.diag([1.0, 1.0, 0.0, 1.0]))
    suite.check_rejects(describe(space="object"), {"to_object": flat}, "to_object")
    identity = mi.ScalarTransform4f()
    suite.check_rejects(describe(space="object"), {"to_uv": identity}, "to_uv")


def test_changed_parameters_take_effect(variant):
    changes = {"alpha_u": 0.4, "alpha_v": 0.2, "density": 6.2, "micro_alpha": 0.03}
    bsdf, fresh = load(density=5.0), load(**changes)
    params = mi.traverse(bsdf)
    for key, value in changes.items():
        params[key] = value
    params.update()
    si, bs, weight = suite.sample(bsdf, RESOLVED, 500)
    _, bs_fresh, weight_fresh = suite.sample(fresh, RESOLVED, 500)
    assert dr.allclose(bs.wo, bs_fresh.wo, atol=1e-5)
    assert (~np.isclose(weight, weight_fresh, rtol=1e-2)).mean() < 0.01


@pytest.mark.parametrize(("key", "value"), [("density", suite.NAN), ("micro_alpha", 0.4)])
def test_changed_parameters_are_checked(variant, key, value):
    params = mi.traverse(load())
    params[key] = value
    with pytest.raises(ValueError, match=f'glint_particles: "{key}" must be'):
        params.update()


def test_describes_itself(variant):
    text = str(load(colors="wheel", density=7.5, material="Al"))
    for part in ("GlintParticles", "density=7.5", "wheel", "ggx", "Conductor"):
        assert part in text


# --------------------------------------------------------------------------------------------------
#  Inside Mitsuba
# --------------------------------------------------------------------------------------------------


def render(bsdf: dict, integrator: str = "path", spp: int = 64) -> np.ndarray:
    """A square under a constant sky and a lamp."""
    lights = {
        "sky": {"type": "constant", "radiance": 0.5},
        "lamp": {"type": "point", "position": [0, 1, 2], "intensity": 2.0},
    }
    return suite.square(bsdf, {"type": integrator, "hide_emitters": True}, lights=lights, spp=spp)


@pytest.mark.parametrize("integrator", ["path", "direct", "prb", "volpath", "glint_path"])
def test_dense_is_roughconductor(variant, integrator):
    glints = describe(density=13.0, footprint_sigma=0.5, pixel_spread=3.6e-3, material="Cu")
    smooth = {"type": "roughconductor", "distribution": "ggx", "alpha": 0.3, "material": "Cu"}
    spp = 1024 if integrator == "glint_path" else 256
    glints = render(glints, integrator, spp)
    smooth = render(smooth, "path" if integrator == "glint_path" else integrator, spp)
    assert np.isclose(glints.mean(), smooth.mean(), rtol=5e-3)


def test_adapters(variant):
    glints = describe(footprint_sigma=0.5, pixel_spread=3.6e-3, density=6.0)
    plain = render(glints)
    assert plain.std() > 0.05
    assert np.allclose(render({"type": "twosided", "nested": glints}), plain, rtol=1e-3, atol=1e-3)


def test_default_facets_of_a_polished_surface(variant):
    """Facets are as rough as the surface allows where that is less than their usual roughness."""
    for alpha, expected in ((0.3, 0.01), (0.01, 0.005), (1e-4, 5e-5)):
        params = mi.traverse(load(alpha_v=alpha))
        assert params["micro_alpha"][0] == pytest.approx(expected)
