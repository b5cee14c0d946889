"""The normal map: where every glint BSDF begins.

A normal is stored as its projection on the unit disk, ``(n_x, n_y)``, with ``n_z > 0`` implied.

Conventions, those of Mitsuba's ``bitmap`` and ``normalmap``:

* row ``i``, column ``j`` has its texel centre at ``uv = ((j + 1/2) / W, (i + 1/2) / H)``: row 0 is
  at ``v = 0``, ``n_x`` leans along ``u`` and ``n_y`` along ``v``;
* data of unsigned integers are fractions of their range, [0, 1]; as normals they are decoded to
  [-1, 1], as heights they stay in [0, 1]. Floating-point data are used as they are. A normal map is
  raw data: no gamma is ever undone;
* a height ``h`` (texels, after ``height_scale``) gives ``n ∝ (-∂h/∂x, -∂h/∂y, 1)`` by central
  differences over the neighbouring texels that ``wrap_mode`` names.

Needs NumPy only: file readers are imported when a file of their kind is read.
"""

from __future__ import annotations

import hashlib
from collections.abc import Mapping
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt

from glintbsdf.core.errors import ParameterError, check, check_choice

if TYPE_CHECKING:
    import mitsuba as mi

WRAP_MODES = ("repeat", "mirror", "clamp")
MAP_TYPES = ("auto", "normal", "height")

_SHAPE = "an H x W x C array with H, W >= 1 and C = 1…4"
MAX_SLOPE = 1000

# What makes a map among the channels of an EXR file, the most telling names first.
_EXR_LAYOUTS = (("R", "G", "B"), ("X", "Y", "Z"), ("R", "G"), ("X", "Y"), ("Y",))


