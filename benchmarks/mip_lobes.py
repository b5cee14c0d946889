"""Error and time of glint_mip's lobes against the map that its look-up table implies.

``python benchmarks/mip_lobes.py [--quick] [-o DIRECTORY]``

The data of Fig. 5, 13, 14 and 17 of Tan22, with our own samples of 256² texels, made 2048². The
reference is glint_elements with elements half a texel apart on the explicit map, as in the paper;
for Fig. 5, besides it, the binned P-NDF. Footprints are round and w = 2σ texels wide. Errors are
relative L1 differences on a grid of 128² normals over the range of the map's, mean of three places,
σ_r = 0.005. Times are CPU times of queries at random places with normals drawn from the reference,
one thread, all methods in turn, after a warm-up that compiles; medians.

* ``clusters`` (Fig. 13): k = 16, 32, 64; error, time and memory over footprints;
* ``scale`` (Fig. 17): C_P = 0.25, 0.5, 0.75, 1;
* ``interpolation`` (Fig. 14): the largest relative L1 change of the P-NDF while the footprint grows
  by 1 % from 16 to 128 texels, with two levels blended and with the nearest one alone;
* ``binning`` (Fig. 5): footprints of 10 and 30 texels, and pictures where -o is given.

Expected before measuring: errors at 64 texels near 0.15 on the bumps and 0.05 on scratches, half as
large for k = 64 as for 16, which takes a third of the time; five times faster than the elements
there, twenty at 128; a cost that is the same at 8 and at 512 texels, within 1.5 times, and largest
where texels and first grids are blended. Without interpolation, jumps of as much as the error, 0.2;
with it, below 0.02.
"""

from __future__ import annotations

import argparse
import json
import platform
import time
from pathlib import Path

import drjit as dr
import mitsuba as mi
import numpy as np

import glintbsdf

mi.set_variant("llvm_ad_rgb")

from glintbsdf import maps  # noqa: E402
from glintbsdf.check.plot import colour_map  # noqa: E402
from glintbsdf.check.reference import binned_pndf  # noqa: E402
from glintbsdf.footprint.gaussian import Footprint  # noqa: E402
from glintbsdf.pndf import Elements, Mip  # noqa: E402

WIDTHS = (8, 16, 32, 64, 128, 256, 512)
#: Wider footprints would keep the reference busy for minutes.
WIDEST_REFERENCE = 128
CLUSTERS = (16, 32, 64)
SCALES = (0.25, 0.5, 0.75, 1.0)
PLACES = ((0.37, 0.61), (0.81, 0.22), (0.13, 0.45))
RES = 128
SIGMA_R = 0.005
QUERIES = 2**11


class NearestLevel(Mip):
    """Without interpolation between levels."""

    def level(self, kernel):
        below, above, fraction = super().level(kernel)
        nearest = dr.select(fraction < 0.5, below, above)
        return nearest, nearest, mi.Float(0)


def normals_of(pndf) -> mi.Vector2f:
    """The grid of normals over the range of the map's."""
    normals = pndf.normal_map.normals.reshape(-1, 2)
    low, high = normals.min(axis=0), normals.max(axis=0)
    row, column = (np.indices((RES, RES)).reshape(2, -1) + 0.5) / RES
    x, y = low[0] + column * (high - low)[0], low[1] + row * (high - low)[1]
    return mi.Vector2f(*(mi.Float(v.astype(np.float32)) for v in (x, y)))


def footprint_of(pndf, uv, width: float) -> Footprint:
    """``width`` texels across."""
    sigma = dr.opaque(mi.Float, width / 2 / pndf.normal_map.width)
    return Footprint.isotropic(mi.Point2f(*(mi.Float(v) for v in uv)), sigma)


def densities(pndf, width: float, m) -> np.ndarray:
    """P-NDFs at all places."""
    return np.array([pndf.eval(m, footprint_of(pndf, uv, width)).numpy() for uv in PLACES])


def relative_l1(a: np.ndarray, b: np.ndarray) -> float:
    return float(np.abs(a - b).sum() / b.sum())


def seconds(pndf, m, footprint) -> float:
    """CPU time, which other processes on the machine do not change much."""
    dr.sync_thread()
    start = time.process_time()
    dr.eval(pndf.eval(m, footprint))
    dr.sync_thread()
    return time.process_time() - start


def times(methods: dict, reference, width: float, repetitions: int) -> dict[str, float]:
    """Microseconds per query, medians of alternating runs; the reference's where it takes part."""
    calls = dict(methods)
    if width <= WIDEST_REFERENCE:
        calls["elements"] = reference
    u = np.random.default_rng(2).random((5, QUERIES), dtype=np.float32)
    footprint = footprint_of(reference, u[:2], width)
    m = reference.sample(footprint, mi.Float(u[4]), mi.Point2f(u[2:4]))
    dr.eval(m)
    for pndf in calls.values():
        seconds(pndf, m, footprint)
    taken = {name: [] for name in calls}
    for _ in range(repetitions):
        for name, pndf in calls.items():
            taken[name].append(seconds(pndf, m, footprint))
    return {name: 1e6 * float(np.median(t)) / QUERIES for name, t in taken.items()}


