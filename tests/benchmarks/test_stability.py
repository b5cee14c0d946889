"""benchmarks/stability.py: a short run, the measures on cases whose answer is known, its bounds."""

from __future__ import annotations

import csv
import io
import json
import sys
from dataclasses import replace
from pathlib import Path

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from rich.console import Console

sys.path.append(str(Path(__file__).parents[2] / "benchmarks"))

ROWS = (("leadr", "white noise"), ("manifold", "3×5, mirror"), ("grid", "none"))


@pytest.fixture
def stability(variant):
    import stability  # chooses a variant where none is active

    return stability


@pytest.fixture
def measures(variant):
    import _measures

    return _measures


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
    assert stability.Judge(10).cells(result)[column].broken


def test_what_is_not_resolved_is_not_judged(stability):
    result = BROKEN["float64"] | BROKEN["NaN"] | {"errors": {}, "resolved": False}
    cells = stability.Judge(10).cells(result)
    assert cells["float64"] == stability.Cell("(2.0e-03)") and cells["NaN"].broken


def test_what_fails_is_named(stability, tmp_path):
    row = stability.Row("lean", "flat", "alpha", -1.0, quick=True)
    status, text = run(stability, [row], tmp_path)
    assert status == 1 and '"alpha" must be' in text


# --------------------------------------------------------------------------------------------------
#  The measures
# --------------------------------------------------------------------------------------------------


def test_quadrature_finds_spikes_of_any_size(measures):
    # Half of the mass in three disks of radius 1e-4, half over the square: as narrow and as far
    # apart as the highlights of flat triangles.
    rng = np.random.default_rng(1)
    centres, radius = np.array([[0.3, -0.2], [0.31, -0.2], [-0.7, 0.9]]), 1e-4

    def density(s):
        distance = np.linalg.norm(s[:, None] - centres, axis=2)
        return 0.5 / 4 + 0.5 / 3 * (distance < radius).sum(1) / (np.pi * radius**2)

    def draw(count):
        r, angle = radius * np.sqrt(rng.random(count)), rng.uniform(0, 2 * np.pi, count)
        spikes = centres[rng.integers(0, 3, count)]
        spikes = spikes + np.stack([r * np.cos(angle), r * np.sin(angle)], 1)
        return np.where(rng.random((count, 1)) < 0.5, spikes, rng.uniform(-1, 1, (count, 2)))

    training, test = draw(8000), draw(8000)
    cells, cell_of = measures.partition(training)
    assert np.isclose(np.prod(cells[:, 1] - cells[:, 0], axis=1).sum(), 4)
    assert (measures.count_in(cells, training) == np.bincount(cell_of, minlength=len(cells))).all()
    mass, error = measures.mass_of(density, cells, training, cell_of)
    total = np.sqrt((error**2).sum())
    assert total < 4e-3 and abs(mass.sum() - 1) < 4 * total
    counts = measures.count_in(cells, test)
    assert measures.suite.p_value(counts, len(test), mass, error) > 1e-3
    # A sampler that draws the spikes one percent wider is found out.
    wider = test.copy()
    for centre in centres:
        near = np.linalg.norm(wider - centre, axis=1) < 2 * radius
        wider[near] = centre + 1.2 * (wider[near] - centre)
    assert measures.suite.p_value(measures.count_in(cells, wider), len(test), mass, error) < 1e-5


def test_quadrature_is_led_to_needles_by_few_samples(measures, monkeypatch):
    # As of 16 degenerate triangles: a thousandth of the mass each, in a quarter of the square.
    rng = np.random.default_rng(2)
    centres, radius = rng.uniform(0.1, 0.9, (16, 2)), 1e-5

    def density(s):
        near = (np.linalg.norm(s[:, None] - centres, axis=2) < radius).sum(1)
        return 0.984 / 2 * (s[:, 0] < 0) + 0.001 * near / (np.pi * radius**2)

    points = rng.uniform((-1, -1), (0, 1), (20_000, 2))
    r, angle = radius * np.sqrt(rng.random(320)), rng.uniform(0, 2 * np.pi, 320)
    offset = np.stack([r * np.cos(angle), r * np.sin(angle)], 1)
    points[:320] = centres[rng.integers(0, 16, 320)] + offset
    monkeypatch.setattr(measures, "MOST_BOXES", 4)  # cut nowhere but where samples say so
    cells = np.array([[[-1, -1], [0, 1]], [[0, -1], [1, 1]]], float)
    mass, error = measures.mass_of(density, cells, points, (points[:, 0] >= 0).astype(int))
    # Where none is led to, both mass and error are 0.
    assert error[1] < 0.02 and (np.abs(mass - [0.984, 0.016]) < 4 * error + 1e-4).all()


