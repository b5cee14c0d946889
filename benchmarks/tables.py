"""Error, speed and memory of the tables behind ``max_error``, against the exact manifold P-NDF.

``python benchmarks/tables.py [--max-error 0.05] [--kernel gaussian] [--errors] [--only MAP…]
[--map FILE]… [-o RESULT.json]``

Six procedural maps of 1024². The error is the relative L1 difference on the tables' bins, 128 along
each axis over the map's normals, without sampling noise: the truth spreads every triangle under the
footprint over the bins, weighed by the kernel at its quad. It is averaged over three places; beside
it stands the error that was predicted, by which the tables chose their level, and the quotient of
the two, of the averages and at the worst of the places. ``--errors`` leaves it at that. Speed is
that of random queries (normals drawn from the P-NDF, as BSDF sampling does) with
one thread, the exact lists and the tables in turn, after a warm-up that compiles; the ratio is the
median of those of the repetitions. Tables answer enough queries that launching the kernel does not
count: up to 32 times as many as the lists do; times are per query.

Expected before measuring: errors between a half and the whole of the predicted one; with
``max_error`` 0.05, 40 × at r = 64 texels, 150 × at r = 128, and no growth beyond, as a query visits
some ten to forty nodes at every size; lists and tables at r = 16, depending on the map. With levels
1⅓ to 1½ apart: flakes 20 × at r = 64 and 60 × at r = 128.
"""

from __future__ import annotations

import argparse
import json
import os
import time
from pathlib import Path

os.environ["GLINTBSDF_CACHE"] = "off"  # the build is timed

import drjit as dr
import mitsuba as mi
import numpy as np

import glintbsdf

mi.set_variant("llvm_ad_rgb")

from glintbsdf import maps  # noqa: E402
from glintbsdf.footprint.gaussian import Footprint  # noqa: E402
from glintbsdf.footprint.kernels import KERNELS  # noqa: E402
from glintbsdf.pndf import Manifold, TabulatedManifold  # noqa: E402

SIZE = 1024

#: Radius r = 3σ (texels) of the smaller axis, aspect, rotation (degrees).
FOOTPRINTS = [
    (16, 1, 0),
    (32, 1, 0),
    (64, 1, 0),
    (64, 2, 30),
    (128, 1, 0),
    (128, 2, 115),
    (256, 1, 0),
    (512, 1, 0),
]

#: Places of the footprints whose errors are averaged.
PLACES = [(0.47, 0.52), (0.13, 0.77), (0.86, 0.31)]

MAPS = {
    "isotropic": {},
    "smooth": {"correlation_length": 48},
    "brushed": {},
    "scratched": {},
    "flakes": {},
    "leather": {},
}


def footprint_of(case, scale, uv) -> Footprint:
    """``scale`` (2,): texels per unit of UV; ``uv`` (2, N)."""
    radius, aspect, degrees = case
    turn, sigma = np.radians(degrees), radius / 3
    du = aspect * sigma * np.array([np.cos(turn), np.sin(turn)]) / scale
    dv = sigma * np.array([-np.sin(turn), np.cos(turn)]) / scale
    opaque = lambda v: mi.Vector2f(*(dr.opaque(mi.Float, float(k)) for k in v))  # noqa: E731
    return Footprint(mi.Point2f(*(mi.Float(np.float32(v)) for v in uv)), opaque(du), opaque(dv))


def errors(pndf, case, scale):
    """Mean of the predicted and of the measured error, the worst ratio, and the level in use.

    The level is −1 where the lists answer.
    """
    predicted, measured = [], []
    for place in PLACES:
        footprint = footprint_of(case, scale, np.array(place)[:, None])
        level = pndf.level(footprint).numpy().item()
        if level < 0:
            return 0.0, 0.0, 0.0, level
        predicted.append(pndf.error(pndf.texel_kernel(footprint), level).numpy().item())
        measured.append(pndf.measured_error(footprint))
    worst = float(np.max(np.divide(measured, predicted)))
    return float(np.mean(predicted)), float(np.mean(measured)), worst, level


def smallest(pndf, scale) -> float:
    """The smallest standard deviation, texels, of round footprints that tables serve."""
    sigma = np.geomspace(2, 200, 500)
    du = np.zeros((2, len(sigma)))
    du[0] = sigma / scale[0]
    axes = (mi.Vector2f(*(mi.Float(v) for v in d)) for d in (du, du[::-1] * scale[0] / scale[1]))
    served = pndf.level(Footprint(mi.Point2f(0.5), *axes)).numpy() >= 0
    return float(sigma[served].min())


