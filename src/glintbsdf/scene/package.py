"""A scene that is sent to other machines: its XML, the files that it names, and their digests.

A :class:`Package` lists everything that a scene consists of, by digests of content. A receiver
first looks for each file at its original path, which works on one machine and on a shared file
system. A file that is missing or different there is sent. The receiver keeps it in a folder, under
its digest. No name in a package can lead out of this folder.
"""

from __future__ import annotations

import functools
import hashlib
import importlib
import json
import os
import re
import tempfile
from collections.abc import Iterator, Mapping
from dataclasses import asdict, dataclass
from pathlib import Path, PurePosixPath

import drjit as dr
import mitsuba as mi

from glintbsdf import __version__
from glintbsdf.scene import rendering

_DIGEST = re.compile(r"[0-9a-f]{40}")
_SUFFIX = re.compile(r"(\.[A-Za-z0-9_]{1,16})?")

#: Size of the pieces in which a file is sent, bytes.
PIECE = 8 << 20


class BadPackage(ValueError):
    """A package, or a piece of a file, is not valid; no correct sender sends it."""


# ------------------------------------------------------------------------------------------------
#  Contents
# ------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Content:
    """A file, identified by its content.

    Attributes:
        digest (str): digest of its bytes, 40 hexadecimal digits.
        suffix (str): suffix of its name, such as ``.exr``; some readers depend on it.
        path (str): path of the original file.
    """

    digest: str
    suffix: str
    path: str

    @staticmethod
    def of(path: Path) -> Content:
        """The content of a file."""
        suffix = path.suffix if _SUFFIX.fullmatch(path.suffix) else ""
        return Content(digest_of(path), suffix, str(path.absolute()))

    @property
    def name(self) -> str:
        """The name under which a receiver keeps the file.

        Raises:
            BadPackage: digest or suffix is not valid, so that the name might lead elsewhere.
        """
        if not _DIGEST.fullmatch(self.digest) or not _SUFFIX.fullmatch(self.suffix):
            raise BadPackage(
                f"no content has the digest {self.digest!r} and suffix {self.suffix!r}"
            )
        return self.digest + self.suffix


def digest_of(path: Path) -> str:
    """Digest of the bytes of a file, 40 hexadecimal digits."""
    digest = hashlib.blake2b(digest_size=20)
    with path.open("rb") as file:
        while piece := file.read(1 << 20):
            digest.update(piece)
    return digest.hexdigest()


@functools.lru_cache(maxsize=4096)
def _digest_of_status(path: Path, _modified: int, _size: int) -> str:
    """The digest of a file, computed again if its time or size has changed."""
    return digest_of(path)


class Store:
    """A folder of files under their digests.

    Args:
        folder: the folder; it is created when the first file arrives.
    """

    def __init__(self, folder: Path) -> None:
        self.folder = folder

    def find(self, content: Content) -> Path | None:
        """A file with this content, either received or the original one; None if there is none."""
        received = self.folder / content.name
        if received.is_file():
            return received
        own = Path(content.path)
        try:
            status = own.stat()
            if not own.is_file() or content.digest != _digest_of_status(
                own, status.st_mtime_ns, status.st_size
            ):
                return None
        except OSError:
            return None
        return own

    def receive(self, content: Content, offset: int, piece: bytes, last: bool) -> None:
        """Receive the next piece of a file. After the last one the file exists.

        Raises:
            BadPackage: pieces are out of order, or the file does not have its digest.
        """
        self.folder.mkdir(parents=True, exist_ok=True)
        unfinished = self.folder / f"{content.name}.{os.getpid()}.part"
        with unfinished.open("ab" if offset else "wb") as file:
            complete = file.tell() == offset
            file.write(piece)
        if not complete:
            unfinished.unlink()
            raise BadPackage(f"a piece of {content.name} is missing")
        if last:
            if digest_of(unfinished) != content.digest:
                unfinished.unlink()
                raise BadPackage(f"what arrived as {content.name} is another file")
            os.replace(unfinished, self.folder / content.name)


def pieces(content: Content) -> Iterator[tuple[int, bytes, bool]]:
    """The pieces of an original file: the arguments of :meth:`Store.receive`.

    Raises:
        OSError: the file is gone.
        ValueError: the file has changed.
    """
    path = Path(content.path)
    if digest_of(path) != content.digest:
        raise ValueError(f"{path} has been changed since the rendering began")
    size, offset = path.stat().st_size, 0
    with path.open("rb") as file:
        while True:
            piece = file.read(PIECE)
            yield offset, piece, offset + len(piece) >= size
            offset += len(piece)
            if offset >= size:
                return


