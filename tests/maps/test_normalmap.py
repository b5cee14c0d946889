"""Normal maps: conventions, all sources, and errors."""

from __future__ import annotations

import subprocess
import sys

import mitsuba as mi
import numpy as np
import OpenEXR
import pytest
import skimage.io

from glintbsdf.core.errors import ParameterError
from glintbsdf.maps.normalmap import NormalMap

SHAPE = (5, 7)
RNG_SEED = 1


def random_normals(shape=SHAPE, seed=RNG_SEED):
    """Unit normals (x, y, z), H x W x 3, tilted by up to about 45 degrees."""
    xy = np.random.default_rng(seed).uniform(-0.5, 0.5, (*shape, 2))
    return np.concatenate((xy, np.sqrt(1 - np.sum(xy**2, axis=2, keepdims=True))), axis=2)


def random_heights(shape=SHAPE, seed=RNG_SEED):
    return np.random.default_rng(seed).uniform(0, 1, shape)


def encode(normals, dtype):
    """Store normals, or fractions of heights, as unsigned integers."""
    return np.round((normals + 1) / 2 * np.iinfo(dtype).max).astype(dtype)


def write_exr(path, channels):
    OpenEXR.File(
        {"type": OpenEXR.scanlineimage, "compression": OpenEXR.ZIP_COMPRESSION},
        {name: np.ascontiguousarray(values) for name, values in channels.items()},
    ).write(str(path))


# -------------------------------------------------------------------------------------------------
# Conventions
# -------------------------------------------------------------------------------------------------


def test_height_leans_against_its_gradient():
    rows, columns = np.mgrid[0:12, 0:20]
    height = 3 * np.sin(2 * np.pi * columns / 20) + 2 * np.cos(2 * np.pi * rows / 12)
    # The central difference of sin(wx) is sin(w) cos(wx): exact, so only float32 rounding is left.
    slope_x = 3 * np.sin(2 * np.pi / 20) * np.cos(2 * np.pi * columns / 20)
    slope_y = -2 * np.sin(2 * np.pi / 12) * np.sin(2 * np.pi * rows / 12)
    length = np.sqrt(1 + slope_x**2 + slope_y**2)
    expected = np.stack((-slope_x / length, -slope_y / length), axis=2)
    normal_map = NormalMap.from_array(height)
    assert (normal_map.height, normal_map.width) == (12, 20)
    assert normal_map.normals.dtype == np.float32
    np.testing.assert_allclose(normal_map.normals, expected, atol=1e-7)


@pytest.mark.parametrize(
    "wrap_mode, border_slope", [("repeat", -3.0), ("mirror", 0.5), ("clamp", 0.5)]
)
def test_wrap_mode_decides_the_slope_at_the_border(wrap_mode, border_slope):
    ramp = np.broadcast_to(np.arange(8.0), (3, 8))
    for axis, height in ((0, ramp), (1, ramp.T)):
        normals = NormalMap.from_array(height, wrap_mode=wrap_mode).normals
        slopes = -normals[..., axis] / np.sqrt(1 - np.sum(normals**2, axis=2))
        across = slopes if axis == 0 else slopes.T
        np.testing.assert_allclose(across[:, 1:-1], 1, rtol=1e-6)
        np.testing.assert_allclose(across[:, [0, -1]], border_slope, rtol=1e-6)


def test_height_scale_is_in_texels_per_unit():
    height = random_heights()
    scaled = NormalMap.from_array(height, height_scale=-2.5)
    np.testing.assert_array_equal(scaled.normals, NormalMap.from_array(-2.5 * height).normals)


@pytest.mark.parametrize("shape", [(1, 1), (1, 6), (6, 1), (2, 2), (3, 17)])
def test_any_size(shape):
    assert NormalMap.from_array(random_heights(shape)).normals.shape == (*shape, 2)
    assert NormalMap.from_array(random_normals(shape)).normals.shape == (*shape, 2)


