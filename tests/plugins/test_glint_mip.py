"""The plugin glint_mip: the shared suite at three footprints, at seams and levels; its errors."""

from __future__ import annotations

from dataclasses import replace
from math import cos, sin, sqrt
from pathlib import Path

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest

from glintbsdf import Footprint, NormalMap, maps
from glintbsdf.check import suite
from glintbsdf.check.derivatives import check_value_derivatives
from glintbsdf.check.suite import EXTREME_VIEWS, View

SAMPLE = maps.isotropic(64, alpha=0.15, seed=1)
SIZE, PATCH = 128, 28  # cells of 25 and 26 texels, divided into 2×2 grids
SIGMA_R = 0.03  # wide enough for the suite's bins
WI = (0.3, 0.1, 1)


def describe(sample: NormalMap = SAMPLE, **parameters) -> dict:
    return {
        "type": "glint_mip",
        "data": mi.TensorXf(sample.normals),
        "wrap_mode": sample.wrap_mode,
        "output_size": SIZE,
        "patch_size": PATCH,
        "clusters": 8,
        "sigma_r": SIGMA_R,
        "footprint_sigma": 1.0,
        "masking": "none",
        **parameters,
    }


def load(sample: NormalMap = SAMPLE, **parameters) -> mi.BSDF:
    return mi.load_dict(describe(sample, **parameters))


def view(sigma: float, uv=(0.37, 0.61)) -> View:
    """A rotated footprint, 1.5 times as long as wide, whose geometric mean is ``sigma`` texels."""
    a, c, s = sigma * sqrt(1.5) / SIZE, cos(0.5), sin(0.5)
    return View(uv, (a * c, a * s), (-a * s / 1.5, a * c / 1.5), WI)


# Levels: texels below λ = 3, grids of half a cell at 4, cells at 5, …; (2σ)² texels are the area.
VIEWS = {
    "texels": view(0.7),
    "between texels and grids": view(5.0),
    "grids, integer level": view(8.0),
    "grids and cells": view(11.0),
    "cells, integer level": view(16.0),
    "whole map": view(100.0),
    "on a seam": view(0.7, uv=(51 / SIZE, 77 / SIZE)),  # cells begin at 51 and 76 texels
    "grids on a seam": view(9.0, uv=(51 / SIZE, 77 / SIZE)),
    "on the edge": view(6.0, uv=(1.0, 0.0)),
}
STIFF_SAMPLES = {
    "clamp": NormalMap(SAMPLE.normals, "clamp"),
    "mirror": NormalMap(SAMPLE.normals, "mirror"),
    "scratched": maps.scratched(64, length=30),
    "smallest": maps.isotropic(PATCH + 1, alpha=0.15, seed=2),
}
DENSITY_TESTS = len(VIEWS) + 2 * len(STIFF_SAMPLES) + 5


# A square within the disk that holds all normals of the samples and five σ_r more.
BOUNDS = ((-0.7, -0.7), (0.7, 0.7))


# --------------------------------------------------------------------------------------------------
#  The shared suite
# --------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("name", VIEWS)
def test_density(variant, name):
    suite.check_chi2(load(), VIEWS[name], BOUNDS, DENSITY_TESTS, samples=50_000, res=17)


def load_exact(**parameters) -> mi.BSDF:
    """The exact representation, with tables for all but the smallest footprints."""
    return load(representation="exact", max_error=0.1, **parameters)


# By elements of the quads, by the tables of their blocks, and of the whole map
@pytest.mark.parametrize(
    "name", ["texels", "on a seam", "on the edge", "grids on a seam", "cells, integer level"]
)
def test_density_of_the_exact_map(variant, name):
    bsdf = load_exact()
    suite.check_chi2(bsdf, VIEWS[name], BOUNDS, DENSITY_TESTS, samples=50_000, res=17)
    suite.check_eval_pdf(bsdf, VIEWS[name])
    suite.check_weights(bsdf, VIEWS[name])


def test_the_exact_map_in_extreme_and_oblique_views(variant):
    for seen in EXTREME_VIEWS.values():
        suite.check_finite(load_exact(sigma_r=1e-3), seen)
    bsdf = load_exact(masking="footprint")
    for name in ("texels", "cells, integer level", "whole map"):
        seen = replace(VIEWS[name], wi=(-1, -1, 0.2))
        suite.check_furnace(bsdf, seen, count=4000)
        suite.check_adjoint(bsdf, seen)


def test_each_representation_has_parameters_of_its_own(variant):
    assert type(load_exact().pndf).__name__ == "Patches"
    for changes, parameter in (
        ({"max_error": -0.1}, "max_error"),
        ({"representation": "lists"}, "representation"),
        ({"wrap_mode": "mirror"}, "representation"),
    ):
        suite.check_rejects({**describe(), "representation": "exact"}, changes, parameter)


@pytest.mark.parametrize("name", STIFF_SAMPLES)
def test_density_of_stiff_samples(variant, name):
    bsdf = load(STIFF_SAMPLES[name])
    for sigma in (1.0, 9.0):
        seen = view(sigma, uv=(1.01, 0.02))  # across the border
        suite.check_chi2(bsdf, seen, BOUNDS, DENSITY_TESTS, samples=50_000, res=17)


