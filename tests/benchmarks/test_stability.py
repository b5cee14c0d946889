"""The command "stability": a short run, its continuation after an interruption, and its bounds."""

from __future__ import annotations

import csv
import io
import json

import pytest
from rich.console import Console

from glintbsdf.check import bounds

ROWS = (("leadr", "white noise"), ("manifold", "3×5, mirror"), ("grid", "none"))


@pytest.fixture
def stability(variant):
    from benchmarks.commands import stability

    return stability


def run(stability, rows, folder) -> tuple[int, str]:
    output = io.StringIO()
    status = stability.run(rows, folder, Console(file=output, width=200))
    return status, output.getvalue()


def test_short_run(stability, tmp_path):
    # Three methods, each with all of its measures, keep all of their bounds.
    rows = [stability.Row(*names, quick=True) for names in ROWS]
    status, text = run(stability, rows, tmp_path)
    assert status == 0, text
    report = json.loads((tmp_path / "stability.json").read_text())
    assert [(row["method"], row["map"]) for row in report["rows"]] == list(ROWS)
    assert all(row["broken"] == [] and not row["result"]["errors"] for row in report["rows"])
    lines = list(csv.DictReader((tmp_path / "stability.csv").read_text().splitlines()))
    assert [line["NaN"] for line in lines] == ["0", "0", "0"]
    page = (tmp_path / "stability.html").read_text()
    assert page.count("<tr>") == 4 and 'class="broken"' not in page and "http" not in page


def test_goes_on_after_an_interruption(stability, tmp_path, monkeypatch):
    rows = [stability.Row("lean", name, quick=True) for name in ("flat", "tilted")]
    good = {"errors": {}, "energy_limit": 1.0}
    measured = []

    def measure(row):
        measured.append(row.map)
        if row.map == "tilted" and len(measured) == 2:
            raise KeyboardInterrupt
        return good

    monkeypatch.setattr(stability, "measure", measure)
    assert run(stability, rows, tmp_path)[0] == 130
    assert len(json.loads((tmp_path / "stability.json").read_text())["rows"]) == 1
    assert run(stability, rows, tmp_path)[0] == 0
    assert measured == ["flat", "tilted", "tilted"]
    assert run(stability, rows, tmp_path)[0] == 0 and len(measured) == 3


BROKEN = {
    "NaN": {"extremes": {"nan": 1, "negative": 0}},
    "negative": {"extremes": {"nan": 0, "negative": 2}},
    "∫D − 1": {"densities": [{"mass": 0.01, "mass_error": 1e-3, "p_value": 0.5}]},
    "float64": {"double": {"error": 2e-3, "last_digit": 1e-4}},
    "χ²": {"densities": [{"mass": 0.0, "mass_error": 1e-3, "p_value": 1e-4}]},
    "furnace": {"energies": [{"energy": 1.1, "error": 0.01}], "energy_limit": 1.0},
    "bright": {"bright": {"apart": 0.0, "nan": 1, "negative": 0}},
}


@pytest.mark.parametrize("column", BROKEN)
def test_broken_bounds_show(stability, tmp_path, monkeypatch, column):
    monkeypatch.setattr(stability, "measure", lambda row: BROKEN[column] | {"errors": {}})
    status, text = run(stability, [stability.Row("lean", "flat")], tmp_path)
    assert status == 1 and "✗" in text
    assert json.loads((tmp_path / "stability.json").read_text())["rows"][0]["broken"] == [column]
    assert (tmp_path / "stability.html").read_text().count('class="broken"') == 1


@pytest.mark.parametrize("column", ["∫D − 1", "float64", "χ²", "furnace"])
def test_nan_breaks_every_bound(stability, column):
    ((name, value),) = [item for item in BROKEN[column].items() if item[0] != "energy_limit"]
    figures = value[0] if isinstance(value, list) else value
    spoilt = dict.fromkeys(figures, float("nan"))
    result = BROKEN[column] | {name: [spoilt] if isinstance(value, list) else spoilt, "errors": {}}
    assert bounds.Judge(10).cells(result)[column].broken


def test_unresolved_values_are_not_judged(stability):
    result = BROKEN["float64"] | BROKEN["NaN"] | {"errors": {}, "resolved": False}
    cells = bounds.Judge(10).cells(result)
    assert cells["float64"] == bounds.Cell("(2.0e-03)") and cells["NaN"].broken


def test_failures_are_named(stability, tmp_path):
    row = stability.Row("lean", "flat", "alpha", -1.0, quick=True)
    status, text = run(stability, [row], tmp_path)
    assert status == 1 and '"alpha" must be' in text