def test_auto_tells_heights_from_normals():
    height, normals = random_heights(), random_normals()
    as_height = NormalMap.from_array(height).normals
    grey = np.repeat(height[..., None], 3, axis=2)
    alpha = np.ones((*SHAPE, 1))
    for data in (height[..., None], grey, np.concatenate((grey, alpha), axis=2)):
        np.testing.assert_array_equal(NormalMap.from_array(data).normals, as_height)
        np.testing.assert_array_equal(NormalMap.from_array(data, "height").normals, as_height)

    for data in (normals, normals[..., :2], np.concatenate((normals, alpha), axis=2)):
        np.testing.assert_allclose(NormalMap.from_array(data).normals, normals[..., :2], atol=1e-7)

    diagonal = np.full((*SHAPE, 3), 0.5)
    np.testing.assert_array_equal(NormalMap.from_array(diagonal).normals, 0)
    np.testing.assert_allclose(NormalMap.from_array(diagonal, "normal").normals, 3**-0.5, rtol=1e-6)


def test_normals_need_no_unit_length():
    normals = random_normals()
    for length in (1e-30, 3, 1e30):
        data = (length * normals).astype(np.float32)
        np.testing.assert_allclose(NormalMap.from_array(data).normals, normals[..., :2], atol=2e-7)


@pytest.mark.parametrize("dtype", [np.uint8, np.uint16, np.uint32])
def test_unsigned_integers_are_fractions(dtype):
    step = 2 / np.iinfo(dtype).max
    normals = random_normals()
    decoded = NormalMap.from_array(encode(normals, dtype)).normals
    # Half a step of rounding per component, and the effect of normalisation: less than two steps.
    np.testing.assert_allclose(decoded, normals[..., :2], atol=max(2 * step, 1e-7))
    height = random_heights()
    stored = np.round(height * np.iinfo(dtype).max).astype(dtype)
    np.testing.assert_allclose(
        NormalMap.from_array(stored).normals,
        NormalMap.from_array(stored / np.iinfo(dtype).max).normals,
        atol=1e-7,
    )


def test_map_is_a_copy_that_cannot_change():
    normals = random_normals()[..., :2].astype(np.float32)
    normal_map = NormalMap(normals)
    normals[:] = 0
    assert np.any(normal_map.normals)
    with pytest.raises(ValueError, match="read-only"):
        normal_map.normals[0, 0] = 0


def test_content_hash_follows_content():
    normals = random_normals((4, 6))[..., :2].astype(np.float32)
    changed = normals.copy()
    changed[3, 5, 1] = np.nextafter(changed[3, 5, 1], np.float32(1))
    maps = [
        NormalMap(normals),
        NormalMap(normals, "mirror"),
        NormalMap(changed),
        NormalMap(normals.reshape(6, 4, 2)),
        NormalMap(np.asfortranarray(normals[::-1])),
    ]
    assert len({normal_map.content_hash for normal_map in maps}) == len(maps)
    assert NormalMap(np.asfortranarray(normals)).content_hash == maps[0].content_hash


def test_roughness_is_that_of_the_slopes():
    rng = np.random.default_rng(3)
    slopes = rng.normal(size=(256, 256, 2)) * (0.1, 0.3) / np.sqrt(2)
    normals = slopes / np.sqrt(1 + np.sum(slopes**2, axis=2, keepdims=True))
    # 65,536 samples: the standard error of a standard deviation is 0.28 %; four of them.
    np.testing.assert_allclose(NormalMap(normals).roughness(), (0.1, 0.3), rtol=0.011)


