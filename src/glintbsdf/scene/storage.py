"""Files of finished work: units, merged images, and the checkpoints that consist of them.

Every file starts with a digest of its content, so a damaged file is noticed when it is read. A file
is complete or does not exist: it is written under a temporary name, synchronised to the disk, and
renamed.
"""

from __future__ import annotations

import hashlib
import io
import json
import os
from collections.abc import Mapping
from pathlib import Path

import numpy as np

from glintbsdf.scene.image import Image
from glintbsdf.scene.passes import Tile

#: The format of a checkpoint's files. Files with another number cannot be read.
FORMAT = 1

#: Number of units between two files of merged sums. If such a file is damaged, at most this many
#: units are merged again; twice as many files of units are kept for this.
UNITS_PER_SNAPSHOT = 16

_DIGEST = 32  # bytes


class Damaged(Exception):
    """A file does not contain what was written to it."""


class Refused(ValueError):
    """A checkpoint cannot be used: it belongs to another rendering, or is damaged."""


# ------------------------------------------------------------------------------------------------
#  Files
# ------------------------------------------------------------------------------------------------


def write(path: Path, arrays: Mapping[str, np.ndarray]) -> None:
    """Write arrays to a file, at once. After the return, the file survives a loss of power.

    Raises:
        OSError: the file cannot be written, for example as the disk is full. The message names the
            file. An older file of this name stays.
    """
    buffer = io.BytesIO()
    np.savez(buffer, **arrays)  # type: ignore[arg-type]  # an array may have any name
    write_bytes(path, hashlib.blake2b(buffer.getbuffer(), digest_size=_DIGEST).digest(), buffer)


def write_bytes(path: Path, head: bytes, buffer: io.BytesIO) -> None:
    """Write the bytes of ``head`` and ``buffer``, as :func:`write` does."""
    temporary = path.with_name(f"{path.name}.tmp")
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        with temporary.open("wb") as file:
            file.write(head)
            file.write(buffer.getbuffer())
            file.flush()
            os.fsync(file.fileno())
        os.replace(temporary, path)
        _bring_to_disk(path.parent)
    except OSError as error:
        temporary.unlink(missing_ok=True)
        raise OSError(f"cannot write {path}: {error.strerror or error}") from error


def _bring_to_disk(folder: Path) -> None:
    """Synchronise the names in a folder to the disk, on systems that can do so."""
    if os.name == "posix":
        handle = os.open(folder, os.O_RDONLY)
        try:
            os.fsync(handle)
        finally:
            os.close(handle)


def read(path: Path) -> dict[str, np.ndarray] | None:
    """The arrays of a file; None if there is none.

    Raises:
        Damaged: the file does not contain what was written.
    """
    try:
        content = path.read_bytes()
    except FileNotFoundError:
        return None
    except OSError as error:
        raise Damaged(f"{path} cannot be read") from error
    head, body = content[:_DIGEST], memoryview(content)[_DIGEST:]
    if hashlib.blake2b(body, digest_size=_DIGEST).digest() != head:
        raise Damaged(f"{path} is damaged")
    with np.load(io.BytesIO(body), allow_pickle=False) as file:
        return {name: file[name] for name in file.files}


class UnitFiles:
    """Finished units in a folder, one file for each."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder

    def path(self, index: int) -> Path:
        return self.folder / f"unit-{index:08d}.glint"

    def save(self, index: int, tile: Tile, sums: np.ndarray) -> None:
        """Write the tile and the sums of a unit."""
        corners = np.array([tile.x, tile.y, tile.width, tile.height], np.int64)
        write(self.path(index), {"tile": corners, "sums": sums, "index": np.array(index, np.int64)})

    def load(self, index: int) -> tuple[Tile, np.ndarray] | None:
        """The tile and the sums of a unit; None if there is no file.

        Raises:
            Damaged: the file does not contain what was saved.
        """
        arrays = read(self.path(index))
        if arrays is None:
            return None
        if int(arrays["index"]) != index:
            raise Damaged(f"{self.path(index)} is another unit's")
        return Tile(*(int(v) for v in arrays["tile"])), arrays["sums"]

    def remove(self, index: int) -> None:
        self.path(index).unlink(missing_ok=True)


# ------------------------------------------------------------------------------------------------
#  Checkpoint
# ------------------------------------------------------------------------------------------------


class Checkpoint:
    """A folder with the finished part of an image.

    It contains a description of the image, and the finished units. After every
    :data:`UNITS_PER_SNAPSHOT` units, the sums of all units so far are written as well. The last two
    of these files are kept, and the units since the older one. So the folder's size does not depend
    on the number of samples.

    Args:
        folder: the folder; it is created if it does not exist.
        description: everything that determines the image, as values that JSON can represent.

    Raises:
        Refused: the folder belongs to another image or to another version.
        OSError: the folder cannot be written.
    """

    def __init__(self, folder: Path, description: Mapping[str, object]) -> None:
        self.folder = folder
        self.units = UnitFiles(folder)
        description = json.loads(json.dumps({"format": FORMAT, **description}))
        path = folder / "rendering.json"
        try:
            known = json.loads(path.read_text("utf-8")) if path.exists() else None
        except (OSError, ValueError):
            raise Refused(
                f"the checkpoint {folder} is damaged: {path.name} cannot be read"
            ) from None
        if known is None:
            if folder.exists() and any(folder.iterdir()):
                raise Refused(f"{folder} is not empty and no checkpoint of a rendering")
            text = json.dumps(description, indent=2, ensure_ascii=False)
            write_bytes(path, b"", io.BytesIO(text.encode()))
        elif known != description:
            raise Refused(_difference(folder, known, description))

    def restore(self, image: Image) -> None:
        """Restore the sums of an empty image from the latest file that is not damaged."""
        for path in sorted(self.folder.glob("sums-*.glint"), reverse=True):
            try:
                arrays = read(path)
            except Damaged:
                path.unlink(missing_ok=True)
                continue
            if arrays is None:
                continue
            image.count = int(arrays["count"])
            image.sums, image.odd = arrays["sums"], arrays["odd"]
            return

    def progressed(self, image: Image) -> None:
        """Write the sums if enough units were merged. To be called after each unit."""
        if image.sums is None or image.odd is None:
            return
        if image.count % UNITS_PER_SNAPSHOT and image.count < len(image.plan):
            return
        count = np.array(image.count, np.int64)
        arrays = {"count": count, "sums": image.sums, "odd": image.odd}
        write(self._snapshot(image.count), arrays)
        kept = sorted(self.folder.glob("sums-*.glint"))[-2:]
        for path in self.folder.glob("sums-*.glint"):
            if path not in kept:
                path.unlink(missing_ok=True)
        merged = int(kept[0].stem.split("-")[1]) if len(kept) > 1 else 0
        for path in self.folder.glob("unit-*.glint"):
            if int(path.stem.split("-")[1]) < merged:
                path.unlink(missing_ok=True)

    def _snapshot(self, count: int) -> Path:
        return self.folder / f"sums-{count:08d}.glint"


def _difference(folder: Path, known: Mapping[str, object], wanted: Mapping[str, object]) -> str:
    """A sentence about the first difference of a checkpoint and a rendering."""
    for key in {**wanted, **known}:
        if known.get(key) != wanted.get(key):
            break
    return (
        f"the checkpoint {folder} belongs to another rendering: its {key} is {known.get(key)}, "
        f"this one's is {wanted.get(key)}. Name another folder, or delete this one."
    )
