"""Error and time of the paper's clusters against τ, and of tables against ``max_error`` (Wu24).

``python benchmarks/clusters.py [queries] [renders] [kernels] [--quick] [-o FOLDER]``

``queries`` (Tables 2 and 3): four maps of 1024², footprints of 64², 128² and 256² texels, which is
(6σ)², a radius r of 32, 64 and 128. The error is the relative L1 difference to the exact P-NDF over
128² bins, mean of two places on the map. Of clusters: 4 million stratified places under the
footprint, whose normals in both are counted by bin, which the exact samplers allow; exact against
exact is 0. Of tables: over all bins exactly, beside what they predict. Times are those of random
queries, normals drawn from the exact P-NDF, all methods in turn within every repetition, after a
warm-up that compiles, on one thread; printed is the median of the ratios to exact. The picture has
error over ratio, one panel a footprint, one colour a map. Expected before measuring: the exact
lists visit few triangles in vain, so that clusters save less than the paper's 6 to 16 times, which
are against a tree: two to five times, at errors of 0.1 to 0.5 on rough maps, and of less than 0.05
on the smooth one; tables save 10 to 40 times at an error of 0.05.

Measured at 128² texels: clusters 2.9 times at 0.22 on the isotropic map, 2.8 times at 0.13 on the
scratched one, none up to τ = 1 on the brushed one; tables 20, 37 and 8 times at 0.006 to 0.026. Our
residuals are integrals in texels⁴, the paper's those of its normal equations: its τ is another
number. With its own residuals and τ = 0.004, the authors' code errs by 0.26 to 0.73.

``renders`` (Fig. 15, Table 3): the curved patch with scratches, 64² texels a footprint: root mean
square error against the exact render of another seed, both clipped to [0, 1], relative to the mean,
and the time over the exact one's; the row "exact" is the noise. Expected: errors grow with τ, as in
the paper; those of tables stay within the noise. Measured with ``--quick``: all are within the
noise of its 16 samples; τ = 1 takes 0.54 of the time, tables with ``max_error`` 0.05 take 0.25.

``kernels`` (Fig. 16): the isotropic map with the Gaussian at 128² texels and with the disk and the
box, which reach half as far at the same σ: 64². Expected: half the time; the same look.

Pictures: ``clusters.png``, ``renders.png`` (exact, then in the order printed), ``kernels.png``.
"""

from __future__ import annotations

import argparse
import copy
import os
import time
from functools import partial
from pathlib import Path

os.environ["GLINTBSDF_CACHE"] = "off"  # the build is timed

import drjit as dr
import matplotlib.pyplot as plt
import mitsuba as mi
import numpy as np

import glintbsdf  # noqa: F401  (registers the plugins)

mi.set_variant("llvm_ad_rgb")

from _common import (  # noqa: E402
    ratios_to_first,
    rmse,
    save_pictures,
    save_results,
    seconds,
    seconds_in_turn,
)
from curved_patch import UV_SCALE, curved_patch  # noqa: E402

from glintbsdf import maps  # noqa: E402
from glintbsdf.footprint.gaussian import Footprint  # noqa: E402
from glintbsdf.footprint.kernels import KERNELS  # noqa: E402
from glintbsdf.pndf import ClusteredManifold, Manifold, TabulatedManifold  # noqa: E402
from glintbsdf.scene.rendering import pixel_angle  # noqa: E402

RADII = (32, 64, 128)
THRESHOLDS = (1e-2, 1e-1, 1.0, 10.0)
MAX_ERRORS = (0.02, 0.05, 0.2)
PLACES = ((0.37, 0.61), (0.81, 0.22))
RES = 128

#: Samples per axis of the footprint.
SAMPLES = 2048

#: Queries timed, by radius: about a tenth of a second of the exact method.
QUERIES = {32: 2**13, 64: 2**12, 128: 2**11}

MAPS = {
    "isotropic": maps.isotropic,
    "brushed": maps.brushed,
    "scratched": maps.scratched,
    "smooth": partial(maps.isotropic, correlation_length=48),
}


# --------------------------------------------------------------------------------------------------
#  Tables 2 and 3: queries
# --------------------------------------------------------------------------------------------------


