"""Error and speed of the tables behind ``max_error``, against the exact manifold P-NDF.

``python benchmarks/tables.py [--max-error 0.05] [--map FILE] [-o RESULT.json]``

The error is the relative L1 difference on the tables' own bins, 128 along each axis over the map's
normals. Both sides are integrals over the bins without sampling noise: the truth spreads every
triangle under the footprint over the bins, weighed by the kernel at its quad. Speed is that of
random queries (normals drawn from the P-NDF, as BSDF sampling does) with one thread, the exact
lists and the tables in turn. Expected before measuring: errors up to the predicted one, on rough
maps half of it; 10 × at r = 64 texels, 40 × at r = 128, no growth beyond.
"""

from __future__ import annotations

import argparse
import json
import time
from pathlib import Path

import drjit as dr
import mitsuba as mi
import numpy as np

import glintbsdf

mi.set_variant("llvm_ad_rgb")

from glintbsdf import maps  # noqa: E402
from glintbsdf.footprint import Footprint  # noqa: E402
from glintbsdf.pndf import Manifold, TabulatedManifold  # noqa: E402
from glintbsdf.pndf.tabulated import ERROR, Spread, clipped_area, doubled_area  # noqa: E402

CENTRE = (0.47, 0.52)

#: Radius r = 3σ (texels) of the smaller axis, aspect, rotation (degrees).
FOOTPRINTS = [(16, 1, 0), (64, 1, 0), (64, 2, 30), (128, 1, 0), (128, 2, 115), (256, 1, 0)]


def footprint_of(radius, aspect, degrees, scale, count=None):
    turn, sigma = np.radians(degrees), radius / 3
    du = aspect * sigma * np.array([np.cos(turn), np.sin(turn)]) / scale
    dv = sigma * np.array([-np.sin(turn), np.cos(turn)]) / scale
    uv = np.array(CENTRE)[:, None] if count is None else np.random.default_rng(1).random((2, count))
    return Footprint(
        mi.Point2f(*(mi.Float(np.float32(v)) for v in uv)),
        mi.Vector2f(*map(float, du)),
        mi.Vector2f(*map(float, dv)),
    )


