"""The comparison of images at equal time: its footprints and its errors."""

from __future__ import annotations

import mitsuba as mi
import numpy as np
import pytest

from benchmarks.commands import convergence
from glintbsdf.check.truth import Truth, reference_render
from glintbsdf.maps import procedural


@pytest.mark.parametrize("texels", [1, 14, 60])
def test_texels_per_pixel(variant, texels):
    """The pixel in the middle of the image covers as many texels as is asked for."""
    size = 64
    bumps = mi.TensorXf(procedural.isotropic(16, seed=1).normals)
    to_uv = convergence.repeated(texels, size)
    material = {"type": "glint_elements", "data": bumps, "masking": "none", "to_uv": to_uv}
    scene = convergence.ball(material, "sun", size)
    bsdf = next(s for s in scene.shapes() if not s.is_emitter()).bsdf()
    middle = mi.Point2f(0.5 + 0.5 / size)
    ray, _ = scene.sensors()[0].sample_ray_differential(0, 0.5, middle, 0.5)
    si = scene.ray_intersect(ray)
    si.compute_uv_partials(ray)
    matrix = mi.traverse(bsdf)["to_uv"].matrix
    scale = np.array([float(matrix[k, k]) for k in (0, 1)])
    seen = np.abs(np.array([si.duv_dx, si.duv_dy]).reshape(2, 2)).max(0) * scale
    assert np.allclose(seen * convergence.TEXELS, texels, rtol=0.03)


def test_errors(variant):
    """Sampling alone has no bias, and a known bias is found."""
    scene = convergence.ball({"type": "roughconductor", "alpha": 0.2}, "softbox", 16)
    truth = reference_render(scene, 4096)
    found = convergence.errors(scene, "path", 4, truth, 12)
    contrast = truth.image.std()
    noise = truth.noise / contrast
    noise_of_mean = found["deviation"] * contrast / truth.image.mean() / (12 * 16**2) ** 0.5
    assert abs(found["mean"] - 1) < 5 * (noise_of_mean + noise / 16)
    assert found["bias"] < 0.25 * found["deviation"] + noise
    assert found["error"] == pytest.approx(found["deviation"], rel=0.1)
    assert found["robust"] < found["error"]
    brighter = Truth(truth.image + 0.5 * contrast, truth.standard_error)
    assert convergence.errors(scene, "path", 4, brighter, 12)["bias"] == pytest.approx(
        0.5, rel=0.15
    )
