"""Materials that have one map have its structures in common, as long as the map stays as it is."""

from __future__ import annotations

import gc
import weakref
from threading import Thread

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest

from glintbsdf import NormalMap, maps
from glintbsdf.pndf.sharing import in_turn

#: Plugins, and how to reach what is shared of each.
STRUCTURES = {
    "glint_manifold": lambda bsdf: (bsdf.pndf.lists, bsdf.masking.area.pyramid),
    "glint_elements": lambda bsdf: (bsdf.pndf.lists, bsdf.pndf.slopes),
    "glint_filtered": lambda bsdf: (bsdf.pndf.pyramid,),
}


@pytest.fixture
def filename(tmp_path, variant) -> str:
    normals = maps.isotropic(32, alpha=0.1, seed=5).normals
    mi.Bitmap(normals.copy()).write(str(tmp_path / "map.exr"))
    return str(tmp_path / "map.exr")


@pytest.mark.openexr
@pytest.mark.parametrize("plugin", STRUCTURES)
def test_two_materials_of_a_map(filename, plugin):
    structures = STRUCTURES[plugin]
    a, b, clamped = (
        mi.load_dict({"type": plugin, "filename": filename, "material": material, **options})
        for material, options in (("Au", {}), ("Cu", {}), ("Cu", {"wrap_mode": "clamp"}))
    )
    assert a.normal_map is b.normal_map is not clamped.normal_map
    for of_a, of_b, other in zip(*map(structures, (a, b, clamped)), strict=True):
        assert of_a is of_b is not other

    # What changes one leaves the other as it is, and shares nothing from then on.
    before = structures(b)
    parameters = mi.traverse(a)
    parameters["data"] = mi.TensorXf(0.5 * np.array(parameters["data"]))
    parameters.update()
    assert structures(b) == before
    for of_a, of_b in zip(structures(a), structures(b), strict=True):
        assert of_a is not of_b
    parameters["data"] = mi.TensorXf(b.normal_map.normals)
    dr.enable_grad(parameters["data"])
    parameters.update()
    for of_a, of_b in zip(structures(a), structures(b), strict=True):
        assert of_a is not of_b


@pytest.mark.openexr
def test_structures_go_with_their_last_material(filename):
    a, b = (mi.load_dict({"type": "glint_filtered", "filename": filename}) for _ in range(2))
    pyramid, normal_map = weakref.ref(a.pndf.pyramid), weakref.ref(a.normal_map)
    del a
    gc.collect()
    assert pyramid() is b.pndf.pyramid and normal_map() is b.normal_map
    del b
    gc.collect()
    assert pyramid() is None and normal_map() is None


@pytest.mark.openexr
def test_a_file_that_has_changed_is_another_map(filename, variant):
    first = NormalMap.load(filename)
    assert NormalMap.load(filename) is first is not NormalMap.load(filename, strength=2.0)
    mi.Bitmap(np.full((8, 8, 2), 0.1, np.float32)).write(filename)
    assert NormalMap.load(filename).width == 8


def test_builds_take_turns():
    """One that comes meanwhile, nested or from another thread, is called when the first ends."""
    log = []

    def first():
        log.append("first begins")
        in_turn(lambda: log.append("second"))
        thread = Thread(target=in_turn, args=[lambda: log.append("third")])
        thread.start()
        thread.join()  # it does not wait for its turn
        log.append("first ends")

    in_turn(first)
    assert log == ["first begins", "first ends", "second", "third"]


def test_a_build_that_fails_keeps_no_other_from_its_turn():
    log = []

    def fail():
        in_turn(lambda: log.append("next"))
        raise ValueError("no map")

    with pytest.raises(ValueError, match="no map"):
        in_turn(fail)
    assert log == ["next"]


def test_an_interrupted_build_leaves_nothing_to_do():
    log = []

    def interrupted():
        in_turn(lambda: log.append("forgotten"))
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        in_turn(interrupted)
    in_turn(lambda: log.append("later"))
    assert log == ["later"]