def true_masses(pndf, footprint, tables) -> np.ndarray:
    """Mass of the exact P-NDF in every bin."""
    kernel = pndf.texel_kernel(footprint)
    mean = mi.Vector2f(kernel.mean)
    spread = Spread(pndf.lattice, pndf.effective_triangles, tables.lower, tables.size, tables.bins)
    mass = dr.zeros(mi.Float, int(np.prod(tables.bins)))

    def add(corners, x, y, row, column, active):
        offset = mi.Vector2f(column, row) + 0.5 - mean
        part = clipped_area(corners, x, y) / dr.abs(doubled_area(*corners))
        index = mi.UInt32(y * spread.columns + x)
        dr.scatter_add(mass, part * kernel.value(offset), index, active & (part > 0))

    (x,), (y,) = np.array(mean)
    reach = kernel.reach_u.numpy().item(), kernel.reach_v.numpy().item()
    sides = [
        np.arange(max(0, int(m - r) // 8 * 8), min(n, int(m + r) + 9), 8)
        for m, r, n in zip(
            (y, x), reach[::-1], (pndf.lattice.y.quads, pndf.lattice.x.quads), strict=True
        )
    ]
    top, left = (v.ravel() for v in np.meshgrid(*sides))
    bottom, right = (
        np.minimum(v + 8, n) for v, n in ((top, pndf.lattice.y.quads), (left, pndf.lattice.x.quads))
    )
    spread.scan(top, bottom, left, right, add)
    return mass.numpy().astype(np.float64)


def table_masses(pndf, footprint) -> np.ndarray:
    """Mass of the tables' P-NDF in every bin."""
    tables = pndf.tables
    columns, rows = (int(n) for n in tables.bins)
    row, column = np.divmod(np.arange(rows * columns), columns)
    m = tables.lower + (np.stack([column, row], -1) + 0.5) * tables.size
    m = mi.Vector2f(m.T.astype(np.float32))
    return pndf.eval(m, footprint).numpy().astype(np.float64) * np.prod(tables.size)


def seconds(pndf, m, footprint) -> float:
    dr.sync_thread()
    start = time.perf_counter()
    dr.eval(pndf.eval(m, footprint))
    dr.sync_thread()
    return time.perf_counter() - start


def speed(exact, tabulated, case, scale, repetitions=5):
    """Seconds per query, exact and by tables, and the median ratio."""
    count = int(np.clip(2**24 / (case[0] ** 2 * case[1]), 2**9, 2**15))
    footprint = footprint_of(*case, scale, count)
    u = np.random.default_rng(2).random((2, count), dtype=np.float32)
    m = exact.sample(footprint, 0.0, mi.Point2f(mi.Float(u[0]), mi.Float(u[1])))
    dr.eval(m)
    times = [[seconds(p, m, footprint) for p in (exact, tabulated)] for _ in range(repetitions + 1)]
    times = np.array(times[1:])
    return *(np.median(times, 0) / count), float(np.median(times[:, 0] / times[:, 1]))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--max-error", type=float, default=0.05)
    parser.add_argument("--kernel", default="gaussian", choices=list(ERROR))
    parser.add_argument("--map", type=Path, action="append", default=[], help="a further map")
    parser.add_argument("-o", "--output", type=Path, help="JSON file to write")
    options = parser.parse_args()

    size = 1024
    cases = {path.name: glintbsdf.NormalMap.load(path) for path in options.map} | {
        "isotropic": maps.isotropic(size, seed=1),
        "brushed": maps.brushed(size, seed=1),
        "scratched": maps.scratched(size, seed=1),
        "flakes": maps.flakes(size, seed=1),
        "leather": maps.leather(size, seed=1),
    }
    threads = dr.thread_count()
    results = []
    print("map              r  aspect   turn  predicted  measured    Mq/s  × exact")
    for name, normal_map in cases.items():
        scale = np.array([normal_map.width, normal_map.height])
        exact = Manifold(normal_map, options.kernel)
        start = time.perf_counter()
        tabulated = TabulatedManifold(normal_map, options.kernel, max_error=options.max_error)
        print(f"{name}: {tabulated}, lists and tables in {time.perf_counter() - start:.1f} s")
        for case in FOOTPRINTS:
            footprint = footprint_of(*case, scale)
            level = tabulated.level(footprint).numpy().item()
            predicted = measured = 0.0
            if level >= 0:
                coefficient, power = ERROR[options.kernel]
                spacing = tabulated.tables.spacing(level)
                predicted = coefficient * (spacing / (case[0] / 3)) ** power
                truth = true_masses(exact, footprint, tabulated.tables)
                truth /= truth.sum()
                measured = float(np.abs(table_masses(tabulated, footprint) - truth).sum())
            dr.set_thread_count(1)
            *per_query, ratio = speed(exact, tabulated, case, scale)
            dr.set_thread_count(threads)
            results.append(
                {
                    "map": name,
                    "radius": case[0],
                    "aspect": case[1],
                    "turn": case[2],
                    "level": level,
                    "predicted": predicted,
                    "measured": measured,
                    "seconds_exact": per_query[0],
                    "seconds": per_query[1],
                    "ratio": ratio,
                }
            )
            errors = f"{predicted:10.2%} {measured:9.2%}" if level >= 0 else "     exact         0"
            print(
                f"{name:12} {case[0]:5} {case[1]:7} {case[2]:5}°{errors}"
                f" {1e-6 / per_query[1]:8.3f} {ratio:8.1f}",
                flush=True,
            )
    if options.output:
        options.output.write_text(json.dumps(results, indent=1) + "\n")


if __name__ == "__main__":
    main()
