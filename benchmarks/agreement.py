"""The exact manifold P-NDF against the binned reference, on every procedural map.

``python benchmarks/agreement.py [--quick] [--map FILE] [-o RESULT.json]``

Footprints from 0.5 to 200 texels, round and stretched, along the axes and rotated, with all
kernels. Both sides have noise: the reference that of its counts, the density that of its average
over a bin (jittered points, their error measured). Printed are the relative L1 difference, what
noise alone makes, and the p-value of Pearson's χ² over the bins with both variances. Expected
before measuring: p-values uniform in [0, 1]; the smallest of n is about 1/n.

The Jacobian is clamped at 1e-3, so that the bins resolve the clamped triangles.
"""

from __future__ import annotations

import argparse
import json
from pathlib import Path

import drjit as dr
import mitsuba as mi
import numpy as np
import scipy.stats

import glintbsdf

mi.set_variant("llvm_ad_rgb")

from glintbsdf import maps  # noqa: E402
from glintbsdf.check.reference import binned_pndf  # noqa: E402
from glintbsdf.footprint.gaussian import Footprint  # noqa: E402
from glintbsdf.pndf import Manifold  # noqa: E402

EPSILON = 1e-3

#: Standard deviations (texels) and rotation (degrees).
FOOTPRINTS = [
    (0.5, 0.5, 0),
    (2, 2, 0),
    (4, 0.5, 30),
    (20, 20, 0),
    (60, 2, 0),
    (60, 2, 115),
    (200, 3, 63),
    (200, 200, 0),
]


REPETITIONS = 16


def density_in_bins(manifold, footprint, bounds, res: int, points: int):
    """Mean of D over each bin, and its standard error."""
    (x_min, y_min), (x_max, y_max) = bounds
    n = res * points
    rng = np.random.default_rng(1)
    runs = []
    for _ in range(REPETITIONS):
        row, column = (np.indices((n, n)) + rng.random((2, n, n))) / n
        m = mi.Vector2f(
            mi.Float((x_min + (x_max - x_min) * column).ravel()),
            mi.Float((y_min + (y_max - y_min) * row).ravel()),
        )
        density = manifold.eval(m, footprint).numpy().astype(np.float64)
        runs.append(density.reshape(res, points, res, points).mean(axis=(1, 3)))
    return np.mean(runs, axis=0), np.std(runs, axis=0, ddof=1) / np.sqrt(REPETITIONS)


def p_value(density, error, reference, samples: int) -> float:
    """Of Pearson's χ² over the bins, the emptiest pooled."""
    expected = samples * reference.bin_area * density.ravel()
    order = np.argsort(expected)
    expected = expected[order]
    counts = samples * reference.bin_area * reference.density.ravel()[order]
    # A variance estimated from n runs makes the square of a t-distribution, of this mean.
    correction = (REPETITIONS - 1) / (REPETITIONS - 3)
    variance = expected + correction * (samples * reference.bin_area * error.ravel()[order]) ** 2
    pooled = np.searchsorted(np.cumsum(expected), 5) + 1
    counts, expected, variance = (
        np.append(v[pooled:], v[:pooled].sum()) for v in (counts, expected, variance)
    )
    statistic = ((counts - expected) ** 2 / variance).sum()
    return float(scipy.stats.chi2.sf(statistic, len(counts)))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--map", type=Path, action="append", default=[], help="a further map")
    parser.add_argument("--quick", action="store_true", help="no footprint above 60 texels")
    parser.add_argument("-o", "--output", type=Path, help="JSON file to write")
    options = parser.parse_args()

    size = 512
    cases = {
        "isotropic": maps.isotropic(size, seed=1),
        "brushed": maps.brushed(size, seed=1),
        "scratched": maps.scratched(size, seed=1),
        "flakes": maps.flakes(size, seed=1),
        "leather": maps.leather(size, seed=1),
        "flat": maps.flat(size),
        "tilted": maps.tilted(size, 0.3, 0.5),
    } | {path.name: glintbsdf.NormalMap.load(path) for path in options.map}
    results = []
    print("map          kernel       σ (texels)     turn  relative L1  noise alone   p-value")
    for name, normal_map in cases.items():
        scale = np.array([normal_map.width, normal_map.height])
        for kernel in ("gaussian", "disk", "box"):
            manifold = Manifold(normal_map, kernel, EPSILON)
            for sigma_1, sigma_2, degrees in FOOTPRINTS:
                large = max(sigma_1, sigma_2) > 60
                if large and (options.quick or kernel == "disk"):
                    continue
                turn = np.radians(degrees)
                du = sigma_1 * np.array([np.cos(turn), np.sin(turn)]) / scale
                dv = sigma_2 * np.array([-np.sin(turn), np.cos(turn)]) / scale
                samples = 1_000_000
                area = sigma_1 * sigma_2
                # Points enough for the spikes of small footprints, in a minute at most.
                res, points = (32, 24) if area <= 20 else (32, 8) if area <= 1000 else (16, 4)
                reference = binned_pndf(
                    normal_map,
                    (0.37, 0.61),
                    np.outer(du, du) + np.outer(dv, dv),
                    kernel=kernel,
                    epsilon=EPSILON,
                    res=res,
                    samples=samples,
                    seed=1,
                )
                footprint = Footprint(
                    mi.Point2f(0.37, 0.61),
                    mi.Vector2f(*map(float, du)),
                    mi.Vector2f(*map(float, dv)),
                )
                density, error = density_in_bins(manifold, footprint, reference.bounds, res, points)
                noise = np.hypot(
                    error, np.where(reference.density > 0, reference.standard_error, 0)
                )
                row = {
                    "map": name,
                    "kernel": kernel,
                    "sigma": [sigma_1, sigma_2],
                    "turn": degrees,
                    "relative_l1": reference.relative_l1(density),
                    "noise": float(np.sqrt(2 / np.pi) * noise.sum() / reference.density.sum()),
                    "p_value": p_value(density, error, reference, samples),
                }
                results.append(row)
                print(
                    f"{name:12} {kernel:9} {sigma_1:6} × {sigma_2:5} {degrees:6}°"
                    f" {row['relative_l1']:12.2%} {row['noise']:12.2%} {row['p_value']:9.3f}",
                    flush=True,
                )
                dr.flush_malloc_cache()
    smallest = min(row["p_value"] for row in results)
    print(
        f"{len(results)} cases, smallest p-value {smallest:.2g}, expected about "
        f"{1 / len(results):.2g}"
    )
    if options.output:
        options.output.write_text(json.dumps(results, indent=1) + "\n")


if __name__ == "__main__":
    main()
