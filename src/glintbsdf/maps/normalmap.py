"""The normal map: where every glint BSDF begins.

A normal is stored as its projection on the unit disk, ``(n_x, n_y)``, with ``n_z > 0`` implied.

The conventions are those of Mitsuba's ``bitmap`` and ``normalmap``:

* row ``i``, column ``j`` has its texel centre at ``uv = ((j + 1/2) / W, (i + 1/2) / H)``: row 0 is
  at ``v = 0``, ``n_x`` leans along ``u`` and ``n_y`` along ``v``;
* integers are fractions of their range. Normals are components in [-1, 1], or stored as (n + 1)/2;
  ``encoding`` says which, or the numbers do. A normal map is raw data: no gamma is ever undone;
* a height ``h`` (texels, after ``height_scale``) gives ``n ∝ (-∂h/∂x, -∂h/∂y, 1)`` by central
  differences over the neighbouring texels that ``wrap_mode`` names.

What ``auto`` has decided is in :attr:`NormalMap.notes`; decisions that another reading could
contradict are warnings, others information (:mod:`~glintbsdf.core.messages`). See
:mod:`~glintbsdf.maps.decoding`.

This module needs NumPy only: file readers are imported when a file of their kind is read.
"""

from __future__ import annotations

import hashlib
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple
from weakref import WeakValueDictionary

import numpy as np
import numpy.typing as npt

from glintbsdf.core.alignment import aligned
from glintbsdf.core.errors import check, check_choice
from glintbsdf.core.messages import inform, warn
from glintbsdf.maps.decoding import (
    ENCODINGS,
    MAP_TYPES,
    MAX_SLOPE,
    WRAP_MODES,
    Decoding,
    Note,
    check_texels,
    curl,
)
from glintbsdf.maps.reading import Picture, is_file, read

if TYPE_CHECKING:
    import mitsuba as mi

__all__ = ["ENCODINGS", "MAP_TYPES", "MAX_SLOPE", "WRAP_MODES", "NormalMap", "check_texels"]

#: The maps of files that are in use, by file and options.
_loaded: WeakValueDictionary[tuple, NormalMap] = WeakValueDictionary()

_SHAPE = "an H x W x C array with H, W >= 1 and C = 1…4"

#: Green points the other way where that makes the curl of the normals so many times smaller.
_DECISIVE = 4


class MapShape(NamedTuple):
    """Size and wrap mode of a map: all that footprints need to know of it."""

    height: int
    width: int
    wrap_mode: str


def map_bytes(normal_map: NormalMap) -> int:
    """Memory of a map and of its tensor in the active variant, bytes.

    On the CPU the tensor is the NumPy array itself; a GPU has a separate copy.
    """
    import mitsuba as mi

    return normal_map.nbytes * (1 if (mi.variant() or "").startswith("llvm") else 2)


