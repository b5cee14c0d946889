"""Numerical stability of every method in stiff and extreme cases: a table of bounds.

Every method is tested on every stiff map, from flat maps to white noise over the whole disk, and
down to a single texel; and with its stiff parameter over eight decades. A row of the table is one
method on one map; docs/reports/stability.rst explains the columns and their bounds.

The significance of all statistical tests of the table together is 0.01. Lobes that are narrower
than a hundred times the error of a half vector must only be finite and not negative; their other
figures are in parentheses and not judged.

The table is printed, and written to the folder as ``stability.json``, ``stability.csv`` and
``stability.html``. The exit status is 1 if a bound is broken.
"""

from __future__ import annotations

import csv
import json
import time
from collections.abc import Iterator
from dataclasses import asdict
from pathlib import Path

import click
import mitsuba as mi
from rich.console import Console
from rich.table import Table

from benchmarks.harness import VARIANT, Store, machine, new_console, open_store, output_option
from benchmarks.report import page
from glintbsdf.check import fuzz, robustness
from glintbsdf.check.bounds import SIGNIFICANCE, Judge
from glintbsdf.check.stability import STIFFEST, Row, is_first, measure, promised
from glintbsdf.check.stiff import NO_MAP, STIFF, STIFF_SIZE
from glintbsdf.core.progress import progress
from glintbsdf.scene.rendering import replacing

#: Maps for sweeps of parameters.
SWEPT = ("step edge", *NO_MAP)


def plan(quick: bool) -> Iterator[Row]:
    """All rows of the table."""
    for name, method in STIFF.items():
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


def test_count(rows: list[Row]) -> int:
    """The number of statistical tests in a table, of the most frequent kind."""
    return max(
        sum(len(robustness.views(STIFF_SIZE, row.quick, STIFF[row.method].large)) for row in rows),
        sum(len(promised(STIFF[row.method], robustness.energy_views(STIFF_SIZE))) for row in rows),
    )


# --------------------------------------------------------------------------------------------------
#  Reports
# --------------------------------------------------------------------------------------------------

Finished = list[tuple[Row, dict]]


def rich_table(finished: Finished, judge: Judge) -> Table:
    """The table for the terminal."""
    words = "; ".join(f"{name} {bound}" for name, bound in judge.bounds().items())
    table = Table(title="Stability", caption=words)
    for name in ("method", "map", "parameter", *judge.bounds()):
        table.add_column(name)
    for row, result in finished:
        cells = judge.cells(result).values()
        table.add_row(*labels(row), *(f"[red]{c.text} ✗[/]" if c.broken else c.text for c in cells))
    return table


def messages(finished: Finished) -> list[str]:
    """The errors, one line each."""
    return [
        f"{row.name}: {name}: {message}"
        for row, result in finished
        for name, message in result["errors"].items()
    ]


def labels(row: Row) -> tuple[str, str, str]:
    return row.method, row.map, f"{row.parameter} {row.value:g}" if row.parameter else ""


def write_reports(folder: Path, finished: Finished, judge: Judge) -> None:
    """Write JSON, CSV and HTML; each file is complete or does not exist."""
    header = {
        "machine": machine(__file__),
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
        text = page.fill(
            "stability.html.jinja", rows=judged, labels=labels, bounds=judge.bounds(),
            machine=header["machine"], errors=messages(finished), about=__doc__,
        )  # fmt: skip
        path.write_text(text, encoding="utf-8")


# --------------------------------------------------------------------------------------------------
#  The run
# --------------------------------------------------------------------------------------------------


def finish(row: Row, store: Store) -> dict:
    """Measure a row, or take it from the store. An error is a result, Ctrl-C is not."""

    def measured() -> tuple[dict, dict]:
        start = time.perf_counter()
        result = measure(row)
        return result | {"seconds": round(time.perf_counter() - start, 2)}, {}

    return store.get(asdict(row) | asdict(STIFF[row.method]), measured)[0]


def run(rows: list[Row], folder: Path, console: Console) -> int:
    """Measure the rows, report, and return the exit status."""
    store, judge, finished = open_store(folder, __file__), Judge(test_count(rows)), []
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


def fuzzed(count: int, seed: int, store: Store) -> fuzz.Report:
    """Values of every kind for every parameter, a thousand to a seed; none is tried twice."""
    total = fuzz.Report()
    with progress("Values of parameters") as report:
        while total.cases < count:
            key = {"cases": min(1000, count - total.cases), "seed": seed + total.cases // 1000}
            found = store.get(key, lambda: (vars(fuzz.fuzz(key["cases"], key["seed"])), {}))[0]  # noqa: B023
            total.include(fuzz.Report(**found))
            report(total.cases / count)
    return total


@click.command(help=__doc__, short_help=__doc__.splitlines()[0])
@click.option("--fuzz", "cases", type=int, help="In place of rows, so many values of parameters.")
@click.option("--seed", default=1, help="Of the first thousand of these values.")
@click.option("--quick", is_flag=True, help="Only the stiffest maps, in two minutes.")
@click.option("--only", metavar="TEXT", default="", help="Only rows whose name has this.")
def stability(
    cases: int | None, seed: int, quick: bool, only: str, output: Path, variant: str
) -> int:
    mi.set_variant(variant)
    if cases:
        print(found := fuzzed(cases, seed, open_store(output, __file__)))
        return int(bool(found.faults))
    rows = [row for row in plan(quick) if only in row.name]
    return run(rows, output, new_console())


stability.params += [output_option(required=True), VARIANT]
