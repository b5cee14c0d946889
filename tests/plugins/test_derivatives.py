"""Derivatives of images: every BSDF, every parameter flagged differentiable, all integrators."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi
import pytest

from glintbsdf import maps
from glintbsdf.check.suite import View, check_render_derivative

# Parameters, and samples per pixel where more than usual are needed to see the derivative.
WITH_MAP = {
    "elements": {"type": "glint_elements", "sigma_r": 0.05},
    "manifold": {"type": "glint_manifold", "footprint_sigma": 2.0},
    "tables": {"type": "glint_manifold", "footprint_sigma": 3.0, "max_error": 0.05},
    "lean": {"type": "glint_filtered", "method": "lean", "alpha": 0.1},
    "diffuse": {"type": "glint_diffuse", "footprint_sigma": 2.0},
    "mip": {"type": "glint_mip", "output_size": 128, "patch_size": 16, "sigma_r": 0.05},
}
WITHOUT_MAP = {
    "flakes": {"type": "glint_elements", "flake_density": 400.0, "sigma_r": 0.08},
    "grid": {"type": "glint_grid", "alpha": 0.2, "density": 6.0},
    "particles": {
        "type": "glint_particles",
        "alpha": 0.2,
        "micro_alpha": 0.05,
        "density": 4.0,
    },
}
KEYS = [
    ("elements", "sigma_r", 64),
    ("elements", "footprint_sigma", 64),
    ("elements", "pixel_spread", 64),
    ("elements", "data", 64),
    ("manifold", "footprint_sigma", 256),
    ("manifold", "pixel_spread", 256),
    ("manifold", "data", 512),
    ("tables", "footprint_sigma", 256),
    ("lean", "alpha", 64),
    ("lean", "pixel_spread", 64),
    ("lean", "data", 64),
    ("diffuse", "data", 256),
    ("mip", "sigma_r", 64),
    ("flakes", "sigma_r", 64),
    ("flakes", "flake_alpha", 64),
    ("grid", "alpha_u", 64),
    ("particles", "alpha_u", 256),
    ("particles", "alpha_v", 256),
    ("particles", "micro_alpha", 256),
]


def bsdf(name: str, **settings) -> dict:
    if name in WITHOUT_MAP:
        description = WITHOUT_MAP[name]
    else:
        normals = maps.isotropic(32, alpha=0.2, correlation_length=3, seed=5).normals
        description = {**WITH_MAP[name], "data": mi.TensorXf(normals)}
    return {"pixel_spread": 0.02, **description, **settings}


def two_sided(nested: dict) -> dict:
    return {"type": "twosided", "nested": nested}


@pytest.mark.parametrize("name, key, spp", KEYS)
def test_derivative_of_an_image(variant, name, key, spp):
    check_render_derivative(two_sided(bsdf(name)), key, "prb", spp)


@pytest.mark.parametrize("integrator", ["prb_basic", "direct", "path", "glint_path"])
def test_derivative_in_every_integrator(variant, integrator):
    check_render_derivative(two_sided(bsdf("elements")), "sigma_r", integrator)


@pytest.mark.parametrize("integrator", ["prb", "path", "glint_path"])
def test_derivative_in_forward_mode(variant, integrator):
    check_render_derivative(
        two_sided(bsdf("elements")), "sigma_r", integrator, spp=256, seeds=3, modes=("forward",)
    )


@pytest.mark.parametrize("integrator", ["path", "glint_path"])
def test_derivative_of_a_map_in_symbolic_integrators(variant, integrator):
    check_render_derivative(two_sided(bsdf("elements")), "data", integrator)


def test_what_has_no_derivative_says_so(variant):
    """Instead of a derivative of zero."""
    grid = mi.load_dict(bsdf("grid"))
    params = mi.traverse(grid)
    dr.enable_grad(params["density"])
    with pytest.raises(ValueError, match='glint_grid: "density" has no derivative'):
        grid.eval(mi.BSDFContext(), View().interaction(), mi.Vector3f(0, 0, 1))
    dr.disable_grad(params["density"])
    grid.eval(mi.BSDFContext(), View().interaction(), mi.Vector3f(0, 0, 1))


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


@pytest.mark.parametrize("adapter", ["normalmap", "blendbsdf"])
def test_derivative_inside_of_adapters(variant, adapter):
    nested = bsdf("elements")
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
    check_render_derivative(two_sided(outer), "sigma_r", "prb")


@pytest.mark.parametrize("name, key", [("elements", "sigma_r"), ("manifold", "data")])
def test_steps_of_an_optimisation_need_no_new_kernel(variant, name, key):
    plate = {"type": "rectangle", "bsdf": two_sided(bsdf(name, masking="none"))}
    scene = mi.load_dict(
        {
            "type": "scene",
            "integrator": {"type": "prb", "max_depth": 2},
            "sensor": {
                "type": "perspective",
                "to_world": mi.ScalarTransform4f().look_at([0, 0, 3], [0, 0, 0], [0, 1, 0]),
                "film": {"type": "hdrfilm", "width": 4, "height": 4},
            },
            "plate": plate,
            "light": {"type": "point", "position": [0.2, 0.1, 4], "intensity": 1.0},
        }
    )
    params = mi.traverse(scene)
    (name,) = (k for k in params.keys() if k.endswith("." + key))  # noqa: SIM118 (not a dict)
    start = params[name] + 0
    missed = []
    for step in range(3):
        # As optimisers do it: a factor written as a number would be a part of a kernel.
        params[name] = start * dr.opaque(mi.Float, 1 + 0.01 * step)
        dr.enable_grad(params[name])
        dr.kernel_history_clear()
        with dr.scoped_set_flag(dr.JitFlag.KernelHistory, True):
            params.update()
            dr.backward(dr.mean(mi.render(scene, params, spp=4, seed=step), axis=None))
            dr.eval(dr.grad(params[name]))
            history = dr.kernel_history([dr.KernelType.JIT])
        missed.append(sum(not kernel["cache_hit"] for kernel in history))
    assert missed[2] == 0, missed
