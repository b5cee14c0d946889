"""Errors of ``glint_grid``, which has no map: it is compared with its mean, and with itself.

Its details are random by definition, so there is no correct image of them. But its
``max_anisotropy`` costs contrast: a footprint that is more stretched is widened, and more details
average out. The error is the loss of contrast (standard deviation over places, over the mean)
relative to the largest ratio. The mean must be equal to the smooth surface.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial

import drjit as dr
import mitsuba as mi
import numpy as np

from benchmarks.harness import seconds_in_turn
from benchmarks.measures.pndf import batch
from glintbsdf.footprint.gaussian import Footprint
from glintbsdf.pndf.grid.microdetails import Grid, beckmann, slope_jacobian

#: The footprint is this many times as long as it is wide.
STRETCH = 64.0

LADDER = (1.0, 4.0, 16.0, 64.0)

#: The density is log10 of details per unit UV area; σ is the footprint's across, in UV.
DENSITY, SIGMA = 5.0, 2e-3

#: Places are drawn from a square of this side, in UV, so that few of their footprints overlap.
EXTENT = 1e3

ALPHA = 0.3


@dataclass(frozen=True)
class Settings:
    """Mean and contrast are over ``places`` independent places."""

    places: int
    repetitions: int


def measure(settings: Settings):
    """Return mean, contrast and time for every ``max_anisotropy``, as a unit of the store."""
    u, v, turn = np.random.default_rng(1).random((3, settings.places))
    axis = np.stack([np.cos(2 * np.pi * turn), np.sin(2 * np.pi * turn)])
    across = np.stack([-axis[1], axis[0]])
    footprint = Footprint(
        mi.Point2f(np.float32(EXTENT * np.stack([u, v]))),
        mi.Vector2f(np.float32(SIGMA * STRETCH * axis)),
        mi.Vector2f(np.float32(SIGMA * across)),
    )
    m = mi.Vector2f(dr.opaque(mi.Float, 0.1), dr.opaque(mi.Float, -0.05))
    cos_theta = dr.sqrt(1 - dr.squared_norm(m))
    smooth = beckmann(m / cos_theta, mi.Vector2f(ALPHA)) * slope_jacobian(cos_theta)
    dr.eval(footprint.uv, footprint.du, footprint.dv, m, smooth)
    rungs = {
        ratio: Grid(alpha=(ALPHA, ALPHA), density=DENSITY, max_anisotropy=ratio) for ratio in LADDER
    }
    # The first round compiles, and gives the values.
    values = {
        ratio: (pndf.eval(m, footprint) / smooth).numpy().astype(np.float64)
        for ratio, pndf in rungs.items()
    }
    works = [partial(batch, pndf, m, footprint) for pndf in rungs.values()]
    taken = np.median(seconds_in_turn(works, settings.repetitions), axis=0) / settings.places
    full = contrast(values[LADDER[-1]])
    points = [
        {
            "max_anisotropy": ratio,
            "mean": float(value.mean()),
            "mean_error": float(value.std() / settings.places**0.5),
            "contrast": contrast(value),
            "contrast_error": contrast_error(value),
            "loss_of_contrast": 1 - contrast(value) / full,
            "seconds_per_query": float(per_query),
        }
        for (ratio, value), per_query in zip(values.items(), taken, strict=True)
    ]
    return {"stretch": STRETCH, "points": points}, {}


def contrast(values: np.ndarray) -> float:
    """Return the standard deviation over the mean."""
    return float(values.std() / values.mean())


def contrast_error(values: np.ndarray, parts: int = 32) -> float:
    """Return the standard error of the contrast, from the spread over parts of the places."""
    found = [contrast(part) for part in np.array_split(values, parts)]
    return float(np.std(found, ddof=1) / parts**0.5)
