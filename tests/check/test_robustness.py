"""Measures of numerical robustness, for cases with a known answer."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi
import numpy as np

from glintbsdf import NormalMap
from glintbsdf.check import robustness


def test_extremes_are_counted(variant):
    class Broken:
        """A BSDF that is NaN for point footprints, and negative for huge ones."""

        def sample(self, ctx, si, sample1, sample2):
            bs = dr.zeros(mi.BSDFSample3f, dr.width(si))
            bs.wo, bs.pdf = mi.warp.square_to_cosine_hemisphere(sample2), 1
            return bs, mi.Spectrum(1)

        def eval_pdf(self, ctx, si, wo):
            length = dr.norm(si.duv_dx)
            value = dr.select(length > 50, -1, dr.select(length == 0, dr.nan, 1))
            return mi.Spectrum(value), mi.Float(1)

        def eval_diffuse_reflectance(self, si):
            return mi.Spectrum(1)

    found = robustness.extremes(Broken(), 800)
    si = robustness.extreme_interaction(800, 1)
    length = np.array(dr.norm(si.duv_dx))
    assert found == {"nan": int((length == 0).sum()), "negative": int((length > 50).sum())}
    assert found["nan"] > 100 and found["negative"] > 50
    # Every extreme occurs.
    assert np.array(si.wi.z).min() == 0 and np.abs(np.array(si.uv)).max() > 1e5


def test_float64_sees_a_difference_and_leaves_nothing_behind(variant):
    # Grooves: normals on a line, so that every Jacobian is singular.
    wave = 0.6 * np.sin(2 * np.pi * np.arange(32) / 32 * 3)
    normals = np.broadcast_to(wave[None, :, None] * np.array([0.8, 0.6]), (32, 32, 2))
    data = mi.TensorXf(NormalMap(normals).normals)

    def load(epsilon: float = 1e-6) -> mi.BSDF:
        return mi.load_dict({"type": "glint_manifold", "data": data, "epsilon": epsilon})

    bsdf = load()
    good = robustness.double_error(bsdf, load, 500)
    assert 0 < good["error"] < 1e-3
    # Instead of the same surface in float64, a surface with slightly wider highlights.
    bad = robustness.double_error(bsdf, lambda: load(1.1e-6), 500)
    assert bad["error"] > 0.03
    assert type(load().pndf.vertices) is mi.Float and mi.Float is not mi.Float64
