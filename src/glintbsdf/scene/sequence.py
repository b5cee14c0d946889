"""Sequences of frames: the parameters of each frame, names of images, contact sheets and videos."""

from __future__ import annotations

import contextlib
import csv
import itertools
import math
import re
import shutil
import string
import subprocess
import tempfile
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import IO, cast

import mitsuba as mi
import numpy as np

#: Largest width and height of an image on a contact sheet, pixels.
THUMBNAIL = 320

_GAP = 4  # pixels between two images on a sheet
_NUMBER = r"[-+]?(?:\d+\.?\d*|\.\d+)(?:[eE][-+]?\d+)?"
_RANGE = re.compile(rf"({_NUMBER}):({_NUMBER}):(\d+)")


class SequenceError(ValueError):
    """The arguments do not make a sequence; the message says why."""


# ------------------------------------------------------------------------------------------------
#  Values
# ------------------------------------------------------------------------------------------------


def values_of(text: str) -> list[str] | None:
    """The values of a range ``first:last:count``, with both ends; None for any other text.

    Raises:
        SequenceError: the range is empty.
    """
    match = _RANGE.fullmatch(text)
    if not match:
        return None
    first, last, count = float(match[1]), float(match[2]), int(match[3])
    if count < 1:
        raise SequenceError(f"a range has one value at least (got {text})")
    return [f"{value:.9g}" for value in np.linspace(first, last, count)]


def frames_of(
    definitions: Mapping[str, str],
    table: Sequence[Mapping[str, str]] = (),
    together: bool = False,
) -> list[dict[str, str]]:
    """The parameters of each frame.

    Args:
        definitions: parameters of all frames. A range has one value for each frame.
        table: a mapping of parameters for each frame.
        together: whether all ranges advance together, frame by frame. Otherwise there is a frame
            for every combination of values; the last range changes fastest. A table is one more
            range, before the others.

    Raises:
        SequenceError: there is neither a range nor a table, or ranges that advance together differ
            in length, or a parameter is given twice.
    """
    common, ranges = {}, []
    if table:
        ranges.append([dict(row) for row in table])
    for key, text in definitions.items():
        values = values_of(text)
        if values is None:
            common[key] = text
        else:
            ranges.append([{key: value} for value in values])
    if not ranges:
        raise SequenceError("nothing makes frames: give -D key=first:last:count, or --table FILE")
    twice = [key for row in table for key in row if key in definitions]
    if twice:
        raise SequenceError(f'"{twice[0]}" is in the table and in -D')
    if together and len({len(values) for values in ranges}) > 1:
        lengths = " and ".join(str(len(values)) for values in ranges)
        raise SequenceError(f"ranges that go on together have the same length (got {lengths})")
    steps = zip(*ranges, strict=True) if together else itertools.product(*ranges)
    return [{**common, **{k: v for part in step for k, v in part.items()}} for step in steps]


def read_table(path: Path) -> list[dict[str, str]]:
    """Rows of a table of parameters. Commas, semicolons or tabs separate its columns, and its first
    line has the names.

    Raises:
        SequenceError: there is no row, or a row has another length.
    """
    text = path.read_text("utf-8-sig")
    heading = text.partition("\n")[0]
    delimiter = max(",;\t", key=heading.count)
    rows = [
        {(key or "").strip(): value for key, value in row.items()}
        for row in csv.DictReader(text.splitlines(), delimiter=delimiter)
    ]
    for number, row in enumerate(rows):
        if None in row.values() or "" in row:
            raise SequenceError(f"{path}: row {number + 2} has not one value for each name")
    if not rows:
        raise SequenceError(f"{path} has no rows: the first line names the parameters")
    return [{key: value.strip() for key, value in row.items()} for row in rows]


# ------------------------------------------------------------------------------------------------
#  Names
# ------------------------------------------------------------------------------------------------