def compare(name, methods, reference, widths, repetitions) -> list[dict]:
    """Errors and times of several settings."""
    m, rows = normals_of(reference), []
    print(f"\n{name}\n  {'setting':<16} width   relative L1   µs/query   elements ÷ it   MB")
    for width in widths:
        exact = densities(reference, width, m) if width <= WIDEST_REFERENCE else None
        threads = dr.thread_count()
        dr.set_thread_count(1)
        taken = times(methods, reference, width, repetitions)
        dr.set_thread_count(threads)
        for setting, pndf in methods.items():
            error = None if exact is None else relative_l1(densities(pndf, width, m), exact)
            ratio = taken["elements"] / taken[setting] if "elements" in taken else None
            rows.append(
                {"sample": name, "setting": setting, "width": width, "relative_l1": error,
                 "microseconds": taken[setting], "faster_than_elements": ratio,
                 "bytes": pndf.nbytes}
            )  # fmt: skip
            shown = ("-" if v is None else f"{v:.3g}" for v in (error, ratio))
            error, ratio = shown
            print(
                f"  {setting:<16} {width:<7} {error:<13} {taken[setting]:<10.3g} {ratio:<15} "
                f"{pndf.nbytes / 1e6:.1f}",
                flush=True,
            )
    return rows


def largest_jumps(methods, reference) -> dict[str, float]:
    """The largest relative L1 change while the footprint grows by 1 %."""
    m, result = normals_of(reference), {}
    widths = 16 * 1.01 ** np.arange(0, np.log(8) / np.log(1.01))
    for name, pndf in methods.items():
        before, jumps = None, []
        for width in widths:
            now = pndf.eval(m, footprint_of(pndf, PLACES[0], width)).numpy()
            if before is not None:
                jumps.append(relative_l1(now, before))
            before = now
        result[name] = max(jumps)
    return result


def binning(pndf, reference, folder: Path | None, name: str) -> list[dict]:
    """P-NDFs of 10 and 30 texels beside the binned one, and their errors."""
    rows, res, points = [], 64, 4
    for width in (10, 30):
        sigma = width / 2 / pndf.normal_map.width
        uv = PLACES[0]
        truth = binned_pndf(
            pndf.normal_map, uv, np.eye(2) * sigma**2, res=res, sigma_r=SIGMA_R, epsilon=0.0,
            samples=4_000_000,
        )  # fmt: skip
        (x0, y0), (x1, y1) = truth.bounds
        row, column = (np.indices((res * points,) * 2).reshape(2, -1) + 0.5) / (res * points)
        m = mi.Vector2f(
            *(mi.Float(np.float32(v)) for v in (x0 + (x1 - x0) * column, y0 + (y1 - y0) * row))
        )
        panels = [truth.density]
        for method, estimator in (("elements", reference), ("lobes", pndf)):
            values = estimator.eval(m, footprint_of(pndf, uv, width)).numpy()
            panels.append(values.reshape(res, points, res, points).mean(axis=(1, 3)))
            row = {
                "sample": name, "width": width, "method": method,
                "relative_l1": truth.relative_l1(panels[-1]), "noise": truth.noise_floor,
            }  # fmt: skip
            rows.append(row)
            print(
                f"  {width} texels, {method}: relative L1 {row['relative_l1']:.3f} to the binned "
                f"P-NDF, whose noise is {row['noise']:.3f}"
            )
        if folder:
            peak = max(panel.max() for panel in panels)
            picture = [colour_map((panel[::-1] / peak) ** 0.5) for panel in panels]
            picture = np.concatenate(picture, axis=1).repeat(4, axis=0).repeat(4, axis=1)
            mi.util.write_bitmap(
                str(folder / f"mip_pndf_{name}_{width}.png"), picture.astype(np.float32)
            )
    return rows


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--quick", action="store_true", help="one sample, made 1024²")
    parser.add_argument("--repetitions", type=int, default=5)
    parser.add_argument("-o", "--output", type=Path, help="directory for JSON and pictures")
    options = parser.parse_args()
    if options.output:
        options.output.mkdir(parents=True, exist_ok=True)

    samples = {"isotropic": maps.isotropic(256, seed=3), "scratched": maps.scratched(256, seed=3)}
    if options.quick:
        del samples["scratched"]
    size = 1024 if options.quick else 2048
    results = {"clusters": [], "scale": [], "interpolation": [], "binning": []}
    for name, sample in samples.items():
        make = {"normal_map": sample, "output_size": size, "sigma_r": SIGMA_R}
        lobes = {f"k = {k}": Mip(**make, clusters=k) for k in CLUSTERS}
        reference = Elements(lobes["k = 32"].normal_map, sigma_r=SIGMA_R, step=0.5)
        print(f"{name}: {lobes['k = 32']}\n{reference}")
        results["clusters"] += compare(name, lobes, reference, WIDTHS, options.repetitions)
        scaled = {f"C_P = {c}": Mip(**make, lod_scale=c) for c in SCALES}
        results["scale"] += compare(name, scaled, reference, (32, 64, 128), options.repetitions)
        jumps = largest_jumps(
            {"blended": lobes["k = 32"], "nearest": NearestLevel(**make)}, reference
        )
        results["interpolation"].append({"sample": name, **jumps})
        print(f"  largest change while the footprint grows by 1 %: {jumps}")
        results["binning"] += binning(lobes["k = 32"], reference, options.output, name)
    if options.output:
        about = {"machine": platform.processor() or platform.machine(),
                 "mitsuba": mi.__version__, "drjit": dr.__version__,
                 "glintbsdf": glintbsdf.__version__}  # fmt: skip
        path = options.output / "mip_lobes.json"
        path.write_text(json.dumps({**about, "results": results}, indent=1) + "\n")


if __name__ == "__main__":
    main()