class NormalMap:
    """A map of unit normals.

    ``normals`` is an H x W x 2 array of projected normals (x, y), every one strictly inside the
    unit disk; the map keeps a read-only float32 copy. ``wrap_mode`` says what lies beyond its
    border: ``repeat``, ``mirror`` (about the border, so texel -1 is texel 0) or ``clamp``. A
    mirrored texel keeps its value, as in Mitsuba.

    ``owner`` and ``parameter`` are named in the :class:`~.ParameterError` that is
    raised for a wrong shape, for NaN or infinite values and for normals on or outside the disk.
    """

    def __init__(
        self,
        normals: npt.ArrayLike,
        wrap_mode: str = "repeat",
        owner: str = "NormalMap",
        parameter: str = "normals",
    ) -> None:
        check_choice(owner, "wrap_mode", wrap_mode, WRAP_MODES)
        normals = np.asarray(normals)
        check(
            normals.ndim == 3
            and normals.shape[2] == 2
            and normals.size > 0
            and np.issubdtype(normals.dtype, np.floating),
            owner,
            parameter,
            "an H x W x 2 array of floating-point numbers with H, W >= 1",
            _shape_and_type(normals),
        )

        with np.errstate(over="ignore"):  # too large for float32 is infinite, and refused below
            normals = np.array(normals, dtype=np.float32, order="C")
            squared_length = np.einsum("ijk,ijk->ij", normals, normals, dtype=np.float64)
        finite = np.isfinite(normals).all(axis=2)
        check_texels(
            owner,
            parameter,
            "normals inside the unit disk, x² + y² < 1",
            {"NaN or infinite": ~finite, "outside the disk": finite & ~(squared_length < 1)},
        )

        normals.flags.writeable = False
        self.normals: npt.NDArray[np.float32] = normals
        self.wrap_mode = wrap_mode

    @classmethod
    def from_array(
        cls,
        data: Any,
        map_type: str = "auto",
        height_scale: float = 1.0,
        wrap_mode: str = "repeat",
        owner: str = "NormalMap",
        parameter: str = "data",
    ) -> NormalMap:
        """Make a map from an array or tensor of H x W or H x W x C values, C = 1…4.

        * C = 1 is a height;
        * C = 2 are the projected normals (x, y), inside the unit disk;
        * C = 3 are normals (x, y, z) of any length; all three equal, everywhere, are a height;
        * C = 4 is C = 3 and an alpha in [0, 1], which is ignored.

        ``map_type`` ``normal`` or ``height`` overrules that choice; a height with several different
        channels is refused. ``height_scale`` is in texels per unit of height and may be negative.
        Anything NumPy can read is accepted, among it ``mi.TensorXf`` and whatever speaks DLPack.
        Raises :class:`~.ParameterError`.
        """
        normals = _projected_normals(
            _as_array(data, owner, parameter), map_type, height_scale, wrap_mode, owner, parameter
        )
        return cls(normals, wrap_mode, owner, parameter)

    @classmethod
    def from_bitmap(
        cls,
        bitmap: mi.Bitmap,
        map_type: str = "auto",
        height_scale: float = 1.0,
        wrap_mode: str = "repeat",
        owner: str = "NormalMap",
        parameter: str = "bitmap",
    ) -> NormalMap:
        """Make a map from an ``mi.Bitmap``, whose gamma flag is ignored.

        Channels are as in :meth:`from_array`. Mitsuba calls any two channels luminance and alpha:
        they are read as projected normals (x, y), unless ``map_type`` is ``height``.
        """
        data = np.asarray(bitmap)
        if map_type == "height" and data.ndim == 3 and data.shape[2] == 2:
            data = data[..., :1]
        return cls.from_array(data, map_type, height_scale, wrap_mode, owner, parameter)

    @classmethod
    def load(
        cls,
        filename: str | Path,
        map_type: str = "auto",
        height_scale: float = 1.0,
        wrap_mode: str = "repeat",
        owner: str = "NormalMap",
    ) -> NormalMap:
        """Read a map from an image file.

        OpenEXR (half, float, unsigned integer; channels R,G,B or X,Y,Z or R,G or X,Y or Y, in a
        layer or not, or a single channel of any name; others, such as alpha, are ignored), TIFF
        (as :meth:`from_array`), and what ``mi.Bitmap`` reads (PNG, JPEG, BMP, TGA, PFM, PPM, HDR;
        alpha is ignored), in 8 or 16 bits per channel or floating point. Raises
        :class:`~.ParameterError` where the file is missing, unreadable, or holds no
        valid map.
        """
        path = Path(filename)
        check(path.is_file(), owner, "filename", "the name of an existing file", str(filename))
        reader = _READERS.get(path.suffix.lower(), _read_bitmap)
        try:
            data = reader(path)
        except Exception as error:  # each library has its own exceptions; all of them mean this:
            raise ParameterError(
                f'{owner}: "filename" must be a readable image file (got "{filename}": {error})'
            ) from error
        return cls.from_array(data, map_type, height_scale, wrap_mode, owner, "filename")

    @property
    def height(self) -> int:
        """Number of rows (texels along v)."""
        return self.normals.shape[0]

    @property
    def width(self) -> int:
        """Number of columns (texels along u)."""
        return self.normals.shape[1]

    @cached_property
    def content_hash(self) -> str:
        """A hexadecimal digest of size, wrap mode and normals: equal maps have equal digests."""
        digest = hashlib.blake2b(digest_size=16)
        digest.update(f"{self.height} {self.width} {self.wrap_mode} ".encode())
        digest.update(self.normals.astype("<f4", copy=False).data)
        return digest.hexdigest()

    def roughness(self) -> tuple[float, float]:
        """Beckmann roughness (alpha_u, alpha_v) of the whole map.

        ``alpha = √2 σ`` with ``σ²`` the mean squared slope ``n_xy / n_z`` about the surface normal.
        """
        x, y = self.normals.astype(np.float64).transpose(2, 0, 1)
        z_squared = 1 - x**2 - y**2
        return (
            float(np.sqrt(2 * np.mean(x**2 / z_squared))),
            float(np.sqrt(2 * np.mean(y**2 / z_squared))),
        )

    def __repr__(self) -> str:
        return f"NormalMap({self.height} x {self.width}, wrap_mode={self.wrap_mode!r})"


