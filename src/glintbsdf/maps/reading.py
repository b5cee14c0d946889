"""Read image files with a map: the numbers as they are stored, and the choice of layer or channels.

Nothing is decoded here: no gamma is undone, and integers stay integers. File readers are imported
when a file of their kind is read.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from glintbsdf.core.errors import ParameterError, check, describe

# Sets of channels of an EXR file that can be a map, the most specific names first.
_EXR_LAYOUTS = (("R", "G", "B"), ("X", "Y", "Z"), ("R", "G"), ("X", "Y"), ("Y",))

#: Names of layers, by type of map.
_LAYER_NAMES = {
    "auto": ("normal",),
    "normal": ("normal",),
    "height": ("height", "displace", "bump"),
}

_GDAL_NODATA = 42113  # a TIFF tag: the value of places without data


@dataclass(frozen=True)
class Picture:
    """The content of a file.

    Attributes:
        data: H x W or H x W x C values.
        void: the value that the file gives to places without data, or None.
        note: a sentence about the choice among several possibilities, or empty.
    """

    data: np.ndarray
    void: float | None = None
    note: str = ""


def is_file(path: Path) -> bool:
    """Whether there is a file of this name, which may be invalid as a name."""
    try:
        return path.is_file()
    except (OSError, ValueError):  # a name too long for the system, or with a null in it
        return False


def read(path: Path, map_type: str, layer: str, owner: str) -> Picture:
    """Read an image file by the library that reads its kind best.

    Args:
        path: an existing file.
        map_type: ``auto``, ``normal`` or ``height``: decides which layer is preferred.
        layer: the layer of an OpenEXR file; empty for the one whose name fits best. A layer called
            "normal" goes before those without a name, and these before any other.

    Raises:
        ParameterError: the file is no image or has no channels of a map, or no such layer.
    """
    suffix = path.suffix.lower()
    check(
        not layer or suffix == ".exr", owner, "layer", "left out for a file without layers", layer
    )
    try:
        if suffix == ".exr":
            return _read_exr(path, map_type, layer, owner)
        if suffix in (".tif", ".tiff"):
            return _read_tiff(path)
        return _read_bitmap(path)
    except ParameterError:
        raise
    except Exception as error:  # each library has its own exceptions; all of them mean this:
        raise ParameterError(
            f'{owner}: "filename" must be a readable image file '
            f"(got {describe(str(path))}: {' '.join(str(error).split())})"
        ) from error


def _read_exr(path: Path, map_type: str, layer: str, owner: str) -> Picture:
    """Read with OpenEXR: Mitsuba's own reader never returns on a machine with one CPU."""
    import OpenEXR

    channels: dict[str, np.ndarray] = {}
    with OpenEXR.File(str(path), separate_channels=True) as file:
        for part in file.parts:
            # The channels of several parts are often told apart by the part's name alone.
            prefix = f"{part.name()}." if len(file.parts) > 1 and part.name() else ""
            for name, channel in part.channels.items():
                own = name if name.startswith(prefix) else prefix + name
                channels.setdefault(own, channel.pixels)

    maps = _maps_among(channels)
    if layer:
        check(layer in maps, owner, "layer", "one of " + ", ".join(filter(None, maps)), layer)
        return Picture(_stacked(channels, maps[layer]))
    if not maps:
        raise ValueError(
            f"no channels R,G,B or X,Y,Z or R,G or X,Y or Y among {', '.join(channels)}"
        )
    wanted = _LAYER_NAMES[map_type]

    def rank(name: str) -> tuple:
        names = maps[name]
        layout = tuple(channel.rpartition(".")[2] for channel in names)
        order = _EXR_LAYOUTS.index(layout) if layout in _EXR_LAYOUTS else len(_EXR_LAYOUTS)
        return (not any(word in name.lower() for word in wanted), order, name)

    best = min(maps, key=rank)
    note = ""
    if len(maps) > 1:
        others = ", ".join(_layer_name(name) for name in sorted(maps) if name != best)
        note = f'taken is the {_layer_name(best)} of the file, not {others}; "layer" names another'
    return Picture(_stacked(channels, maps[best]), note=note)


def _layer_name(name: str) -> str:
    return f'layer "{name}"' if name else "layer without a name"


def _maps_among(channels: dict[str, np.ndarray]) -> dict[str, list[str]]:
    """The channels that make a map, by their layer: "layer.R" belongs to the layer "layer"."""
    maps = {}
    for layer in {name.rpartition(".")[0] for name in channels}:
        prefix = f"{layer}." if layer else ""
        own = [name for name in channels if name.rpartition(".")[0] == layer]
        for layout in _EXR_LAYOUTS:
            names = [prefix + name for name in layout]
            if all(name in channels for name in names):
                maps[layer] = names
                break
        else:
            colours = [name for name in own if name != f"{prefix}A"]
            if len(colours) == 1:
                maps[layer] = colours
    return maps


def _stacked(channels: dict[str, np.ndarray], names: list[str]) -> np.ndarray:
    return np.stack([channels[name] for name in names], axis=2)


def _read_tiff(path: Path) -> Picture:
    """Read the first page of a TIFF file: planar or not, inverted or not, of a palette or not."""
    import tifffile

    with tifffile.TiffFile(path) as file:
        page = file.pages.first
        data = page.asarray()
        if page.planarconfig == tifffile.PLANARCONFIG.SEPARATE and data.ndim == 3:
            data = np.moveaxis(data, 0, -1)
        if page.photometric == tifffile.PHOTOMETRIC.PALETTE:
            data = np.moveaxis(np.asarray(page.colormap)[:, data], 0, -1)
        elif page.photometric == tifffile.PHOTOMETRIC.MINISWHITE:
            data = _inverted(data, page.bitspersample)
        elif data.dtype.kind == "u" and page.bitspersample < 8 * data.dtype.itemsize:
            data = data / np.float32(2**page.bitspersample - 1)  # of 1, 4 or 12 bits
        tag = page.tags.get(_GDAL_NODATA)
        note = f"taken is the first of {len(file.pages)} pages" if len(file.pages) > 1 else ""
    try:
        void = None if tag is None else float(str(tag.value).strip("\0 "))
    except ValueError:
        void = None
    return Picture(data, void, note)


def _inverted(data: np.ndarray, bits: int) -> np.ndarray:
    """The negative of values whose smallest one means white."""
    if data.dtype.kind == "b":
        return (~data).astype(np.uint8) * np.uint8(255)
    if data.dtype.kind != "u":
        return -data
    if bits < 8 * data.dtype.itemsize:
        return 1 - data / np.float32(2**bits - 1)
    return np.iinfo(data.dtype).max - data


def _read_bitmap(path: Path) -> Picture:
    """Read with Mitsuba: scikit-image would silently reduce a 16-bit colour PNG to 8 bits."""
    from mitsuba import Bitmap

    data = np.array(Bitmap(str(path)))
    # In a file, unlike in memory, a second channel is what the format says it is: alpha.
    return Picture(data[..., 0] if data.ndim == 3 and data.shape[2] == 2 else data)
