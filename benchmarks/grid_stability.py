"""Temporal stability of glint_grid under motion of the camera by fractions of a pixel.

``python benchmarks/grid_stability.py [-o RESULT.json] [--picture FRAMES.png]``

32 frames of a plane, one query per pixel, with round pixels and pixels of 16:1. The plane pans by
an eighth of a pixel per frame; or the camera recedes until pixels are 2.2 times as large, about
points that stay, so that every pixel changes its grids once. What is printed is the mean absolute
difference of a pixel between frames, relative to that between pictures of independent microdetails
(another seed):

* coherent: the plugin's grids;
* blended: the same without coherence: grids of two levels share nothing (Fig. 5, left);
* single: one grid, the level nearest to the pixel's size, the cell at the pixel's centre.

"worst" is the largest difference of one frame to the next, relative to the mean of the sequence:
near 1 without popping. Expected: coherent less than blended, which is less than single; worst below
2 for both of them, and many times that for single while the camera recedes.
"""

from __future__ import annotations

import argparse
import json
import math
from pathlib import Path

import drjit as dr
import mitsuba as mi
import numpy as np

import glintbsdf

mi.set_variant("llvm_ad_rgb")

from glintbsdf.footprint.gaussian import Footprint  # noqa: E402
from glintbsdf.pndf import Grid  # noqa: E402
from glintbsdf.pndf.grid.microdetails import CoveredCells  # noqa: E402

FRAMES, SIZE = 32, 256
ANGLE = math.radians(20)  # of the long axis of a pixel


class BlendedCells(CoveredCells):
    """Both grids without coherence: each level is moved to a place of its own."""

    def sum(self, term, zero, active):
        def moved(x, y, level, active):
            return term(x + level * 1_000_003, y - level * 999_983, level, active)

        return super().sum(moved, zero, active)


class SingleCell(CoveredCells):
    """The cell at the pixel's centre, on the grid whose cells are nearest to the pixel's size."""

    def sum(self, term, zero, active):
        level = dr.select(self.blend < 0.5, self.level, self.level + 1)
        centre = self.centre * dr.exp2(-mi.Float(level))
        cell = self.swapped(mi.Vector2i(dr.round(centre)))
        return zero + term(cell.x, cell.y, level, active)


def grid_of(cells: type[CoveredCells], **parameters) -> Grid:
    grid = Grid(**parameters)
    grid.covered_cells = cells
    return grid


METHODS = {"coherent": CoveredCells, "blended": BlendedCells, "single": SingleCell}


def frame(grid: Grid, ratio: float, shift: float, zoom: float) -> np.ndarray:
    """One picture: ``shift`` in pixels, ``zoom`` the size of a pixel relative to the first."""
    pitch = 2.7e-4  # UV; at density 8 a microdetail is 1e-4 wide
    row, column = np.divmod(np.arange(SIZE * SIZE), SIZE)
    c, s = math.cos(ANGLE), math.sin(ANGLE)
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


def difference(a: np.ndarray, b: np.ndarray) -> float:
    return float(np.abs(a - b).mean())


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("-o", "--output", type=Path, help="JSON file to write")
    parser.add_argument("--picture", type=Path, help="PNG of four frames of each method to write")
    options = parser.parse_args()
    motions = {
        "pan": [(k / 8, 1.0) for k in range(FRAMES)],
        "recede": [(0.0, 2.2 ** (k / (FRAMES - 1))) for k in range(FRAMES)],
    }
    results, strips = [], []
    print("ratio  motion  method    difference / independent   worst / mean")
    for ratio in (1, 16):
        for motion, path in motions.items():
            for name, cells in METHODS.items():
                frames = [frame(grid_of(cells), ratio, *step) for step in path]
                other = frame(grid_of(cells, seed=1), ratio, *path[0])
                steps = [difference(a, b) for a, b in zip(frames, frames[1:], strict=False)]
                row = {
                    "ratio": ratio,
                    "motion": motion,
                    "method": name,
                    "difference": np.mean(steps) / difference(frames[0], other),
                    "worst": max(steps) / np.mean(steps),
                }
                results.append(row)
                print(f"{ratio:4}:1 {motion:7} {name:9}"
                      f"{row['difference']:12.3f} {row['worst']:22.2f}")  # fmt: skip
                strips.append(np.hstack([f[:96, :96] for f in frames[::8]]))
    if options.picture:
        strip = np.vstack(strips)
        pixels = np.uint8(255 * np.clip(strip / np.quantile(strip, 0.99), 0, 1))
        mi.Bitmap(pixels).write(str(options.picture))
    if options.output:
        options.output.write_text(
            json.dumps({"version": glintbsdf.__version__, "results": results}, indent=1) + "\n"
        )


if __name__ == "__main__":
    main()
