"""The report of error against run time: its figures, its continuation after an interruption, its
files and its page."""

import json
import os
import re
import shutil
import signal
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest

pytest.importorskip("matplotlib")
pytest.importorskip("jinja2")

ROOT = Path(__file__).parents[2]
SCHEMA = ROOT / "benchmarks" / "report" / "schema.json"


# -------------------------------------------------------------------------------------------------
# What is made of measurements
# -------------------------------------------------------------------------------------------------


def point(method, seconds, l1, noise=0.001):
    return {"method": method, "seconds_per_query": seconds, "l1": l1, "noise_l1": noise}


def test_front_has_the_undominated_points():
    from benchmarks.report import pareto

    points = [
        point("slow and exact", 8.0, 0.0005),
        point("fast and rough", 1.0, 0.3),
        point("beaten by the next", 5.0, 0.1),
        point("between", 4.0, 0.05),
        point("slower, as good as exact", 9.0, 0.0001),
    ]
    front = [p["method"] for p in pareto.front(points)]
    assert front == ["fast and rough", "between", "slow and exact"]


def test_errors_below_their_noise_count_as_zero():
    from benchmarks.report import pareto

    points = [point("noisy", 1.0, 0.08, noise=0.07), point("sure", 2.0, 0.04)]
    assert pareto.front(points) == points[:1]
    assert pareto.fastest(points, 0.02)["method"] == "noisy"
    assert pareto.fastest([point("sure", 2.0, 0.04)], 0.02) is None


def test_the_first_among_equally_fast_is_named():
    from benchmarks.report import pareto

    points = [point("simple", 1.2, 0.04), point("other", 1.0, 0.04), point("slow", 1.4, 0.04)]
    assert pareto.fastest(points, 0.05)["method"] == "simple"
    assert pareto.fastest(points[1:], 0.05)["method"] == "other"
    assert pareto.fastest(points[::-1], 0.05)["method"] == "other"


def test_equal_times_are_interpolated_as_powers_and_never_beyond():
    from benchmarks.measures import images

    def curve(method, first, last, factor):
        seconds = np.geomspace(first, last, 3)
        return [
            {"method": method, "seconds": float(t), "rmse": float(factor * t**-0.5)}
            for t in seconds
        ]

    rows = images.at_equal_times(curve("a", 1.0, 100.0, 1.0) + curve("b", 10.0, 1000.0, 2.0))
    assert len(rows) == 5
    for row in rows:
        t = row["seconds"]
        assert ("a" in row["rmse"]) == (t <= 100 * (1 + 1e-9))
        for name, factor in (("a", 1.0), ("b", 2.0)):
            if name in row["rmse"]:
                assert row["rmse"][name] == pytest.approx(factor * t**-0.5, rel=1e-9)


def test_bands_cover_the_mean_as_often_as_they_say():
    from benchmarks.measures import images

    rng = np.random.default_rng(0)
    bands = [images.band(list(5 + rng.standard_normal(4))) for _ in range(2000)]
    covered = np.mean([band["rmse_low"] <= 5 <= band["rmse_high"] for band in bands])
    assert abs(covered - 0.95) < 4 * (0.95 * 0.05 / 2000) ** 0.5


def test_bins_are_averaged_without_bias_and_with_the_error_they_have(variant):
    """For a density whose means over bins are known, the measured error and the measured noise are
    correct."""
    import drjit as dr
    import mitsuba as mi

    from benchmarks.measures import pndf
    from glintbsdf.check.reference import BinnedPNDF
    from glintbsdf.footprint.gaussian import Footprint

    class Ramp:
        """The density 1 + x + 2 y² over the unit square."""

        def eval(self, m, footprint, active=True):
            return 1 + m.x + 2 * dr.square(m.y)

    edges = np.linspace(0, 1, 9)
    x = (edges[1:] + edges[:-1]) / 2
    y = (edges[1:] ** 3 - edges[:-1] ** 3) / 3 * 8
    truth = 1 + x[None, :] + 2 * y[:, None]
    truth[0, 0] = 0  # found empty: a bin with few points
    reference = BinnedPNDF(truth, np.full((8, 8), 1e-3), ((0, 0), (1, 1)))
    footprint = Footprint.isotropic(mi.Point2f(0.5), 0.1)
    mean, deviation = pndf.in_bins(Ramp(), footprint, reference, 4 * 64 * 4**2)
    difference = (mean - truth)[truth > 0]
    assert np.abs(difference).max() < 5 * deviation.max() < 0.05
    # 63 bins, whose errors are estimated from 4 sets each: about 9 % and 5 % apart.
    assert np.sqrt((difference**2).mean()) == pytest.approx(
        np.sqrt((deviation[truth > 0] ** 2).mean()), rel=0.35
    )


