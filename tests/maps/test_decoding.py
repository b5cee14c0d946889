"""Decoding of maps: encodings, grey images, padding, voids, and the messages about them."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.ndimage import gaussian_filter

from glintbsdf import maps
from glintbsdf.core.errors import ParameterError
from glintbsdf.maps.decoding import curl
from glintbsdf.maps.normalmap import NormalMap

SIZE = 48


def bumps(seed: int = 0) -> np.ndarray:
    """Smooth heights in [0, 1], which wrap around."""
    noise = np.random.default_rng(seed).normal(size=(SIZE, SIZE))
    height = gaussian_filter(noise, 3, mode="wrap")
    return (height - height.min()) / np.ptp(height)


HEIGHT = bumps()
NORMALS = NormalMap.from_array(12 * HEIGHT).normals.astype(np.float64)
VECTORS = np.dstack((NORMALS, np.sqrt(1 - (NORMALS**2).sum(axis=2))))
STORED = (VECTORS + 1) / 2
BYTES = np.round(255 * STORED).astype(np.uint8)
GREY = np.round(255 * HEIGHT).astype(np.uint8)
DISK = np.hypot(*np.indices((SIZE, SIZE)) - SIZE / 2) < SIZE / 3


def read(data, **options) -> np.ndarray:
    return NormalMap.from_array(data, **options).normals


@pytest.mark.parametrize("channels", [2, 3])
@pytest.mark.parametrize("dtype, tolerance", [(np.float16, 1e-3), (np.float32, 2e-7)])
def test_floats_are_read_as_they_look(told, channels, dtype, tolerance):
    for numbers, encoding in ((VECTORS, "signed"), (STORED, "unsigned")):
        data = numbers[..., :channels].astype(dtype)
        for given in ("auto", encoding):
            np.testing.assert_allclose(read(data, encoding=given), NORMALS, atol=tolerance)
        # Guesses that the type alone does not settle give one message with a remedy; stated types
        # give none.
        warnings = told()
        assert len(warnings) == (encoding == "unsigned")
        assert all('(encoding unsigned); "encoding" signed' in text for text in warnings)


@pytest.mark.parametrize("kind", ["isotropic", "brushed", "scratched", "flakes", "leather", "flat"])
def test_every_kind_of_map_is_recognised(kind):
    normals = getattr(maps, kind)(SIZE).normals.astype(np.float64)
    vectors = np.dstack((normals, np.sqrt(1 - (normals**2).sum(axis=2))))
    for channels in (2, 3):
        for data in (vectors[..., :channels], vectors[..., :channels] / 2 + 0.5):
            np.testing.assert_allclose(read(data), normals, atol=1e-6)


def test_leaning_maps_are_recognised():
    for lean in ((0.3, 0.2), (0.05, 0.02), (-0.4, 0.3)):
        normals = np.broadcast_to(lean, (8, 8, 2))
        vectors = np.dstack((normals, np.full((8, 8), np.sqrt(1 - np.dot(lean, lean)))))
        for data in (vectors[..., :2], vectors, vectors / 2 + 0.5):
            np.testing.assert_allclose(read(data), normals, atol=1e-6)


def test_integers_of_every_kind():
    np.testing.assert_allclose(read(BYTES), NORMALS, atol=2 / 255 * 1.5)
    np.testing.assert_allclose(read(BYTES[..., :2]), NORMALS, atol=2 / 255)
    signed = np.round(32767 * VECTORS).astype(np.int16)
    np.testing.assert_allclose(read(signed), NORMALS, atol=1e-4)
    # Unsigned components that were stored unchanged: the data show it, not the type.
    leaning = np.broadcast_to((0.3, 0.2, np.sqrt(0.87)), (8, 8, 3))
    plain = np.round(65535 * leaning).astype(np.uint16)
    np.testing.assert_allclose(read(plain), leaning[..., :2], atol=1e-4)


def test_integer_heights_are_fractions_of_their_range():
    for dtype in (np.uint8, np.int8, np.int16, np.uint16):
        stored = np.round(HEIGHT * np.iinfo(dtype).max).astype(dtype)
        expected = read(stored / np.iinfo(dtype).max, height_scale=12)
        np.testing.assert_allclose(read(stored, height_scale=12), expected, atol=1e-6)


def test_encoding_can_be_stated():
    corner = np.full((4, 4, 3), 0.5)
    corner[..., 2] = np.sqrt(0.5)
    np.testing.assert_allclose(read(corner, map_type="normal", encoding="signed"), 0.5, atol=1e-6)
    np.testing.assert_allclose(read(corner, map_type="normal", encoding="unsigned"), 0, atol=1e-6)
    with pytest.raises(ParameterError, match='"encoding" must be one of auto, signed, unsigned'):
        read(STORED, encoding="srgb")


def test_invalid_normals_are_reported(told):
    read((STORED**2.2).astype(np.float32), encoding="unsigned")
    assert any("gamma was undone" in text for text in told())


# -------------------------------------------------------------------------------------------------
#  Green, strength
# -------------------------------------------------------------------------------------------------


def test_flip_y_turns_green():
    np.testing.assert_array_equal(read(VECTORS * (1, -1, 1), flip_y=True), read(VECTORS))
    np.testing.assert_array_equal(read(NORMALS * (1, -1), flip_y=True), read(NORMALS))
    with pytest.raises(ParameterError, match='"flip_y" must be false for a height'):
        read(HEIGHT, flip_y=True)


def test_curl_tells_which_way_green_points(told):
    along, against = curl(NORMALS)
    assert along < 1e-5 and against > 0.5
    assert curl(NORMALS * (1, -1)) == pytest.approx((against, along))
    flipped = BYTES.copy()
    flipped[..., 1] = 255 - flipped[..., 1]
    assert not told()
    read(BYTES)
    assert not told()
    read(flipped)
    (text,) = told()
    assert '"flip_y" true' in text and "OpenGL against DirectX" in text
    for stated in (False, True):
        read(flipped, flip_y=stated)
    # There is no evidence for either in a map that is flat, or curved across one axis only.
    read(maps.flat(SIZE).normals)
    read(np.broadcast_to(BYTES[:1], BYTES.shape))
    assert not told()


def test_strength_is_a_factor_on_slopes():
    for data in (VECTORS, NORMALS, STORED):
        stronger = read(data, strength=2.5)
        np.testing.assert_allclose(stronger, read(12 * HEIGHT, height_scale=2.5), atol=1e-6)
        assert not read(data, strength=0).any()
    np.testing.assert_array_equal(
        read(12 * HEIGHT, strength=2.5), read(12 * HEIGHT, height_scale=2.5)
    )
    with pytest.raises(ParameterError, match='"strength" must be a finite number'):
        read(VECTORS, strength=float("inf"))


# -------------------------------------------------------------------------------------------------
#  Heights or normals
# -------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("low", [0.0, 0.52])
def test_colours_that_are_nearly_grey_are_a_height(told, low):
    grey = np.round(255 * (low + (1 - low) * HEIGHT)).astype(np.uint8)
    expected = read(grey, height_scale=12)
    rng = np.random.default_rng(0)
    noise = np.clip(grey[..., None] + rng.integers(-2, 2, (SIZE, SIZE, 3)), 0, 255)
    for blue in (np.clip(grey.astype(int) - rng.integers(0, 2, grey.shape), 0, 255),):
        rgb = np.dstack((grey, grey, blue)).astype(np.uint8)
        for map_type in ("auto", "height"):
            np.testing.assert_array_equal(read(rgb, map_type=map_type, height_scale=12), expected)
    texts = told()
    assert len(texts) == 1 and "read as a height" in texts[0]
    assert NormalMap.from_array(noise.astype(np.uint8)).is_height
    tinted = np.round(255 * np.dstack((0.9 * HEIGHT + 0.1, HEIGHT, 0.7 * HEIGHT))).astype(np.uint8)
    for map_type in ("auto", "height"):
        assert NormalMap.from_array(tinted, map_type).is_height


def test_normals_are_not_taken_for_a_height():
    flat = np.full((8, 8, 3), (128, 128, 255), np.uint8)
    noisy = flat - np.random.default_rng(0).integers(0, 3, (8, 8, 1)).astype(np.uint8)
    for data in (BYTES, STORED, VECTORS, flat, noisy, np.dstack((BYTES, GREY))):
        assert not NormalMap.from_array(data).is_height


def test_alpha_may_carry_x(told):
    x, y = BYTES[..., 0], BYTES[..., 1]
    full = np.full_like(x, 255)
    expected = read(BYTES[..., :2], flip_y=False)
    for colours in ((full, y, full), (np.zeros_like(x), y, np.zeros_like(x)), (y, y, y)):
        data = np.dstack((*colours, x))
        for map_type in ("auto", "normal"):
            np.testing.assert_array_equal(read(data, map_type=map_type), expected)
            assert any("taken from the alpha channel" in text for text in told())
    assert NormalMap.from_array(np.dstack((y, y, y, x)), "height").is_height
    # An alpha channel that masks texels, fully or partly, is not an x component.
    for alpha in (full, full * DISK, np.round(255 * gaussian_filter(1.0 * DISK, 1)).astype("u1")):
        assert NormalMap.from_array(np.dstack((GREY, GREY, GREY, alpha))).is_height
        np.testing.assert_array_equal(read(np.dstack((BYTES, alpha))), read(BYTES))


# -------------------------------------------------------------------------------------------------
#  Voids
# -------------------------------------------------------------------------------------------------


def test_voids_of_heights(told):
    height = (12 * HEIGHT).astype(np.float32)
    whole = read(height)
    for value in (np.nan, np.inf, -9999, -32768, -3.4e38):
        data = height.copy()
        data[10, 10] = data[20:23, 20:22] = value
        with pytest.raises(ParameterError, match='"fill_voids" true'):
            read(data)
        filled = read(data, fill_voids=True)
        assert any("7 of 2304 texels (0.3 %) hold nothing" in text for text in told())
        # Away from the voids nothing changes; beside them the slope is a one-sided difference.
        away = np.ones(height.shape, bool)
        for row, column in ((10, 10), *np.ndindex(3, 2)):
            r, c = (row, column) if row == 10 else (row + 20, column + 20)
            away[r - 1 : r + 2, c - 1 : c + 2] = False
        np.testing.assert_allclose(filled[away], whole[away], atol=1e-6)
        assert np.abs(filled - whole).max() < 0.7
        slope = -filled[10, 9, 0] / np.sqrt(1 - (filled[10, 9] ** 2).sum())
        assert slope == pytest.approx(height[10, 9] - height[10, 8], rel=1e-5)


def test_padding_of_an_atlas(told):
    for empty, fault in ((0, "down-facing"), (128, "zero")):
        data = BYTES.copy()
        data[~DISK] = empty
        with pytest.raises(ParameterError, match=f'"fill_voids" true .* {fault}'):
            read(data)
        filled = read(data, fill_voids=True)
        assert any("hold nothing" in text for text in told())
        np.testing.assert_array_equal(filled[DISK], read(BYTES)[DISK])
        # Each gets the normal of a texel that has one.
        inside = {tuple(normal) for normal in read(BYTES)[DISK]}
        assert {tuple(normal) for normal in filled[~DISK]} <= inside
    transparent = np.dstack((BYTES, np.where(DISK, 255, 0).astype(np.uint8)))
    np.testing.assert_array_equal(read(transparent, fill_voids=True), filled)
    for data in (np.zeros_like(BYTES), np.full((4, 4, 3), np.nan)):
        with pytest.raises(ParameterError, match="at least one texel"):
            read(data, map_type="normal", fill_voids=True)


def test_a_map_that_faces_down_is_not_filled():
    data = VECTORS.copy()
    data[3, 4, 2] = -0.5
    with pytest.raises(ParameterError, match="1 down-facing; the first at row 3, column 4"):
        read(data, fill_voids=True)
