"""A BSDF loops over the components of its interface: densities and values of several add up."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest

from glintbsdf.check import suite
from glintbsdf.check.suite import View
from glintbsdf.microfacet.interface import Reflection

VIEW = View(du=(0.02, 0), dv=(0, 0.02), wi=(0.3, 0.1, 1))


def flipped(w: mi.Vector3f) -> mi.Vector3f:
    return mi.Vector3f(w.x, w.y, -w.z)


class Part(Reflection):
    """A mirror that reflects a part of what arrives."""

    share = 0.25

    def throughput(self, value, mode, si, wi, wo, m, active):
        return super().throughput(value * self.share, mode, si, wi, wo, m, active)


class Through(Part):
    """The rest goes through a thin sheet and leaves on the other side, as if it were reflected."""

    share = 0.75

    def __init__(self, interface) -> None:
        super().__init__(interface)
        self.flags = mi.BSDFFlags.GlossyTransmission

    def above_horizon(self, active, wi, *wo):
        active, wi, *wo = super().above_horizon(active, wi, *map(flipped, wo))
        return (active, wi, *map(flipped, wo))

    def half_vector(self, wi, wo):
        return super().half_vector(wi, flipped(wo))

    def scattered(self, wi, m, active):
        wo, active = super().scattered(wi, m, active)
        return flipped(wo), active

    def upward(self, wo):
        return flipped(wo)

    def density_of_direction(self, pdf, wo, m):
        return super().density_of_direction(pdf, flipped(wo), m)

    def throughput(self, value, mode, si, wi, wo, m, active):
        return super().throughput(value, mode, si, wi, flipped(wo), m, active)


@pytest.fixture
def shared(variant):
    """The plugin ``glint_filtered``, which reflects a quarter and lets the rest through."""
    bsdf = load()
    bsdf.interface.components = (Part(bsdf.interface), Through(bsdf.interface))
    return bsdf


def load() -> mi.BSDF:
    data = np.zeros((4, 4, 2), np.float32)
    return mi.load_dict({"type": "glint_filtered", "data": mi.TensorXf(data), "alpha": 0.1})


def test_passes_the_shared_suite(shared):
    suite.check_eval_pdf(shared, VIEW)
    suite.check_weights(shared, VIEW)
    suite.check_furnace(shared, VIEW)
    suite.check_finite(shared, VIEW)


def test_each_side_gets_its_part(shared):
    whole, ctx = load(), mi.BSDFContext()
    si, bs, _ = suite.sample(whole, VIEW, 500)
    value, pdf = whole.eval_pdf(ctx, si, bs.wo)
    for wo, share in ((bs.wo, 0.25), (flipped(bs.wo), 0.75)):
        of_side, drawn = shared.eval_pdf(ctx, si, wo)
        assert dr.allclose(of_side, share * value) and dr.allclose(drawn, 0.5 * pdf)


def test_context_with_one_component(shared):
    """A context that names a component gets its part, and samples it alone."""
    si, bs, weight = suite.sample(load(), VIEW, 500)
    ctx = mi.BSDFContext()
    ctx.component = 1
    assert dr.all(shared.eval(ctx, si, bs.wo)[0] == 0)
    u = suite.random_numbers(500, 3, 0)
    chosen, of_part = shared.sample(ctx, si, u[0], mi.Point2f(u[1], u[2]))
    assert dr.all(chosen.sampled_component == 1) and dr.allclose(chosen.wo, flipped(bs.wo))
    assert dr.allclose(of_part, 0.75 * weight) and dr.allclose(chosen.pdf, bs.pdf)


def test_both_components_are_drawn(shared):
    _, bs, _ = suite.sample(shared, VIEW, 4000)
    second = np.array(bs.sampled_component)[np.array(bs.pdf) > 0] == 1
    assert abs(second.mean() - 0.5) < 4 * 0.5 / np.sqrt(len(second))
