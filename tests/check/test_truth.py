"""Brute-force reference images: their map, their error, and the agreement of glint_manifold."""

from __future__ import annotations

import mitsuba as mi
import numpy as np
import pytest

from glintbsdf import NormalMap, ParameterError, maps
from glintbsdf.check import truth

SIZE = (9, 14)


@pytest.mark.parametrize("wrap_mode", ["repeat", "mirror", "clamp"])
def test_refined_map_is_the_mesh(variant, wrap_mode):
    normal_map = NormalMap(maps.isotropic(SIZE, seed=2).normals, wrap_mode)
    n = normal_map.normals
    fine = truth.refined(normal_map, 3)
    assert np.array_equal(fine[1::3, 1::3], n)
    # A third of the way from texel (4, 5) to its neighbour, and two thirds along both axes, which
    # lies in the second triangle.
    assert np.allclose(fine[13, 17], (2 * n[4, 5] + n[4, 6]) / 3, atol=1e-6)
    assert np.allclose(fine[15, 18], (n[4, 6] + n[5, 5] + n[5, 6]) / 3, atol=1e-6)
    beyond = {"repeat": n[0, -1], "mirror": n[0, 0], "clamp": n[0, 0]}[wrap_mode]
    assert np.allclose(fine[1, 0], (2 * n[0, 0] + beyond) / 3, atol=1e-6)


def scene(material: dict) -> mi.Scene:
    """A plate, seen from above through a long lens, under a round light."""
    above = mi.ScalarTransform4f().look_at([0, 0, 30], [0, 0, 0], [0, 1, 0])
    return mi.load_dict(
        {
            "type": "scene",
            "integrator": {"type": "path", "max_depth": 2, "hide_emitters": True},
            "sensor": {
                "type": "perspective",
                "fov": 2,
                "to_world": above,
                "film": {"type": "hdrfilm", "width": 12, "height": 12, "rfilter": {"type": "box"}},
            },
            "light": {
                "type": "sphere",
                "center": [2, 1, 20],
                "radius": 2.0,
                "emitter": {"type": "area", "radiance": 10.0},
            },
            "plate": {"type": "rectangle", "bsdf": material},
        }
    )


def test_manifold_agrees_with_the_truth(variant):
    normal_map = maps.isotropic(32, seed=3)
    expected = truth.reference_render(scene(truth.mirrors(normal_map, 5)), spp=2048, passes=8)
    # Footprints of a hundredth of a texel, at 512 samples per pixel, are nearly points.
    glints = {
        "type": "glint_manifold",
        "data": mi.TensorXf(normal_map.normals),
        "masking": "none",
        "pixel_spread": np.radians(2) / 12 / 40,
    }
    actual = truth.reference_render(scene(glints), spp=512, passes=8, seed=1)
    assert expected.relative_error < 0.2 and expected.image.mean() > 0.01
    difference = (actual.image - expected.image).mean()
    noise = np.sqrt(
        (actual.standard_error**2 + expected.standard_error**2).mean() / expected.image[..., 0].size
    )
    assert abs(difference) < 4 * noise
    lit = expected.image > 0.1 * expected.image.mean()
    noise = np.hypot(actual.standard_error, expected.standard_error)[lit]
    scatter = (actual.image - expected.image)[lit] / noise
    assert lit.sum() > 20 and 0.5 < np.sqrt((scatter**2).mean()) < 1.5


def test_standard_error_is_that_of_the_mean(variant):
    light = scene({"type": "diffuse"})
    images = [truth.reference_render(light, spp=16, passes=4, seed=seed) for seed in range(24)]
    spread = np.std([x.image for x in images], axis=0, ddof=1)
    told = np.mean([x.standard_error for x in images], axis=0)
    # Standard deviations of 4 numbers are 8 % too small in the mean.
    assert 0.8 < told.mean() / spread.mean() < 1.05


def test_difference_to_a_noisy_truth(variant):
    rng = np.random.default_rng(0)
    exact = np.full((40, 40, 3), 2.0)
    noisy = truth.Truth(exact + rng.normal(scale=0.1, size=exact.shape), np.full(exact.shape, 0.1))
    assert noisy.relative_rmse(exact) < 0.015
    assert np.isclose(noisy.relative_rmse(exact + 0.4), 0.2, rtol=0.03)
    assert np.isclose(noisy.relative_error, 0.05, rtol=0.01)


def test_bad_parameters(variant):
    for subdivisions in (0, 2, -1):
        with pytest.raises(ParameterError, match='mirrors: "subdivisions"'):
            truth.mirrors(maps.flat(4), subdivisions)
    for spp, passes in ((16, 1), (17, 4)):
        with pytest.raises(ParameterError, match='reference_render: "spp"'):
            truth.reference_render(scene({"type": "diffuse"}), spp, passes)
