"""Records of moments keep the digits that they state."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest

from glintbsdf.pndf.filters.records import FloatRecords, PackedRecords

COUNT = 500


def values(means: int, products: int) -> list[np.ndarray]:
    """Means of either sign, and second moments over many orders of magnitude; some covariances are
    those of slopes on an oblique line, some are zero."""
    rng = np.random.default_rng(1)
    found = [rng.normal(size=COUNT) * 10 ** rng.uniform(-4, 2, COUNT) for _ in range(means)]
    xx, yy = 10 ** rng.uniform(-11, 5, (2, COUNT))
    correlation = rng.choice([-1, -0.9999, 0, 0.5, 1], COUNT)
    xx[::50] = 0
    found += [xx, yy, correlation * np.sqrt(xx * yy)][:products]
    return [np.float32(x) for x in found]


@pytest.mark.parametrize("means, products", [(2, 3), (2, 2), (2, 1), (3, 1), (4, 1)])
def test_packed_records(variant, means, products):
    records = PackedRecords(2 * COUNT, means, products)
    assert records.words == {(2, 3): 3, (2, 2): 3, (2, 1): 2, (3, 1): 3, (4, 1): 4}[means, products]
    given, index = values(means, products), dr.arange(mi.UInt32, COUNT)
    for shift in (0, COUNT):
        records.put(index + shift, [mi.Float(x) for x in given])
    found = [x.numpy() for x in records.get(index + COUNT)]
    for x, y in zip(given[:means], found, strict=False):
        assert np.allclose(x, y, rtol=2**-16)
    scale = np.sqrt(np.float64(given[means]) * given[means + 1]) if products == 3 else None
    for k, (x, y) in enumerate(zip(given[means:], found[means:], strict=True)):
        # Of a root 11 digits are stored, and the square has twice its error.
        assert np.allclose(x, y, rtol=1.05 * 2**-10 if k < 2 else 0, atol=1e-12) or k == 2
        if k == 2:
            assert (np.abs(x - y) <= 1.6 * 2**-10 * scale + 1e-12).all()
    if products == 3:
        xx, yy, xy = (np.float64(x) for x in found[means:])
        assert (xx * yy - xy * xy >= -3e-7 * xx * yy).all()  # float32 rounds, the root does not


def test_float_records(variant):
    for count in (1, 3, 4, 5):
        given = [np.float32(x) for x in np.random.default_rng(2).normal(size=(count, COUNT))]
        records = FloatRecords(COUNT, count)
        records.put(dr.arange(mi.UInt32, COUNT), [mi.Float(x) for x in given])
        found = records.get(dr.arange(mi.UInt32, COUNT))
        assert all(np.array_equal(x, y.numpy()) for x, y in zip(given, found, strict=True))
