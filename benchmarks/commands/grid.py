"""glint_grid under motion."""

from __future__ import annotations

from functools import cache, partial
from math import cos, radians, sin

import drjit as dr
import mitsuba as mi
import numpy as np

from benchmarks.harness import Run, family
from glintbsdf import Footprint
from glintbsdf.pndf import Grid, Particles
from glintbsdf.pndf.grid.microdetails import CoveredCells

FRAMES, SIZE = 32, 256
ANGLE = radians(20)  # of the long axis of a pixel


class BlendedCells(CoveredCells):
    """Both grids without coherence: each level is shifted by a different distance."""

    def sum(self, term, zero, active):
        def moved(x, y, level, *rest):
            return term(x + level * 1_000_003, y - level * 999_983, level, *rest)

        return super().sum(moved, zero, active)


class SingleCell(CoveredCells):
    """One cell: at the pixel's centre, in the grid whose cells are nearest to the pixel's size."""

    def sum(self, term, zero, active):
        level = dr.select(self.blend < 0.5, self.level, self.level + 1)
        centre = self.centre * dr.exp2(-mi.Float(level))
        cell = self.swapped(mi.Vector2i(dr.round(centre)))
        return zero + term(cell.x, cell.y, level, active, mi.Float(0))


PARTICLES = "particles"
CELLS = {"coherent": CoveredCells, "blended": BlendedCells, "single": SingleCell}


def frame(grid: Grid | Particles, ratio: float, shift: float, zoom: float) -> np.ndarray:
    """One image; ``shift`` is in pixels, ``zoom`` is the size of a pixel relative to the first."""
    pitch = 2.7e-4  # UV; at density 8 a microdetail is 1e-4 wide
    row, column = np.divmod(np.arange(SIZE * SIZE), SIZE)
    c, s = cos(ANGLE), sin(ANGLE)
    x = pitch * ratio * (column - SIZE / 2 + shift)
    y = pitch * (row - SIZE / 2 + 0.6 * shift)
    uv = np.float32([0.4137 + c * x - s * y, 0.7321 + s * x + c * y])
    half = 0.5 * dr.opaque(mi.Float, pitch * zoom)
    footprint = Footprint(
        mi.Point2f(*(mi.Float(v) for v in uv)),
        mi.Vector2f(c, s) * (half * ratio),
        mi.Vector2f(-s, c) * half,
    )
    return np.array(grid.eval(mi.Vector2f(0.1, 0.05), footprint), np.float64).reshape(SIZE, SIZE)


def moved(run: Run, ratio: float, motion: str, cells: str) -> dict:
    """Differences of pixels between successive frames of a motion."""
    count = 8 if run.quick else FRAMES
    path = {
        "pan": [(k / 8, 1.0) for k in range(count)],
        "recede": [(0.0, 2.2 ** (k / (count - 1))) for k in range(count)],
    }[motion]

    @cache
    def grid(seed: int) -> Grid | Particles:
        if cells == PARTICLES:
            return Particles(distribution="beckmann", micro_alpha=0.05, seed=seed)
        made = Grid(seed=seed)
        made.covered_cells = CELLS[cells]
        return made

    frames = [frame(grid(0), ratio, *step) for step in path]
    other = frame(grid(1), ratio, *path[0])
    strip = np.hstack([f[:96, :96] for f in frames[::8]])
    shown = np.clip(strip / np.quantile(strip, 0.99), 0, 1) ** 2.2
    run.save_pictures(f"motion_{ratio}_{motion}_{cells}", [[shown]])
    steps = [float(np.abs(a - b).mean()) for a, b in zip(frames, frames[1:], strict=False)]
    independent = float(np.abs(frames[0] - other).mean())
    return {
        "difference": np.mean(steps) / independent,
        "of the mean": np.mean(steps) / np.mean(frames),
        "worst": max(steps) / np.mean(steps),
    }


def motion(run: Run) -> None:
    """Stability of images while the camera moves by fractions of a pixel (Zirr16, Fig. 5).

    A plane has one query per pixel, with round pixels or pixels of 16:1. It pans by an eighth of a
    pixel per frame; or pixels grow by a factor of 2.2 around fixed points, so that every pixel
    changes its grids once. The table has the mean absolute difference of a pixel between frames,
    relative to images with independent microdetails (another seed). "worst" is the largest
    difference of successive frames, over the mean; it is near 1 without popping. "coherent" are the
    plugin's grids; in "blended", the two grids have independent noise (Fig. 5, left); "single" is
    the cell at the pixel's centre. "particles" is ``glint_particles`` with the same roughnesses and
    density instead. "of the mean" is the difference relative to the mean of the images.
    """
    with run.table("motion") as table:
        for ratio in (1, 16):
            for name in ("pan", "recede"):
                for cells in (*CELLS, PARTICLES):
                    key = {"ratio": ratio, "motion": name, "cells": cells}
                    table.measure(key, partial(moved, run, *key.values()))


grid = family("grid", motion)
