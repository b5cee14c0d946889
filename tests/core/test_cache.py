"""The disk cache returns what was stored, or builds it, whatever has happened to the disk."""

from __future__ import annotations

import multiprocessing
import os
import sys
import time
from pathlib import Path

import numpy as np
import platformdirs
import pytest

from glintbsdf.core import cache


@pytest.fixture
def folder(tmp_path, monkeypatch):
    monkeypatch.setenv("GLINTBSDF_CACHE", str(tmp_path / "cache"))
    cache._warn_once.cache_clear()
    return tmp_path / "cache"


@pytest.fixture
def warned(monkeypatch):
    """The warnings of the cache, as a list of texts."""
    messages = []
    monkeypatch.setattr(cache, "warn", messages.append)
    return messages


class Builder:
    """A builder that counts its calls."""

    def __init__(self, seed=0):
        self.calls = 0
        rng = np.random.default_rng(seed)
        self.arrays = {
            "floats": rng.normal(size=(3, 50, 2)).astype(np.float32),
            "offsets": rng.integers(0, 1 << 40, 1000),
            "empty": np.zeros((0, 4), np.uint8),
            "scalar": np.array(2.5),
        }

    def __call__(self):
        self.calls += 1
        return self.arrays

    def check(self, arrays):
        assert arrays.keys() == self.arrays.keys()
        for name, expected in self.arrays.items():
            assert arrays[name].dtype == expected.dtype
            np.testing.assert_array_equal(arrays[name], expected, strict=True)


def forbidden():
    raise AssertionError("built although it is in the cache")


# For the cache, its arrays are the same as those of Builder.
forbidden.__qualname__ = Builder.__qualname__


def test_round_trip(folder):
    builder, other = Builder(), Builder(seed=1)
    builder.check(cache.load_or_build(builder, "lists 1 abc"))
    builder.check(cache.load_or_build(forbidden, "lists 1 abc"))
    other.check(cache.load_or_build(other, "lists 1 abd"))
    builder.check(cache.load_or_build(forbidden, "lists 1 abc"))
    assert builder.calls == other.calls == 1
    assert sorted(path.suffix for path in folder.iterdir()) == [".npz", ".npz"]


@pytest.mark.parametrize("value", ["off", ""])
def test_cache_off(folder, monkeypatch, value):
    monkeypatch.setenv("GLINTBSDF_CACHE", value)
    builder = Builder()
    for _ in range(2):
        builder.check(cache.load_or_build(builder, "key"))
    assert builder.calls == 2 and cache.directory() is None and not folder.exists()


def test_default_directory(monkeypatch):
    monkeypatch.delenv("GLINTBSDF_CACHE")
    assert cache.directory() == platformdirs.user_cache_path() / "glintbsdf"
    monkeypatch.setenv("GLINTBSDF_CACHE", "~/elsewhere")
    assert cache.directory() == Path.home() / "elsewhere"