def binned(pndf, footprint, u):
    """Mass per bin: the normals at places drawn from the kernel, by the exact sampler."""
    lower, upper = pndf.bounds()
    m = np.array(pndf.sample(footprint, 0.0, u)).T
    column, row = np.clip((m - lower) * (RES / (upper - lower)), 0, RES - 1).astype(np.int64).T
    return np.bincount(row * RES + column, minlength=RES**2) / len(m)


def errors(exact, methods, radius, size):
    """Relative L1 error of each method, mean over :data:`PLACES`, and what it predicts, or None."""
    row, column = np.indices((SAMPLES, SAMPLES))
    jitter = np.random.default_rng(1).random((2, SAMPLES, SAMPLES))
    u = ((np.stack([column, row]) + jitter) / SAMPLES).reshape(2, -1).astype(np.float32)
    u = mi.Point2f(np.minimum(u, np.float32(1 - 2**-24)))
    sigma = dr.opaque(mi.Float, radius / 3 / size)
    found, predicted = {name: [] for name in methods}, dict.fromkeys(methods)
    for uv in PLACES:
        footprint = Footprint.isotropic(mi.Point2f(uv), sigma)
        reference = binned(exact, footprint, u)
        for name, pndf in methods.items():
            if isinstance(pndf, TabulatedManifold):
                level = int(pndf.level(footprint)[0])
                used = level >= 0
                found[name].append(pndf.measured_error(footprint) if used else 0)
                kernel = pndf.texel_kernel(footprint)
                predicted[name] = float(pndf.error(kernel, level)[0]) if used else 0.0
            else:
                found[name].append(np.abs(binned(pndf, footprint, u) - reference).sum())
    return {name: float(np.mean(e)) for name, e in found.items()}, predicted


def times(exact, methods, radius, size, repetitions):
    """Median ratio of exact to each method, and microseconds per exact query."""
    count = QUERIES[radius]
    u = np.random.default_rng(2).random((4, count), dtype=np.float32)
    sigma = dr.opaque(mi.Float, radius / 3 / size)
    footprint = Footprint.isotropic(mi.Point2f(u[:2]), sigma)
    m = exact.sample(footprint, 0.0, mi.Point2f(u[2:]))
    dr.eval(m)
    works = [lambda _, pndf=pndf: pndf.eval(m, footprint) for pndf in (exact, *methods.values())]
    seconds_in_turn(works, 1)
    taken = seconds_in_turn(works, repetitions)
    ratios = dict(zip(methods, 1 / ratios_to_first(taken)[1:], strict=True))
    return ratios, 1e6 * float(np.median(taken[:, 0])) / count


def queries(options: argparse.Namespace) -> list[dict]:
    names = ("isotropic", "scratched") if options.quick else tuple(MAPS)
    cases = {name: MAPS[name](options.size, seed=1) for name in names}
    cases |= {path.name: glintbsdf.NormalMap.load(path) for path in options.map}
    threads = dr.thread_count()
    results = []
    for name, normal_map in cases.items():
        dr.set_thread_count(threads)
        exact, methods, build = Manifold(normal_map), {}, {}
        for threshold in THRESHOLDS:
            start = time.perf_counter()
            methods[f"τ = {threshold:g}"] = ClusteredManifold(normal_map, threshold)
            build[f"τ = {threshold:g}"] = time.perf_counter() - start
        start = time.perf_counter()
        tables = TabulatedManifold(normal_map, max_error=MAX_ERRORS[0])
        for max_error in MAX_ERRORS:
            pndf = copy.copy(tables)  # of the same tables
            pndf.max_error = max_error
            methods[f"max_error = {max_error:g}"] = pndf
            build[f"max_error = {max_error:g}"] = time.perf_counter() - start
        print(f"\n{name}: {exact}")
        for method, pndf in methods.items():
            print(
                f"  {method:17} built in {build[method]:.1f} s (exact lists included),"
                f" {(pndf.nbytes - exact.nbytes) / 1e6:.1f} MB more"
            )
        print("  footprint  method             relative L1   predicted   × exact    exact (µs)")
        for radius in RADII[:1] if options.quick else RADII:
            size = normal_map.width
            error, predicted = errors(exact, methods, radius, size)
            dr.set_thread_count(1)
            ratio, exact_time = times(exact, methods, radius, size, options.repetitions)
            dr.set_thread_count(threads)
            for method, pndf in methods.items():
                row = {
                    "map": name,
                    "radius": radius,
                    "method": method,
                    "relative_l1": error[method],
                    "predicted": predicted[method],
                    "ratio_to_exact": float(ratio[method]),
                    "exact_microseconds": exact_time,
                    "build_seconds": build[method],
                    "bytes": pndf.nbytes,
                    "bytes_exact": exact.nbytes,
                }
                results.append(row)
                said = "" if row["predicted"] is None else f"{row['predicted']:.4f}"
                print(
                    f"  {2 * radius:>3}²       {method:18} {error[method]:<13.4f} {said:11}"
                    f" {ratio[method]:<10.2f} {exact_time:.1f}",
                    flush=True,
                )
    if options.output:
        plot(options.output / "clusters.png", results)
    return results


