"""Derivatives of images: every BSDF, every parameter flagged differentiable, all integrators."""

from __future__ import annotations

from math import log

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest

from glintbsdf import Footprint
from glintbsdf.check.derivatives import (
    INTEGRATORS,
    STEP,
    check_render_derivatives,
    examples,
    render_derivatives,
)
from glintbsdf.check.suite import View
from glintbsdf.pndf import Flakes, Grid

NAMES = (
    *("elements", "elements, lamp", "manifold", "manifold, map", "tables"),
    *("lean", "diffuse", "mip", "flakes", "grid", "particles"),
)


def bsdf(name: str, **settings) -> dict:
    """The description of an example without its adapter."""
    return {**examples()[name][0]["nested"], **settings}


def two_sided(nested: dict) -> dict:
    return {"type": "twosided", "nested": nested}


@pytest.mark.parametrize("name", NAMES)
def test_derivatives_of_an_image(variant, name):
    assert set(examples()) == set(NAMES)
    plate, keys, settings = examples()[name]
    # What makes noise: the lamp's edge where a BSDF's samples cross it, and random patterns.
    noisy = {"elements, lamp": 0.15, "manifold, map": 0.3, "grid": 0.15}
    check_render_derivatives(plate, keys, "prb", noisy.get(name, 0.05), **settings)


# Other methods of the same plugins: the example, what differs, and the parameters.
VARIATIONS = [
    *(
        ("lean", {"method": m}, ("alpha", "data"))
        for m in ("toksvig", "variance", "clean", "leadr")
    ),
    ("elements", {"elements": "flat"}, ("sigma_r", "footprint_sigma", "data")),
    ("elements", {"step": 0.7}, ("sigma_r", "footprint_sigma", "data")),
    ("diffuse", {"method": "oren_nayar"}, ("data", "reflectance.value")),
]


@pytest.mark.parametrize("name, settings, keys", VARIATIONS)
def test_derivatives_of_other_methods(variant, name, settings, keys):
    check_render_derivatives(two_sided(bsdf(name, **settings)), keys, "prb", 0.05)


def test_the_example_of_tables_uses_tables(variant):
    tables = mi.load_dict(bsdf("tables"))
    sigma = 0.5 * 3 * tables.pixel_spread * tables.footprint_sigma  # of a plate of 2 units, 3 away
    for factor in (1 - STEP, 1 + STEP):
        level = tables.pndf.level(Footprint.isotropic(mi.Point2f(0.5), sigma * factor))
        assert dr.all(level >= 0)


# Masking is left out where it is not what differs.
@pytest.mark.parametrize("integrator", ["prb_basic", "direct"])
def test_derivative_in_other_integrators(variant, integrator):
    plate = two_sided(bsdf("elements", masking="none"))
    check_render_derivatives(plate, ["sigma_r"], integrator, 0.15, **INTEGRATORS[integrator])


@pytest.mark.parametrize("integrator", ["path", "glint_path"])
def test_derivatives_in_symbolic_integrators(variant, integrator):
    plate = two_sided(bsdf("elements", masking="none"))
    check_render_derivatives(
        plate, ["sigma_r", "data"], integrator, lamp="sphere", spp=64, resolution=0.3
    )


def test_the_manifold_under_integrated_lights(variant):
    """Elements answer with derivatives and without: the images are those of the differences."""
    plate, keys, settings = examples()["manifold, map"]
    settings = {**settings, "lamp": "sphere", "spp": 64}
    (derivative,) = render_derivatives(plate, keys, "glint_path", **settings)
    assert derivative.right and derivative.noise < 0.01 * abs(derivative.difference), derivative


def test_merged_elements_under_integrated_lights(variant):
    """Sharp elements in a wide footprint, under a wide lamp: merged elements answer."""
    to_uv = mi.ScalarTransform4f().scale([10, 10, 1])
    settings = {"sigma_r": 0.005, "footprint_sigma": 6.0, "masking": "none", "to_uv": to_uv}
    plate = two_sided(bsdf("elements", **settings))
    (derivative,) = render_derivatives(plate, ["data"], "glint_path", lamp="sphere", spp=64)
    assert derivative.right and derivative.noise < 0.01 * abs(derivative.difference), derivative


@pytest.mark.parametrize("integrator", ["prb", "path", "glint_path"])
def test_derivative_in_forward_mode(variant, integrator):
    plate = two_sided(bsdf("elements", masking="none"))
    check_render_derivatives(plate, ["sigma_r"], integrator, modes=("forward",))


def test_what_has_no_derivative_says_so(variant):
    """Instead of a derivative of zero."""
    grid = mi.load_dict(bsdf("grid"))
    params = mi.traverse(grid)
    dr.enable_grad(params["detail_alpha_u"])
    with pytest.raises(ValueError, match='glint_grid: "detail_alpha_u" has no derivative'):
        grid.eval(mi.BSDFContext(), View().interaction(), mi.Vector3f(0, 0, 1))
    dr.disable_grad(params["detail_alpha_u"])
    grid.eval(mi.BSDFContext(), View().interaction(), mi.Vector3f(0, 0, 1))


