"""Queries per second of the exact manifold P-NDF against its first versions.

``python benchmarks/manifold_queries.py [--map FILE] [-o RESULT.json]``

One thread. For every footprint radius r = 3σ (texels), coherent queries, such as neighbouring
pixels make, and random ones. All versions run in turn within every repetition, after a warm-up that
compiles; the figures are medians of throughput, and of the ratio to each first version within the
same repetition. Densities are compared as well. Expected before measuring: at least the better of
the two first versions everywhere, about 1.5 × where lists are used.
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

from first_versions import FirstLists, PlainLoop  # noqa: E402

from glintbsdf.footprint.gaussian import Footprint  # noqa: E402
from glintbsdf.pndf import Manifold  # noqa: E402

#: Radius in texels, and number of queries: about a second each for the slowest version.
RADII = {1.5: 2**18, 4: 2**17, 32: 2**13, 64: 2**12, 128: 2**11}


def queries(normal_map, radius: float, count: int, coherent: bool, seed: int = 7):
    """``(uv, m)``: coherent ones as pixels a footprint apart, with normals that turn slowly; random
    ones at uniform places, with normals of the map itself."""
    height, width = normal_map.height, normal_map.width
    if coherent:
        side = int(count**0.5)
        y, x = np.divmod(np.arange(side * side), side)
        step = 2 * radius / 3
        uv = np.stack([(0.98 * step * x + 3) / width, (1.01 * step * y + 5) / height], -1)
        spread = 2 * normal_map.normals.std()
        turn = x / side, y / side
        m = spread * np.stack([np.sin(6 * turn[0] + 0.1), np.cos(5 * turn[1] + turn[0])], -1)
    else:
        rng = np.random.default_rng(seed)
        uv = rng.random((count, 2))
        i, j = rng.integers(0, (height, width), (count, 2)).T
        t = rng.random((count, 2))
        t = np.where(t.sum(1, keepdims=True) > 1, 1 - t, t)
        n = normal_map.normals
        n0, n1, n2 = n[i, j], n[i, (j + 1) % width], n[(i + 1) % height, j]
        m = n0 + (n1 - n0) * t[:, :1] + (n2 - n0) * t[:, 1:]
    uv, m = (uv % 1).T, m.T
    return mi.Point2f(uv.astype(np.float32)), mi.Vector2f(m.astype(np.float32))


def seconds(evaluate) -> tuple[float, np.ndarray]:
    dr.sync_thread()
    start = time.perf_counter()
    density = evaluate()
    dr.eval(density)
    dr.sync_thread()
    return time.perf_counter() - start, density.numpy()


def measure(versions, normal_map, radius, count, coherent, repetitions):
    uv, m = queries(normal_map, radius, count, coherent)
    sigma = dr.opaque(mi.Float, radius / 3)
    sigma_uv = sigma / normal_map.width
    calls = {
        "lists": lambda: versions["lists"].eval(
            m, Footprint(uv, mi.Vector2f(sigma_uv, 0), mi.Vector2f(0, sigma_uv))
        ),
        "first lists": lambda: versions["first lists"].eval(m, uv, sigma),
    }
    if radius <= 32:  # beyond, it takes minutes
        calls["plain loop"] = lambda: versions["plain loop"].eval(m, uv, sigma)
    densities = {name: seconds(call)[1] for name, call in calls.items()}
    times = {name: [] for name in calls}
    for _ in range(repetitions):
        for name, call in calls.items():
            times[name].append(seconds(call)[0])
    reference = densities["first lists"].astype(np.float64)
    result = {
        "radius": radius,
        "coherent": coherent,
        "relative_l1": float(np.abs(densities["lists"] - reference).sum() / reference.sum()),
    }
    for name in calls:
        result[f"{name} Mq/s"] = dr.width(uv) / float(np.median(times[name])) / 1e6
        if name != "lists":
            result[f"ratio to {name}"] = float(np.median(np.divide(times[name], times["lists"])))
    return result


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--map", help="a map with sides that are powers of two; default: isotropic")
    parser.add_argument("--repetitions", type=int, default=5)
    parser.add_argument("-o", "--output", type=Path, help="JSON file to write")
    options = parser.parse_args()

    if options.map:
        normal_map = glintbsdf.NormalMap.load(options.map)
    else:
        normal_map = glintbsdf.maps.isotropic(1024, seed=1)
    start = time.perf_counter()
    manifold = Manifold(normal_map)
    build = time.perf_counter() - start
    print(f"{manifold}, built in {build:.1f} s on {dr.thread_count()} threads (compiling included)")
    dr.set_thread_count(1)
    versions = {
        "lists": manifold,
        "first lists": FirstLists(normal_map.normals),
        "plain loop": PlainLoop(normal_map.normals),
    }
    results = []
    print("     r  queries     Mq/s   × first lists   × plain loop   relative L1")
    for radius, count in RADII.items():
        for coherent in (True, False):
            row = measure(versions, normal_map, radius, count, coherent, options.repetitions)
            results.append(row)
            plain = row.get("ratio to plain loop")
            print(
                f"{radius:6} {'coherent' if coherent else 'random  '} {row['lists Mq/s']:9.4f}"
                f" {row['ratio to first lists']:12.2f}"
                f" {'–' if plain is None else f'{plain:.2f}':>15} {row['relative_l1']:15.1e}"
            )
    if options.output:
        options.output.write_text(
            json.dumps(
                {
                    "machine": platform.processor() or platform.machine(),
                    "mitsuba": mi.__version__,
                    "drjit": dr.__version__,
                    "llvm": list(dr.detail.llvm_version()),
                    "map": options.map or "isotropic",
                    "build_seconds": build,
                    "bytes": manifold.nbytes,
                    "bytes_first_lists": versions["first lists"].nbytes,
                    "results": results,
                },
                indent=1,
            )
            + "\n"
        )


if __name__ == "__main__":
    main()