def plot(path: Path, results: list[dict]) -> None:
    """Error over speed-up, for each footprint; filled marks are clusters, hollow ones tables."""
    radii = sorted({row["radius"] for row in results})
    figure, panels = plt.subplots(
        1, len(radii), figsize=(5 * len(radii), 4), squeeze=False, sharey=True, layout="constrained"
    )
    for panel, radius in zip(panels[0], radii, strict=True):
        for colour, name in enumerate(dict.fromkeys(row["map"] for row in results)):
            for kind, style in (("τ", "o-"), ("max_error", "s--")):
                rows = [
                    row
                    for row in results
                    if (row["map"], row["radius"]) == (name, radius)
                    and row["method"].startswith(kind)
                    and row["relative_l1"] > 0
                ]
                panel.plot(
                    [row["ratio_to_exact"] for row in rows],
                    [row["relative_l1"] for row in rows],
                    style,
                    color=f"C{colour}",
                    markerfacecolor=f"C{colour}" if kind == "τ" else "none",
                    label=f"{name}, {kind}",
                )
        panel.set(xscale="log", yscale="log", title=f"{2 * radius}² texels")
        panel.set(xlabel="times as fast as exact lists", ylabel="relative L1 error")
        panel.grid(alpha=0.3)
    figure.legend(*panels[0, 0].get_legend_handles_labels(), loc="outside right upper")
    path.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(path, dpi=110)
    plt.close(figure)


# --------------------------------------------------------------------------------------------------
#  Figs. 15 and 16: renders
# --------------------------------------------------------------------------------------------------


def spread_for(radius: float, texels: int, size: int) -> float:
    """The ``pixel_spread`` with which footprints on the curved patch have this radius, 3σ (texels).

    σ is half a pixel; the radius is the geometric mean of both axes, its median over the patch.
    """
    scene = curved_patch({"type": "diffuse"}, size, 1)
    sensor = scene.sensors()[0]
    place = (np.mgrid[:size, :size].reshape(2, -1) + 0.5) / size
    ray, _ = sensor.sample_ray_differential(0, 0.5, mi.Point2f(np.float32(place)), 0.5)
    si = scene.ray_intersect(ray)
    si.compute_uv_partials(ray)
    area = np.abs(np.array(si.duv_dx.x * si.duv_dy.y - si.duv_dx.y * si.duv_dy.x))
    area = area[np.array(si.is_valid()) & (area > 0)]
    seen = 3 * 0.5 * texels * UV_SCALE * np.sqrt(np.median(area))
    return radius / seen * pixel_angle(sensor)


def render_all(materials: dict[str, dict], options: argparse.Namespace) -> tuple[dict, dict]:
    """Pictures of the curved patch by material, and the ratio of their times to the first one's."""
    first = next(iter(materials.values()))
    pairs = {name: render_pair(first, material, options) for name, material in materials.items()}
    return tuple({name: pair[k] for name, pair in pairs.items()} for k in (0, 1))


