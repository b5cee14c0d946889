"""One method on one stiff map: what it loads, all of its figures, and the bounds of its energy."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import mitsuba as mi
import numpy as np

from glintbsdf.check import densities, robustness
from glintbsdf.check.stiff import (
    NARROWEST_LOBE,
    NO_MAP,
    STIFF,
    VERTICAL,
    WIDTHS,
    Stiff,
    stiff_map,
)
from glintbsdf.check.suite import View
from glintbsdf.core.errors import one_line
from glintbsdf.core.interruption import interruptible
from glintbsdf.pndf import Grid

if TYPE_CHECKING:
    from glintbsdf.bridge.bsdf import GlintBSDF

#: Maps under a bright light.
STIFFEST = ("white noise", *NO_MAP)


@dataclass(frozen=True)
class Row:
    """One method on one map, with at most one parameter changed."""

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
        """The dictionary for ``mi.load_dict``; without UV partials, footprints are cones."""
        method = STIFF[self.method]
        description = {
            "type": method.plugin,
            "footprint_sigma": 1.0,
            "pixel_spread": 1e-3,
            **method.parameters,
        }
        if self.map not in NO_MAP:
            normal_map = stiff_map(self.map)
            description["data"] = mi.TensorXf(normal_map.normals)
            description["wrap_mode"] = normal_map.wrap_mode
        if self.parameter:
            description[self.parameter] = self.value
        return description


def is_first(name: str) -> bool:
    """Whether a method is the first of its plugin."""
    plugin = STIFF[name].plugin
    return name == next(other for other, method in STIFF.items() if method.plugin == plugin)


def measure(row: Row) -> dict:
    """All figures of a row, by name; ``errors`` has the messages of failed ones."""
    method, description = STIFF[row.method], row.description()

    def load() -> GlintBSDF:
        return mi.load_dict(description)

    try:
        bsdf = load()
    except Exception as error:
        return {"errors": {"load": in_a_line(error)}}
    texels, spread = extent(row, bsdf)
    samples = 1 << (13 if row.quick else 14)
    views = robustness.views(texels, row.quick, method.large)
    energy_views = promised(method, robustness.energy_views(texels))
    measured = {
        "extremes": lambda: robustness.extremes(bsdf, method.lanes),
        "densities": lambda: [
            {"view": name, **densities.density(bsdf, view, samples)} for name, view in views.items()
        ],
        "energies": lambda: robustness.energy(
            bsdf, energy_views, (2 if row.quick else 8) * method.lanes, spread
        ),
        "energy_limit": lambda: energy_limit(row),
        "resolved": lambda: (
            row.parameter not in WIDTHS or WIDTHS[row.parameter](row.value) >= NARROWEST_LOBE
        ),
    }
    if isinstance(bsdf.pndf, Grid):
        measured["mean"] = lambda: robustness.mean_of_grid(bsdf, 1 << 16)
    if method.double:
        measured["double"] = lambda: robustness.double_error(bsdf, load, 4 * method.lanes)
    if row.map in STIFFEST and not row.parameter and (is_first(row.method) or not row.quick):
        measured["bright"] = lambda: robustness.bright_light(bsdf)

    result, errors = {}, {}
    for name, figure in measured.items():
        try:
            with interruptible():
                result[name] = figure()
        except Exception as error:
            errors[name] = in_a_line(error)
    return result | {"errors": errors}


def in_a_line(error: Exception) -> str:
    """What an error is, and what it says."""
    return f"{type(error).__name__}: {one_line(str(error))}"


def extent(row: Row, bsdf: GlintBSDF) -> tuple[float, float]:
    """Texels, flakes or finest cells per unit of UV, and the distance over which to spread places.

    ``glint_grid`` keeps the energy only on average over places.
    """
    method = STIFF[row.method]
    if isinstance(bsdf.pndf, Grid):
        cells = float(bsdf.pndf.scale[0])
        return cells, 1e4 / cells
    if row.map in NO_MAP:
        return method.parameters.get("flake_density", 1e3) ** 0.5, 0.0
    return max(stiff_map(row.map).normals.shape[:2]), 0.0


def promised(method: Stiff, views: list[View]) -> list[View]:
    """The views from which the method must keep the energy."""
    if method.furnace == VERTICAL:
        return [view for view in views if view.wi[2] == 1]
    return views


#: Largest share of uniform light that Oren and Nayar's model reflects, along the horizon: the
#: maximum of A + B/2 over roughness.
OREN_NAYAR = 1.0152


def energy_limit(row: Row) -> float:
    """The largest share of uniform light that a method may reflect."""
    if row.method == "diffuse":
        normals = stiff_map(row.map).normals.astype(np.float64)
        return float((0.5 + 0.5 / np.sqrt(1 - (normals**2).sum(-1))).max())
    if STIFF[row.method].parameters.get("method") == "oren_nayar":
        return OREN_NAYAR
    # Masking is that of the map, from which D may be ``max_error`` off.
    description = STIFF[row.method].parameters | {row.parameter: row.value}
    return 1 + description.get("max_error", 0.0)
