"""Every method of the register that integrates lights: a light's spread, and the half vector's turn
over the footprint.

Where facets are random, they are so dense that all places look alike: small footprints would show
others than large ones.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import mitsuba as mi
import numpy as np
import pytest

from glintbsdf.check import suite
from glintbsdf.check.suite import View
from glintbsdf.footprint.gaussian import Footprint
from glintbsdf.maps.normalmap import NormalMap
from glintbsdf.pndf import methods

SIZE = 64
BOUNDS = ((-0.45, -0.45), (0.45, 0.45))
VIEW = View((0.48, 0.53), (2.0 / SIZE, 0.8 / SIZE), (-0.4 / SIZE, 1.0 / SIZE))
SPREAD = ((0.04, 0.02), (0.0, 0.03))
TURN = np.array([[1.5, -0.7], [0.4, 0.9]])


@dataclass(frozen=True)
class Case:
    """How a method is tested.

    Attributes:
        options: of the method.
        spread, turn, mass: tolerances; see the functions of the suite.
        scale: of footprints, relative to ``VIEW``.
        turned: of the turn over a footprint, relative to ``TURN`` over ``VIEW``.
        points: of a bin, along each axis.
    """

    options: dict = field(default_factory=dict)
    spread: float = 0.03
    turn: float = 0.06
    mass: float = 0.01
    scale: float = 1.0
    turned: float = 1.0
    points: int = 6


MANIFOLD = Case({"epsilon": 1e-4}, 0.05, 0.1, mass=0.03, scale=2.0, points=12)
CASES = {
    "elements": Case({"sigma_r": 0.02}, 0.03, 0.032),
    "filters": Case({"method": "lean", "alpha": 0.1, "distribution": "beckmann"}, 0.013, 0.12),
    "manifold": MANIFOLD,
    "clusters": MANIFOLD,
    "tables": MANIFOLD,
    "mip": Case({"output_size": 128, "patch_size": 28, "sigma_r": 0.02}, 0.007, 0.03),
    "grid": Case(
        {"density": 14.0, "alpha": (0.1, 0.1), "detail_alpha": (0.02, 0.02)},
        0.018,
        0.026,
        scale=0.03,
    ),
    "particles": Case({"density": 9.0, "alpha": (0.1, 0.1)}, 0.07, 0.135, 0.03, 0.03, 1.5),
}
METHODS = [name for name, method in methods().items() if method.pndf.integrates_lights]


@pytest.fixture(scope="module")
def waves() -> NormalMap:
    """Normals that vary over several texels."""
    u, v = np.meshgrid(*[np.arange(SIZE) * (2 * np.pi / SIZE)] * 2)
    n = 0.12 * np.stack([np.sin(3 * u + np.cos(2 * v)), np.cos(4 * v - np.sin(u))], -1)
    return NormalMap(n.astype(np.float32), "repeat")


def create(name: str, normal_map: NormalMap):
    case = CASES.get(name, Case())
    return methods()[name].create(normal_map, **case.options), case


def view_of(case: Case) -> View:
    du, dv = (tuple(case.scale * x for x in axis) for axis in (VIEW.du, VIEW.dv))
    return View(VIEW.uv, du, dv)


@pytest.mark.parametrize("name", METHODS)
def test_spread_is_an_average_over_an_ellipse(variant, waves, name):
    pndf, case = create(name, waves)
    view = view_of(case)
    at = Footprint(mi.Point2f(view.uv), mi.Vector2f(view.du), mi.Vector2f(view.dv))
    suite.check_spread(pndf, at, SPREAD, BOUNDS, case.spread, case.mass, points=case.points)


@pytest.mark.parametrize("name", METHODS)
def test_turn_is_an_average_over_small_footprints(variant, waves, name):
    pndf, case = create(name, waves)
    turn, options = TURN * (case.turned / case.scale), {"mass": case.mass, "points": case.points}
    suite.check_turn(pndf, view_of(case), turn, BOUNDS, case.turn, **options)


@pytest.mark.parametrize("name", METHODS)
def test_extreme_lights(variant, waves, name):
    suite.check_extreme_lights(create(name, waves)[0])


@pytest.mark.parametrize("name", METHODS)
def test_plugins_say_so(variant, waves, name):
    """The plugin of the method has the flag that integrators look for."""
    from glintbsdf.bridge.carried import INTEGRATES_LIGHTS

    method = methods()[name]
    data = {"data": mi.TensorXf(waves.normals)} if method.takes_map else {}
    small = {"output_size": 128, "patch_size": 28} if "output_size" in method.settings else {}
    bsdf = mi.load_dict({"type": method.plugin, **data, **method.settings, **small})
    assert int(bsdf.flags()) & INTEGRATES_LIGHTS
