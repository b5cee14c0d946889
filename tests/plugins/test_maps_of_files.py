"""The same map in several files gives the same material, and files are read as Mitsuba reads
them."""

from __future__ import annotations

import mitsuba as mi
import numpy as np
import pytest

from glintbsdf import maps


def picture(bsdf: dict) -> np.ndarray:
    camera = mi.ScalarTransform4f().look_at([0, 0, 3], [0, 0, 0], [0, 1, 0])
    film = {"type": "hdrfilm", "width": 16, "height": 16, "rfilter": {"type": "box"}}
    light = {"type": "area", "radiance": 10.0}
    scene = mi.load_dict(
        {
            "type": "scene",
            "integrator": {"type": "direct"},
            "sensor": {"type": "perspective", "fov": 40, "to_world": camera, "film": film},
            "plate": {"type": "rectangle", "bsdf": bsdf},
            "light": {"type": "sphere", "center": [0, 0, 4], "radius": 0.4, "emitter": light},
        }
    )
    return np.array(mi.render(scene, spp=32, seed=1))[..., 0]


@pytest.mark.openexr
def test_a_float_map_stored_from_zero_to_one(variant, tmp_path):
    """As in Poly Haven, Blender and Mitsuba's ``normalmap``: the image is not black."""
    xy = maps.isotropic(64, alpha=0.1, correlation_length=8).normals.astype(np.float64)
    stored = 0.5 + 0.5 * np.dstack((xy, np.sqrt(1 - (xy**2).sum(axis=2))))
    exr, png = (str(tmp_path / f"n.{suffix}") for suffix in ("exr", "png"))
    mi.Bitmap(stored.astype(np.float32)).write(exr)
    bitmap = mi.Bitmap(np.round(stored * 65535).astype(np.uint16))
    bitmap.set_srgb_gamma(False)
    bitmap.write(png)
    lobe = {"alpha": 0.05, "pixel_spread": 0.005}
    ours = [picture({"type": "glint_filtered", "filename": name, **lobe}) for name in (exr, png)]
    assert np.allclose(*ours, rtol=2e-2, atol=1e-3)
    theirs = picture(
        {
            "type": "normalmap",
            "normalmap": {"type": "bitmap", "filename": exr, "raw": True},
            "bsdf": {"type": "roughconductor", "alpha": 0.05, "distribution": "beckmann"},
        }
    )
    assert abs(ours[0].mean() / theirs.mean() - 1) < 0.1


def test_an_embossed_plate_of_an_obj_file(variant, tmp_path):
    """Lit from above, it looks as with Mitsuba's ``bumpmap``, for left-handed and for right-handed
    UVs."""
    (tmp_path / "plate.obj").write_text(
        "v -1 -1 0\nv 1 -1 0\nv 1 1 0\nv -1 1 0\nvt 0 0\nvt 1 0\nvt 1 1\nvt 0 1\nvn 0 0 1\n"
        "f 1/1/1 2/2/1 3/3/1\nf 1/1/1 3/3/1 4/4/1\n"
    )
    size = 64
    i, j = np.mgrid[:size, :size]
    places = ((15, 20), (40, 45), (45, 15), (20, 50))
    bumps = sum(np.exp(-((i - a) ** 2 + (j - b) ** 2) / (2 * 4.5**2)) for a, b in places)
    height = np.float32(1.5 * bumps)[..., None]

    def image(bsdf: dict, flip: bool) -> np.ndarray:
        camera = mi.ScalarTransform4f().look_at([0, 0, 3], [0, 0, 0], [0, 1, 0])
        film = {"type": "hdrfilm", "width": 32, "height": 32, "rfilter": {"type": "box"}}
        light = {"type": "directional", "direction": [0, -0.5, -1], "irradiance": 3.0}
        mesh = {"type": "obj", "filename": str(tmp_path / "plate.obj"), "flip_tex_coords": flip}
        scene = mi.load_dict(
            {
                "type": "scene",
                "integrator": {"type": "direct"},
                "sensor": {"type": "perspective", "fov": 40, "to_world": camera, "film": film},
                "plate": mesh | {"bsdf": bsdf},
                "light": light,
            }
        )
        return np.array(mi.render(scene, spp=16))[..., 0].ravel()

    for flip in (False, True):
        texture = {"type": "bitmap", "data": mi.TensorXf(height), "raw": True}
        rough = {"type": "roughconductor", "alpha": 0.15, "distribution": "beckmann"}
        bump = {"type": "bumpmap", "arbitrary": texture, "scale": 2 / size, "bsdf": rough}
        ours = {"type": "glint_filtered", "data": mi.TensorXf(height), "alpha": 0.15}
        ours |= {"map_type": "height", "pixel_spread": 0.005}
        assert np.corrcoef(image(ours, flip), image(bump, flip))[0, 1] > 0.97
