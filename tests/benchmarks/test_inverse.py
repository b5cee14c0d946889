"""The example of inverse rendering, in little."""

from __future__ import annotations

import numpy as np
import pytest

from benchmarks.commands.inverse import example, ratio
from glintbsdf.check.derivatives import examples


@pytest.fixture
def inverse(variant):
    return example()


def test_roughness_and_tint_come_near_the_truth(inverse):
    """In a few steps of a small picture; they begin 150 % and 67 % away."""
    found = inverse.roughness_and_tint(steps=30, pixels=16)
    assert found["error of roughness"] < 0.6 and found["error of tint"] < 0.3, found


def test_pictures_under_all_lamps_at_once_are_those_of_renderings(inverse):
    """A wide lobe is the same at all places of a pixel."""
    bumps = inverse.glintbsdf.maps.isotropic(16, alpha=0.1, correlation_length=6).normals
    scene = inverse.sample(
        inverse.glints(16, data=inverse.mi.TensorXf(bumps), sigma_r=0.2, masking="none"), 16
    )
    lamps = inverse.lamps_around([(0, 0), (0.1, -0.05)])
    at_once = inverse.lit(scene, lamps, spp=1, blur=0.0, seed=0).numpy()
    rendered = inverse.Photographer(scene, lamps).pictures(spp=16)
    for ours, theirs in zip(at_once, rendered, strict=True):
        assert np.abs(ours / theirs[..., 0] - 1).max() < 0.05


def test_an_iteration_is_timed(variant):
    bsdf, keys, _ = examples()["lean"]
    row = ratio(bsdf, keys[0], "direct", repetitions=1)
    assert row["parameter"] == keys[0]
    assert row["forward, s"] > 0 and row["iteration over forward"] > 0
