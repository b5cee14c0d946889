"""Kernels contain no data of a map: the second map of a scene compiles nothing."""

from __future__ import annotations

import gc
from itertools import cycle

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest

from glintbsdf import maps

METHODS = [
    ("glint_manifold", {}),
    ("glint_manifold", {"masking": "none"}),
    ("glint_manifold", {"masking": "beckmann"}),
    ("glint_manifold", {"masking": "none", "max_error": 0.1}),
    ("glint_manifold", {"masking": "none", "threshold": 0.01}),
    ("glint_elements", {}),
    ("glint_filtered", {}),
    ("glint_diffuse", {}),
]


#: Roughness and size of bumps (texels), of the first map, the second, and so on.
bumps = cycle([(0.05, 9), (0.3, 3), (0.15, 5)])


def a_map(size: int = 64) -> np.ndarray:
    """A map that no earlier run has used, as kernels are kept on disk; flat and steep in turn."""
    alpha, length = next(bumps)
    seed = int(np.random.default_rng().integers(1 << 30))
    return maps.isotropic(size, alpha=alpha, correlation_length=length, seed=seed).normals


def plate(plugin: str, options: dict, size: int = 64, wrapped: bool = False) -> mi.Scene:
    camera = mi.ScalarTransform4f().look_at([0, 0, 3], [0, 0, 0], [0, 1, 0])
    film = {"type": "hdrfilm", "width": 8, "height": 8}
    data = {} if "seed" in options else {"data": mi.TensorXf(a_map(size))}
    bsdf = {"type": plugin, "pixel_spread": 0.01, **data, **options}
    if wrapped:
        bsdf = {"type": "twosided", "bsdf": bsdf}
    return mi.load_dict(
        {
            "type": "scene",
            "integrator": {"type": "path", "max_depth": 2},
            "sensor": {"type": "perspective", "to_world": camera, "film": film},
            "light": {"type": "point", "position": [0.3, 0, 4], "intensity": 20.0},
            "plate": {"type": "rectangle", "bsdf": bsdf},
        }
    )


def compiled(action) -> int:
    """Number of kernels that an action compiles."""
    with dr.scoped_set_flag(dr.JitFlag.KernelHistory, True):
        dr.kernel_history_clear()
        action()
        dr.sync_thread()
        history = dr.kernel_history()
    return sum(not kernel.get("cache_hit", True) for kernel in history)


@pytest.mark.parametrize(("plugin", "options"), METHODS, ids=str)
def test_another_map_compiles_nothing(variant, monkeypatch, plugin, options):
    monkeypatch.setenv("GLINTBSDF_CACHE", "off")  # building is part of it

    def show():
        np.array(mi.render(plate(plugin, options), spp=1))

    counts = [compiled(show) for _ in range(3)]
    assert counts[2] == 0, counts


@pytest.mark.parametrize(
    ("plugin", "options"),
    [
        ("glint_grid", {"density": 5.0}),
        ("glint_particles", {"density": 5.0}),
        ("glint_elements", {"flake_density": 400.0}),
    ],
    ids=str,
)
def test_another_pattern_compiles_nothing(variant, monkeypatch, plugin, options):
    monkeypatch.setenv("GLINTBSDF_CACHE", "off")
    seeds = np.random.default_rng().integers(1 << 30, size=3).tolist()

    def show():
        np.array(mi.render(plate(plugin, {**options, "seed": seeds.pop()}), spp=1))

    counts = [compiled(show) for _ in range(3)]
    assert counts[2] == 0, counts


@pytest.mark.parametrize(
    ("plugin", "options"),
    [("glint_manifold", {}), ("glint_elements", {}), ("glint_diffuse", {})],
    ids=str,
)
def test_maps_of_other_sizes_share_kernels(variant, monkeypatch, plugin, options):
    monkeypatch.setenv("GLINTBSDF_CACHE", "off")
    sizes = iter((64, 80, 48))

    def show():
        np.array(mi.render(plate(plugin, options, next(sizes)), spp=1))

    counts = [compiled(show) for _ in range(3)]
    assert counts[2] == 0, counts


@pytest.mark.parametrize(("plugin", "options"), METHODS[1:2] + METHODS[5:], ids=str)
def test_another_data_compiles_nothing(variant, plugin, options):
    scene = plate(plugin, options)
    params = mi.traverse(scene)
    (key,) = (key for key in params.keys() if key.endswith(".data"))

    def update():
        params[key] = mi.TensorXf(np.array(params[key]) * np.float32(0.97))
        params.update()
        np.array(mi.render(scene, spp=1))

    counts = [compiled(update) for _ in range(3)]
    assert counts[2] == 0, counts


@pytest.mark.parametrize(("plugin", "options"), METHODS[:1] + METHODS[5:], ids=str)
def test_bsdfs_go_with_their_scenes(variant, plugin, options):
    """They are freed at once, without the garbage collector: a reference cycle would keep maps and
    kernels alive."""
    from glintbsdf.bridge.bsdf import FootprintBSDF  # of the active variant

    gc.collect()
    gc.disable()
    try:
        for _ in range(3):
            np.array(mi.render(plate(plugin, options, wrapped=True), spp=1))
        assert not any(isinstance(thing, FootprintBSDF) for thing in gc.get_objects())
    finally:
        gc.enable()
