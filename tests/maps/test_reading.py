"""Reading of files with several layers, and with inverted or void values."""

from __future__ import annotations

import numpy as np
import OpenEXR
import pytest
import tifffile

from glintbsdf import maps
from glintbsdf.core.errors import ParameterError
from glintbsdf.maps.normalmap import NormalMap

NORMALS = maps.isotropic(16, alpha=0.2).normals
VECTORS = np.dstack((NORMALS, np.sqrt(1 - (NORMALS**2).sum(axis=2)))).astype(np.float32)
HEIGHT = np.random.default_rng(0).random((16, 16)).astype(np.float32)
COLOURS = np.random.default_rng(1).random((16, 16, 3)).astype(np.float32)


def write_exr(path, **layers) -> str:
    """Write layers, each with H x W x C values and the names of its channels."""
    channels = {}
    for layer, (values, names) in layers.items():
        for i, name in enumerate(names):
            channels[f"{layer}.{name}" if layer != "nameless" else name] = values[..., i].copy()
    OpenEXR.File({"type": OpenEXR.scanlineimage}, channels).write(str(path))
    return str(path)


def test_a_layer_called_normal_goes_first(tmp_path, told):
    path = write_exr(
        tmp_path / "render.exr",
        nameless=(COLOURS, "RGB"),
        **{"View.Albedo": (COLOURS, "RGB"), "View.Normal": (VECTORS, "XYZ")},
    )
    normal_map = NormalMap.load(path)
    np.testing.assert_allclose(normal_map.normals, NORMALS, atol=1e-6)
    (text,) = [text for text in told() if "taken is" in text]
    assert 'taken is the layer "View.Normal"' in text and '"View.Albedo"' in text
    assert any('"View.Normal"' in note.text for note in normal_map.notes)


def test_a_layer_can_be_named(tmp_path):
    path = write_exr(
        tmp_path / "map.exr",
        nameless=(VECTORS, "RGB"),
        bump=(HEIGHT[..., None], "Y"),
        leaning=(np.broadcast_to(np.float32([0.3, 0, 0.954]), VECTORS.shape), "XYZ"),
    )
    np.testing.assert_allclose(NormalMap.load(path).normals, NORMALS, atol=1e-6)
    np.testing.assert_allclose(
        NormalMap.load(path, layer="leaning").normals[..., 0], 0.3, atol=1e-3
    )
    expected = NormalMap.from_array(HEIGHT).normals
    np.testing.assert_array_equal(NormalMap.load(path, layer="bump").normals, expected)
    np.testing.assert_array_equal(NormalMap.load(path, "height").normals, expected)
    with pytest.raises(ParameterError, match='"layer" must be one of .*bump.* \\(got "cavity"\\)'):
        NormalMap.load(path, layer="cavity")


def test_only_exr_files_have_layers(tmp_path):
    tifffile.imwrite(tmp_path / "map.tif", HEIGHT)
    with pytest.raises(ParameterError, match='"layer" must be left out'):
        NormalMap.load(tmp_path / "map.tif", layer="normal")


def test_parts_of_an_exr_file(tmp_path):
    parts = [
        OpenEXR.Part({"type": OpenEXR.scanlineimage}, {"RGB": values}, name=name)
        for name, values in (("beauty", COLOURS), ("normal", VECTORS))
    ]
    OpenEXR.File(parts).write(str(tmp_path / "map.exr"))
    np.testing.assert_allclose(NormalMap.load(tmp_path / "map.exr").normals, NORMALS, atol=1e-6)


@pytest.mark.parametrize("dtype", [np.uint8, np.uint16])
def test_inverted_tiff(tmp_path, dtype):
    most = np.iinfo(dtype).max
    height = np.round(most * HEIGHT).astype(dtype)
    tifffile.imwrite(tmp_path / "map.tif", most - height, photometric="miniswhite")
    np.testing.assert_array_equal(
        NormalMap.load(tmp_path / "map.tif").normals, NormalMap.from_array(height).normals
    )


def test_planar_and_signed_tiff(tmp_path):
    stored = np.round(65535 * (VECTORS + 1) / 2).astype(np.uint16)
    planes = np.moveaxis(stored, 2, 0)
    tifffile.imwrite(tmp_path / "map.tif", planes, photometric="rgb", planarconfig="separate")
    np.testing.assert_array_equal(
        NormalMap.load(tmp_path / "map.tif").normals, NormalMap.from_array(stored).normals
    )
    height = np.round(30000 * HEIGHT).astype(np.int16)
    tifffile.imwrite(tmp_path / "map.tif", height)
    np.testing.assert_array_equal(
        NormalMap.load(tmp_path / "map.tif").normals,
        NormalMap.from_array(height).normals,
    )


def test_void_value_that_a_tiff_names(tmp_path):
    height = (4 * HEIGHT).astype(np.float32)
    height[5, 6] = -77777
    tag = (42113, "s", 0, "-77777", True)
    tifffile.imwrite(tmp_path / "map.tif", height, extratags=[tag])
    with pytest.raises(ParameterError, match="fill_voids"):
        NormalMap.load(tmp_path / "map.tif")
    filled = NormalMap.load(tmp_path / "map.tif", fill_voids=True)
    assert any("1 of 256 texels" in note.text for note in filled.notes)
