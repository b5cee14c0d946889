"""One pass: Mitsuba's samples, summed in a fixed order."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest

from glintbsdf.scene import passes, rendering, units
from glintbsdf.scene.passes import Tile

FILTERS = ("box", "tent", "gaussian", "mitchell")


def scene(
    rfilter: str = "gaussian",
    sampler: str = "independent",
    integrator: dict | None = None,
    film: dict | None = None,
    spp: int = 8,
    sensor: dict | None = None,
) -> mi.Scene:
    """A rough plate, partly in front of the sky, with 24 × 16 pixels."""
    return mi.load_dict(
        {
            "type": "scene",
            "integrator": integrator or {"type": "path", "max_depth": 3},
            "sensor": {
                "type": "perspective",
                "fov": 40,
                "to_world": mi.ScalarTransform4f().look_at([1, 2, 3], [0, 0, 0], [0, 1, 0]),
                "film": {
                    "type": "hdrfilm",
                    "width": 24,
                    "height": 16,
                    "pixel_format": "rgb",
                    "rfilter": {"type": rfilter},
                    **(film or {}),
                },
                "sampler": {"type": sampler, "sample_count": spp},
                **(sensor or {}),
            },
            "light": {"type": "point", "position": [0.5, 0.5, 2], "intensity": 5.0},
            "sky": {"type": "constant", "radiance": 0.3},
            "plate": {"type": "rectangle", "bsdf": {"type": "roughconductor", "alpha": 0.2}},
            "ball": {"type": "sphere", "radius": 0.3},
        }
    )


def mitsubas(loaded: mi.Scene, spp: int, seed: int) -> np.ndarray:
    sensor = loaded.sensors()[0]
    loaded.integrator().render(loaded, sensor, seed=seed, spp=spp)
    return np.array(sensor.film().bitmap())


def ours(loaded: mi.Scene, spp: int, seed: int) -> np.ndarray:
    sensor, integrator = loaded.sensors()[0], loaded.integrator()
    tile = passes.whole(sensor.film())
    target, sums = passes.sums_of_samples(loaded, sensor, integrator, tile, spp, spp, seed)
    assert target == tile and sums.dtype == np.float32
    return np.array(passes.developed(sensor.film(), integrator.aov_names(), sums))


@pytest.mark.parametrize("rfilter", FILTERS)
def test_the_image_is_mitsubas(variant, rfilter):
    """The samples and the filter are the same, but Mitsuba looks up the filter in a table."""
    loaded = scene(rfilter)
    expected = mitsubas(loaded, 8, 3)
    tolerance = 1e-6 if rfilter == "box" else 0.02 * expected.max()
    assert np.abs(ours(loaded, 8, 3) - expected).max() <= tolerance
    assert np.isclose(ours(loaded, 8, 3).mean(), expected.mean(), rtol=2e-3)


@pytest.mark.parametrize(
    "options",
    [
        {"sampler": "multijitter", "spp": 16},
        {"film": {"pixel_format": "rgba"}},
        {"film": {"pixel_format": "luminance"}},
        {"film": {"crop_width": 10, "crop_height": 7, "crop_offset_x": 5, "crop_offset_y": 4}},
        {"integrator": {"type": "aov", "aovs": "d:depth,n:sh_normal", "i": {"type": "path"}}},
        {"integrator": {"type": "prb", "max_depth": 3}},
        {"integrator": {"type": "volpath", "max_depth": 3}},
        {"sensor": {"type": "thinlens", "aperture_radius": 0.1, "focus_distance": 3.0}},
        {"sensor": {"shutter_open": 0.0, "shutter_close": 1.0}},
    ],
    ids=["stratified", "alpha", "luminance", "crop", "aov", "prb", "volpath", "lens", "shutter"],
)
def test_samplers_films_integrators_and_sensors(variant, options):
    loaded = scene("box", **options)
    spp = options.get("spp", 8)
    np.testing.assert_allclose(ours(loaded, spp, 1), mitsubas(loaded, spp, 1), rtol=1e-5, atol=1e-6)


def test_colours_of_other_variants(each_variant):
    loaded = scene("box")
    np.testing.assert_allclose(ours(loaded, 8, 1), mitsubas(loaded, 8, 1), rtol=1e-4, atol=1e-5)


def test_an_integrator_without_camera_rays(variant):
    """ptracer distributes particles over the image; its passes are averaged as well."""
    integrator = {"type": "ptracer", "max_depth": 3, "hide_emitters": True}
    loaded = scene("box", integrator=integrator)
    assert ours(loaded, 64, 1).mean() == pytest.approx(mitsubas(loaded, 64, 1).mean(), rel=1e-4)


@pytest.mark.parametrize("rfilter", ["box", "gaussian"])
def test_last_bits_do_not_depend_on_threads(variant, rfilter):
    """With 7 samples, the work of a thread ends within a pixel. Mitsuba's own images differ from
    run to run here."""
    loaded = scene(rfilter, film={"width": 150, "height": 100}, spp=7)
    count = dr.thread_count()
    images = []
    try:
        for threads in (1, 2, 4, 2):
            dr.set_thread_count(threads)
            images.append(ours(loaded, 7, 5))
    finally:
        dr.set_thread_count(count)
    assert all(np.array_equal(images[0], image) for image in images)


@pytest.mark.parametrize("rfilter", ["box", "gaussian"])
@pytest.mark.parametrize("most", [8 * 24 * 5, 8 * 7])
def test_tiles_make_the_whole(variant, rfilter, most, monkeypatch):
    """Bands and parts of rows have the same mean as one piece, without seams."""
    loaded = scene(rfilter)
    whole = np.mean([np.array(rendering.render(loaded, 8, seed)) for seed in range(8)], axis=0)
    monkeypatch.setattr(units, "MOST", most)
    with rendering.Renderer(loaded, 8) as renderer:
        tiles = renderer.plan(0).tiles
    assert len(tiles) > 3
    tiled = np.mean([np.array(rendering.render(loaded, 8, seed)) for seed in range(8, 16)], axis=0)
    assert np.isclose(tiled.mean(), whole.mean(), rtol=0.02)
    # In the sky nothing is random, not even the filter's weights.
    sky = np.isclose(whole[..., 0], 0.3, rtol=1e-6)
    assert sky.mean() > 0.1
    assert np.isclose(tiled[sky], 0.3, rtol=1e-5).mean() > 0.98


def test_a_tile_reaches_as_far_as_the_filter(variant):
    loaded = scene("gaussian")
    sensor = loaded.sensors()[0]
    target, sums = passes.sums_of_samples(
        loaded, sensor, loaded.integrator(), Tile(3, 4, 5, 6), 2, 8, 0
    )
    border = sensor.film().rfilter().border_size()
    assert target == Tile(3 - border, 4 - border, 5 + 2 * border, 6 + 2 * border)
    assert sums.shape == (target.height, target.width, 4)
    # Weights: the filter's whole integral, for 2 samples in each of 30 pixels.
    offsets = np.linspace(-2.5, 2.5, 2001, dtype=np.float32)
    profile = np.array(sensor.film().rfilter().eval(mi.Float(offsets)))
    integral = profile.sum() * (offsets[1] - offsets[0])
    assert sums[..., 3].sum() == pytest.approx(60 * integral**2, rel=0.05)
