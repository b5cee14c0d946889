"""The plugin glint_elements: the shared suite for curved and flat elements and for flakes; its
errors."""

from __future__ import annotations

from dataclasses import replace

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest

from glintbsdf import NormalMap, maps
from glintbsdf.check import suite
from glintbsdf.check.suite import EXTREME_VIEWS, View

SIGMA_R = 0.01
MAP = maps.isotropic((29, 36), seed=1)
RUGGED = NormalMap(np.random.default_rng(2).normal(scale=0.1, size=(9, 14, 2)))
STIFF_MAPS = {
    "flat": maps.flat(16),
    "tilted": maps.tilted(7),
    "one_texel": maps.tilted(1),
    "1xN": NormalMap(MAP.normals[:1]),
    "rugged": RUGGED,
    "mirror": NormalMap(MAP.normals, "mirror"),
    "clamp": NormalMap(MAP.normals, "clamp"),
}
KINDS = {
    "curved": {},
    "flat": {"elements": "flat"},
    "coarse": {"step": 2.0},
    "uneven": {"step": 0.7},
    "flakes": {"flake_density": 500.0, "flake_alpha": 0.15, "data": None},
}
VIEWS = {
    "resolved": View(du=(0.04, 0.03), dv=(-0.015, 0.02)),
    "wide": View(du=(0.2, 0.05), dv=(-0.05, 0.1)),
    "small": View(du=(0.004, 0.003), dv=(-0.002, 0.003)),
}
RESOLVED = VIEWS["resolved"]
# Large footprints are evaluated from lists, small ones element by element.
DENSITIES = [(kind, view) for kind in ("curved", "flakes") for view in VIEWS]
DENSITIES += [("flat", "small"), ("coarse", "wide"), ("uneven", "resolved")]
TEST_COUNT = len(DENSITIES) + len(STIFF_MAPS)


def describe(normal_map: NormalMap = MAP, **parameters) -> dict:
    description = {
        "type": "glint_elements",
        "data": mi.TensorXf(normal_map.normals),
        "wrap_mode": normal_map.wrap_mode,
        "sigma_r": SIGMA_R,
        "footprint_sigma": 1.0,
        **parameters,
    }
    if "flake_density" in parameters:
        del description["wrap_mode"]
    return {key: value for key, value in description.items() if value is not None}


def load(normal_map: NormalMap = MAP, **parameters) -> mi.BSDF:
    return mi.load_dict(describe(normal_map, **parameters))


def bounds_of(bsdf: mi.BSDF, view: View) -> suite.Bounds:
    """A rectangle of normals that contains almost all visible ones, to resolve their spikes."""
    si, bs, _ = suite.sample(bsdf, view, 200_000, seed=9)
    m = np.array(dr.normalize(si.wi + bs.wo))[:2]
    return tuple(m.min(axis=1) - SIGMA_R / 2), tuple(m.max(axis=1) + SIGMA_R / 2)


# --------------------------------------------------------------------------------------------------
#  The shared suite
# --------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(("kind", "view"), DENSITIES)
def test_density(variant, kind, view):
    bsdf = load(**KINDS[kind])
    suite.check_chi2(bsdf, VIEWS[view], bounds_of(bsdf, VIEWS[view]), TEST_COUNT)


@pytest.mark.parametrize("name", STIFF_MAPS)
def test_density_of_stiff_maps(variant, name):
    bsdf = load(STIFF_MAPS[name])
    suite.check_chi2(bsdf, RESOLVED, bounds_of(bsdf, RESOLVED), TEST_COUNT)


@pytest.mark.parametrize("kind", ["curved", "flat", "flakes"])
def test_consistency(variant, kind):
    bsdf = load(**KINDS[kind], material="Au")
    for view in (replace(RESOLVED, wi=(-1, 1, 0.4)), EXTREME_VIEWS["1000:1"]):
        suite.check_eval_pdf(bsdf, view, count=500)
        suite.check_weights(bsdf, view, count=500)
        suite.check_horizon(bsdf, view, count=200)
        suite.check_adjoint(bsdf, view)


@pytest.mark.parametrize("kind", ["curved", "flakes"])
def test_extremes_are_finite(variant, kind):
    bsdf = load(**KINDS[kind])
    for view in EXTREME_VIEWS.values():
        suite.check_finite(bsdf, view, count=16)