# -------------------------------------------------------------------------------------------------
# From channels to projected normals
# -------------------------------------------------------------------------------------------------


def _as_array(data: Any, owner: str, parameter: str) -> np.ndarray:
    """Read anything array-like as H x W x C; checks shape and type."""
    if hasattr(data, "__dlpack__") and not hasattr(data, "__array__"):
        data = np.from_dlpack(data)
    array = np.asarray(data)
    if array.ndim == 2:
        array = array[..., None]
    check(
        array.ndim == 3 and array.size > 0 and array.shape[2] <= 4,
        owner,
        parameter,
        _SHAPE,
        _shape_and_type(np.asarray(data)),
    )
    check(
        np.issubdtype(array.dtype, np.floating) or np.issubdtype(array.dtype, np.unsignedinteger),
        owner,
        parameter,
        "floating-point numbers or unsigned integers",
        str(array.dtype),
    )
    return array


def _projected_normals(
    data: np.ndarray, map_type: str, height_scale: float, wrap_mode: str, owner: str, parameter: str
) -> np.ndarray:
    """Turn H x W x C values into H x W x 2 projected normals; see :meth:`NormalMap.from_array`."""
    check_choice(owner, "map_type", map_type, MAP_TYPES)
    check_choice(owner, "wrap_mode", wrap_mode, WRAP_MODES)
    check(bool(np.isfinite(height_scale)), owner, "height_scale", "a finite number", height_scale)

    if data.shape[2] == 4:
        alpha = _as_fractions(data[..., 3])
        check(
            bool(np.all((alpha >= 0) & (alpha <= 1))),
            owner,
            parameter,
            "a map whose fourth channel is an alpha in [0, 1]",
            f"a fourth channel from {alpha.min():.6g} to {alpha.max():.6g}",
        )
        data = data[..., :3]

    channels = data.shape[2]
    is_grey = channels == 1 or (channels == 3 and bool(np.all(data == data[..., :1])))
    if map_type == "height" or (map_type == "auto" and is_grey):
        check(
            is_grey,
            owner,
            parameter,
            "a height, one channel or three equal ones",
            f"{channels} channels that differ" if channels == 3 else f"{channels} channels",
        )
        return _normals_from_height(
            _as_fractions(data[..., 0]), height_scale, wrap_mode, owner, parameter
        )

    check(channels > 1, owner, parameter, "normals, of two or three channels", "1 channel")
    vectors = _as_fractions(data)
    if np.issubdtype(data.dtype, np.unsignedinteger):
        vectors = 2 * vectors - 1
    return vectors if channels == 2 else _project(vectors, owner, parameter)


def _as_fractions(data: np.ndarray) -> np.ndarray:
    """Unsigned integers as fractions of their range, floats as they are; at least float32."""
    if np.issubdtype(data.dtype, np.unsignedinteger):
        working_type = np.float32 if data.dtype.itemsize <= 2 else np.float64
        return data.astype(working_type) / working_type(np.iinfo(data.dtype).max)
    return data.astype(np.result_type(data.dtype, np.float32), copy=False)


def _normals_from_height(
    height: np.ndarray, height_scale: float, wrap_mode: str, owner: str, parameter: str
) -> np.ndarray:
    """``n ∝ (-∂h/∂x, -∂h/∂y, 1)`` by central differences, in texels."""
    check_texels(owner, parameter, "finite heights", {"NaN or infinite": ~np.isfinite(height)})
    # Mirrored about the border, the texel beyond it is the border texel itself, as when clamped.
    padded = np.pad(height, 1, mode="wrap" if wrap_mode == "repeat" else "edge")
    scale = 0.5 * float(height_scale)
    with np.errstate(over="ignore", invalid="ignore"):  # refused below
        slope_x = scale * (padded[1:-1, 2:] - padded[1:-1, :-2])
        slope_y = scale * (padded[2:, 1:-1] - padded[:-2, 1:-1])
        length = np.hypot(np.hypot(slope_x, slope_y), 1)
    # Steeper ones would be horizontal in float32.
    check_texels(
        owner,
        parameter,
        f"a height with slopes below {MAX_SLOPE}, after height_scale",
        {"steeper": ~(length < MAX_SLOPE)},
    )
    return np.stack((-slope_x / length, -slope_y / length), axis=2)