def names_of(template: str, frames: Sequence[Mapping[str, str]]) -> list[Path]:
    """File names of frames, from a template such as ``{index:04}_{alpha}.exr``.

    Args:
        template: its fields may be ``index``, which counts from 0, and the names of parameters that
            all frames have. Numbers may have formats.
        frames: the parameters of each frame.

    Raises:
        SequenceError: a field is unknown, or two frames have the same name, or a value would lead
            into another folder.
    """
    fields = {name for _, name, _, _ in string.Formatter().parse(template) if name is not None}
    known = {"index", *set.intersection(*(set(frame) for frame in frames))}
    if not fields <= known:
        raise SequenceError(
            f'the name has a field "{min(fields - known)}"; there are {", ".join(sorted(known))}'
        )
    names = []
    for index, frame in enumerate(frames):
        used = {key: frame[key] for key in fields - {"index"}}
        for key, value in used.items():
            if re.search(r"[/\\:\0]", value) or value in ("", ".", ".."):
                raise SequenceError(f'"{key}" cannot be part of a name (got "{value}")')
        try:
            name = template.format(index=index, **{k: _number(v) for k, v in used.items()})
        except ValueError as error:
            raise SequenceError(f"{template}: {error}") from error
        names.append(Path(name))
    if len(set(names)) < len(names):
        raise SequenceError(f"{template} gives several frames the same name; use {{index:04}}")
    return names


def _number(text: str) -> int | float | str:
    for kind in (int, float):
        try:
            return kind(text)
        except ValueError:
            continue
    return text


# ------------------------------------------------------------------------------------------------
#  All frames at once
# ------------------------------------------------------------------------------------------------


def colours(path: Path) -> np.ndarray:
    """The colours of an image file as sRGB: (height, width, 3) uint8."""
    bitmap = mi.Bitmap(str(path))
    if bitmap.pixel_format() == mi.Bitmap.PixelFormat.MultiChannel:
        bitmap = bitmap.split()[0][1]
    return np.array(bitmap.convert(mi.Bitmap.PixelFormat.RGB, mi.Struct.Type.UInt8, True))


def sheet(images: Sequence[Path], columns: int | None = None) -> mi.Bitmap:
    """A contact sheet: all images row by row, reduced to :data:`THUMBNAIL`.

    Args:
        images: image files.
        columns: images in a row; None for about as many as there are rows.
    """
    from skimage.transform import resize

    columns = columns or math.ceil(len(images) ** 0.5)
    tiles = []
    for path in images:
        image = colours(path)
        scale = min(1.0, THUMBNAIL / max(image.shape[:2]))
        shape = [max(1, round(size * scale)) for size in image.shape[:2]]
        if scale < 1:
            image = resize(image, shape, anti_aliasing=True, preserve_range=True).round()
        tiles.append(image.astype(np.uint8))
    height, width = (max(tile.shape[axis] for tile in tiles) + _GAP for axis in range(2))
    rows = -(-len(tiles) // columns)
    made = np.full((rows * height - _GAP, columns * width - _GAP, 3), 255, np.uint8)
    for index, tile in enumerate(tiles):
        top, left = index // columns * height, index % columns * width
        made[top : top + tile.shape[0], left : left + tile.shape[1]] = tile
    return mi.Bitmap(made)


def require_ffmpeg() -> str:
    """The path of the program ffmpeg.

    Raises:
        SequenceError: it is not installed.
    """
    program = shutil.which("ffmpeg")
    if program is None:
        raise SequenceError("a video needs the program ffmpeg, which is not there")
    return program


def write_video(images: Sequence[Path], path: Path, rate: float) -> None:
    """Make a video from image files of the same size.

    Args:
        images: image files, one per frame.
        path: the video; its suffix determines the format.
        rate: frames per second.

    Raises:
        SequenceError: ffmpeg is not installed, or it fails; the message is its last line.
    """
    height, width = colours(images[0]).shape[:2]
    command = [
        *(require_ffmpeg(), "-y", "-loglevel", "error", "-f", "rawvideo", "-pix_fmt", "rgb24"),
        *("-s", f"{width}x{height}", "-r", str(rate), "-i", "-"),
        # Many formats need even sizes.
        *("-vf", "pad=ceil(iw/2)*2:ceil(ih/2)*2", "-pix_fmt", "yuv420p", str(path)),
    ]
    with tempfile.TemporaryFile() as messages:
        process = subprocess.Popen(command, stdin=subprocess.PIPE, stderr=messages)
        try:
            pipe = cast(IO[bytes], process.stdin)
            with contextlib.suppress(BrokenPipeError):  # ffmpeg has ended; the reason is read below
                for image in images:
                    pipe.write(colours(image).tobytes())
                pipe.close()
            if process.wait():
                messages.seek(0)
                lines = messages.read().decode(errors="replace").strip().splitlines()
                raise SequenceError(f"ffmpeg: {lines[-1] if lines else 'failed'}")
        finally:
            process.kill()
            process.wait()
