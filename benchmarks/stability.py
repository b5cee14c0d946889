"""Numerical stability of every method on stiff and extreme cases: one table of broken bounds.

``python benchmarks/stability.py [--quick] -o DIR``

Every method meets every map of :data:`MAPS`, from flat to white noise up to the disk's rim and down
to a single texel, and its own stiff parameter over eight decades. A row of the table is one method
on one map; the columns, what is expected of them, and so the bounds:

* **NaN** and **negative**: lanes in which a value, density, weight, direction or albedo is not
  finite, or negative, for footprints from a point to 100 maps, ratios to 10⁴ in any rotation, UV
  coordinates to 10⁶, directions to exactly horizontal, partial derivatives of the position that are
  parallel, mirrored or zero, and light of 10⁶. Expected: none. Bound: 0.
* **∫D − 1**: the integral of the pdf and the share of invalid samples, less one; the farthest of
  several footprints. float32 rounds areas and sums by 1e-6. Bound: 1e-3 and the quadrature's error,
  see below. For ``glint_grid``, normalised on average only: the mean of D over its expectation.
* **float64**: the value in float32 against the same formulas in float64, mean relative difference
  over random footprints and normals. Expected: 1e-6 times the condition of a thin triangle or a
  needle of a footprint, 10 to 100. Bound: 1e-3, and four times what the last digit of the normal
  and of the place changes: features narrower than float32 half vectors are nobody's fault.
* **χ²**: the smallest p-value of Pearson's test of samples against the pdf. Expected: uniform in
  [0, 1], so the smallest of n is near 1/n. Bound: significance 0.01 for the whole table, by Šidák's
  correction for the number of its tests.
* **furnace**: the largest share of uniform light reflected, for footprints of half a texel, four
  texels and the map, from vertical to 89.9°, where the method promises not to exceed 1 (for
  ``glint_diffuse``, whose facets count with their own area, the largest (1 + 1/m_z)/2, or what
  Oren and Nayar's model reaches; for tables 1 + ``max_error``, as their masking is that of the
  map). Bound: that, as much as ∫D may be off, and the error of the estimate.
* **bright**: pictures of squares with ordinary, inverted and collapsed UV coordinates in light of
  2²⁰ and of 1, relative L1 difference. Scaling by a power of two changes no digit. Bound: 1e-5, the
  order of sums over samples.

Errors of estimates count as often as makes the significance of the whole table 0.01. Lobes that are
narrower than a hundred times the error of a half vector are asked for numbers that are finite and
not negative, and for no more: what is in parentheses is not judged.

The table is printed, and written to DIR as ``stability.json``, ``stability.csv`` and
``stability.html``. Every finished row is a file in ``DIR/measured``: interrupted, the same command
goes on from there, as long as no source file has changed. The exit status is 1 if a bound is
broken.
"""

from __future__ import annotations

import argparse
import csv
import hashlib
import json
import os
import sys
import time
from collections.abc import Callable, Iterator
from dataclasses import asdict, dataclass, field
from functools import cache
from html import escape
from pathlib import Path

os.environ["GLINTBSDF_CACHE"] = "off"  # what is measured is built by this code

import mitsuba as mi  # noqa: E402  (the environment comes first)
import numpy as np  # noqa: E402
import scipy.stats  # noqa: E402
from glintbsdf.cli.main import interruptible  # noqa: E402
from rich.console import Console  # noqa: E402
from rich.table import Table  # noqa: E402

import glintbsdf  # noqa: E402, F401  (registers the plugins)
from glintbsdf import NormalMap, maps  # noqa: E402
from glintbsdf.core.progress import progress  # noqa: E402
from glintbsdf.pndf.manifold.mesh import equilateral  # noqa: E402
from glintbsdf.scene.rendering import replacing  # noqa: E402

if mi.variant() is None:
    mi.set_variant("llvm_ad_rgb")

sys.path.append(str(Path(__file__).parent))
import _measures as measures  # noqa: E402
from report.store import Store, machine  # noqa: E402

