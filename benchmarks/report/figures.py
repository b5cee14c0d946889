"""Figures of error over time, memory and samples; they need matplotlib."""

from __future__ import annotations

import io
from pathlib import Path

import matplotlib
import numpy as np
from matplotlib.figure import Figure
from matplotlib.lines import Line2D

from benchmarks.report import pareto
from glintbsdf.check.plot import label_logarithmic

#: Okabe and Ito's colours, which the colour-blind can distinguish, and markers, one per family.
COLOURS = ("#0072B2", "#56B4E9", "#009E73", "#D55E00", "#CC79A7", "#E69F00", "#000000", "#999999")
MARKERS = ("o", "s", "^", "D", "v", "P", "X", "*")

#: Marks of errors above the noise of their measurement, and of errors within it.
ABOVE_NOISE = {"markeredgecolor": "white", "markeredgewidth": 0.5}
WITHIN_NOISE = {"markerfacecolor": "white", "markeredgewidth": 1.2}

METRICS = {"l1": "relative L1 error", "l2": "relative L2 error", "maximum": "maximum error"}

STYLE = {
    "svg.fonttype": "none", "svg.hashsalt": "glintbsdf", "font.size": 8, "legend.frameon": False,
    "axes.grid": True, "grid.color": "#e4e4e4", "axes.axisbelow": True, "axes.titlesize": 9,
}  # fmt: skip


class Palette:
    """A colour and a marker for every family."""

    def __init__(self, families: list[str]) -> None:
        families = list(dict.fromkeys(families))
        self.families = families
        self.colour = {f: COLOURS[i % len(COLOURS)] for i, f in enumerate(families)}
        self.marker = {f: MARKERS[i % len(MARKERS)] for i, f in enumerate(families)}


def save(figure: Figure, folder: Path, name: str) -> str:
    """Write PNG and SVG, and return the SVG as text for a page."""
    figure.savefig(folder / f"{name}.png", dpi=140)
    text = io.StringIO()
    figure.savefig(text, format="svg", metadata={"Date": None})
    svg = text.getvalue()
    (folder / f"{name}.svg").write_text(svg, encoding="utf-8")
    return svg[svg.index("<svg") :]


def draw(folder: Path, name: str, plot, *arguments) -> str:
    """A figure by one of the functions below, saved."""
    with matplotlib.rc_context(STYLE):
        return save(plot(name, *arguments), folder, name)