# ------------------------------------------------------------------------------------------------
#  Scenes
# ------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Package:
    """Everything that a scene consists of.

    Attributes:
        documents (tuple[tuple[str, Content], ...]): XML files by name, relative to a common folder;
            the scene's own file comes first.
        files (tuple[tuple[str, Content], ...]): all other files, by their names in the XML.
        definitions (tuple[tuple[str, str], ...]): values of the scene's parameters.
    """

    documents: tuple[tuple[str, Content], ...]
    files: tuple[tuple[str, Content], ...]
    definitions: tuple[tuple[str, str], ...]

    @staticmethod
    def of(filename: str | Path, definitions: Mapping[str, str] | None = None) -> Package:
        """The package of a scene.

        Raises:
            RuntimeError: the XML cannot be read.
        """
        definitions = dict(definitions or {})
        documents, files = inputs(filename, definitions)
        root = Path(os.path.commonpath([document.parent for document in documents]))
        return Package(
            tuple((d.relative_to(root).as_posix(), Content.of(d)) for d in documents),
            tuple((value, Content.of(found)) for value, found in files.items()),
            tuple(definitions.items()),
        )

    @property
    def contents(self) -> tuple[Content, ...]:
        """All files of the scene."""
        return tuple(content for _, content in (*self.documents, *self.files))

    @property
    def digest(self) -> str:
        """A digest of everything that determines the scene. Paths of files do not count."""
        parts = [
            [[name, content.digest] for name, content in group]
            for group in (self.documents, self.files)
        ]
        text = json.dumps([*parts, self.definitions])
        return hashlib.blake2b(text.encode(), digest_size=20).hexdigest()

    def missing(self, store: Store) -> list[Content]:
        """Files that must be sent, as ``store`` does not find them."""
        return [content for content in self.contents if store.find(content) is None]

    def load(self, store: Store, deferred: bool = False, glint_path: bool = False) -> mi.Scene:
        """Load the scene, see :func:`.load_scene`. No file may be missing.

        Raises:
            BadPackage: a name leads out of the folder.
        """
        files = {name: str(store.find(content)) for name, content in self.files}
        with tempfile.TemporaryDirectory(prefix="glintbsdf-") as folder:
            for name, content in self.documents:
                target = inside(Path(folder), name)
                target.parent.mkdir(parents=True, exist_ok=True)
                source = store.find(content)
                if source is None:
                    raise FileNotFoundError(f"{name} is missing")
                target.write_bytes(source.read_bytes())
            main = inside(Path(folder), self.documents[0][0])
            return rendering.load_scene(main, dict(self.definitions), deferred, files, glint_path)


def inputs(
    filename: str | Path, definitions: Mapping[str, str] | None = None
) -> tuple[list[Path], dict[str, Path]]:
    """The XML files of a scene, its own first, and all other files, by their names in the XML.

    Raises:
        RuntimeError: the XML cannot be read.
    """
    path = Path(filename).absolute()
    config = mi.parser.ParserConfig(mi.variant() or "")
    state = mi.parser.parse_file(config, str(path), **(definitions or {}))
    files: dict[str, Path] = {}
    for _, _, value in rendering.strings(state):
        if value not in files and (found := _find(value, path.parent)) is not None:
            files[value] = found
    return [Path(str(name)).resolve() for name in state.files], files


def inside(folder: Path, name: str) -> Path:
    """The path of a relative name in a folder.

    Raises:
        BadPackage: the path leads out of the folder.
    """
    pure = PurePosixPath(name)
    bad = pure.is_absolute() or ".." in pure.parts or not pure.parts or "\\" in name or ":" in name
    if bad or not (folder / pure).resolve().is_relative_to(folder.resolve()):
        raise BadPackage(f"the name {name!r} leads out of the folder for files")
    return folder / pure


def _find(value: str, folder: Path) -> Path | None:
    """The file that a string names, as Mitsuba finds it; None for other strings."""
    if not value or len(value) > 4096 or "\0" in value:
        return None
    resolver = mi.file_resolver()  # type: ignore[operator]  # an object in the stubs
    for path in (folder / value, Path(str(resolver.resolve(value)))):
        try:
            if path.is_file():
                return path
        except OSError:
            continue
    return None


# ------------------------------------------------------------------------------------------------
#  Versions
# ------------------------------------------------------------------------------------------------


@functools.cache
def versions() -> dict[str, str]:
    """Everything that must be the same on all machines for equal images: the versions of packages,
    and a digest of this package's source."""
    digest = hashlib.blake2b(digest_size=6)
    for package in ("glintbsdf", "glintbsdf.plugins"):
        folder = Path(next(iter(importlib.import_module(package).__path__)))
        for path in sorted(folder.rglob("*.py")):
            digest.update(path.relative_to(folder).as_posix().encode())
            digest.update(path.read_bytes())
    return {
        "glintbsdf": f"{__version__} (source {digest.hexdigest()})",
        "mitsuba": str(mi.__version__),
        "drjit": dr.__version__,  # type: ignore[attr-defined]  # its stubs lack it
    }


def version_difference(others: Mapping[str, str]) -> str | None:
    """The first difference of the versions here and elsewhere, in words; None if there is none."""
    for name, own in versions().items():
        if others.get(name) != own:
            return f"{name} {own}, and not {others.get(name)}"
    return None


@dataclass(frozen=True)
class Job:
    """An image to render: everything that determines it.

    Attributes:
        package (Package): the scene.
        variant (str): variant of Mitsuba.
        spp (int): samples per pixel.
        seed (int): seed of the image.
        denoise, trim (bool): see :class:`~glintbsdf.scene.rendering.Renderer` and
            :class:`~glintbsdf.scene.inspection.Trimmed`.
        sensor (str): the sensor, see :func:`~glintbsdf.scene.rendering.chosen_sensor`.
        glint_path (bool): see :func:`~glintbsdf.scene.rendering.load_scene`.
    """

    package: Package
    variant: str
    spp: int
    seed: int
    denoise: bool = False
    trim: bool = False
    sensor: str = ""
    glint_path: bool = False

    def description(self) -> dict[str, object]:
        """Everything that determines the image, for checkpoints, as values for JSON."""
        own = {k: v for k, v in asdict(self).items() if k not in ("package", "trim")}
        return {"scene": self.package.digest, **own, **versions()}
