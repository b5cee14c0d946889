"""The shapes of a BSDF, and warnings and errors about shapes that do not fit its map."""

from __future__ import annotations

import subprocess
import sys

import mitsuba as mi
import numpy as np
import pytest

from glintbsdf import maps
from glintbsdf.bridge import surfaces
from tests.small_scenes import write_plates

NORMALS = maps.isotropic(32, alpha=0.1, correlation_length=5).normals
VECTORS = np.dstack((NORMALS, np.sqrt(1 - (NORMALS**2).sum(axis=2))))
OPPOSITE = VECTORS * np.float32((1, -1, 1))

BARE = "v -1 -1 0\nv 1 -1 0\nv 1 1 0\nvn 0 0 1\nf 1//1 2//1 3//1\n"


@pytest.fixture
def folder(tmp_path):
    write_plates(tmp_path)
    (tmp_path / "bare.obj").write_text(BARE)
    return tmp_path


def mesh(folder, name="plate", **options) -> dict:
    return {"type": "obj", "filename": str(folder / f"{name}.obj"), **options}


def glints(data=NORMALS, **options) -> dict:
    tensor = mi.TensorXf(np.ascontiguousarray(data))
    return {"type": "glint_filtered", "data": tensor, "pixel_spread": 0.01, **options}


def scene(**shapes) -> mi.Scene:
    camera = mi.ScalarTransform4f().look_at([0, 0, 3], [0, 0, 0], [0, 1, 0])
    film = {"type": "hdrfilm", "width": 4, "height": 4}
    return mi.load_dict(
        {
            "type": "scene",
            "integrator": {"type": "path", "max_depth": 2},
            "sensor": {"type": "perspective", "to_world": camera, "film": film},
            "sky": {"type": "constant"},
            **shapes,
        }
    )


MIRROR = [-1, 1, 1]


@pytest.mark.parametrize(
    ("options", "expected"),
    [
        ({}, -1),
        ({"flip_tex_coords": False}, 1),
        ({"name": "mirrored"}, 1),
        ({"to_world": MIRROR}, 1),
        ({"face_normals": True}, -1),
        ({"face_normals": True, "to_world": MIRROR}, -1),
        ({"flip_normals": True}, 1),
    ],
    ids=str,
)
def test_orientation_is_that_of_the_interaction(variant, folder, options, expected):
    if "to_world" in options:
        options = options | {"to_world": mi.ScalarTransform4f().scale(options["to_world"])}
    check_orientation(mesh(folder, **options), expected)


@pytest.mark.parametrize("kind", ["rectangle", "disk", "sphere"])
@pytest.mark.parametrize("flip", [False, True])
def test_orientation_of_other_shapes(variant, kind, flip):
    check_orientation({"type": kind, "flip_normals": flip}, None)


def check_orientation(shape: dict, expected: int | None) -> None:
    loaded = scene(shape=shape)
    si = loaded.ray_intersect(mi.Ray3f(mi.Point3f(0.3, 0.2, 3), mi.Vector3f(0, 0, -1)))
    normal = np.cross(np.array(si.dp_du).T[0], np.array(si.dp_dv).T[0])
    true = int(np.sign(normal @ np.array(si.sh_frame.n).T[0]))
    assert surfaces.uv_orientation(loaded.shapes()[0]) == true
    assert expected in (None, true)


def test_shapes_are_found_wherever_they_are(variant, folder):
    bsdf = mi.load_dict(glints())
    twosided = mi.load_dict({"type": "twosided", "bsdf": bsdf})
    group = {"type": "shapegroup", "mesh": mesh(folder, bsdf=twosided, id="grouped")}
    loaded = scene(
        group=group,
        instance={"type": "instance", "group": {"type": "ref", "id": "group"}},
        plain={"type": "rectangle", "bsdf": bsdf, "id": "plain"},
        other={"type": "sphere", "id": "other"},
    )
    assert loaded is not None
    assert sorted(shape.id() for shape in surfaces.shapes_of(bsdf)) == ["grouped", "plain"]


@pytest.mark.parametrize("where", ["alone", "in a group"])
def test_a_mesh_without_uvs_is_refused_from_python_as_well(variant, folder, where):
    bare = mesh(folder, "bare", bsdf={"type": "twosided", "bsdf": glints()}, id="bare")
    shapes = {"bare": bare}
    if where == "in a group":
        shapes = {
            "group": {"type": "shapegroup", "bare": bare},
            "instance": {"type": "instance", "group": {"type": "ref", "id": "group"}},
        }
    loaded = scene(**shapes)
    with pytest.raises(Exception) as caught:
        mi.render(loaded, spp=1)
    told, error = "", caught.value
    while error is not None:  # Dr.Jit wraps it
        told, error = told + str(error), error.__cause__ or error.__context__
    assert 'glint_filtered: the mesh "bare" has no UV coordinates' in told


@pytest.mark.parametrize("left_handed", [False, True])
@pytest.mark.parametrize("mirrored", [False, True])
@pytest.mark.parametrize("data", ["ours", "opposite"])
def test_green_that_does_not_fit_the_surface_is_reported(
    variant, folder, capfd, left_handed, mirrored, data
):
    """On left-handed UVs, or if to_uv mirrors, the second component points against the rows."""
    to_uv = mi.ScalarTransform4f().scale([1, -1 if mirrored else 1, 1])
    shape = mesh(folder, flip_tex_coords=left_handed)
    values = VECTORS if data == "ours" else OPPOSITE
    fits = (data == "ours") == (left_handed == mirrored)
    for options in ({}, {"flip_y": False}):
        mi.render(scene(plate=shape | {"bsdf": glints(values, to_uv=to_uv, **options)}), spp=1)
        output = "".join(capfd.readouterr())
        assert ('"flip_y" true turns it' in output) == (not fits and not options)


def test_no_shapes():
    code = (
        "import glintbsdf, mitsuba as mi; mi.set_variant('llvm_ad_rgb');"
        "from glintbsdf.bridge import surfaces; print(list(surfaces.live_shapes()))"
    )
    result = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, timeout=100
    )
    assert result.stdout.strip() == "[]"