def _project(vectors: np.ndarray, owner: str, parameter: str) -> np.ndarray:
    """Normalise vectors (x, y, z), which rounding to 8 bits leaves off the sphere, and drop z."""
    finite = np.isfinite(vectors).all(axis=2)
    zero = ~vectors.any(axis=2)
    check_texels(
        owner,
        parameter,
        "normals that are finite, non-zero and face up, z > 0",
        {
            "NaN or infinite": ~finite,
            "zero": zero,
            "down-facing": finite & ~zero & ~(vectors[..., 2] > 0),
        },
    )
    length = np.sqrt(np.einsum("ijk,ijk->ij", vectors, vectors, dtype=np.float64))
    return vectors[..., :2] / length[..., None]


# -------------------------------------------------------------------------------------------------
# Telling what is wrong
# -------------------------------------------------------------------------------------------------


def check_texels(
    owner: str, parameter: str, requirement: str, faults: Mapping[str, np.ndarray]
) -> None:
    """Raise unless every H x W mask of ``faults`` is empty; tell each count and the first place."""
    counts = {fault: int(np.count_nonzero(mask)) for fault, mask in faults.items()}
    if any(counts.values()):
        row, column = np.argwhere(np.logical_or.reduce(list(faults.values())))[0]
        listed = ", ".join(f"{count} {fault}" for fault, count in counts.items() if count)
        check(
            False,
            owner,
            parameter,
            requirement,
            f"{listed}; the first at row {row}, column {column}",
        )


def _shape_and_type(array: np.ndarray) -> str:
    return f"{' x '.join(map(str, array.shape)) or 'a scalar'}, {array.dtype}"


# -------------------------------------------------------------------------------------------------
# Reading files
# -------------------------------------------------------------------------------------------------


def _read_exr(path: Path) -> np.ndarray:
    """Read with OpenEXR: Mitsuba's own reader never returns on a machine with one CPU."""
    import OpenEXR

    with OpenEXR.File(str(path), separate_channels=True) as file:
        channels = {name: channel.pixels for name, channel in file.channels().items()}
    # "layer.R" is channel R of a layer; those without a layer come first.
    layers = sorted({name.rpartition(".")[0] for name in channels})
    for layout in _EXR_LAYOUTS:
        for layer in layers:
            names = [f"{layer}.{name}" if layer else name for name in layout]
            if all(name in channels for name in names):
                return np.stack([channels[name] for name in names], axis=2)
    colours = [name for name in channels if name.rpartition(".")[2] != "A"]
    if len(colours) == 1:
        return channels[colours[0]]
    raise ValueError(f"no channels R,G,B or X,Y,Z or R,G or X,Y or Y among {', '.join(channels)}")


def _read_tiff(path: Path) -> np.ndarray:
    from skimage.io import imread

    return imread(path)


def _read_bitmap(path: Path) -> np.ndarray:
    """Read with Mitsuba: scikit-image would silently reduce a 16-bit colour PNG to 8 bits."""
    from mitsuba import Bitmap

    bitmap = Bitmap(str(path))
    data = np.array(bitmap)
    # In a file, unlike in memory, a second channel is what the format says it is: alpha.
    return data[..., 0] if data.ndim == 3 and data.shape[2] == 2 else data


_READERS = {".exr": _read_exr, ".tif": _read_tiff, ".tiff": _read_tiff}
