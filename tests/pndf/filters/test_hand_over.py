"""The transition from a P-NDF to its smooth limit."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest

from glintbsdf import Footprint, maps
from glintbsdf.check import suite
from glintbsdf.check.reference import normal_bounds
from glintbsdf.check.suite import View
from glintbsdf.pndf import HandOver, Manifold

MAP = maps.isotropic(64, seed=1)


def describe(**parameters) -> dict:
    return {
        "type": "glint_manifold",
        "data": mi.TensorXf(MAP.normals),
        "footprint_sigma": 1.0,
        "masking": "none",
        "epsilon": 1e-3,
        "hand_over": 4.0,
        **parameters,
    }


def test_weight_follows_the_size_of_the_footprint(variant):
    pndf = HandOver(Manifold(MAP), 4.0)
    sizes = np.float32([0, 1, 3.99, 2**2.5, 8.01, 30])
    weight = pndf.weight(Footprint.isotropic(mi.Point2f(0.5), mi.Float(sizes / 64)))
    assert np.allclose(weight, [0, 0, 0, 0.5, 1, 1], atol=1e-3)
    stretched = Footprint(mi.Point2f(0.5), mi.Vector2f(16 / 64, 0), mi.Vector2f(0, 2 / 64))
    assert np.isclose(pndf.weight(stretched)[0], 0.5, atol=1e-3)


@pytest.mark.parametrize("size", [2, 5, 7, 12])
def test_density(variant, size):
    view = View(du=(size / 64, 0), dv=(0, size / 64), wi=(0.2, 0.1, 1))
    (x_min, y_min), (x_max, y_max) = normal_bounds(MAP, 1e-3)
    # The lobe reaches beyond the map's normals.
    bounds = ((1.5 * x_min, 1.5 * y_min), (1.5 * x_max, 1.5 * y_max))
    bsdf = mi.load_dict(describe())
    suite.check_chi2(bsdf, view, bounds, test_count=4)
    suite.check_eval_pdf(bsdf, view)
    suite.check_weights(bsdf, view)


def test_far_away_it_is_the_lobe_and_near_by_the_manifold(variant):
    pndf = HandOver(Manifold(MAP), 4.0)
    u = suite.random_numbers(500, 2, seed=1)
    m = mi.Vector2f(0.4 * u[0] - 0.2, 0.4 * u[1] - 0.2)
    for size, expected in ((3, pndf.near), (9, pndf.far)):
        footprint = Footprint.isotropic(mi.Point2f(0.3, 0.6), size / 64)
        assert dr.allclose(pndf.eval(m, footprint), expected.eval(m, footprint), rtol=1e-5)


def test_changed_map_changes_both(variant):
    bsdf = mi.load_dict(describe())
    new = maps.isotropic(64, alpha=0.3, seed=2)
    params = mi.traverse(bsdf)
    params["data"] = mi.TensorXf(new.normals)
    params.update()
    fresh = mi.load_dict(describe(data=mi.TensorXf(new.normals)))
    si, bs, _ = suite.sample(fresh, View(du=(6 / 64, 0), dv=(0, 6 / 64)), 200)
    ctx = mi.BSDFContext()
    assert dr.allclose(bsdf.eval(ctx, si, bs.wo), fresh.eval(ctx, si, bs.wo), rtol=1e-3)


@pytest.mark.parametrize("value", [-1.0, suite.NAN, "far"])
def test_bad_size(variant, value):
    suite.check_rejects(describe(), {"hand_over": value}, "hand_over")
