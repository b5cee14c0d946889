"""Error and time of the paper's clusters against its threshold τ and the footprint.

``python benchmarks/clusters.py [--map FILE]… [--quick] [-o RESULT.json]``

The axes of Tables 2 and 3 of Wu24, with our own maps: footprints of radius r = 3σ (texels), τ from
1e-4 to 1. The error is the relative L1 difference to the exact P-NDF on a grid of 128² normals,
mean of two places on the map: 4 million stratified places under the footprint, whose normals in
both are counted by bin, which the exact samplers allow; exact against exact is 0. Times are those
of random queries, normals drawn from the exact P-NDF, all methods in turn within every repetition,
after a warm-up that compiles; printed is the median of the ratios to exact. One thread.

Expected before measuring: the exact lists visit few triangles in vain, so that clusters save less
than the paper's 6 to 16 times, which are against a tree: two to five times, at errors of 0.1 to 0.5
on rough maps, and of less than 0.05 on the smooth one.
"""

from __future__ import annotations

import argparse
import json
import os
import platform
import time
from pathlib import Path

os.environ["GLINTBSDF_CACHE"] = "off"  # the build is timed

import drjit as dr
import mitsuba as mi
import numpy as np

import glintbsdf

mi.set_variant("llvm_ad_rgb")

from glintbsdf import maps  # noqa: E402
from glintbsdf.footprint import Footprint  # noqa: E402
from glintbsdf.pndf import ClusteredManifold, Manifold  # noqa: E402

RADII = (16, 64, 128, 256)
THRESHOLDS = (1e-4, 1e-3, 1e-2, 1e-1, 1.0)
PLACES = ((0.37, 0.61), (0.81, 0.22))
RES = 128

#: Samples per axis of the footprint.
SAMPLES = 2048

#: Queries timed, by radius: about a tenth of a second of the exact method.
QUERIES = {16: 2**14, 64: 2**12, 128: 2**11, 256: 2**10}


def binned(pndf, footprint, u):
    """Mass per bin: the normals at places drawn from the kernel, by the exact sampler."""
    lower, upper = pndf.bounds()
    m = np.array(pndf.sample(footprint, 0.0, u)).T
    column, row = np.clip((m - lower) * (RES / (upper - lower)), 0, RES - 1).astype(np.int64).T
    return np.bincount(row * RES + column, minlength=RES**2) / len(m)


def errors(exact, methods, radius, size):
    """Relative L1 error of each method, mean over :data:`PLACES`."""
    row, column = np.indices((SAMPLES, SAMPLES))
    jitter = np.random.default_rng(1).random((2, SAMPLES, SAMPLES))
    u = ((np.stack([column, row]) + jitter) / SAMPLES).reshape(2, -1).astype(np.float32)
    u = mi.Point2f(np.minimum(u, np.float32(1 - 2**-24)))
    sigma = dr.opaque(mi.Float, radius / 3 / size)
    found = {name: [] for name in methods}
    for uv in PLACES:
        footprint = Footprint.isotropic(mi.Point2f(uv), sigma)
        reference = binned(exact, footprint, u)
        for name, pndf in methods.items():
            found[name].append(np.abs(binned(pndf, footprint, u) - reference).sum())
    return {name: float(np.mean(e)) for name, e in found.items()}


def seconds(pndf, m, footprint) -> float:
    dr.sync_thread()
    start = time.perf_counter()
    dr.eval(pndf.eval(m, footprint))
    dr.sync_thread()
    return time.perf_counter() - start


def times(exact, methods, radius, size, repetitions):
    """Median ratio of exact to each method, and microseconds per exact query."""
    count = QUERIES[radius]
    u = np.random.default_rng(2).random((4, count), dtype=np.float32)
    sigma = dr.opaque(mi.Float, radius / 3 / size)
    footprint = Footprint.isotropic(mi.Point2f(u[:2]), sigma)
    m = exact.sample(footprint, 0.0, mi.Point2f(u[2:]))
    dr.eval(m)
    calls = {"exact": exact, **methods}
    for pndf in calls.values():
        seconds(pndf, m, footprint)
    taken = {name: [] for name in calls}
    for _ in range(repetitions):
        for name, pndf in calls.items():
            taken[name].append(seconds(pndf, m, footprint))
    ratios = {name: float(np.median(np.divide(taken["exact"], taken[name]))) for name in methods}
    return ratios, 1e6 * float(np.median(taken["exact"])) / count


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--map", type=Path, action="append", default=[], help="a further map")
    parser.add_argument("--size", type=int, default=1024, help="of the procedural maps, texels")
    parser.add_argument("--quick", action="store_true", help="radii of 16 and 64 texels only")
    parser.add_argument("--repetitions", type=int, default=5)
    parser.add_argument("-o", "--output", type=Path, help="JSON file to write")
    options = parser.parse_args()

    cases = {
        "isotropic": maps.isotropic(options.size, seed=1),
        "brushed": maps.brushed(options.size, seed=1),
        "scratched": maps.scratched(options.size, seed=1),
        "smooth": maps.isotropic(options.size, correlation_length=48, seed=1),
    } | {path.name: glintbsdf.NormalMap.load(path) for path in options.map}
    threads = dr.thread_count()
    results = []
    for name, normal_map in cases.items():
        dr.set_thread_count(threads)
        exact, methods, build = Manifold(normal_map), {}, {}
        for threshold in THRESHOLDS:
            start = time.perf_counter()
            methods[threshold] = ClusteredManifold(normal_map, threshold)
            build[threshold] = time.perf_counter() - start
        print(f"\n{name}: {exact}")
        for threshold, pndf in methods.items():
            ladder = [] if pndf.ladder is None else pndf.ladder.thresholds
            print(
                f"  τ = {threshold:<6g} built in {build[threshold]:.1f} s (exact lists and cache"
                f" included), {(pndf.nbytes - exact.nbytes) / 1e6:.1f} MB of clusters, rungs from"
                f" {', '.join(f'{t:.3g}' for t in ladder) or 'none'} texels⁴"
            )
        print("  r (texels)  τ        rung   relative L1   × exact    exact (µs)")
        for radius in RADII[:2] if options.quick else RADII:
            size = normal_map.width
            error = errors(exact, methods, radius, size)
            dr.set_thread_count(1)
            ratio, exact_time = times(exact, methods, radius, size, options.repetitions)
            dr.set_thread_count(threads)
            for threshold, pndf in methods.items():
                allowed = mi.Float(radius**2 * threshold)
                rung = 0 if pndf.ladder is None else int(pndf.ladder.rung(allowed)[0])
                row = {
                    "map": name, "radius": radius, "threshold": threshold, "rung": rung,
                    "relative_l1": error[threshold], "ratio_to_exact": ratio[threshold],
                    "exact_microseconds": exact_time, "build_seconds": build[threshold],
                    "bytes": pndf.nbytes, "bytes_exact": exact.nbytes,
                }  # fmt: skip
                results.append(row)
                print(
                    f"  {radius:<11} {threshold:<8g} {rung:<6} {error[threshold]:<13.4f}"
                    f" {ratio[threshold]:<10.2f} {exact_time:.1f}",
                    flush=True,
                )
    if options.output:
        machine = platform.processor() or platform.machine()
        options.output.write_text(
            json.dumps({"machine": machine, "mitsuba": mi.__version__, "drjit": dr.__version__,
                        "results": results}, indent=1) + "\n"
        )  # fmt: skip


if __name__ == "__main__":
    main()