# --------------------------------------------------------------------------------------------------
#  What is measured
# --------------------------------------------------------------------------------------------------

SIZE = 32  # texels: the fewest for which there are clusters


def step_edge() -> NormalMap:
    """Two planes: all triangles are degenerate, those across the edge as long as can be."""
    normals = np.zeros((SIZE, SIZE, 2))
    normals[:, : SIZE // 2], normals[:, SIZE // 2 :] = (-0.3, 0), (0.6, 0.1)
    return NormalMap(normals)


def rank_one() -> NormalMap:
    """Grooves: normals on a line, of one direction of the map alone; every Jacobian is singular."""
    wave = 0.6 * np.sin(2 * np.pi * np.arange(SIZE) / SIZE * 3)
    return NormalMap(np.broadcast_to(wave[None, :, None] * np.array([0.8, 0.6]), (SIZE, SIZE, 2)))


def white_noise(shape: tuple[int, int], wrap_mode: str = "repeat") -> NormalMap:
    """Normals evenly over the disk, each texel another, to slopes of 200."""
    rng = np.random.default_rng(1)
    radius, angle = np.sqrt(rng.random(shape)), rng.uniform(0, 2 * np.pi, shape)
    normals = 0.99999 * radius * np.stack([np.cos(angle), np.sin(angle)])
    return NormalMap(np.moveaxis(normals, 0, -1), wrap_mode)


MAPS: dict[str, Callable[[], NormalMap]] = {
    "isotropic": lambda: maps.isotropic(SIZE, seed=1),
    "flat": lambda: maps.flat(SIZE),
    "tilted": lambda: maps.tilted(SIZE, 0.5, 0.3),
    "rank-one": rank_one,
    "step edge": step_edge,
    "white noise": lambda: white_noise((SIZE, SIZE)),
    "single texel": lambda: maps.tilted(1, 0.3, 1.0),
    "3×5, mirror": lambda: NormalMap(maps.isotropic((3, 5), 0.4).normals, "mirror"),
    "1×17, clamp": lambda: white_noise((1, 17), "clamp"),
}

EVERYWHERE, VERTICAL = "everywhere", "vertical"


@dataclass(frozen=True)
class Method:
    """A plugin with parameters, and what it promises.

    ``furnace``: where no more light is reflected than arrives: everywhere, or seen from straight
    above. ``sweep``: the stiff parameter and its values. ``lanes``: queries for NaN, fewer where
    one costs much. ``double``: whether it can compute in float64. ``large``: whether its density is
    tested under a footprint of half the map as well.
    """

    plugin: str
    parameters: dict = field(default_factory=dict)
    furnace: str = EVERYWHERE
    sweep: tuple[str, tuple[float, ...]] = ("", ())
    maps: tuple[str, ...] = tuple(MAPS)
    lanes: int = 512
    double: bool = True
    large: bool = False


def decades(first: int, last: int) -> tuple[float, ...]:
    return tuple(10.0**k for k in range(first, last + 1))


NO_MAP = ("none",)
FLAKES = {"flake_density": 1e3, "flake_alpha": 0.2}
#: A map of twice the sample's side; samples must be larger than a patch.
SMALL_MIP = {"output_size": 2 * SIZE, "patch_size": SIZE // 2, "overlap": 4, "clusters": 8}
SQUARE_MAPS = tuple(MAPS)[:6]
METHODS: dict[str, Method] = {
    "manifold": Method("glint_manifold", sweep=("epsilon", decades(-10, -2))),
    "manifold, disk, beckmann": Method(
        "glint_manifold", {"kernel": "disk", "masking": "beckmann"}, VERTICAL
    ),
    "manifold, box, analytic": Method(
        "glint_manifold", {"kernel": "box", "masking": "analytic"}, lanes=64
    ),
    "manifold, no masking": Method("glint_manifold", {"masking": "none"}, VERTICAL),
    "manifold, threshold": Method(
        "glint_manifold", {"threshold": 1e-2}, sweep=("threshold", decades(-6, 2))
    ),
    "manifold, max_error": Method(
        "glint_manifold", {"max_error": 0.1}, sweep=("max_error", decades(-6, 2)), large=True
    ),
    # Its far side is LEAN's lobe, with the masking of the map.
    "manifold, hand_over": Method("glint_manifold", {"hand_over": 0.7}, VERTICAL),
    "elements": Method("glint_elements", {}, VERTICAL, ("sigma_r", decades(-8, 0))),
    "elements, flat": Method("glint_elements", {"elements": "flat", "step": 2.0}, VERTICAL),
    "elements, flakes": Method("glint_elements", FLAKES, VERTICAL, maps=NO_MAP),
    "mip": Method(
        "glint_mip", SMALL_MIP, VERTICAL, ("sigma_r", decades(-8, 0)), SQUARE_MAPS, large=True
    ),
    "diffuse": Method("glint_diffuse", {"reflectance": 1.0}, lanes=64),
    "diffuse, Oren–Nayar": Method(
        "glint_diffuse",
        {"reflectance": 1.0, "method": "oren_nayar"},
        double=False,  # Mitsuba has frames in float32 alone
    ),
    "grid": Method("glint_grid", maps=NO_MAP, sweep=("density", (-20, -10, -3, 0, 3, 6, 12, 20))),
    "grid, grooves": Method(
        "glint_grid", {"detail_alpha_u": 0.3, "detail_alpha_v": 1e-4}, maps=NO_MAP
    ),
    "grid, wheel": Method("glint_grid", {"colors": "wheel", "size_variation": 2.0}, maps=NO_MAP),
    "lean": Method("glint_filtered", {"method": "lean"}, VERTICAL, ("alpha", decades(-7, 1))),
    "leadr": Method("glint_filtered", {"method": "leadr"}),
    "clean": Method("glint_filtered", {"method": "clean"}, VERTICAL),
    "toksvig": Method("glint_filtered", {"method": "toksvig"}, VERTICAL),
    "toksvig, GGX": Method(
        "glint_filtered", {"method": "toksvig", "distribution": "ggx"}, VERTICAL
    ),
    "variance": Method("glint_filtered", {"method": "variance"}, VERTICAL),
    "variance, GGX": Method(
        "glint_filtered", {"method": "variance", "distribution": "ggx"}, VERTICAL
    ),
}

#: Widths of lobes of normals that parameters stand for (of a degenerate triangle the radius of the
#: circle in it), and the narrowest that can be judged: float32 half vectors are 6e-8 apart, and
#: recovered from two directions with an error of about 1e-7.
WIDTHS: dict[str, Callable[[float], float]] = {
    "alpha": lambda alpha: alpha,
    "sigma_r": lambda sigma_r: sigma_r,
    "epsilon": lambda epsilon: equilateral(epsilon)[0][1] / 2,
}
NARROWEST_LOBE = 1e-5
#: Maps on which parameters are swept, and on which pictures are made; the latter is what is left
#: of all maps in a hurry.
SWEPT, STIFFEST = ("step edge", *NO_MAP), ("white noise", *NO_MAP)


@dataclass(frozen=True)
class Row:
    """One method on one map, with one parameter changed or none."""

    method: str
    map: str
    parameter: str = ""
    value: float = 0.0
    quick: bool = False

    @property
    def name(self) -> str:
        return f"{self.method} | {self.map}" + (
            f" | {self.parameter} {self.value:g}" if self.parameter else ""
        )

    def description(self) -> dict:
        """For ``mi.load_dict``; footprints of a query without UV partials are cones."""
        method = METHODS[self.method]
        description = {
            "type": method.plugin,
            "footprint_sigma": 1.0,
            "pixel_spread": 1e-3,
            **method.parameters,
        }
        if self.map not in NO_MAP:
            normal_map = normal_map_of(self.map)
            description["data"] = mi.TensorXf(normal_map.normals)
            description["wrap_mode"] = normal_map.wrap_mode
        if self.parameter:
            description[self.parameter] = self.value
        return description


@cache
def normal_map_of(name: str) -> NormalMap:
    return MAPS[name]()


def plan(quick: bool) -> Iterator[Row]:
    """All rows of the table."""
    for name, method in METHODS.items():
        yield from (
            Row(name, map_name, quick=quick)
            for map_name in method.maps
            if not quick or map_name in STIFFEST
        )
        parameter, values = method.sweep
        yield from (
            Row(name, map_name, parameter, value, quick)
            for map_name in method.maps
            if map_name in SWEPT
            for value in (values[: is_first(name)] if quick else values)
        )


def is_first(name: str) -> bool:
    """Whether a method is the first of its plugin."""
    plugin = METHODS[name].plugin
    return name == next(other for other, method in METHODS.items() if method.plugin == plugin)


def measure(row: Row) -> dict:
    """Everything that is measured of a row, by name; ``errors`` holds messages of what failed."""
    method, description = METHODS[row.method], row.description()

    def load() -> mi.BSDF:
        return mi.load_dict(description)

    try:
        bsdf = load()
    except Exception as error:
        return {"errors": {"load": in_a_line(error)}}
    texels, spread = extent(row, bsdf)
    samples = 1 << (13 if row.quick else 14)
    views = measures.views(texels, row.quick, method.large)
    energy_views = promised(method, measures.energy_views(texels))
    measured = {
        "extremes": lambda: measures.extremes(bsdf, method.lanes),
        "densities": lambda: [
            {"view": name, **measures.density(bsdf, view, samples)} for name, view in views.items()
        ],
        "energies": lambda: measures.energy(
            bsdf, energy_views, (2 if row.quick else 8) * method.lanes, spread
        ),
        "energy_limit": lambda: energy_limit(row),
        "resolved": lambda: (
            row.parameter not in WIDTHS or WIDTHS[row.parameter](row.value) >= NARROWEST_LOBE
        ),
    }
    if method.plugin == "glint_grid":
        measured["mean"] = lambda: measures.mean_of_grid(bsdf, 1 << 16)
    if method.double:
        measured["double"] = lambda: measures.double_error(bsdf, load, 4 * method.lanes)
    if row.map in STIFFEST and not row.parameter and (is_first(row.method) or not row.quick):
        measured["bright"] = lambda: measures.bright_light(bsdf)

    result, errors = {}, {}
    for name, figure in measured.items():
        try:
            result[name] = figure()
        except Exception as error:
            errors[name] = in_a_line(error)
    return result | {"errors": errors}


def in_a_line(error: Exception) -> str:
    """What an error says: Mitsuba quotes all of Python's traceback, whose last line it is."""
    lines = [line.strip() for line in f"{type(error).__name__}: {error}".splitlines()]
    return next((line for line in reversed(lines) if "Error: " in line), lines[0])


def extent(row: Row, bsdf: mi.BSDF) -> tuple[float, float]:
    """Texels, flakes or finest cells per unit of UV, and how far apart places are to lie.

    Only on average over places does ``glint_grid`` keep the energy.
    """
    method = METHODS[row.method]
    if method.plugin == "glint_grid":
        cells = float(bsdf.pndf.scale[0])
        return cells, 1e4 / cells
    if row.map in NO_MAP:
        return method.parameters["flake_density"] ** 0.5, 0.0
    return max(normal_map_of(row.map).normals.shape[:2]), 0.0


def promised(method: Method, views: list[measures.View]) -> list[measures.View]:
    """The views from which the method keeps the energy."""
    if method.furnace == VERTICAL:
        return [view for view in views if view.wi[2] == 1]
    return views


#: The most that Oren and Nayar's model reflects of uniform light, along the horizon: A + B/2, of
#: all roughnesses.
OREN_NAYAR = 1.0152


def energy_limit(row: Row) -> float:
    """The largest share of uniform light that a method may reflect."""
    if row.method == "diffuse":
        normals = normal_map_of(row.map).normals.astype(np.float64)
        return float((0.5 + 0.5 / np.sqrt(1 - (normals**2).sum(-1))).max())
    if METHODS[row.method].parameters.get("method") == "oren_nayar":
        return OREN_NAYAR
    # Masking is that of the map, from which D may be ``max_error`` off.
    description = METHODS[row.method].parameters | {row.parameter: row.value}
    return 1 + description.get("max_error", 0.0)


# --------------------------------------------------------------------------------------------------
#  Bounds
# --------------------------------------------------------------------------------------------------

SIGNIFICANCE = 0.01
MASS_BOUND, DOUBLE_BOUND, BRIGHT_BOUND = 1e-3, 1e-3, 1e-5
LAST_DIGITS = 4  # of the input, that rounding may amount to
UNRESOLVED = 0.01  # an integral of a larger error says nothing


@dataclass(frozen=True)
class Cell:
    """One figure of the table; ``text`` is empty where the column does not apply."""

    text: str = ""
    broken: bool = False


@dataclass(frozen=True)
class Judge:
    """Bounds for a table of ``tests`` statistical tests of a kind."""

    tests: int

    @property
    def smallest_p(self) -> float:
        """Significance of a single test, by Šidák's correction."""
        return 1 - (1 - SIGNIFICANCE) ** (1 / self.tests)

    @property
    def sigmas(self) -> float:
        """Standard errors that an estimate may be off."""
        return float(scipy.stats.norm.isf(self.smallest_p / 2))

    def bounds(self) -> dict[str, str]:
        """The bound of each column, in words."""
        error = f"{self.sigmas:.1f} errors"
        return {
            "NaN": "0",
            "negative": "0",
            "∫D − 1": f"≤ {MASS_BOUND:g} + {error}; error ≤ {UNRESOLVED:g}",
            "float64": f"≤ {DOUBLE_BOUND:g} + {LAST_DIGITS} last digits",
            "χ²": f"p ≥ {self.smallest_p:.2g}",
            "furnace": f"≤ 1 + {MASS_BOUND:g} + {error}",
            "bright": f"≤ {BRIGHT_BOUND:g}",
        }

    def cells(self, result: dict) -> dict[str, Cell]:
        """The columns of a measured row; those that do not apply are empty."""
        verdicts = {
            "NaN": ("extremes", self.nan),
            "negative": ("extremes", self.negative),
            "∫D − 1": ("densities", self.mass),
            "float64": ("double", self.double),
            "χ²": ("densities", self.chi_squared),
            "furnace": ("energies", self.furnace),
            "bright": ("bright", self.bright),
        }
        cells = {}
        for name, (measured, verdict) in verdicts.items():
            cells[name] = Cell()
            if {measured, "load"} & set(result["errors"]):
                cells[name] = Cell("error", True)
            elif measured in result:
                cells[name] = verdict(result)
        if not result.get("resolved", True):
            for name in ("∫D − 1", "float64", "χ²"):
                cells[name] = Cell(f"({cells[name].text})")
        return cells

    def nan(self, result: dict) -> Cell:
        return Cell(str(result["extremes"]["nan"]), result["extremes"]["nan"] > 0)

    def negative(self, result: dict) -> Cell:
        return Cell(str(result["extremes"]["negative"]), result["extremes"]["negative"] > 0)

    def mass(self, result: dict) -> Cell:
        """The integral that is farthest beyond its error."""
        masses = [*result["densities"], *result.get("mean", [])]
        worst = max(masses, key=lambda d: self.beyond(abs(d["mass"]), d["mass_error"]))
        value, error = worst["mass"], worst["mass_error"]
        kept = self.beyond(abs(value), error) <= MASS_BOUND and error <= UNRESOLVED
        return Cell(f"{value:+.4f} ± {error:.4f}", not kept)

    def double(self, result: dict) -> Cell:
        error, last_digit = result["double"]["error"], result["double"]["last_digit"]
        return Cell(f"{error:.1e}", not error <= DOUBLE_BOUND + LAST_DIGITS * last_digit)

    def chi_squared(self, result: dict) -> Cell:
        smallest = min(density["p_value"] for density in result["densities"])
        return Cell(f"{smallest:.2g}", not smallest >= self.smallest_p)

    def furnace(self, result: dict) -> Cell:
        """The energy that is farthest beyond its error."""
        worst = max(result["energies"], key=lambda e: self.beyond(e["energy"], e["error"]))
        kept = self.beyond(worst["energy"], worst["error"]) <= result["energy_limit"] + MASS_BOUND
        limit = result["energy_limit"]
        text = f"{worst['energy']:.3f} ± {worst['error']:.3f}"
        return Cell(text + (f" of {limit:.3g}" if limit != 1 else ""), not kept)

    def bright(self, result: dict) -> Cell:
        bright = result["bright"]
        kept = bright["apart"] <= BRIGHT_BOUND and not bright["nan"] and not bright["negative"]
        return Cell(f"{bright['apart']:.1e}", not kept)

    def beyond(self, value: float, error: float) -> float:
        """What noise does not explain of a value; NaN stays the largest."""
        value = value - self.sigmas * error
        return value if np.isfinite(value) else np.inf


def test_count(rows: list[Row]) -> int:
    """Statistical tests in a table, of the kind there are most of."""
    return max(
        sum(len(measures.views(SIZE, row.quick, METHODS[row.method].large)) for row in rows),
        sum(len(promised(METHODS[row.method], measures.energy_views(SIZE))) for row in rows),
    )


# --------------------------------------------------------------------------------------------------
#  Reports
# --------------------------------------------------------------------------------------------------

Finished = list[tuple[Row, dict]]


def rich_table(finished: Finished, judge: Judge) -> Table:
    """The table for the terminal."""
    table = Table(title="Stability", caption=bounds_in_words(judge))
    for name in ("method", "map", "parameter", *judge.bounds()):
        table.add_column(name)
    for row, result in finished:
        cells = judge.cells(result).values()
        table.add_row(*labels(row), *(f"[red]{c.text} ✗[/]" if c.broken else c.text for c in cells))
    return table


def messages(finished: Finished) -> list[str]:
    """What went wrong, a line for each measure of a row."""
    return [
        f"{row.name}: {name}: {message}"
        for row, result in finished
        for name, message in result["errors"].items()
    ]


def labels(row: Row) -> tuple[str, str, str]:
    return row.method, row.map, f"{row.parameter} {row.value:g}" if row.parameter else ""


def bounds_in_words(judge: Judge) -> str:
    return "; ".join(f"{name} {bound}" for name, bound in judge.bounds().items())


def write_reports(folder: Path, finished: Finished, judge: Judge) -> None:
    """Write JSON, CSV and HTML; each file appears whole or not at all."""
    header = {
        "machine": machine(),
        "bounds": judge.bounds(),
        "significance": SIGNIFICANCE,
        "tests": judge.tests,
    }
    judged = [(row, result, judge.cells(result)) for row, result in finished]
    rows = [
        asdict(row)
        | {"result": result, "broken": [name for name, cell in cells.items() if cell.broken]}
        for row, result, cells in judged
    ]
    with replacing(folder / "stability.json") as path:
        path.write_text(json.dumps(header | {"rows": rows}, indent=1) + "\n")
    with replacing(folder / "stability.csv") as path, path.open("w", newline="") as stream:
        writer = csv.writer(stream)
        writer.writerow(["method", "map", "parameter", *judge.bounds(), "broken"])
        for row, _, cells in judged:
            broken = " ".join(name for name, cell in cells.items() if cell.broken)
            writer.writerow([*labels(row), *(cell.text for cell in cells.values()), broken])
    with replacing(folder / "stability.html") as path:
        path.write_text(html(judged, judge, header), encoding="utf-8")


STYLE = """
body { font: 15px/1.4 system-ui, sans-serif; margin: 2em; color: #222; background: #fff }
table { border-collapse: collapse } th, td { padding: .2em .7em; text-align: left }
th { border-bottom: 2px solid #222; position: sticky; top: 0; background: #fff }
tr:nth-child(even) { background: #f4f4f4 } td { font-variant-numeric: tabular-nums }
td.broken { background: #c62828; color: #fff } .bound { font-weight: normal; color: #666 }
pre { white-space: pre-wrap }
"""


def html(judged: list, judge: Judge, header: dict) -> str:
    """One page with the table, which needs nothing from elsewhere."""
    heads = "".join(
        f'<th>{escape(name)}<br><span class="bound">{escape(bound)}</span></th>'
        for name, bound in {"method": "", "map": "", "parameter": "", **judge.bounds()}.items()
    )
    lines = []
    for row, _, cells in judged:
        data = "".join(f"<td>{escape(text)}</td>" for text in labels(row))
        for cell in cells.values():
            data += (
                f'<td class="broken">{escape(cell.text)}</td>'
                if cell.broken
                else (f"<td>{escape(cell.text)}</td>")
            )
        lines.append(f"<tr>{data}</tr>")
    broken = sum(cell.broken for _, _, cells in judged for cell in cells.values())
    errors = messages([(row, result) for row, result, _ in judged])
    machine = ", ".join(f"{name} {value}" for name, value in header["machine"].items())
    return (
        '<!doctype html><html lang="en"><head><meta charset="utf-8">'
        f"<title>Stability of glintbsdf</title><style>{STYLE}</style></head><body>"
        f"<h1>Stability</h1><p>{len(judged)} rows, {broken} broken bounds. {escape(machine)}</p>"
        f"<table><thead><tr>{heads}</tr></thead><tbody>{''.join(lines)}</tbody></table>"
        f"<pre>{escape(chr(10).join(errors))}</pre><pre>{escape(__doc__)}</pre></body></html>\n"
    )


# --------------------------------------------------------------------------------------------------
#  The run
# --------------------------------------------------------------------------------------------------


def fingerprint() -> str:
    """A hash of all sources that a figure may depend on."""
    root, digest = Path(__file__).parents[1], hashlib.blake2b(digest_size=12)
    files = [*root.glob("src/**/*.py"), *root.glob("plugins/*.py")]
    for path in sorted({*files, Path(__file__), Path(measures.__file__)}):
        digest.update(path.read_bytes())
    return digest.hexdigest()


def finish(row: Row, store: Store) -> dict:
    """Measure a row, or take it from an earlier run. An error is a result, Ctrl-C is not."""

    def measured() -> tuple[dict, dict]:
        start = time.perf_counter()
        with interruptible():
            result = measure(row)
        return result | {"seconds": round(time.perf_counter() - start, 2)}, {}

    return store.get(asdict(row) | asdict(METHODS[row.method]), measured)[0]


def run(rows: list[Row], folder: Path, console: Console) -> int:
    """Measure the rows, report, and return the exit status."""
    context = {"source": fingerprint()} | {k: machine()[k] for k in ("mitsuba", "drjit", "variant")}
    store, judge, finished = Store(folder / "measured", context), Judge(test_count(rows)), []
    status = 0
    try:
        with progress("Stability") as report:
            for row in rows:
                finished.append((row, finish(row, store)))
                report(len(finished) / len(rows))
    except KeyboardInterrupt:
        console.print(
            f"Interrupted after {len(finished)} of {len(rows)} rows; run it again to go on."
        )
        status = 130
    write_reports(folder, finished, judge)
    console.print(rich_table(finished, judge), *messages(finished), sep="\n")
    broken = sum(any(c.broken for c in judge.cells(result).values()) for _, result in finished)
    console.print(
        f"{len(finished)} rows, {broken} with a broken bound: {folder / 'stability.html'}"
    )
    return status or int(broken > 0)


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--quick", action="store_true", help="the stiffest maps alone, two minutes")
    parser.add_argument("--only", metavar="TEXT", default="", help="rows whose name holds this")
    parser.add_argument("-o", "--output", type=Path, required=True, metavar="DIR")
    options = parser.parse_args()
    rows = [row for row in plan(options.quick) if options.only in row.name]
    console = Console()
    if not console.is_terminal:
        console = Console(width=170)  # a file has no width of its own
    return run(rows, options.output, console)


if __name__ == "__main__":
    sys.exit(main())