def test_noise_is_the_error_of_an_exact_density(variant):
    from benchmarks.measures import pndf
    from glintbsdf.check.reference import BinnedPNDF

    rng = np.random.default_rng(3)
    truth = np.exp(-(np.linspace(-2, 2, 32) ** 2))[None, :] * np.ones((32, 1))
    found = []
    for _ in range(50):
        reference = BinnedPNDF(truth + rng.normal(0, 0.02, truth.shape), np.full((32, 32), 0.02),
                               ((0, 0), (1, 1)))  # fmt: skip
        density = truth + rng.normal(0, 0.01, truth.shape)
        found.append(list(pndf.errors(reference, density).values()))
    expected = pndf.noise(reference, np.full((32, 32), 0.01))
    # The mean over 50 runs and the one expected, over 16 draws, differ by their own noise: 1 %, and
    # 3 % for the maximum.
    assert np.mean(found, axis=0) == pytest.approx(list(expected.values()), rel=0.12)


# -------------------------------------------------------------------------------------------------
# The store
# -------------------------------------------------------------------------------------------------


def test_store_keeps_whole_units_only(tmp_path):
    from benchmarks.harness import Store

    store, calls = Store(tmp_path, {"machine": 1}), []

    def measure():
        calls.append(1)
        return {"x": 0.1}, {"a": np.arange(3, dtype=np.float32)}

    def interrupted():
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        store.get({"unit": "a"}, interrupted)
    assert not any(tmp_path.iterdir())
    for _ in range(2):
        values, arrays = store.get({"unit": "a"}, measure)
        assert values == {"x": 0.1} and arrays["a"].tolist() == [0, 1, 2]
    assert len(calls) == 1
    store.get({"unit": "a", "settings": 2}, measure)
    Store(tmp_path, {"machine": 2}).get({"unit": "a"}, measure)
    assert len(calls) == 3, "other settings and another machine are other units"


# -------------------------------------------------------------------------------------------------
# The whole
# -------------------------------------------------------------------------------------------------

#: The command, with a report that takes half a minute.
SCRIPT = """
from benchmarks.__main__ import fresh_caches, run

def shorten():
    import glintbsdf  # before Dr.Jit
    from benchmarks.commands import error_vs_time as command
    from benchmarks.measures import glitter, images, pndf
    command.QUICK = command.Settings(
        pndf.Settings(64, (2, 8), ((0.37, 0.61),), 16, 20_000, 2**17, 5.0, 2, 0.002),
        images.Settings(64, ("flakes",), (2.0,), 16, 32, (1, 4), 2),
        glitter.Settings(2000, 1),
    )
    names = ("manifold, exact", "filter, lean")
    command.METHODS = [method for method in command.METHODS if method.name in names]
    for method in command.METHODS:
        object.__setattr__(method, "image", method.name == "filter, lean")

if __name__ == "__main__":
    with fresh_caches():
        shorten()
        run()
"""


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """The folder of a report that was interrupted once, and continued."""
    base = tmp_path_factory.mktemp("report")
    script, output = base / "run.py", base / "report"
    script.write_text(SCRIPT, encoding="utf-8")
    command = [sys.executable, str(script), "error_vs_time", "--quick", "--maps", "flakes"]
    command += ["-o", str(output)]
    environment = os.environ | {"PYTHONPATH": str(ROOT)}

    with subprocess.Popen(command, stderr=subprocess.PIPE, text=True, env=environment) as process:
        deadline = time.monotonic() + 120
        while not list(output.glob("measured/[!.]*.npz")) and process.poll() is None:
            assert time.monotonic() < deadline
            time.sleep(0.05)
        process.send_signal(signal.SIGINT)
        error = process.communicate(timeout=60)[1]
    assert process.returncode == 1, error
    assert "goes on from here" in error
    assert not (output / "report.json").exists()
    measured = {path: path.stat().st_mtime_ns for path in output.glob("measured/*")}
    assert measured and all(path.suffix == ".npz" for path in measured)

    done = subprocess.run(command, capture_output=True, text=True, timeout=300, env=environment)
    assert done.returncode == 0, done.stderr
    assert "What no other method beats" in done.stdout
    assert all(path.stat().st_mtime_ns == then for path, then in measured.items())
    return output


@pytest.fixture
def report(folder):
    return json.loads((folder / "report.json").read_text(encoding="utf-8"))


def test_json_is_as_its_schema_says(report):
    jsonschema = pytest.importorskip("jsonschema")
    schema = json.loads(SCHEMA.read_text(encoding="utf-8"))
    jsonschema.Draft202012Validator.check_schema(schema)
    jsonschema.Draft202012Validator(schema).validate(report)