@pytest.mark.parametrize("sigma_r", [1e-8, 1.0])
def test_extreme_roughness_is_finite(variant, sigma_r):
    bsdf = load(RUGGED, sigma_r=sigma_r)
    for view in ("point", "line", "grazing"):
        suite.check_finite(bsdf, EXTREME_VIEWS[view], count=50)


@pytest.mark.parametrize("kind", ["curved", "flakes"])
def test_furnace(variant, kind):
    bsdf = load(**KINDS[kind])
    for wi in ((0, 0, 1), (1, 0, 1), (0, 1, 0.3), (1, 1, 0.1)):
        suite.check_furnace(bsdf, replace(VIEWS["small"], wi=wi))
        suite.check_furnace(bsdf, replace(EXTREME_VIEWS["one_map"], wi=wi), count=2000)


def test_masking_is_that_of_the_overall_roughness(variant):
    alpha = 0.25
    flakes = {"flake_density": 2000.0, "flake_alpha": alpha, "data": None}
    masked, bare = (load(**flakes, masking=masking) for masking in ("beckmann", "none"))
    si, bs, _ = suite.sample(masked, replace(RESOLVED, wi=(1, 0.2, 0.4)), 500)
    ctx = mi.BSDFContext()
    ratio = masked.eval(ctx, si, bs.wo)[0] / bare.eval(ctx, si, bs.wo)[0]
    m = dr.normalize(si.wi + bs.wo)
    distribution = mi.MicrofacetDistribution(mi.MicrofacetType.Beckmann, alpha, False)
    lambdas = [1 / distribution.smith_g1(w, m) - 1 for w in (si.wi, bs.wo)]
    valid = np.array(bs.pdf) > 0
    # Mitsuba's masking of Beckmann is a rational fit, to about 0.4 % per direction.
    assert np.allclose(np.array(ratio)[valid], np.array(1 / (1 + sum(lambdas)))[valid], rtol=1e-2)


def test_flakes_depend_on_seed_and_density(variant):
    first, again, other = (
        load(**KINDS["flakes"], seed=seed).pndf.flakes.numpy() for seed in (0, 0, 1)
    )
    assert np.array_equal(first, again) and not np.array_equal(first, other)
    assert "500 flakes" in str(load(**KINDS["flakes"]))


# --------------------------------------------------------------------------------------------------
#  Parameters
# --------------------------------------------------------------------------------------------------

NAN = float("nan")


@pytest.mark.parametrize(("changes", "parameter"), suite.BAD_PARAMETERS)
def test_shared_parameters_are_checked(variant, changes, parameter):
    suite.check_rejects(describe(), changes, parameter)


@pytest.mark.parametrize(
    ("changes", "parameter"),
    [
        ({"sigma_r": 0.0}, "sigma_r"),
        ({"sigma_r": -1.0}, "sigma_r"),
        ({"sigma_r": NAN}, "sigma_r"),
        ({"sigma_r": "rough"}, "sigma_r"),
        ({"step": 0.0}, "step"),
        ({"step": -0.5}, "step"),
        ({"step": NAN}, "step"),
        ({"step": float("inf")}, "step"),
        ({"elements": "bent"}, "elements"),
        ({"masking": "ggx_fit"}, "masking"),
        ({"data": None}, "flake_density"),  # neither map nor flakes
        ({"flake_density": 100.0}, "flake_density"),  # besides a map
        ({"flake_alpha": 0.2}, "flake_alpha"),  # without flakes
    ],
)
def test_parameters_are_checked(variant, changes, parameter):
    with pytest.raises(Exception, match=f'glint_elements(?s:.)*"{parameter}"'):
        mi.load_dict(describe(**changes))


@pytest.mark.parametrize(
    ("changes", "parameter"),
    [
        ({"flake_density": 0.0}, "flake_density"),
        ({"flake_density": -5.0}, "flake_density"),
        ({"flake_density": NAN}, "flake_density"),
        ({"flake_alpha": -0.1}, "flake_alpha"),
        ({"flake_alpha": NAN}, "flake_alpha"),
        ({"seed": -1}, "seed"),
        ({"seed": 0.5}, "seed"),
        ({"flake_density": 1e9}, "flake_density"),  # does not fit memory
    ],
)
def test_parameters_of_flakes_are_checked(variant, changes, parameter):
    suite.check_rejects(describe(**KINDS["flakes"]), changes, parameter)


def test_flakes_that_do_not_fit_state_their_need(variant):
    with pytest.raises(Exception, match="1000000000 flakes need 559 GiB"):
        load(**{**KINDS["flakes"], "flake_density": 1e9})
