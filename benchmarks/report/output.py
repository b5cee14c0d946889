"""The files of the report: JSON, CSV, figures, the page, and the table of fastest methods."""

from __future__ import annotations

import csv
import json
from pathlib import Path

from rich.console import Console
from rich.table import Table

from benchmarks.measures import images
from benchmarks.report import figures, page, pareto
from glintbsdf.scene.rendering import replacing

#: The JSON has this version; ``schema.json`` describes it.
SCHEMA_VERSION = 1


def write(folder: Path, machine: dict, described: dict, found: dict, console: Console) -> dict:
    """Write everything to ``folder``, print the table, and return the values of the JSON."""
    report = assemble(machine, described, found)
    pictures = folder / "figures"
    pictures.mkdir(exist_ok=True)
    write_text(folder / "report.json", json.dumps(report, indent=1, ensure_ascii=False) + "\n")
    write_csv(folder / "pndf.csv", [
        {"map": unit["map"], "radius": unit["radius"], **point}
        for unit in report["pndf"] for point in unit["points"]
    ])  # fmt: skip
    write_csv(folder / "images.csv", [
        {"map": case["map"], "scale": case["scale"], **point}
        for case in report["images"] for point in case["points"]
    ])  # fmt: skip
    write_csv(folder / "which_when.csv", fastest(report["which_when"]))
    drawn = draw(pictures, report)
    write_text(folder / "report.html", page.html(report, drawn, thumbnails(report, found), picture))
    Console().print(fronts(report["which_when"]))
    console.print(f"{folder / 'report.html'} shows everything.")
    return report


def assemble(machine: dict, described: dict, found: dict) -> dict:
    """The report as plain values; figures and page refer to a point by its ``id``."""
    rungs = {method["name"]: method["rung"] for method in described["methods"]}
    units = []
    for index, (unit, _) in enumerate(found["pndf"]):
        points = [
            {"id": f"p{index}-{i}", "rung": rungs[point["method"]], **point}
            for i, point in enumerate(unit["points"])
        ]
        units.append({**unit, "points": points})
    cases = []
    for index, (truth, _) in enumerate(found["truths"]):
        where = {"map": truth["map"], "scale": truth["scale"]}
        points = [
            point
            for unit, _ in found["images"]
            if {key: unit[key] for key in where} == where
            for point in unit["points"]
        ]
        points = [{"id": f"i{index}-{i}", **point} for i, point in enumerate(points)]
        cases.append({
            **where,
            "truth": {key: truth[key] for key in ("samples_per_pixel", "noise")},
            "points": points,
            "at_equal_times": images.at_equal_times(points),
        })  # fmt: skip
    return {
        "schema_version": SCHEMA_VERSION,
        "machine": machine,
        **described,
        "structures": [values for values, _ in found["structures"]],
        "pndf": units,
        "images": cases,
        "grid": found["grid"][0][0],
        "which_when": pareto.which_when(units),
    }


def of_maps(units: list[dict]) -> dict[str, list[dict]]:
    """Units by the name of their map."""
    maps: dict[str, list[dict]] = {}
    for unit in units:
        maps.setdefault(unit["map"], []).append(unit)
    return maps


def picture(*parts: str) -> str:
    """Name of a figure, without spaces."""
    return "_".join(parts).replace(" ", "-")


def draw(folder: Path, report: dict) -> dict[str, str]:
    """All figures, as SVG, by name."""
    palette = figures.Palette([method["family"] for method in report["methods"]])
    drawn = {}
    for name, units in of_maps(report["pndf"]).items():
        for metric in figures.METRICS:
            title = picture("pndf", name, metric)
            drawn[title] = figures.draw(
                folder, title, figures.errors, units, palette, metric, "seconds_per_query"
            )
        title = picture("pndf", name, "memory")
        drawn[title] = figures.draw(folder, title, figures.errors, units, palette, "l1", "bytes")
    drawn["pndf_cost"] = figures.draw(
        folder, "pndf_cost", figures.cost, of_maps(report["pndf"]), palette
    )
    for case in report["images"]:
        title = picture("images", case["map"], f"{case['scale']:g}")
        names = list(dict.fromkeys(point["method"] for point in case["points"]))
        drawn[title] = figures.draw(
            folder, title, figures.images, case["points"], case["truth"]["noise"], names
        )
    return drawn


def thumbnails(report: dict, found: dict) -> dict[str, str]:
    """Images of points as data URIs, by the points' ids; references by the unit's number."""
    uris = {}
    for index, (unit, (_, arrays)) in enumerate(zip(report["pndf"], found["pndf"], strict=True)):
        references = {key: a for key, a in arrays.items() if key.startswith("reference ")}
        peak = max(a.max() for a in references.values())
        for key, array in references.items():
            uris[f"p{index}-{key}"] = page.density_uri(array, peak)
        for point in unit["points"]:
            uris[point["id"]] = page.density_uri(arrays[point["method"]], peak)
    for index, (case, (_, truth)) in enumerate(zip(report["images"], found["truths"], strict=True)):
        white = page.white_of(truth["image"])
        uris[f"i{index}-truth"] = page.image_uri(truth["image"], white)
        where = (case["map"], case["scale"])
        pictures = {
            unit["samples_per_pixel"]: arrays
            for unit, arrays in found["images"]
            if (unit["map"], unit["scale"]) == where
        }
        for point in case["points"]:
            image = pictures[point["samples_per_pixel"]][point["method"]]
            uris[point["id"]] = page.image_uri(image, white)
    return uris


def write_text(path: Path, text: str) -> None:
    with replacing(path) as temporary:
        temporary.write_text(text, encoding="utf-8")


def write_csv(path: Path, rows: list[dict]) -> None:
    with replacing(path) as temporary, temporary.open("w", newline="", encoding="utf-8") as file:
        writer = csv.DictWriter(file, list(rows[0]))
        writer.writeheader()
        writer.writerows(rows)


def fronts(rows: list[dict]) -> Table:
    """The front of error against time per map and footprint."""
    found = Table(title="What no other method beats in both time per query and relative L1 error")
    for name in ("map", "r (texels)", "µs", "error", "method"):
        found.add_column(name, justify="left" if name in ("map", "method") else "right")
    for row in rows:
        for position, point in enumerate(row["front"]):
            where = ("", "") if position else (row["map"], f"{row['radius']:g}")
            told = point["l1"] > pareto.DETECTABLE * point["noise_l1"]
            found.add_row(
                *where,
                f"{1e6 * point['seconds_per_query']:.2g}",
                f"{point['l1']:.1%}" if told else "noise",
                point["method"],
            )
        found.add_section()
    return found


def fastest(rows: list[dict]) -> list[dict]:
    """Rows for a table of the fastest method per map, footprint and tolerated error."""
    return [
        {"map": row["map"], "r (texels)": f"{row['radius']:g}"}
        | {f"≤ {cell['tolerance']:.0%}": cell["method"] or "–" for cell in row["fastest"]}
        for row in rows
    ]