class NormalMap:
    """A map of unit normals.

    ``normals`` is an H x W x 2 array of projected normals (x, y), every one strictly inside the
    unit disk; the map keeps a read-only float32 copy. ``wrap_mode`` continues the map beyond its
    border: ``repeat``, ``mirror`` (about the border, so texel -1 is texel 0) or ``clamp``. A
    mirrored texel keeps its value, as in Mitsuba. ``notes`` lists the decisions made in reading
    it, ``is_height`` states whether it was a height. A map never changes: loading the same file
    again gives the same object.

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
            normals = aligned(np.array(normals, dtype=np.float32, order="C"))
            squared_length = np.einsum("ijk,ijk->ij", normals, normals, dtype=np.float64)
        finite = np.isfinite(normals).all(axis=2)
        check_texels(
            owner,
            parameter,
            "normals inside the unit disk, x² + y² < 1",
            {"NaN or infinite": ~finite, "outside the disk": finite & ~(squared_length < 1)},
        )

        normals.flags.writeable = False
        self.parameter = parameter
        self.normals: npt.NDArray[np.float32] = normals
        self.wrap_mode = wrap_mode
        self.notes: tuple[Note, ...] = ()
        self.is_height = False

    @classmethod
    def from_array(
        cls,
        data: Any,
        map_type: str = "auto",
        height_scale: float = 1.0,
        wrap_mode: str = "repeat",
        owner: str = "NormalMap",
        parameter: str = "data",
        flip_y: bool | None = None,
        **decoding: Any,
    ) -> NormalMap:
        """Make a map from an array or tensor of H x W or H x W x C values, C = 1…4.

        * C = 1 is a height;
        * C = 2 are the projected normals (x, y), inside the unit disk;
        * C = 3 are normals (x, y, z) of any length; all three equal, but for a few levels of
          8 bits, are a height;
        * C = 4 is C = 3 and an alpha in [0, 1], which is ignored; or an alpha that carries x, with
          y in green and nothing else in the other two.

        ``map_type`` ``normal`` or ``height`` overrules that choice; a height with several different
        channels is refused. ``height_scale`` is in texels per unit of height and may be negative.
        ``flip_y`` turns the second component of normals; where it is None, a warning is logged if
        they would fit together better that way. ``decoding``: ``encoding``, ``strength`` and
        ``fill_voids``, see :class:`~glintbsdf.maps.decoding.Decoding`.

        Anything NumPy can read is accepted, among it ``mi.TensorXf`` and whatever speaks DLPack.
        Raises :class:`~.ParameterError`.
        """
        picture = Picture(_as_array(data, owner, parameter))
        return cls._decoded(
            picture,
            owner,
            parameter,
            flip_y,
            map_type=map_type,
            height_scale=height_scale,
            wrap_mode=wrap_mode,
            **decoding,
        )

    @classmethod
    def from_bitmap(
        cls,
        bitmap: mi.Bitmap,
        map_type: str = "auto",
        height_scale: float = 1.0,
        wrap_mode: str = "repeat",
        owner: str = "NormalMap",
        parameter: str = "bitmap",
        flip_y: bool | None = None,
        **decoding: Any,
    ) -> NormalMap:
        """Make a map from an ``mi.Bitmap``, whose gamma flag is ignored.

        Channels and options are as in :meth:`from_array`. Mitsuba calls any two channels luminance
        and alpha: they are read as projected normals (x, y), unless ``map_type`` is ``height``.
        """
        data = np.asarray(bitmap)
        if map_type == "height" and data.ndim == 3 and data.shape[2] == 2:
            data = data[..., :1]
        return cls.from_array(
            data, map_type, height_scale, wrap_mode, owner, parameter, flip_y, **decoding
        )

    @classmethod
    def load(
        cls,
        filename: str | Path,
        map_type: str = "auto",
        height_scale: float = 1.0,
        wrap_mode: str = "repeat",
        owner: str = "NormalMap",
        layer: str = "",
        flip_y: bool | None = None,
        **decoding: Any,
    ) -> NormalMap:
        """Read a map from an image file.

        OpenEXR (half, float, unsigned integer; channels R,G,B or X,Y,Z or R,G or X,Y or Y, in a
        layer or not, or a single channel of any name; others, such as alpha, are ignored; ``layer``
        names a layer, by default one with "normal" in its name goes first), TIFF (as
        :meth:`from_array`), and what ``mi.Bitmap`` reads (PNG, JPEG, BMP, TGA, PFM, PPM, HDR), in 8
        or 16 bits per channel or floating point. Options are those of :meth:`from_array`. Raises
        :class:`~.ParameterError` where the file is missing, unreadable, or holds no valid map.
        """
        path = Path(filename)
        check(is_file(path), owner, "filename", "the name of an existing file", str(filename))
        check_choice(owner, "map_type", map_type, MAP_TYPES)
        status = path.stat()
        content = path.resolve(), status.st_mtime_ns, status.st_size
        key = (*content, map_type, height_scale, wrap_mode, layer, flip_y, *decoding.items())
        if (known := _loaded.get(key)) is not None:
            known.tell(owner, "filename", path.name)
            return known
        picture = read(path, map_type, layer, owner)
        data = _as_array(picture.data, owner, "filename")
        picture = Picture(data, picture.void, picture.note)
        options = {"map_type": map_type, "height_scale": height_scale, "wrap_mode": wrap_mode}
        result = cls._decoded(picture, owner, "filename", flip_y, path.name, **options, **decoding)
        _loaded[key] = result
        return result

    @classmethod
    def _decoded(
        cls,
        picture: Picture,
        owner: str,
        parameter: str,
        flip_y: bool | None,
        name: str = "",
        **options: Any,
    ) -> NormalMap:
        """The map of a picture, its notes told with the ``name`` of its file."""
        decoding = Decoding(
            owner=owner, parameter=parameter, flip_y=bool(flip_y), void=picture.void, **options
        )
        if picture.note:
            decoding.note(picture.note)
        result = cls(decoding.normals(picture.data), decoding.wrap_mode, owner, parameter)
        result.is_height = decoding.reads_height
        if flip_y is None and (text := result.doubt_of_green(1)):
            decoding.note(text)
        result.notes = tuple(decoding.notes)
        result.tell(owner, parameter, name)
        return result

    def tell(self, owner: str, parameter: str, name: str = "") -> None:
        """Tell the user what has been decided about the map, with the ``name`` of its file."""
        for note in self.notes:
            tell = warn if note.doubtful else inform
            tell(f'{owner}: "{parameter}"' + (f' "{name}"' if name else "") + f": {note.text}")

    def doubt_of_green(self, orientation: int) -> str:
        """A sentence where the normals speak for green that points the other way; else empty.

        ``orientation``: 1 where the second component of a normal points along the map's rows on the
        surface, -1 where against them. A height has no green, and maps without curvature across
        both axes say nothing.
        """
        if self.is_height:
            return ""
        along, against = self.curl
        now, flipped = (along, against) if orientation > 0 else (against, along)
        if now <= _DECISIVE * flipped:
            return ""
        return (
            f"its normals fit together if green points the other way (curl {flipped:.2g} rather "
            f'than {now:.2g}; OpenGL against DirectX): "flip_y" true turns it, false says that '
            "it is right"
        )

    @cached_property
    def curl(self) -> tuple[float, float]:
        """Deviation of the normals from those of a height, as they are and with y reversed."""
        return curl(self.normals)

    @property
    def height(self) -> int:
        """Number of rows (texels along v)."""
        return self.normals.shape[0]

    @property
    def width(self) -> int:
        """Number of columns (texels along u)."""
        return self.normals.shape[1]

    @property
    def shape(self) -> MapShape:
        """Size and wrap mode."""
        return MapShape(self.height, self.width, self.wrap_mode)

    @property
    def nbytes(self) -> int:
        """Memory of the normals, bytes."""
        return self.normals.nbytes

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


def _as_array(data: Any, owner: str, parameter: str) -> np.ndarray:
    """Anything array-like as H x W x C numbers; checks shape and type."""
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
        np.issubdtype(array.dtype, np.floating) or np.issubdtype(array.dtype, np.integer),
        owner,
        parameter,
        "floating-point numbers or integers",
        str(array.dtype),
    )
    return array


def _shape_and_type(array: np.ndarray) -> str:
    return f"{' x '.join(map(str, array.shape)) or 'a scalar'}, {array.dtype}"


def wrapped(index: np.ndarray, count: int, wrap_mode: str) -> np.ndarray:
    """The texels that stand at any indices along an axis of ``count`` texels."""
    if wrap_mode == "clamp":
        return np.clip(index, 0, count - 1)
    if wrap_mode == "mirror":
        index = index % (2 * count)
        return np.minimum(index, 2 * count - 1 - index)
    return index % count