def render_pair(first: dict, material: dict, options: argparse.Namespace):
    """The picture with ``material``, and the ratio of its time to that with ``first``.

    No other material is alive meanwhile: Dr.Jit compiles all there are into every frame.
    """
    size, spp = frame_of(options)
    scenes = [curved_patch(m, size, spp) for m in (first, material)]
    frames = [lambda seed, s=s: mi.render(s, spp=spp, seed=seed) for s in scenes]
    for frame in frames:
        seconds(frame, 0)
    ratios = ratios_to_first(seconds_in_turn(frames, 1 if options.quick else 3))
    return seen(frames[1](1)), float(ratios[1])


def frame_of(options: argparse.Namespace) -> tuple[int, int]:
    """Width of a picture in pixels, and samples per pixel."""
    return (96, 16) if options.quick else (192, 64)


def seen(image: mi.TensorXf) -> np.ndarray:
    """What a screen shows: the brightest glints would outweigh all else in a mean square."""
    return np.clip(np.array(image), 0, 1)


def glints(normal_map, spread: float, **parameters) -> dict:
    return {
        "type": "glint_manifold",
        "data": mi.TensorXf(normal_map.normals),
        "to_uv": mi.ScalarTransform4f().scale(UV_SCALE),
        "material": "Cr",
        "pixel_spread": spread,
        "masking": "beckmann",
        **parameters,
    }


def renders(options: argparse.Namespace) -> list[dict]:
    normal_map = MAPS["scratched"](options.size, seed=1)
    spread = spread_for(32, options.size, 96)
    material = partial(glints, normal_map, spread)
    materials = {"exact": material()}
    materials |= {f"τ = {t:g}": material(threshold=t) for t in THRESHOLDS}
    materials |= {f"max_error = {e:g}": material(max_error=e) for e in MAX_ERRORS}
    images, ratios = render_all(materials, options)
    size, spp = frame_of(options)
    reference = seen(mi.render(curved_patch(materials["exact"], size, spp), spp=spp, seed=99))
    results = []
    print("method             RMSE / mean   time / exact")
    for name, image in images.items():
        error = rmse(image, reference) / float(reference.mean())
        results.append({"method": name, "rmse": error, "ratio": ratios[name]})
        print(f"{name:17} {error:12.4f} {ratios[name]:14.2f}", flush=True)
    if options.output:
        pictures = list(images.values())
        save_pictures(options.output / "renders.png", [pictures[:4], pictures[4:]])
    return results


def kernels(options: argparse.Namespace) -> list[dict]:
    normal_map = MAPS["isotropic"](options.size, seed=1)
    spread = spread_for(64, options.size, 96)
    images, ratios = render_all(
        {kernel: glints(normal_map, spread, kernel=kernel) for kernel in KERNELS}, options
    )
    results = []
    print("kernel        time / gaussian   RMSE from gaussian / mean")
    for name, image in images.items():
        error = rmse(image, images["gaussian"]) / float(images["gaussian"].mean())
        results.append({"kernel": name, "rmse": error, "ratio": ratios[name]})
        print(f"{name:12} {ratios[name]:16.2f} {error:26.4f}", flush=True)
    if options.output:
        save_pictures(options.output / "kernels.png", [list(images.values())])
    return results


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parts = {"queries": queries, "renders": renders, "kernels": kernels}
    parser.add_argument("parts", nargs="*", metavar="PART", help="queries, renders, kernels (all)")
    parser.add_argument("--map", type=Path, action="append", default=[], help="a further map")
    parser.add_argument("--size", type=int, default=1024, help="of the procedural maps, texels")
    parser.add_argument("--quick", action="store_true", help="few maps, footprints and pixels")
    parser.add_argument("--repetitions", type=int, default=5)
    parser.add_argument("-o", "--output", type=Path, help="folder for JSON and pictures")
    options = parser.parse_args()
    unknown = set(options.parts) - set(parts)
    if unknown:
        parser.error(f"unknown part {', '.join(sorted(unknown))}; known are {', '.join(parts)}")
    results = {}
    for part in options.parts or parts:
        print(f"\n{part}")
        results[part] = parts[part](options)
    if options.output:
        save_results(options.output / "clusters.json", results)


if __name__ == "__main__":
    main()