def seconds(pndf, m, footprint) -> float:
    dr.sync_thread()
    start = time.perf_counter()
    dr.eval(pndf.eval(m, footprint))
    dr.sync_thread()
    return (time.perf_counter() - start) / dr.width(m)


def speed(exact, tabulated, case, scale, repetitions=5):
    """Seconds per query, exact and by tables, and the median ratio."""
    few = int(np.clip(2**22 / (case[0] ** 2 * case[1]), 2**6, 2**13))
    rng = np.random.default_rng(1)
    queries = []
    for pndf, count in ((exact, few), (tabulated, min(32 * few, 2**15))):
        footprint = footprint_of(case, scale, rng.random((2, count)))
        u = rng.random((2, count), dtype=np.float32)
        m = exact.sample(footprint, 0.0, mi.Point2f(mi.Float(u[0]), mi.Float(u[1])))
        dr.eval(m, footprint.uv)
        queries.append((pndf, m, footprint))
    times = np.array([[seconds(*query) for query in queries] for _ in range(repetitions + 1)])[1:]
    return *np.median(times, 0), float(np.median(times[:, 0] / times[:, 1]))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--max-error", type=float, default=0.05)
    parser.add_argument("--kernel", default="gaussian", choices=KERNELS)
    parser.add_argument("--errors", action="store_true", help="errors only")
    parser.add_argument("--only", nargs="+", default=list(MAPS), choices=list(MAPS), help="maps")
    parser.add_argument("--map", type=Path, action="append", default=[], help="a further map")
    parser.add_argument("-o", "--output", type=Path, help="JSON file to write")
    options = parser.parse_args()

    cases = {path.name: glintbsdf.NormalMap.load(path) for path in options.map}
    functions = {"smooth": maps.isotropic}
    for name in options.only:
        cases[name] = functions.get(name, getattr(maps, name, None))(SIZE, seed=1, **MAPS[name])
    threads = dr.thread_count()
    results = []
    speeds = "" if options.errors else "   µs/query  × exact"
    print(f"map              r aspect  turn  level predicted  measured  of it  worst{speeds}")
    for name, normal_map in cases.items():
        scale = np.array([normal_map.width, normal_map.height])
        start = time.perf_counter(), time.process_time()
        exact = Manifold(normal_map, options.kernel)
        lists = time.perf_counter() - start[0]
        pndf = TabulatedManifold(normal_map, options.kernel, max_error=options.max_error)
        built, worked = time.perf_counter() - start[0] - lists, time.process_time() - start[1]
        tables = pndf.tables
        sizes = ", ".join(f"{n / 2**20:.1f}" for n in tables.level_nbytes)
        of_kernel = [level[KERNELS.index(options.kernel)] for level in tables.grains]
        grains = ", ".join(f"{np.mean(grain):.0f}" for grain in of_kernel)
        print(
            f"{name}: lists {exact.nbytes / 2**20:.1f} MiB, {lists:.1f} s; with tables "
            f"{pndf.nbytes / 2**20:.1f} MiB, {built:.1f} s (both: {worked:.1f} s of processors)\n"
            f"  nodes from {tables.spacing(0):.1f} texels on; levels of {sizes} MiB; "
            f"grains of {grains} texels;\n"
            f"  round footprints from {smallest(pndf, scale):.1f} texels on",
            flush=True,
        )
        for case in FOOTPRINTS:
            predicted, measured, worst, level = errors(pndf, case, scale)
            per_query, ratio = [None, None], None
            if not options.errors:
                dr.set_thread_count(1)
                *per_query, ratio = speed(exact, pndf, case, scale)
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
                    "worst_ratio": worst,
                    "seconds_exact": per_query[0],
                    "seconds": per_query[1],
                    "ratio": ratio,
                    "seconds_build": built,
                    "bytes": pndf.nbytes,
                    "bytes_levels": tables.level_nbytes,
                    "grain": of_kernel[max(level, 0)],
                }
            )
            if level < 0:
                found = "exact         –         –      –      –"
            else:
                found = f"{level:5} {predicted:9.2%} {measured:9.2%} {measured / predicted:6.2f}"
                found += f" {worst:6.2f}"
            if ratio is not None:
                found += f" {1e6 * per_query[1]:10.3f} {ratio:8.1f}"
            print(f"{name:12} {case[0]:5} {case[1]:6} {case[2]:4}°  {found}", flush=True)
    if options.output:
        options.output.write_text(json.dumps(results, indent=1) + "\n")


if __name__ == "__main__":
    main()
