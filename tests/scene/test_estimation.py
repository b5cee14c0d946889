"""How long a rendering takes is told before it begins, with what would help."""

from __future__ import annotations

import mitsuba as mi
import pytest

from glintbsdf import maps
from glintbsdf.scene import estimation, rendering
from glintbsdf.scene.estimation import Estimate, column_of
from glintbsdf.scene.passes import Tile


def scene(integrator: str = "path", **options) -> mi.Scene:
    to_world = mi.ScalarTransform4f().look_at([0, 0, 3], [0, 0, 0], [0, 1, 0])
    film = {"type": "hdrfilm", "width": 20, "height": 12}
    data = mi.TensorXf(maps.isotropic(16).normals)
    return mi.load_dict(
        {
            "type": "scene",
            "integrator": {"type": integrator, "max_depth": 2},
            "sensor": {"type": "perspective", "to_world": to_world, "film": film},
            "sky": {"type": "constant"},
            "plate": {
                "type": "rectangle",
                "bsdf": {"type": "glint_manifold", "data": data, **options},
            },
        }
    )


def test_an_estimate_grows_with_the_samples_and_changes_no_image(variant):
    found = {}
    for spp in (1, 64):
        with rendering.Renderer(scene(), spp) as renderer:
            found[spp] = estimation.estimate(renderer)
    assert 0 < found[1].seconds < found[64].seconds
    assert found[1].nbytes > 0
    assert any("max_error" in remedy for remedy in found[1].remedies)
    with rendering.Renderer(scene(max_error=0.1, hand_over=0), 4) as renderer:
        assert not any("max_error" in remedy for remedy in estimation.estimate(renderer).remedies)
        after = rendering.produce(renderer).bitmap
    assert after == rendering.render(scene(max_error=0.1, hand_over=0), 4)


def test_building_structures_is_not_counted(variant, monkeypatch):
    """It takes as long for an image of any size."""
    tile = Tile(0, 0, 5, 8)
    kernels = [
        {"size": 40, "execution_time": 3.0},
        {"size": 1 << 18, "execution_time": 9e6},
        {"size": 40, "execution_time": 1.0},
    ]
    monkeypatch.setattr(estimation.dr, "kernel_history", lambda: kernels)
    with rendering.Renderer(scene(), 1) as renderer:
        assert estimation.seconds_of(renderer, tile, 0) == pytest.approx(4e-3)


def test_what_cannot_be_tried_has_no_estimate(variant):
    with rendering.Renderer(scene("ptracer"), 1) as renderer:
        assert estimation.estimate(renderer) is None


@pytest.mark.parametrize(
    "pixels, expected",
    [(64, Tile(299, 168, 1, 64)), (1024, Tile(299, 0, 2, 400)), (1 << 20, Tile(0, 0, 600, 400))],
)
def test_tried_are_columns_in_the_middle(pixels, expected):
    assert column_of(Tile(0, 0, 600, 400), pixels) == expected


def test_it_is_one_sentence():
    assert str(Estimate(754, 4_310_000_000, ["a: b", "c"])) == (
        "rendering takes about 12 min 34 s, and glints 4.3 GB of memory. What helps: a: b; c"
    )