def test_view_that_sees_no_facet(measures, stability):
    bsdf = mi.load_dict(stability.Row("manifold", "tilted").description())
    view = measures.View(wi=(-1, 0.4, 0.05))
    assert (np.array(measures.suite.sample(bsdf, view, 100)[1].pdf) == 0).all()
    found = measures.density(bsdf, view, 100)
    assert found == {"mass": 0.0, "mass_error": 0.0, "p_value": 1.0}
    # A density that no sample has is found out.
    stated = measures.density(Stated(bsdf, lambda *x: mi.Float(0.1)), view, 100)
    assert stated["mass"] > 0.05


class Stated:
    """A BSDF that states another density than the one it draws from."""

    def __init__(self, bsdf, pdf):
        self.bsdf, self.pdf = bsdf, pdf

    def __getattr__(self, name):
        return getattr(self.bsdf, name)


def test_cells_around_points_that_coincide(measures):
    # As of a lobe that is hardly wider than the spacing of float32.
    points = np.full((300, 2), 0.6)
    points[200:] += np.linspace(0, 1e-4, 100)[:, None]
    cells, cell_of = measures.partition(points)
    assert np.isclose(np.prod(cells[:, 1] - cells[:, 0], axis=1).sum(), 4)
    assert len(np.unique(cell_of)) > 3


def test_false_densities_are_found(measures):
    def rough(alpha):
        return mi.load_dict({"type": "roughconductor", "alpha": alpha, "distribution": "beckmann"})

    bsdf, view = rough(0.2), measures.View(wi=(0.3, 0.1, 1))
    true = measures.density(bsdf, view, 8192)
    assert abs(true["mass"]) < 4 * true["mass_error"] + 1e-3 and true["p_value"] > 1e-3
    bright = measures.density(Stated(bsdf, lambda *x: 1.05 * bsdf.pdf(*x)), view, 8192)
    assert bright["mass"] == pytest.approx(true["mass"] + 0.05, abs=5e-3)
    wide = measures.density(Stated(bsdf, rough(0.22).pdf), view, 8192)
    assert abs(wide["mass"]) < 4 * wide["mass_error"] + 5e-3 and wide["p_value"] < 1e-5


def test_extremes_are_counted(measures):
    class Broken:
        """Not a number where footprints are a point, negative where they are huge."""

        def sample(self, ctx, si, sample1, sample2):
            bs = dr.zeros(mi.BSDFSample3f, dr.width(si))
            bs.wo, bs.pdf = mi.warp.square_to_cosine_hemisphere(sample2), 1
            return bs, mi.Spectrum(1)

        def eval_pdf(self, ctx, si, wo):
            length = dr.norm(si.duv_dx)
            value = dr.select(length > 50, -1, dr.select(length == 0, dr.nan, 1))
            return mi.Spectrum(value), mi.Float(1)

        def eval_diffuse_reflectance(self, si):
            return mi.Spectrum(1)

    found = measures.extremes(Broken(), 800)
    si = measures.extreme_interaction(800, 1)
    length = np.array(dr.norm(si.duv_dx))
    assert found == {"nan": int((length == 0).sum()), "negative": int((length > 50).sum())}
    assert found["nan"] > 100 and found["negative"] > 50
    # Every extreme takes part.
    assert np.array(si.wi.z).min() == 0 and np.abs(np.array(si.uv)).max() > 1e5


def test_float64_sees_a_difference_and_leaves_nothing_behind(measures, stability):
    row = stability.Row("manifold", "rank-one")
    bsdf = mi.load_dict(row.description())
    good = measures.double_error(bsdf, lambda: mi.load_dict(row.description()), 500)
    assert 0 < good["error"] < 1e-3
    # In place of the same surface in float64, one whose highlights are a little wider.
    other = replace(row, parameter="epsilon", value=1.1e-6)
    bad = measures.double_error(bsdf, lambda: mi.load_dict(other.description()), 500)
    assert bad["error"] > 0.03
    again = mi.load_dict(row.description())
    assert type(again.pndf.vertices) is mi.Float and mi.Float is not mi.Float64