# -------------------------------------------------------------------------------------------------
# Sources
# -------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("dtype, tolerance", [(np.float16, 5e-4), (np.float32, 1e-7)])
@pytest.mark.parametrize("names", ["RGB", "XYZ", "RG", "XY"])
def test_exr_normals(tmp_path, dtype, tolerance, names):
    normals = random_normals()
    path = tmp_path / "map.exr"
    channels = {name: normals[..., i].astype(dtype) for i, name in enumerate(names)}
    for extra in ({}, {"A": np.zeros(SHAPE, dtype)}, {"mask": np.zeros(SHAPE, dtype)}):
        write_exr(path, channels | extra)
        loaded = NormalMap.load(path)
        np.testing.assert_allclose(loaded.normals, normals[..., :2], atol=tolerance)
    write_exr(path, {f"layer.{name}": values for name, values in channels.items()})
    np.testing.assert_array_equal(NormalMap.load(path).normals, loaded.normals)


def test_exr_layers_are_not_mixed(tmp_path):
    normals = random_normals().astype(np.float32)
    other = np.full(SHAPE, 0.1, np.float32)
    channels = {f"b.{name}": normals[..., i] for i, name in enumerate("XYZ")}
    for extra in ({"Z": other}, {"a.X": other, "a.Y": other}, {"c.X": other, "c.Z": other}):
        write_exr(tmp_path / "map.exr", channels | extra)
        np.testing.assert_allclose(
            NormalMap.load(tmp_path / "map.exr").normals, normals[..., :2], atol=1e-7
        )


@pytest.mark.parametrize("dtype", [np.float16, np.float32])
@pytest.mark.parametrize(
    "names", [["Y"], ["height"], ["Y", "A"], ["R", "G", "B"], ["R", "G", "B", "A"]]
)
def test_exr_heights(tmp_path, dtype, names):
    height = random_heights().astype(dtype)
    write_exr(tmp_path / "map.exr", {name: height for name in names})
    loaded = NormalMap.load(tmp_path / "map.exr", height_scale=4)
    np.testing.assert_array_equal(
        loaded.normals, NormalMap.from_array(height, height_scale=4).normals
    )


@pytest.mark.parametrize("dtype", [np.uint8, np.uint16])
@pytest.mark.parametrize("suffix", ["png", "tif", "tiff"])
def test_integer_files_lose_nothing(tmp_path, dtype, suffix):
    path = tmp_path / f"map.{suffix}"
    normals = encode(random_normals(), dtype)
    alpha = np.full((*SHAPE, 1), 7, dtype)
    height = np.round(random_heights() * np.iinfo(dtype).max).astype(dtype)
    for data in (normals, np.concatenate((normals, alpha), axis=2), height):
        if suffix == "png":
            mi.Bitmap(data).write(str(path))
        else:
            skimage.io.imsave(path, data, check_contrast=False)
        np.testing.assert_array_equal(
            NormalMap.load(path).normals, NormalMap.from_array(data).normals
        )


def test_png_of_grey_and_alpha_is_a_height(tmp_path):
    height = np.round(random_heights() * 255).astype(np.uint8)
    data = np.stack((height, np.full_like(height, 9)), axis=2)
    mi.Bitmap(data, mi.Bitmap.PixelFormat.YA).write(str(tmp_path / "map.png"))
    np.testing.assert_array_equal(
        NormalMap.load(tmp_path / "map.png").normals, NormalMap.from_array(height).normals
    )


def test_floating_point_tiff(tmp_path):
    height = random_heights().astype(np.float32)
    skimage.io.imsave(tmp_path / "map.tif", height, check_contrast=False)
    np.testing.assert_array_equal(
        NormalMap.load(tmp_path / "map.tif").normals, NormalMap.from_array(height).normals
    )


@pytest.mark.parametrize("dtype", [np.uint8, np.uint16, np.float16, np.float32])
def test_bitmaps_are_raw(dtype):
    normals = random_normals()
    data = encode(normals, dtype) if np.issubdtype(dtype, np.integer) else normals.astype(dtype)
    for channels in (2, 3):
        bitmap = mi.Bitmap(np.ascontiguousarray(data[..., :channels]))
        expected = NormalMap.from_array(data[..., :channels]).normals
        for gamma in (False, True):
            bitmap.set_srgb_gamma(gamma)
            np.testing.assert_array_equal(NormalMap.from_bitmap(bitmap).normals, expected)
    height = np.ascontiguousarray(data[..., 0])
    two = mi.Bitmap(np.stack((height, height), axis=2), mi.Bitmap.PixelFormat.YA)
    for bitmap in (mi.Bitmap(height), two):
        np.testing.assert_array_equal(
            NormalMap.from_bitmap(bitmap, "height").normals,
            NormalMap.from_array(height, "height").normals,
        )