def panels(count: int, width: float = 3.1, height: float = 2.7, most: int = 5):
    """A figure and ``count`` axes, in rows of at most ``most``."""
    columns = min(count, most) if count % most == 0 or count < most else -(-count // 2)
    columns = min(columns, most)
    rows = -(-count // columns)
    figure = Figure(figsize=(width * columns, height * rows + 0.5), layout="constrained")
    axes = figure.subplots(rows, columns, squeeze=False).ravel()
    for axis in axes[count:]:
        axis.remove()
    return figure, axes[:count]


def legend_below(figure: Figure, handles: dict, panels: int) -> None:
    """A legend of as many columns as fit under ``panels`` panels."""
    figure.legend(
        handles.values(), handles.keys(), loc="outside lower center", ncols=min(8, 2 * panels)
    )


def column(points: list[dict], key: str) -> np.ndarray:
    """An entry of all points."""
    return np.array([point[key] for point in points])


def errors(name: str, units: list[dict], palette: Palette, metric: str, cost: str) -> Figure:
    """Error over ``cost`` for one map, with a panel for each footprint.

    Errors within the noise are hollow. Horizontal lines are the noise of the references. Points on
    the Pareto front are larger.
    """
    figure, axes = panels(len(units))
    scale, label = {
        "seconds_per_query": (1e6, "time per query (µs)"),
        "bytes": (1e-6, "memory (MB)"),
    }[cost]
    seen = {}
    for axis, unit in zip(axes, units, strict=True):
        points = [point for point in unit["points"] if point[cost] > 0]
        front = pareto.front(points, cost, metric)
        on_front = {point["method"] for point in front}
        lowest = np.minimum.accumulate(column(front, metric))
        step = {"drawstyle": "steps-post", "color": "#c8c8c8", "linewidth": 3, "zorder": 1}
        axis.plot(scale * column(front, cost), lowest, **step)
        for sigma, floor in unit["noise_floor"].items():
            style = "--" if float(sigma) == 0 else ":"
            axis.axhline(floor[metric], linestyle=style, color="#777777", linewidth=0.9, zorder=1)
        for family in palette.families:
            own = [p for p in points if p["family"] == family]
            if len(own) > 1 and all(p["rung"] is not None for p in own):
                own.sort(key=lambda p: p["rung"])
                colour, at = palette.colour[family], scale * column(own, cost)
                axis.plot(at, column(own, metric), color=colour, linewidth=0.8)
            for point in own:
                (mark,) = axis.plot(
                    [scale * point[cost]],
                    [point[metric]],
                    palette.marker[family],
                    color=palette.colour[family],
                    markersize=6 if point["method"] in on_front else 4.5,
                    **(ABOVE_NOISE if pareto.excess(point, metric) else WITHIN_NOISE),
                    zorder=3,
                    gid=f"{name}--{point['id']}",
                )
                seen.setdefault(family, mark)
        axis.set(xscale="log", yscale="log", title=f"r = {unit['radius']:g} texels")
        label_logarithmic(axis.xaxis, axis.yaxis)
        axis.set_xlabel(label)
    axes[0].set_ylabel(METRICS[metric])
    solid = {
        family: Line2D([], [], linestyle="", marker=palette.marker[family], color=mark.get_color())
        for family, mark in seen.items()
    }
    legend_below(figure, solid, len(axes))
    return figure


def cost(name: str, units_of_maps: dict[str, list[dict]], palette: Palette) -> Figure:
    """Time per query over the footprint's size, with a panel for each map."""
    figure, axes = panels(len(units_of_maps), most=3)
    lines = {}
    for axis, (title, units) in zip(axes, units_of_maps.items(), strict=True):
        methods = [point["method"] for point in units[0]["points"]]
        for method in methods:
            own = [next(p for p in unit["points"] if p["method"] == method) for unit in units]
            family = own[0]["family"]
            (line,) = axis.plot(
                column(units, "radius"),
                1e6 * column(own, "seconds_per_query"),
                marker=palette.marker[family],
                markersize=3,
                linewidth=0.9,
                color=palette.colour[family],
            )
            lines.setdefault(family, line)
        axis.set(xscale="log", yscale="log", title=title)
        label_logarithmic(axis.xaxis, axis.yaxis)
        axis.set_xlabel("radius r of the footprint (texels)")
    axes[0].set_ylabel("time per query (µs)")
    legend_below(figure, lines, min(len(axes), 3))
    return figure


def images(name: str, points: list[dict], noise: float, names: list[str]) -> Figure:
    """Error of images over time and over samples, with 95 % bands over the seeds."""
    figure, axes = panels(2, width=4.6, height=3.6)
    colours = matplotlib.colormaps["tab20"](np.linspace(0, 1, 20))
    for index, method in enumerate(names):
        own = [point for point in points if point["method"] == method]
        own.sort(key=lambda point: point["samples_per_pixel"])
        for axis, x in zip(axes, ("seconds", "samples_per_pixel"), strict=True):
            at, colour = column(own, x), colours[index % 20]
            band = column(own, "rmse_low"), column(own, "rmse_high")
            axis.fill_between(at, *band, color=colour, alpha=0.2, linewidth=0)
            axis.plot(at, column(own, "rmse"), color=colour, linewidth=1, label=method)
            for point in own:
                look = {"color": colour, "markersize": 4, "gid": f"{name}-{x}--{point['id']}"}
                axis.plot([point[x]], [point["rmse"]], MARKERS[index % len(MARKERS)], **look)
    for axis, label in zip(axes, ("seconds of rendering", "samples per pixel"), strict=True):
        axis.axhline(noise, linestyle="--", color="#777777", linewidth=0.9)
        axis.set(xscale="log", yscale="log", xlabel=label)
        label_logarithmic(axis.xaxis, axis.yaxis)
    axes[0].set_ylabel("relative RMSE")
    figure.legend(*axes[0].get_legend_handles_labels(), loc="outside right upper")
    return figure


def convergence(name: str, rows: list[dict]) -> Figure:
    """Error over time by light. Dotted is sampling alone, dashed the noise of the truth."""
    cases = list(dict.fromkeys((row["light"], row["texels"]) for row in rows))
    figure, axes = panels(len(cases), most=3)
    for axis, (light, texels) in zip(axes, cases, strict=True):
        own = [row for row in rows if (row["light"], row["texels"]) == (light, texels)]
        for index, method in enumerate(dict.fromkeys(row["method"] for row in own)):
            look = {"color": COLOURS[index % len(COLOURS)], "linewidth": 1}
            points = [row for row in own if row["method"] == method]
            glints = [row for row in points if row["by"] == "glint_path"]
            at, error = column(glints, "seconds"), column(glints, "error")
            axis.plot(at, error, MARKERS[index % len(MARKERS)] + "-", label=method, **look)
            alone = next(row for row in points if row["by"] == "sampling alone")
            chance = alone["error"] * np.sqrt(alone["seconds"] / at)
            axis.plot(at, chance, ":", **look)
            axis.axhline(alone["noise_of_truth"], linestyle="--", alpha=0.6, **look)
        axis.set(xscale="log", yscale="log", title=f"{light}, {texels:g} texels a pixel")
        label_logarithmic(axis.xaxis, axis.yaxis)
        axis.set_xlabel("seconds of rendering")
    axes[0].set_ylabel("error over contrast")
    figure.legend(*axes[0].get_legend_handles_labels(), loc="outside lower center", ncols=3)
    return figure
