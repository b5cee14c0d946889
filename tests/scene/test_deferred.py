"""Scenes that are loaded deferred build their structures late, whatever thread makes a plugin."""

from __future__ import annotations

import mitsuba as mi
import numpy as np
import OpenEXR
import pytest

from glintbsdf import maps
from glintbsdf.footprint.domain import Domain
from glintbsdf.scene import inspection, rendering

KINDS = {
    "glint_manifold": "",
    "glint_elements": "",
    "glint_filtered": '<string name="method" value="leadr"/>',
    "glint_diffuse": '<string name="method" value="oren_nayar"/>',
}


@pytest.fixture
def scene_file(variant, tmp_path):
    """Eight materials, two of each kind, nested and not; Mitsuba makes them in parallel."""
    normals = maps.isotropic(64, alpha=0.2).normals
    z = np.sqrt(1 - (normals**2).sum(axis=2, keepdims=True))
    pixels = np.concatenate([normals, z], axis=2).astype(np.float32)
    with OpenEXR.File({}, {"RGB": pixels}) as file:
        file.write(str(tmp_path / "map.exr"))
    shapes = []
    for k in range(2):
        for row, (kind, more) in enumerate(KINDS.items()):
            bsdf = (
                f'<bsdf type="{kind}" id="{kind}-{k}">{more}'
                '<string name="filename" value="map.exr"/>'
                '<string name="encoding" value="signed"/>'
                f'<float name="pixel_spread" value="{0.01 + 0.001 * k}"/></bsdf>'
            )
            if k:
                bsdf = f'<bsdf type="twosided">{bsdf}</bsdf>'
            shapes.append(
                '<shape type="rectangle"><transform name="to_world"><scale value="0.2"/>'
                f'<translate x="{k - 0.5}" y="{0.5 * row - 0.75}"/></transform>{bsdf}</shape>'
            )
    text = (
        '<scene version="3.0.0"><integrator type="path"/><sensor type="perspective">'
        '<float name="fov" value="40"/><transform name="to_world">'
        '<lookat origin="0, 0, 3" target="0, 0, 0" up="0, 1, 0"/></transform>'
        '<film type="hdrfilm"><integer name="width" value="32"/>'
        '<integer name="height" value="32"/></film>'
        '<sampler type="independent"><integer name="sample_count" value="2"/></sampler></sensor>'
        f'<emitter type="constant"/>{"".join(shapes)}</scene>'
    )
    path = tmp_path / "scene.xml"
    path.write_text(text)
    return path


def test_the_order_in_which_plugins_are_made_does_not_matter(scene_file):
    complete = rendering.load_scene(scene_file)
    assert all(bsdf.parts() for bsdf in rendering.glint_bsdfs(complete))
    expected = np.array(mi.render(complete, seed=1))
    for _ in range(2):
        deferred = rendering.load_scene(scene_file, deferred=True)
        found = rendering.glint_bsdfs(deferred)
        assert len(found) == len({bsdf.id() for bsdf in found}) == 2 * len(KINDS)
        assert all(bsdf.deferred for bsdf in found)
        for bsdf in found:
            bsdf.build()
        assert np.array_equal(np.array(mi.render(deferred, seed=1)), expected)


def test_scenes_loaded_one_within_the_other_do_not_disturb_each_other(scene_file):
    """No state of a module decides what is built: an ordinary BSDF in between is built at once."""
    deferred = inspection.load(scene_file)
    data = mi.TensorXf(maps.isotropic(16).normals)
    ordinary = mi.load_dict({"type": "glint_manifold", "data": data})
    other = inspection.load(scene_file)
    assert ordinary.pndf is not None
    for scene in (deferred, other):
        glossy = [bsdf for bsdf in scene.bsdfs if hasattr(bsdf, "pndf")]
        assert glossy and all(bsdf.pndf is None for bsdf in glossy)


def test_queries_outside_the_domain_are_noticed(scene_file):
    """The gate of a trimmed BSDF notices queries that it was not built for, and they are never
    answered wrongly."""
    inspected = inspection.load(scene_file)
    domains = [Domain((30, 33), (30, 33), 0.5, 0.6)] * len(inspected.bsdfs)
    inspection.build_trimmed(inspected, domains)
    mi.render(inspected.scene, seed=1)
    assert any(bsdf.watch.missed() for bsdf in inspected.bsdfs)