def test_tensors(variant):
    normals = random_normals().astype(np.float32)
    expected = NormalMap.from_array(normals).normals
    np.testing.assert_array_equal(NormalMap.from_array(mi.TensorXf(normals)).normals, expected)

    class OnlyDLPack:
        def __dlpack__(self, **options):
            return normals.__dlpack__(**options)

        def __dlpack_device__(self):
            return normals.__dlpack_device__()

    np.testing.assert_array_equal(NormalMap.from_array(OnlyDLPack()).normals, expected)


def test_readers_are_imported_when_needed_only():
    code = (
        "import sys, glintbsdf.maps.normalmap, glintbsdf.maps, glintbsdf.reference;"
        "glintbsdf.maps.isotropic(8);"
        "print([m for m in ('OpenEXR', 'skimage', 'matplotlib', 'PIL') if m in sys.modules])"
    )
    result = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, check=True
    )
    assert result.stdout.strip() == "[]"


# -------------------------------------------------------------------------------------------------
# Invalid input
# -------------------------------------------------------------------------------------------------


def changed(array, *places, value):
    array = np.array(array)
    for place in places:
        array[place] = value
    return array


BAD_DATA = {
    "empty": (np.zeros((0, 4, 3)), {}, 'an H x W x C array .* (got "0 x 4 x 3, float64")'),
    "no array": (None, {}, "an H x W x C array"),
    "one axis": (np.zeros(9), {}, 'an H x W x C array .* (got "9, float64")'),
    "five channels": (np.zeros((4, 4, 5)), {}, "an H x W x C array"),
    "complex": (np.zeros((4, 4), complex), {}, "floating-point numbers or integers .*complex128"),
    "text": ("map.png", {}, "an H x W x C array"),
    "NaN": (
        changed(random_normals(), (2, 3, 0), (4, 1, 2), value=np.nan),
        {},
        "2 NaN or infinite; the first at row 2, column 3",
    ),
    "infinite": (
        changed(random_normals(), (0, 6, 1), value=np.inf),
        {},
        "1 NaN or infinite; the first at row 0, column 6",
    ),
    "zero": (
        changed(random_normals(), (1, 2), value=0),
        {},
        "1 zero; the first at row 1, column 2",
    ),
    "down": (
        changed(random_normals(), (3, 0, 2), (3, 1, 2), value=-0.5),
        {},
        "2 down-facing; the first at row 3, column 0",
    ),
    "horizontal": (changed(random_normals(), (3, 0, 2), value=0), {}, "1 down-facing"),
    "several": (
        changed(changed(random_normals(), (3, 0), value=0), (0, 1, 1), value=np.nan),
        {},
        "1 NaN or infinite, 1 zero; the first at row 0, column 1",
    ),
    "black": (np.zeros((2, 2, 3), np.uint8), {"map_type": "normal"}, "4 down-facing"),
    "outside": (
        changed(random_normals()[..., :2], (2, 2), value=0.8),
        {},
        'x² \\+ y² < 1 (got "1 outside the disk; the first at row 2, column 2',
    ),
    "height NaN": (
        changed(random_heights(), (2, 5), value=np.nan),
        {},
        'finite heights .* (got "1 NaN or infinite; the first at row 2, column 5',
    ),
    "steep": (
        changed(random_heights(), (2, 3), value=1e30),
        {},
        'a height with slopes below 1000.* (got "4 steeper; the first at row 1, column 3',
    ),
    "steep by overflow": (
        changed(random_heights(), (2, 3), (2, 5), value=1.7e308),
        {"height_scale": -4.0},
        "slopes below 1000",
    ),
    "height of colours": (
        random_normals(),
        {"map_type": "height"},
        'a height, .* (got "3 channels that differ")',
    ),
    "height of two": (random_normals()[..., :2], {"map_type": "height"}, '(got "2 channels")'),
    "normal of one": (random_heights(), {"map_type": "normal"}, "normals, of two or three"),
    "alpha": (np.full((2, 2, 4), 2.0), {}, "fourth channel is an alpha in \\[0, 1\\]"),
}


