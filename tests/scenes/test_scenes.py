"""The scenes of the README and of the documentation: they load, they glint, and the script makes
them."""

import importlib.util
import math
import re
import shutil
from pathlib import Path

import mitsuba as mi
import numpy as np
import OpenEXR
import pytest

from glintbsdf import NormalMap

SCENES = Path(__file__).parents[2] / "scenes"

# Scene, horizontal field of view in degrees, and a window (rows, columns; fractions of the image)
# that shows metal only, without silhouettes, which repeat between two renders as glints do.
CASES = {
    "curved_patch": (45, (0.25, 0.50, 0.25, 0.75)),
    "kettle": (30, (0.50, 0.75, 0.25, 0.55)),
    "plate": (26, (0.10, 0.90, 0.10, 0.90)),
}
WIDTH, HEIGHT, SPP = 90, 60, 64


@pytest.fixture(params=CASES)
def case(request):
    fov, window = CASES[request.param]
    pixel_spread = math.radians(fov) / WIDTH / math.sqrt(SPP)
    parameters = {
        "resx": WIDTH,
        "resy": HEIGHT,
        "spp": SPP,
        "pixel_spread": pixel_spread,
        "uv_scale": 0.5,
    }  # larger features, so that a small image resolves them
    return SCENES / f"{request.param}.xml", parameters, window


def load(filename, **parameters):
    return mi.load_file(str(filename), **{key: str(value) for key, value in parameters.items()})


def repeatability(scene, window):
    """Correlation of the differences between neighbouring pixels, for two renders with independent
    seeds.

    Glints have fixed positions on the map and repeat; the noise of a smooth highlight does not.
    """
    details = []
    for seed in (1, 2):
        image = np.array(mi.render(scene, seed=seed)).mean(axis=2)
        assert np.isfinite(image).all() and image.mean() > 0.01
        # Logarithms, so that a few bright pixels do not decide alone.
        image = np.log(image + 1e-3)
        rows, columns = image.shape
        top, bottom, left, right = np.multiply(window, (rows, rows, columns, columns)).astype(int)
        image = image[top:bottom, left:right]
        smooth = (image[:-2, 1:-1] + image[2:, 1:-1] + image[1:-1, :-2] + image[1:-1, 2:]) / 4
        details.append(image[1:-1, 1:-1] - smooth)
    return np.corrcoef(details[0].ravel(), details[1].ravel())[0, 1]


def test_glints_where_a_smooth_metal_has_none(variant, case, tmp_path):
    filename, parameters, window = case
    glints = repeatability(load(filename, **parameters), window)

    scenes = shutil.copytree(SCENES, tmp_path / "scenes", ignore=shutil.ignore_patterns("*.py"))
    smooth_file = scenes / filename.name
    smooth_bsdf = '<bsdf type="roughconductor"><float name="alpha" value="0.2"/></bsdf>'
    text, count = re.subn(
        r'<bsdf type="glint_manifold">.*?</bsdf>',
        smooth_bsdf,
        smooth_file.read_text(encoding="utf-8"),
        flags=re.DOTALL,
    )
    assert count == 1
    smooth_file.write_text(text, encoding="utf-8")
    smooth = repeatability(load(smooth_file, resx=WIDTH, resy=HEIGHT, spp=SPP), window)

    # Measured over the scenes: 0.53…0.67 with glints, -0.02…0.11 without; the standard deviation of
    # the correlation of N pixels of noise, 1/√N, is 0.05 in the smallest window.
    assert glints > 0.4, glints
    assert smooth < 0.25, smooth


def test_paths_are_relative_to_the_scene(variant, case, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    filename, parameters, _ = case
    load(filename, **parameters)


def test_parameters_override_the_defaults(variant, case):
    filename, parameters, _ = case
    scene = load(filename, **{**parameters, "resx": 7, "resy": 5, "spp": 3, "material": "Au"})
    assert tuple(scene.sensors()[0].film().size()) == (7, 5)
    assert scene.sensors()[0].sampler().sample_count() == 3
    with pytest.raises(Exception, match='"kernel" must be one of'):
        load(filename, **parameters, kernel="gauss")


def test_assets_are_what_the_script_makes(tmp_path):
    """The script reproduces the committed files, except for rounding by another machine's libm."""
    spec = importlib.util.spec_from_file_location("make_assets", SCENES / "make_assets.py")
    make_assets = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(make_assets)
    make_assets.main(tmp_path)

    made = sorted(path.relative_to(tmp_path) for path in tmp_path.rglob("*") if path.is_file())
    committed = {
        path.relative_to(SCENES)
        for path in SCENES.rglob("*")
        if path.suffix in (".ply", ".exr", ".png")
    }
    assert set(made) == committed

    for path in made:
        if path.suffix == ".ply":
            ours, our_faces = read_ply(tmp_path / path)
            theirs, their_faces = read_ply(SCENES / path)
            assert our_faces == their_faces, path
            # Normals are differences over 2e-5 of float64 positions: rounding 1e-16 / 1e-5 = 1e-11,
            # below the 1.2e-7 of float32; UVs and positions reach 16.
            np.testing.assert_allclose(ours, theirs, rtol=1e-6, atol=1e-6, err_msg=str(path))
        elif path.parent.name == "maps":
            ours, theirs = (NormalMap.load(root / path).normals for root in (tmp_path, SCENES))
            # Halves below 1 are apart by at most 2^-11.
            np.testing.assert_allclose(ours, theirs, rtol=0, atol=2**-11, err_msg=str(path))
        elif path.parent.name == "textures" and path.suffix == ".exr":
            ours, theirs = (OpenEXR.File(str(r / path)).channels() for r in (tmp_path, SCENES))
            for name, channel in ours.items():
                # Neighbouring halves
                np.testing.assert_allclose(
                    channel.pixels, theirs[name].pixels, rtol=2**-10, atol=2**-10, err_msg=str(path)
                )


def read_ply(filename):
    """Vertices (N, 8) and the bytes of the faces of a PLY file that the script wrote."""
    header, _, body = filename.read_bytes().partition(b"end_header\n")
    count = int(re.search(rb"element vertex (\d+)", header)[1])
    return np.frombuffer(body, "<f4", 8 * count).reshape(count, 8), body[32 * count :]
