"""Figures: a P-NDF beside its reference, a footprint on its map, error over time.

Every function returns a matplotlib figure. ``figure.savefig`` writes it, and a notebook shows it
after ``%matplotlib inline``.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
from matplotlib.axes import Axes
from matplotlib.colors import PowerNorm
from matplotlib.figure import Figure
from matplotlib.patches import Ellipse
from matplotlib.ticker import FuncFormatter, LogLocator, MaxNLocator, NullFormatter

from glintbsdf.check.comparison import Comparison
from glintbsdf.footprint.gaussian import Footprint
from glintbsdf.maps.normalmap import NormalMap, wrapped

#: Colours are spread by this power of the density. Without it, a few peaks leave all else black.
_GAMMA = 0.5

#: Largest distance, in pixels, from the centre of a drawing of a footprint to its border.
_MAX_REACH = 500


def pndf(comparison: Comparison) -> Figure:
    """Draw a P-NDF beside its reference on one scale, and the footprint on the map if there is one.

    The axes are the projected normal's x and y; the second scales are its inclination along them,
    in degrees.
    """
    has_map = comparison.normal_map is not None
    figure = Figure(figsize=(13 if has_map else 8.8, 4.4), layout="constrained")
    axes = figure.subplots(1, 3 if has_map else 2)
    reference = comparison.reference
    peak = max(comparison.density.max(), reference.density.max())
    (left, bottom), (right, top) = reference.bounds
    named = {
        comparison.title: comparison.density,
        "reference" if has_map else "samples": reference.density,
    }
    for axis, (title, density) in zip(axes, named.items(), strict=False):
        shown = axis.imshow(
            density,
            extent=(left, right, bottom, top),
            origin="lower",
            norm=PowerNorm(_GAMMA, 0, peak if peak > 0 else 1),
            cmap="inferno",
            aspect="equal" if 0.2 < (right - left) / (top - bottom) < 5 else "auto",
        )
        axis.set(title=title, xlabel="normal x", ylabel="normal y")
        degrees = (_inclination, _projection)
        across = axis.secondary_xaxis("top", functions=degrees, xlabel="degrees")
        across.set_xticks(_inclination_ticks(left, right))
        up = axis.secondary_yaxis("right", functions=degrees)
        up.set_yticks(_inclination_ticks(bottom, top))
    figure.colorbar(shown, ax=list(axes[:2]), label="density over the disk", shrink=0.8)
    if has_map:
        draw_footprint(axes[2], comparison.normal_map, comparison.footprint)
    return figure


def _inclination(projected: np.ndarray) -> np.ndarray:
    """The angle in degrees whose sine is a coordinate of the projected normal."""
    return np.degrees(np.arcsin(np.clip(projected, -1, 1)))


def _projection(degrees: np.ndarray) -> np.ndarray:
    """The inverse of :func:`_inclination`."""
    return np.sin(np.radians(np.clip(degrees, -90, 90)))


def _inclination_ticks(low: float, high: float) -> np.ndarray:
    """Round inclinations in degrees for an axis of projected normals: at most seven, within ±80.

    Beyond 80 degrees, labels have only the last 1.5 % of the disk's radius.
    """
    seen = np.clip(_inclination(np.array([low, high])), -80, 80)
    ticks = MaxNLocator(nbins=6, steps=[1, 2, 3, 5, 10]).tick_values(*seen)
    return ticks[(ticks >= seen[0]) & (ticks <= seen[1])]


def footprint(normal_map: NormalMap, seen: Footprint) -> Figure:
    """Draw a footprint on the texels around it; see :func:`draw_footprint`."""
    figure = Figure(figsize=(4.4, 4.4), layout="constrained")
    draw_footprint(figure.subplots(), normal_map, seen)
    return figure


def draw_footprint(axis: Axes, normal_map: NormalMap, seen: Footprint) -> None:
    """Draw a footprint on the texels around it, with ellipses at one and three standard deviations.

    Texels have the colours of a normal map: red for x, green for y. The axes count texels from the
    centre of texel 0.

    Args:
        axis: axes of matplotlib.
        normal_map: the map.
        seen: a single footprint in UV.
    """
    size = np.array([normal_map.width, normal_map.height])
    centre = np.array(seen.uv, np.float64).ravel() * size - 0.5
    axes = np.stack([np.array(v, np.float64).ravel() * size for v in (seen.du, seen.dv)], axis=1)
    directions, deviations, _ = np.linalg.svd(axes)
    reach = max(4 * deviations[0], 3.0)
    step = int(np.ceil(reach / _MAX_REACH))  # texels of a large footprint that are one pixel
    column, row = (
        np.arange(np.floor(c - reach), np.ceil(c + reach) + 1, step).astype(int) for c in centre
    )
    rows = wrapped(row, normal_map.height, normal_map.wrap_mode)
    columns = wrapped(column, normal_map.width, normal_map.wrap_mode)
    s = normal_map.normals[np.ix_(rows, columns)]
    z = np.sqrt(np.maximum(1 - (s**2).sum(axis=2, keepdims=True), 0))
    axis.imshow(
        0.5 + 0.5 * np.concatenate([s, z], axis=2),
        extent=(column[0] - step / 2, column[-1] + step / 2, row[-1] + step / 2, row[0] - step / 2),
    )
    angle = np.degrees(np.arctan2(directions[1, 0], directions[0, 0]))
    for factor, style in ((1, "-"), (3, ":")):
        across, along = 2 * factor * deviations[0], 2 * factor * deviations[1]
        axis.add_patch(
            Ellipse(centre, across, along, angle=angle, fill=False, color="black", linestyle=style)
        )
    axis.set(title="footprint on the map: 1 σ, 3 σ", xlabel="texels", ylabel="texels")


def errors(
    curves: Mapping[str, tuple[Sequence[float], Sequence[float]]],
    noise: float | None = None,
    cost: str = "seconds",
) -> Figure:
    """Draw errors over their cost, both logarithmic, a line for each name.

    Args:
        curves: for each name, costs and errors, positive.
        noise: the error of the reference, below which nothing can be measured; a dashed line.
        cost: what the costs are, with their unit.
    """
    figure = Figure(figsize=(5.6, 4.2), layout="constrained")
    axis = figure.subplots()
    for name, (costs, values) in curves.items():
        axis.plot(costs, values, "o-", markersize=4, linewidth=1, label=name)
    if noise is not None:
        axis.axhline(noise, linestyle="--", color="#777777", linewidth=0.9)
    axis.set(xscale="log", yscale="log", xlabel=cost, ylabel="error")
    label_logarithmic(axis.xaxis, axis.yaxis)
    axis.legend(frameon=False)
    return figure


def label_logarithmic(*axes) -> None:
    """Label logarithmic axes (``axis.xaxis``) at 1, 2, 5, or at decades if there are many."""
    for axis in axes:
        low, high = axis.get_view_interval()
        subdivided = high < 300 * low
        axis.set_major_locator(LogLocator(subs=(1, 2, 5) if subdivided else (1,)))
        axis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))
        axis.set_minor_formatter(NullFormatter())