@pytest.mark.parametrize("case", BAD_DATA)
def test_bad_data(case):
    data, options, message = BAD_DATA[case]
    message = message.replace("(", "\\(").replace(")", "\\)")
    with pytest.raises(ParameterError, match=f'^glint_manifold: "data" must be .*{message}'):
        NormalMap.from_array(data, owner="glint_manifold", **options)


@pytest.mark.parametrize(
    "option, value, message",
    [
        ("map_type", "bump", 'one of auto, normal, height (got "bump")'),
        ("wrap_mode", "border", 'one of repeat, mirror, clamp (got "border")'),
        ("height_scale", float("nan"), "a finite number (got nan)"),
    ],
)
def test_bad_options(option, value, message):
    with pytest.raises(ParameterError) as caught:
        NormalMap.from_array(random_heights(), owner="glint_manifold", **{option: value})
    assert str(caught.value) == f'glint_manifold: "{option}" must be {message}'


@pytest.mark.parametrize(
    "normals",
    [np.zeros((3, 3, 3)), np.zeros((3, 2)), np.zeros((0, 3, 2)), np.zeros((3, 3, 2), int)],
)
def test_bad_projected_normals(normals):
    with pytest.raises(ParameterError, match='^NormalMap: "normals" must be an H x W x 2 array'):
        NormalMap(normals)


def test_bad_bitmap_names_its_parameter():
    with pytest.raises(ParameterError, match='^glint_manifold: "bitmap" must be normals'):
        NormalMap.from_bitmap(
            mi.Bitmap(np.zeros((2, 2, 3), np.float32)), "normal", owner="glint_manifold"
        )


def test_missing_file(tmp_path):
    for path in (tmp_path / "none.exr", tmp_path):
        with pytest.raises(ParameterError) as caught:
            NormalMap.load(path, owner="glint_manifold")
        assert str(caught.value) == (
            f'glint_manifold: "filename" must be the name of an existing file (got "{path}")'
        )


@pytest.mark.parametrize("suffix", ["exr", "png", "tif", "jpg", "txt", ""])
def test_unreadable_file(tmp_path, suffix):
    path = tmp_path / f"map.{suffix}"
    for content in (b"", b"not an image"):
        path.write_bytes(content)
        with pytest.raises(ParameterError, match='^mine: "filename" must be a readable image file'):
            NormalMap.load(path, owner="mine")


@pytest.mark.parametrize("suffix", ["exr", "png", "tif"])
def test_file_cut_short(tmp_path, suffix):
    path = tmp_path / f"map.{suffix}"
    normals = random_normals((64, 64))
    if suffix == "exr":
        write_exr(path, {"RGB": normals.astype(np.float32)})
    elif suffix == "png":
        mi.Bitmap(encode(normals, np.uint8)).write(str(path))
    else:
        skimage.io.imsave(path, encode(normals, np.uint8), check_contrast=False)
    content = path.read_bytes()
    for length in (len(content) // 10, len(content) // 2, len(content) * 9 // 10):
        path.write_bytes(content[:length])
        with pytest.raises(ParameterError, match='^mine: "filename" must be a readable image file'):
            NormalMap.load(path, owner="mine")


def test_exr_without_a_map(tmp_path):
    write_exr(tmp_path / "map.exr", {name: np.zeros(SHAPE, np.float32) for name in ("U", "V")})
    with pytest.raises(ParameterError, match="no channels R,G,B or .* among U, V"):
        NormalMap.load(tmp_path / "map.exr")
