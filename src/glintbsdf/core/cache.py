"""A cache on disk for structures that are built from a map: dictionaries of plain NumPy arrays.

The environment variable ``GLINTBSDF_CACHE`` names its directory; ``off`` or an empty value disables
it. By default it is the user's cache directory (on Linux ``~/.cache/glintbsdf``). The directory may
be deleted at any time. The least recently used files are deleted when the total passes 4 GiB.

Files appear whole or not at all, so processes may share the directory. A file that is cut short or
damaged is noticed by the checksum of its arrays and replaced. Nothing is ever unpickled.
"""

from __future__ import annotations

import contextlib
import functools
import hashlib
import os
import re
import sys
import tempfile
import threading
import time
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path

import numpy as np

from glintbsdf.core.messages import warn

LIMIT = 4 << 30  # bytes
_PREFIX = "glintbsdf-"  # the directory may hold files of others, which are never touched
_STALE = 3600  # seconds; an older unfinished file can only be what a killed process left


def directory() -> Path | None:
    """The directory in use, which need not exist yet, or None where the cache is off."""
    value = os.environ.get("GLINTBSDF_CACHE")
    if value is None:
        import platformdirs

        return platformdirs.user_cache_path("glintbsdf", appauthor=False)
    return None if value in ("", "off") else Path(value).expanduser()


def load_or_build(
    build: Callable[[], Mapping[str, np.ndarray]], *content: object
) -> dict[str, np.ndarray]:
    """Return the arrays that ``build()`` makes from this content, or the cached ones.

    The key consists of ``content``, which must contain all that determines the result: a map's
    content hash and every parameter, as values whose ``repr`` tells them apart. The name of
    ``build`` and the source of its module, and of the modules of this package that it imports, are
    added here, so a changed builder does not get the results of the former one. A cache that cannot
    be read or written causes one warning only; an error in ``build`` is passed on.
    """
    folder = directory()
    if folder is None:
        return dict(build())
    name = getattr(build, "__qualname__", type(build).__qualname__)
    key = f"{build.__module__}.{name} {source_digest(build.__module__)} {content!r}"
    path = folder / f"{_PREFIX}{hashlib.blake2b(key.encode(), digest_size=20).hexdigest()}.npz"
    arrays = _load(path)
    if arrays is None:
        with _alone(path):
            arrays = _load(path)  # another process may have built it meanwhile
            if arrays is None:
                arrays = dict(build())
                _store(path, arrays)
    return arrays


#: Locks that this process holds, and what guards the set.
_held: set[Path] = set()
_guard = threading.Lock()


@contextlib.contextmanager
def _alone(path: Path) -> Iterator[None]:
    """Let no other process of this machine build ``path`` during the block.

    Mitsuba makes plugins in parallel, and a thread that waits for a kernel may take up the next
    plugin meanwhile. So who holds a lock never waits for another one: it builds all the same. A
    process that dies gives its place to the next. Where the folder cannot be written, everybody
    builds.
    """
    import filelock

    lock = filelock.FileLock(path.with_suffix(".lock"), thread_local=False)
    with _guard:
        waits = not _held
        mine = path not in _held
        if mine:
            _held.add(path)
    locked = False
    try:
        if mine:
            try:
                path.parent.mkdir(parents=True, exist_ok=True)
                lock.acquire(timeout=-1 if waits else 0)
                locked = True
            except (OSError, NotImplementedError, RuntimeError):
                pass
        yield
    finally:
        if locked:
            with contextlib.suppress(OSError):
                Path(lock.lock_file).unlink(missing_ok=True)  # who waits for it may still have it
            lock.release()
        if mine:
            with _guard:
                _held.discard(path)


@functools.cache
def source_digest(module: str) -> str:
    """A digest of the source of a module and of all modules of this package that it imports."""
    digest = hashlib.blake2b(digest_size=16)
    waiting, found = [module], {module}
    while waiting:
        path = _source_file(waiting.pop())
        if path is None:
            continue
        source = path.read_bytes()
        digest.update(source)
        for base, names in _IMPORT.findall(source.decode()):
            for other in (base, *(f"{base}.{name}" for name in re.findall(r"\w+", names))):
                if other not in found:
                    found.add(other)
                    waiting.append(other)
    return digest.hexdigest()


def _source_file(module: str) -> Path | None:
    """The source of a module of this package, or of one that is loaded; None if there is none."""
    package, _, rest = module.partition(".")
    if package != __name__.partition(".")[0]:
        name = getattr(sys.modules.get(module), "__file__", None)
        return Path(name) if name else None
    path = Path(__file__).parents[1].joinpath(*filter(None, rest.split(".")))
    candidates = (path.with_suffix(".py"), path / "__init__.py")
    return next((candidate for candidate in candidates if candidate.is_file()), None)


#: Import statements of this package: ``from MODULE import NAMES``.
_IMPORT = re.compile(r"^\s*from (glintbsdf[\w.]*) import (\([^)]*\)|[^\n]*)", re.MULTILINE)


def _load(path: Path) -> dict[str, np.ndarray] | None:
    """Read a file whole, or return None where there is none or it is damaged."""
    try:
        with path.open("rb") as stream, np.load(stream, allow_pickle=False) as file:
            arrays = {name: file[name] for name in file.files}
    except Exception:  # whatever is the matter with the file, it is built again
        return None
    with contextlib.suppress(OSError):  # a cache that may only be read serves as well
        os.utime(path)  # used just now
    return arrays


def _store(path: Path, arrays: Mapping[str, np.ndarray]) -> None:
    """Write a file under another name in the same folder, then rename it.

    It does not wait for the disk: after a power failure, the checksums reveal damaged files.
    """
    if any(array.dtype.hasobject for array in arrays.values()):
        raise TypeError("only plain arrays can be cached, not arrays of Python objects")
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        with tempfile.NamedTemporaryFile(
            dir=path.parent, prefix=_PREFIX, suffix=".tmp", delete=False
        ) as file:
            try:
                np.savez(file, **arrays)  # type: ignore[arg-type]  # an array may have any name
                file.close()
                os.replace(file.name, path)
            except BaseException:
                with contextlib.suppress(OSError):  # a full disk fails here once more
                    file.close()
                os.unlink(file.name)
                raise
        _tidy(path.parent)
    except OSError as error:
        _warn_once(str(path.parent), str(error))


def _tidy(folder: Path) -> None:
    """Delete what killed processes left, then the least recently used files beyond the limit.

    Another process may do the same at the same time, or still read a file (which Windows keeps).
    """
    now, total = time.time(), 0
    with contextlib.suppress(OSError):
        for entry in folder.glob(f"{_PREFIX}*.tmp"):
            if now - entry.stat().st_mtime > _STALE:
                entry.unlink()
        used = sorted(
            ((entry.stat(), entry) for entry in folder.glob(f"{_PREFIX}*.npz")),
            key=lambda pair: pair[0].st_mtime,
            reverse=True,
        )
        for position, (status, entry) in enumerate(used):
            total += status.st_size
            if total > LIMIT and position > 0:
                entry.unlink()


@functools.cache
def _warn_once(folder: str, error: str) -> None:
    warn(
        f"glintbsdf builds without its cache, because {folder} cannot be written "
        f"({error}). Name another directory in GLINTBSDF_CACHE, or set it to off."
    )
