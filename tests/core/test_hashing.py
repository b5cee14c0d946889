"""Hashed random numbers: repeatable, uniform, independent, and equal on coherent grids."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
import scipy.stats

from glintbsdf.core import hashing


def arrays(values):
    return [np.array(v) for v in values]


def pcg3d_in_python(x, y, z):
    """The published algorithm in integers of any size."""
    mask = 2**32 - 1
    x, y, z = ((v * 1664525 + 1013904223) & mask for v in (x, y, z))
    x, y, z = mix(x, y, z, mask)
    return mix(*(v ^ (v >> 16) for v in (x, y, z)), mask)


def mix(x, y, z, mask):
    x = (x + y * z) & mask
    y = (y + z * x) & mask
    z = (z + x * y) & mask
    return x, y, z


def test_hash_is_the_published_one(variant):
    keys = [(0, 0, 0), (1, 2, 3), (2**32 - 1, 2**31, 12345)]
    hashed = arrays(hashing.pcg3d(*(mi.UInt32(v) for v in zip(*keys, strict=True))))
    assert np.stack(hashed, 1).tolist() == [list(pcg3d_in_python(*key)) for key in keys]


def test_hash_does_not_depend_on_the_batch(variant):
    index = dr.arange(mi.UInt32, 1000)
    whole = arrays(hashing.pcg3d(index, 3, index * index))
    for size in (1, 7, 500):
        part = index[:size] if size > 1 else mi.UInt32(0)
        for a, b in zip(whole, arrays(hashing.pcg3d(part, 3, part * part)), strict=True):
            assert (a[:size] == b).all()


@pytest.mark.parametrize("key", [0, 1, 4_000_000_000])
def test_numbers_are_uniform_and_independent(variant, key):
    # Neighbouring keys, as cells of a grid have; 15 statistics per key, all within 4 sigma.
    n, side = 1 << 20, 1 << 10
    i = dr.arange(mi.UInt32, n)
    hashed = hashing.pcg3d(i % side, i // side, key)
    numbers = [np.array(hashing.uniform(h), np.float64) for h in hashed]
    for k, u in enumerate(numbers):
        assert 0 < u.min() and u.max() < 1
        counts = np.bincount((u * 1000).astype(int), minlength=1000)
        assert abs(scipy.stats.norm.isf(scipy.stats.chisquare(counts).pvalue)) < 4
        for other in (np.roll(u, 1), np.roll(u, side), numbers[k - 1]):
            assert abs(np.corrcoef(u, other)[0, 1]) < 4 / np.sqrt(n)


def test_gaussian(variant):
    bits = hashing.pcg3d(dr.arange(mi.UInt32, 1 << 20), 7, 1)[0]
    x = np.sort(np.array(hashing.gaussian(bits), np.float64))
    # Standard errors are 1e-3 and 1.3e-3.
    assert abs(x.mean()) < 4e-3 and abs(x.var() - 1) < 5.2e-3
    difference = scipy.stats.norm.cdf(x) - np.linspace(0, 1, len(x))
    assert np.abs(difference).max() < 0.009 + 4 * 0.5e-3


def test_vertices_have_one_name_on_all_levels_and_share_it_with_no_other(variant):
    side, levels = 33, 6
    x, y = np.meshgrid(np.arange(side) - side // 2, np.arange(side) - side // 2)
    names: dict[tuple, tuple] = {}
    for level in range(levels):
        name = hashing.coherent_vertex(mi.Int(x.ravel()), mi.Int(y.ravel()), mi.Int(level))
        for place, key in zip(
            zip(x.ravel() * 2**level, y.ravel() * 2**level, strict=True),
            zip(*map(np.ravel, arrays(name)), strict=True),
            strict=True,
        ):
            assert names.setdefault(place, key) == key, place
    assert len(set(names.values())) == len(names)