# A step of an optimisation that leaves the range: the parameter, and what it becomes.
STEPS_TOO_FAR = [
    ("elements", "sigma_r", -0.01),
    ("elements", "pixel_spread", -0.01),
    ("elements", "data", 1.5),
    ("manifold", "footprint_sigma", -1.0),
    ("lean", "alpha", 0.0),
    ("lean", "specular_reflectance.value", 1.5),
    ("lean", "eta.value", -0.5),
    ("diffuse", "reflectance.value", -0.1),
    ("flakes", "flake_alpha", -0.1),
    ("flakes", "flake_density", 0.2),
    ("grid", "alpha_u", -0.1),
    ("grid", "intensity", -0.1),
]


@pytest.mark.parametrize("name, key, value", STEPS_TOO_FAR)
def test_a_step_out_of_range_is_an_error_with_the_value(variant, name, key, value):
    params = mi.traverse(mi.load_dict(bsdf(name)))
    params[key] = params[key] * 0 + value
    plugin, parameter = bsdf(name)["type"], key.removesuffix(".value")
    with pytest.raises(ValueError, match=rf'{plugin}: .*"{parameter}".*\(got .*\)'):
        params.update()


def test_flakes_keep_their_places_as_they_turn(variant):
    flakes = mi.load_dict(bsdf("flakes", flake_alpha=0.1))
    params = mi.traverse(flakes)
    before = flakes.pndf.flakes.numpy().reshape(-1, 4)
    params["flake_alpha"] = mi.Float(0.2)
    params.update()
    after = flakes.pndf.flakes.numpy().reshape(-1, 4)
    assert (after[:, :2] == before[:, :2]).all()
    fresh = mi.load_dict(bsdf("flakes", flake_alpha=0.2)).pndf.flakes.numpy().reshape(-1, 4)
    assert abs(after - fresh).max() < 1e-7
    assert dr.allclose(flakes.pndf.alpha_squared(), 0.04)
    params["flake_alpha"] = mi.Float(-0.1)
    with pytest.raises(ValueError, match='"flake_alpha" must be a finite number ≥ 0'):
        params.update()


# The P-NDF for a seed and a density; ln of the density per unit of the parameter, and its step; and
# the standard deviations of a footprint.
DENSITIES = {
    "flakes": (
        lambda seed, density: Flakes(density, sigma_r=0.05, seed=seed),
        *("flake_density", 4000.0, 1 / 4000.0, 1600.0, (0.01, 0.01)),
    ),
    "grid": (
        lambda seed, density: Grid(density=density, seed=seed),
        *("density", 4.0, log(10), 0.1, (0.03, 0.09)),
    ),
}


@pytest.mark.parametrize("name", DENSITIES)
def test_derivative_with_respect_to_density_is_that_of_contrast(variant, name):
    """On average over places: each density has a pattern of its own."""
    make, key, density, scale, step, (du, dv) = DENSITIES[name]
    rng = np.random.default_rng(1)
    uv = mi.Point2f(*(mi.Float(row) for row in rng.random((2, 1 << 15), np.float32)))
    m = mi.Vector2f(*(mi.Float(row) for row in rng.normal(0, 0.1, (2, 1 << 15)).astype("f4")))
    du, dv = (dr.opaque(mi.Float, sigma) for sigma in (du, dv))

    def mean_square(pndf):
        footprint = Footprint(uv, mi.Vector2f(du, 0), mi.Vector2f(0, dv))
        return dr.mean(dr.square(pndf.eval(m, footprint)))

    ours, theirs = [], []
    for seed in range(4):
        pndf = make(seed, density)
        dr.enable_grad(getattr(pndf, key))
        value = mean_square(pndf)
        dr.backward(value)
        ours.append(dr.grad(getattr(pndf, key))[0] / (scale * value[0]))
        more, fewer = (mean_square(make(seed, density + sign * step))[0] for sign in (1, -1))
        ratio = log((density + step) / (density - step)) if name == "flakes" else 2 * step * scale
        theirs.append((more - fewer) / (ratio * value[0]))
    noise = 3 * np.std(np.subtract(ours, theirs), ddof=1) / 2
    assert abs(np.mean(ours) - np.mean(theirs)) <= noise, (ours, theirs)
    assert noise <= 0.5 * abs(np.mean(theirs)), (ours, theirs)


@pytest.mark.parametrize("adapter", ["normalmap", "blendbsdf"])
def test_derivative_inside_of_adapters(variant, adapter):
    nested = bsdf("elements", masking="none")
    if adapter == "normalmap":
        flat = mi.TensorXf([0.5, 0.5, 1.0], (1, 1, 3))
        texture = {"type": "bitmap", "data": flat, "raw": True, "filter_type": "nearest"}
        outer = {"type": "normalmap", "normalmap": texture, "nested": nested}
    else:
        outer = {
            "type": "blendbsdf",
            "weight": 0.3,
            "first": nested,
            "second": {"type": "diffuse"},
        }
    check_render_derivatives(two_sided(outer), ["sigma_r"], "prb")