@pytest.mark.parametrize("name", ["texels", "grids and cells", "whole map"])
def test_consistency(variant, name):
    bsdf = load(material="Au", masking="footprint")
    for seen in (VIEWS[name], replace(VIEWS[name], wi=(-1, 1, 0.2))):
        suite.check_eval_pdf(bsdf, seen)
        suite.check_weights(bsdf, seen)
        suite.check_horizon(bsdf, seen)
        suite.check_adjoint(bsdf, seen)


@pytest.mark.parametrize("wrap_mode", ["repeat", "mirror", "clamp"])
def test_extremes_are_finite(variant, wrap_mode):
    bsdf = load(NormalMap(SAMPLE.normals, wrap_mode), sigma_r=1e-5)
    for seen in EXTREME_VIEWS.values():
        suite.check_finite(bsdf, seen)


def test_furnace(variant):
    bsdf = load(masking="footprint")
    for wi in ((0, 0, 1), (1, 0, 1), (-1, -1, 0.2)):
        for name in ("texels", "grids and cells", "whole map"):
            suite.check_furnace(bsdf, replace(VIEWS[name], wi=wi), count=4000)


@pytest.mark.parametrize("name", ["texels", "grids and cells"])
def test_derivatives(variant, name):
    check_value_derivatives(load(), VIEWS[name], "sigma_r", "footprint_sigma")


def test_other_variants(each_variant):
    bsdf = load(material="Al", masking="beckmann")
    suite.check_weights(bsdf, VIEWS["grids and cells"])
    suite.check_finite(bsdf, VIEWS["texels"])


@pytest.mark.parametrize(("changes", "parameter"), suite.BAD_PARAMETERS)
def test_bad_shared_parameters(variant, changes, parameter):
    suite.check_rejects(describe(), changes, parameter)


# --------------------------------------------------------------------------------------------------
#  Its own parameters
# --------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("changes", "parameter"),
    [
        ({"patch_size": 64}, "patch_size"),  # not smaller than the sample
        ({"patch_size": 2}, "patch_size"),
        ({"patch_size": 8.0}, "patch_size"),
        ({"overlap": 14}, "overlap"),  # not smaller than half a patch
        ({"overlap": 0}, "overlap"),
        ({"output_size": PATCH}, "output_size"),
        ({"output_size": 1 << 17}, "output_size"),
        ({"output_size": 31, "overlap": 13}, "overlap"),  # cells smaller than the overlap
        ({"clusters": 0}, "clusters"),
        ({"clusters": 16.0}, "clusters"),
        ({"clusters": True}, "clusters"),
        ({"lod_scale": -0.5}, "lod_scale"),
        ({"lod_scale": suite.NAN}, "lod_scale"),
        ({"balance": 1.5}, "balance"),
        ({"normal_weight": -1.0}, "normal_weight"),
        ({"sigma_r": 0.0}, "sigma_r"),
        ({"sigma_r": suite.NAN}, "sigma_r"),
        ({"seed": -1}, "seed"),
        ({"seed": 0.5}, "seed"),
        ({"masking": "ggx_fit"}, "masking"),
    ],
)
def test_bad_parameters(variant, changes, parameter):
    suite.check_rejects(describe(), changes, parameter)


def test_a_uniform_sample_works_and_says_so(variant, capfd):
    bsdf = load(maps.tilted(40, 0.2))
    assert "glint_mip: the sample has 1 distinct normals" in "".join(capfd.readouterr())
    for seen in (VIEWS["texels"], VIEWS["grids and cells"]):
        suite.check_chi2(bsdf, seen, BOUNDS, 1, samples=20_000, res=17)
        # All normals are the one of the sample, within σ_r
        normal = mi.Vector2f(*maps.tilted(1, 0.2).normals[0, 0].tolist())
        peak = suite.density(bsdf, seen, normal)
        assert dr.allclose(peak, 1 / (2 * np.pi * SIGMA_R**2), rtol=1e-2)


def test_the_finest_level_is_that_of_all_texels(variant):
    # lod_scale = 0 leaves texels at every footprint
    bsdf = load(lod_scale=0.0)
    level, above, fraction = bsdf.pndf.level(bsdf.pndf.texel_kernel(footprint(VIEWS["whole map"])))
    assert level[0] == 0 and above[0] == 0 and fraction[0] == 0


def footprint(seen: View) -> Footprint:
    return Footprint(mi.Point2f(seen.uv), mi.Vector2f(seen.du), mi.Vector2f(seen.dv))


def test_new_data_make_a_new_map(variant):
    bsdf = load()
    params = mi.traverse(bsdf)
    before = suite.density(bsdf, VIEWS["grids and cells"], mi.Vector2f(0.1, 0.05))
    params["data"] = mi.TensorXf(maps.isotropic(64, alpha=0.1, seed=3).normals)
    params.update()
    after = suite.density(bsdf, VIEWS["grids and cells"], mi.Vector2f(0.1, 0.05))
    assert abs(after[0] / before[0] - 1) > 0.1
    fresh = load(maps.isotropic(64, alpha=0.1, seed=3))
    assert dr.allclose(
        after, suite.density(fresh, VIEWS["grids and cells"], mi.Vector2f(0.1, 0.05))
    )


@pytest.mark.openexr
def test_the_scene_renders_its_glints(variant):
    scenes = Path(__file__).parents[2] / "scenes"
    small = {"resx": "24", "resy": "24", "spp": "4", "output_size": "300"}
    scene = mi.load_file(str(scenes / "samples.xml"), **small, pixel_spread="0.005")
    image = np.array(mi.render(scene, seed=1))
    assert np.isfinite(image).all() and image.mean() > 0.01