def test_report_is_complete(folder, report):
    assert [(unit["map"], unit["radius"]) for unit in report["pndf"]] == [
        ("flakes", 2),
        ("flakes", 8),
    ]
    for unit in report["pndf"]:
        assert [p["method"] for p in unit["points"]] == ["manifold, exact", "filter, lean"]
        exact, lean = unit["points"]
        assert exact["times_faster_than_exact"] == 1
        assert exact["l1"] < 3 * exact["noise_l1"]
    # One facet under the smaller footprint is a lobe, as LEAN has it; a few are none.
    assert report["pndf"][0]["points"][1]["l1"] < 0.1 < 0.3 < lean["l1"]
    (case,) = report["images"]
    assert {p["method"] for p in case["points"]} == {
        "brute force",
        "roughconductor",
        "filter, lean",
    }
    assert {p["samples_per_pixel"] for p in case["points"]} == {1, 4}
    mean = {p["max_anisotropy"]: (p["mean"], p["mean_error"]) for p in report["grid"]["points"]}
    for value, error in mean.values():
        assert abs(value - 1) < 5 * error
    assert (folder / "pndf.csv").read_text().count("\n") == 5
    assert (folder / "images.csv").read_text().count("\n") == 7
    assert (folder / "which_when.csv").read_text(encoding="utf-8").count("\n") == 3
    pictures = {path.suffix for path in (folder / "figures").iterdir()}
    assert pictures == {".png", ".svg"}


def test_page_needs_nothing_else(folder):
    page = (folder / "report.html").read_text(encoding="utf-8")
    sources = re.findall(r'(?:src|href)="([^"]*)"', page)
    assert sources and all(s.startswith(("data:", "#")) for s in sources)
    assert "url(http" not in page and "@import" not in page


#: What a reader does: choose another metric, and point at each mark in turn.
READER = """
<script>
for (const value of ["l2", "memory", "l1"]) {
  metric.value = value;
  metric.dispatchEvent(new Event("change"));
}
let shown = 0;
for (const mark of document.querySelectorAll('figure [id*="--"]')) {
  mark.dispatchEvent(new Event("mouseenter"));
  const images = [...document.querySelectorAll("#detail img")];
  if (!document.getElementById("detail").hidden && images.length === 2) shown += 1;
}
document.documentElement.dataset.shown = shown;
Promise.all([...document.images].map(image => image.decode())).then(
  () => { document.documentElement.dataset.images = document.images.length; });
const whole = document.documentElement.outerHTML;
if (window === top) for (const width of [1300, 400]) {  // a desk and a phone
  const frame = document.createElement("iframe");
  frame.style.width = `${width}px`;
  frame.style.border = 0;
  frame.onload = () => {
    const needed = frame.contentDocument.documentElement.scrollWidth;
    document.documentElement.dataset[`at${width}`] = needed <= width ? "fits" : needed;
    frame.remove();
  };
  frame.srcdoc = whole;
  document.body.append(frame);
}
</script>
"""


def test_page_works_in_a_browser(folder, tmp_path):
    chromium = shutil.which("chromium")
    if chromium is None:
        pytest.skip("Chromium is not installed")
    page = (folder / "report.html").read_text(encoding="utf-8")
    read = tmp_path / "read.html"
    read.write_text(page.replace("</body>", READER + "</body>"), encoding="utf-8")
    command = [
        chromium, "--headless", "--disable-gpu", "--host-resolver-rules=MAP * ~NOTFOUND",
        f"--user-data-dir={tmp_path / 'profile'}", "--virtual-time-budget=10000",
        "--enable-logging=stderr", "--dump-dom", read.as_uri(),
    ]  # fmt: skip
    if hasattr(os, "geteuid") and os.geteuid() == 0:
        command.insert(1, "--no-sandbox")  # which Chromium refuses to set up for root
    done = subprocess.run(command, capture_output=True, text=True, timeout=120)
    assert "CONSOLE" not in done.stderr, done.stderr
    document = re.search(r"<html[^>]*>", done.stdout)[0]
    marks = len(re.findall(r'<g id="[^"]*--[^"]*"', page))
    assert 'data-ready="true"' in document
    # Four P-NDF pictures of four points each, an image of six in two panels.
    assert marks == 4 * 4 + 2 * 6
    assert f'data-shown="{marks}"' in document
    assert re.search(r'data-images="\d+"', document), "every picture decodes"
    assert 'data-at1300="fits"' in document and 'data-at400="fits"' in document
    assert done.stdout.count("<svg") == 4 + 1 + 1
