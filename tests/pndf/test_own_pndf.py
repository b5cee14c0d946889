"""The example of the page "Write your own P-NDF" passes the shared suite; the register of
P-NDFs."""

from __future__ import annotations

import importlib.util
from pathlib import Path

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest

from glintbsdf.check import suite
from glintbsdf.check.suite import View
from glintbsdf.pndf import base

EXAMPLE = Path(__file__).parents[2] / "docs" / "examples" / "waves.py"

VIEWS = {
    "short": View(du=(0.002, 0), dv=(0, 0.003)),
    "rotated": View(du=(0.004, 0.002), dv=(-0.001, 0.002), wi=(0.2, -0.1, 1)),
    "point": View(),
}
BOUNDS = ((-0.25, -0.25), (0.25, 0.25))


@pytest.fixture
def waves(variant):
    spec = importlib.util.spec_from_file_location("waves", EXAMPLE)
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


@pytest.fixture
def bsdf(waves):
    return mi.load_dict({"type": "glint_waves", "footprint_sigma": 1.0})


@pytest.mark.parametrize("view", VIEWS)
def test_passes_the_shared_suite(bsdf, view):
    view = VIEWS[view]
    suite.check_chi2(bsdf, view, BOUNDS, test_count=len(VIEWS))
    suite.check_eval_pdf(bsdf, view)
    suite.check_weights(bsdf, view)
    suite.check_horizon(bsdf, view)
    suite.check_finite(bsdf, view)
    suite.check_furnace(bsdf, view)


def test_renders_and_is_in_the_register(waves):
    image = suite.square({"type": "glint_waves", "pixel_spread": 1e-3})
    assert image.mean() > 0.1
    method = base.methods()["waves"]
    assert method.pndf is waves.Waves and method.plugin == "glint_waves"
    assert isinstance(method.create(amplitude=0.2), waves.Waves)


def test_turn_and_spread_of_a_query(waves):
    """A turn removes the Jacobian, and a spread adds its covariance: the variance of the normals is
    known."""
    from glintbsdf import Footprint
    from glintbsdf.footprint.query import Query

    pndf = waves.Waves(sigma_r=0.01)
    footprint = Footprint(mi.Point2f(0.0), mi.Vector2f(0.004, 0), mi.Vector2f(0, 0.004))
    slope = 2 * np.pi * 10 * 0.1
    turned = Query(footprint, turn=mi.Matrix2f(slope, 0, 0, slope))
    peak = pndf.eval(mi.Vector2f(0), turned)[0]
    assert np.isclose(peak, 1 / (2 * np.pi * 0.01**2), rtol=1e-4)
    spread = Query(turned.footprint, turned.turn, (mi.Vector2f(0.02, 0), mi.Vector2f(0, 0.02)))
    assert np.isclose(
        pndf.eval(mi.Vector2f(0), spread)[0], 1 / (2 * np.pi * (0.01**2 + 0.02**2)), rtol=1e-4
    )


def test_a_query_computes_its_values_once(variant):
    from glintbsdf import Footprint
    from glintbsdf.footprint.query import Query

    query = Query(Footprint(mi.Point2f(0), mi.Vector2f(0.1, 0), mi.Vector2f(0, 0.1)))
    kernels = [query.texel_kernel("gaussian", 64, 64, "repeat") for _ in range(2)]
    assert kernels[0] is kernels[1]
    assert query.texel_kernel("box", 64, 64, "repeat") is not kernels[0]
    assert Query.of(query) is query and dr.allclose(Query.of(query.footprint).footprint.du.x, 0.1)


def test_the_register_refuses_what_lacks_a_part_or_has_a_name_twice(variant):
    class Half(base.PNDF):
        def _eval(self, m, query, active):
            return mi.Float(0)

    with pytest.raises(TypeError, match='P-NDF "half": must implement _sample .got .*Half'):
        base.register("half", title="half")(Half)

    class Other(Half):
        def _sample(self, query, sample1, sample2, active):
            return mi.Vector2f(0)

    with pytest.raises(TypeError, match='P-NDF "manifold": must have a name of its own'):
        base.register("manifold", title="other")(Other)
    with pytest.raises(TypeError, match="must derive from"):
        base.register("number", title="a number")(int)
    assert "half" not in base.methods() and base.methods()["manifold"].pndf.__name__ == "Manifold"


def test_every_method_keeps_the_contract(variant):
    """Every method of the register is finite and not negative, and reports its memory."""
    from glintbsdf import Footprint, maps

    normal_map = maps.isotropic(64, alpha=0.2)
    m = mi.Vector2f(dr.linspace(mi.Float, -0.3, 0.3, 64), 0.05)
    for name, method in base.methods().items():
        pndf = method.create(normal_map)
        footprint = Footprint(mi.Point2f(0.3, 0.6), mi.Vector2f(0.03, 0), mi.Vector2f(0, 0.03))
        density = np.array(pndf.eval(m, footprint))
        assert np.isfinite(density).all() and (density >= 0).all() and density.any(), name
        sample = pndf.sample(footprint, mi.Float(0.3), mi.Point2f(0.4, 0.7))
        assert np.isfinite(np.array(sample)).all(), name
        assert pndf.nbytes == sum(pndf.parts().values()), name
        lower, upper = pndf.normal_bounds()
        assert (np.asarray(lower) < np.asarray(upper)).all(), name
