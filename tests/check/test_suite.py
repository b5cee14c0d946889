"""The test suite for BSDFs: the table that a failed χ² test writes."""

from __future__ import annotations

import csv

import numpy as np
import pytest

from glintbsdf.check import suite

BOUNDS = ((-0.4, 0.1), (0.4, 0.5))


def counts_of(mass: np.ndarray, total: int) -> np.ndarray:
    drawn = np.random.default_rng(1).multinomial(total, mass.ravel() / mass.sum())
    return drawn.reshape(mass.shape)


def test_failed_chi2_names_a_file_with_its_table(tmp_path, monkeypatch):
    monkeypatch.setenv(suite.TABLES, str(tmp_path / "tables"))
    mass, total = np.full((4, 8), 1 / 32), 10_000
    error = np.full(mass.shape, 1e-4)
    counts = counts_of(mass, total)
    suite.assert_distributed(counts, total, mass, error, 10, BOUNDS)
    assert not (tmp_path / "tables").exists()

    counts[3, 5] += 500
    with pytest.raises(AssertionError, match="not distributed as stated") as failure:
        suite.assert_distributed(counts, total, mass, error, 10, BOUNDS)
    (path,) = (tmp_path / "tables").iterdir()
    assert str(path) in str(failure.value)
    rows = [
        {k: float(v) for k, v in row.items()}
        for row in csv.DictReader(path.read_text().splitlines())
    ]
    assert len(rows) == mass.size
    worst = max(rows, key=lambda row: abs(row["pull"]))
    assert (worst["row"], worst["column"], worst["observed"]) == (3, 5, counts[3, 5])
    assert worst["expected"] == pytest.approx(total / 32)
    # The middle of the last row and the sixth of eight columns.
    assert (worst["x"], worst["y"]) == (pytest.approx(0.15), pytest.approx(0.45))
    deviation = np.sqrt(total / 32 + (total * 1e-4) ** 2)
    assert worst["pull"] == pytest.approx((counts[3, 5] - total / 32) / deviation, rel=1e-6)


def test_tables_go_to_the_temporary_files_by_default(tmp_path, monkeypatch):
    monkeypatch.delenv(suite.TABLES, raising=False)
    monkeypatch.setattr(suite.tempfile, "gettempdir", lambda: str(tmp_path))
    mass = np.full(8, 1 / 8)  # bins without a place on the disk
    path = suite.dumped(np.arange(8), 28, mass, 0 * mass, None)
    assert path.parent == tmp_path and path.read_text().count("nan") == 16