def test_damaged_file_is_built_again(folder):
    builder = Builder()
    cache.load_or_build(builder, "key")
    (path,) = folder.iterdir()
    content = path.read_bytes()
    damaged = [content[:length] for length in (0, 1, 4, 100, len(content) // 2, len(content) - 1)]
    header, values = content.index(b"NUMPY"), content.index(builder.arrays["floats"].tobytes())
    for position in (0, header, header + 20, values, values + 1000, len(content) - 30):
        damaged.append(
            content[:position] + bytes([content[position] ^ 0x55]) + content[position + 1 :]
        )
    damaged += [b"\x93NUMPY", b"\x80\x04K\x01.", b"not a file of arrays"]
    for built_before, broken in enumerate(damaged, start=1):
        path.write_bytes(broken)
        builder.check(cache.load_or_build(builder, "key"))
        assert builder.calls == built_before + 1
        builder.check(cache.load_or_build(forbidden, "key"))
    assert list(folder.iterdir()) == [path]


def test_unwritable_directory_warns_once(tmp_path, monkeypatch, warned):
    (tmp_path / "file").write_text("in the way")
    monkeypatch.setenv("GLINTBSDF_CACHE", str(tmp_path / "file" / "cache"))
    cache._warn_once.cache_clear()
    builder = Builder()
    builder.check(cache.load_or_build(builder, "key"))
    builder.check(cache.load_or_build(builder, "key"))
    assert len(warned) == 1 and builder.calls == 2
    assert "builds without its cache" in warned[0] and "GLINTBSDF_CACHE" in warned[0]


@pytest.mark.skipif(
    sys.platform == "win32" or not hasattr(os, "geteuid") or os.geteuid() == 0,
    reason="root may write anywhere",
)
def test_read_only_cache_is_read(folder):
    builder = Builder()
    cache.load_or_build(builder, "key")
    folder.chmod(0o500)
    try:
        builder.check(cache.load_or_build(forbidden, "key"))
    finally:
        folder.chmod(0o700)


@pytest.mark.parametrize("error", [OSError(28, "No space left on device"), KeyboardInterrupt()])
def test_interrupted_write_leaves_nothing(folder, monkeypatch, error, warned):
    def half(file, **arrays):
        file.write(b"PK half")
        raise error

    monkeypatch.setattr(np, "savez", half)
    builder = Builder()
    if isinstance(error, OSError):
        builder.check(cache.load_or_build(builder, "key"))
        assert len(warned) == 1 and "No space left" in warned[0]
    else:
        with pytest.raises(KeyboardInterrupt):
            cache.load_or_build(builder, "key")
    assert list(folder.iterdir()) == []


def test_error_while_building_leaves_nothing(folder):
    def broken():
        raise RuntimeError("no")

    with pytest.raises(RuntimeError, match="no"):
        cache.load_or_build(broken, "key")
    with pytest.raises(TypeError, match="plain arrays"):
        cache.load_or_build(lambda: {"objects": np.array([None])}, "key")
    assert not folder.exists() or list(folder.iterdir()) == []


def test_old_files_go(folder, monkeypatch):
    builder = Builder()
    for i in range(3):
        cache.load_or_build(builder, f"key {i}")
        (path,) = (path for path in folder.iterdir() if path.stat().st_mtime > 1e6)
        os.utime(path, (1000 + i, 1000 + i))
    size = path.stat().st_size
    cache.load_or_build(forbidden, "key 0")  # used last
    stale, fresh = folder / "glintbsdf-killed.tmp", folder / "glintbsdf-running.tmp"
    foreign = [folder / "mine.tmp", folder / "mine.npz"]
    for file in (stale, fresh, *foreign):
        file.write_bytes(b"half")
    for file in (stale, *foreign):
        os.utime(file, (1000, 1000))

    monkeypatch.setattr(cache, "LIMIT", 2.5 * size)
    cache.load_or_build(builder, "key 3")
    assert not stale.exists() and fresh.exists()
    assert len(list(folder.glob("glintbsdf-*.npz"))) == 2
    cache.load_or_build(forbidden, "key 0")
    cache.load_or_build(forbidden, "key 3")

    monkeypatch.setattr(cache, "LIMIT", 1)
    cache.load_or_build(builder, "key 4")
    cache.load_or_build(forbidden, "key 4")
    assert len(list(folder.glob("glintbsdf-*.npz"))) == 1
    assert all(file.exists() for file in foreign)


@pytest.mark.skipif(sys.platform == "win32", reason="limits the size of files as POSIX does")
def test_a_full_disk_stays_as_it_was(folder, warned):
    import resource

    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (100_000, hard))
    try:
        arrays = cache.load_or_build(lambda: {"a": np.ones(100_000)}, "large")
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))
    assert arrays["a"].sum() == 100_000
    assert len(warned) == 1 and "builds without its cache" in warned[0]
    assert not list(folder.iterdir())


def slow_build():
    """Leaves a mark, and takes long enough for other processes to come."""
    (cache.directory() / f"built-by-{os.getpid()}").touch()
    time.sleep(1)
    return {"a": np.arange(10)}


def build_once(_index):
    return cache.load_or_build(slow_build, "once")["a"].sum()


def test_processes_build_once(folder):
    context = multiprocessing.get_context("spawn")
    with context.Pool(3) as pool:
        assert pool.map(build_once, range(3), chunksize=1) == [45, 45, 45]
    assert len(list(folder.glob("built-by-*"))) == 1
    assert not list(folder.glob("*.lock"))


def hammer(seed):
    """Write and read one key over and over; any mixture of two files would be noticed."""
    for _ in range(30):
        arrays = cache.load_or_build(
            lambda: {name: np.full(100_000, 7.0) for name in ("first", "second")}, "shared"
        )
        assert all((array == 7).all() and array.size == 100_000 for array in arrays.values())
        for path in cache.directory().glob("*.npz"):
            path.unlink(missing_ok=True)
    return seed


def test_processes_share_a_directory(folder):
    context = multiprocessing.get_context("spawn")
    with context.Pool(2) as pool:
        assert pool.map(hammer, range(2)) == [0, 1]
    assert not list(folder.glob("*.tmp"))


def test_key_changes_with_the_source_of_the_builder():
    """A builder's digest covers the modules that it imports, and no others."""
    from glintbsdf.pndf.manifold import exact

    assert cache.source_digest(exact.__name__) == cache.source_digest(exact.__name__)
    digests = {
        cache.source_digest(f"glintbsdf.{module}")
        for module in ("core.errors", "core.hashing", "footprint.lattice", "pndf.index.lists")
    }
    assert len(digests) == 4
