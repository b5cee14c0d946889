"""Storage, time and seams of the maps that glint_mip synthesises.

``python benchmarks/mip_synthesis.py [--quick] [-o DIRECTORY]``

Table 2 of Tan22: the memory of lobes and look-up table for a sample of 256² texels made 4096² (the
paper: 27.4 MB), and 512² made 7168² (75.8 MB); with the time that it takes to build them, the cache
being off. Then the seams: the squared difference (Eq. 7) of neighbouring texels of the map in the
overlaps, over that inside of patches, mean and 99th percentile; and that of the texels on either
side of a cut. And how much of the map repeats: the autocorrelation of its normals at its highest,
half a patch to four patches away, and the largest share of cells that show the same patch. With -o,
pictures of the maps.

Expected before measuring: 24 and 60 MB, 15 and 60 seconds (the paper takes 10 to 35 minutes). Seams
of rough samples no rougher than inside; of smooth ones several times, with two texels of overlap,
as two patches agree along 64 texels by chance only, and less than twice with six. Measured, mean
for overlaps of 2, 6 and 12 texels: isotropic 2.8, 1.6 and 1.3, scratched 1.6, 1.5 and 1.1, leather,
flakes and brushed 1.2 to 1.5, 1.1 to 1.3 and 0.9 to 1.2; 22.4 and 72.9 MB, 13 and 51 seconds.
Choosing patches by the error of the cut itself, or among 25 times as many, changes the seams by
less than a tenth.
"""

from __future__ import annotations

import argparse
import json
import os
import platform
import time
from pathlib import Path

os.environ["GLINTBSDF_CACHE"] = "off"  # the build is timed

import mitsuba as mi
import numpy as np

import glintbsdf

mi.set_variant("llvm_ad_rgb")

from glintbsdf import NormalMap, maps  # noqa: E402
from glintbsdf.maps.quilting import lobe_features, synthesise  # noqa: E402
from glintbsdf.pndf import Mip  # noqa: E402


def white_noise(size: int) -> NormalMap:
    """Texels without any relation to their neighbours."""
    normals = np.random.default_rng(0).uniform(-0.3, 0.3, (size, size, 2))
    return NormalMap(normals.astype(np.float32))


def storage(sample: int, size: int, patch: int) -> dict:
    """Memory and time of a map."""
    normal_map = maps.isotropic(sample, seed=3)
    start, start_cpu = time.perf_counter(), time.process_time()
    pndf = Mip(normal_map, output_size=size, patch_size=patch)
    seconds, cpu_seconds = time.perf_counter() - start, time.process_time() - start_cpu
    table = pndf.grids.nbytes
    row = {
        "sample": sample, "size": size, "patch": patch,
        "seconds": seconds, "cpu_seconds": cpu_seconds,
        "bytes": pndf.nbytes, "bytes_table": table, "bytes_lobes": pndf.nbytes - table,
    }  # fmt: skip
    print(
        f"{sample}² → {size}², patches of {patch}²: lobes {row['bytes_lobes'] / 1e6:.1f} MB, "
        f"look-up table {table / 1e6:.1f} MB, together {pndf.nbytes / 1e6:.1f} MB, in "
        f"{seconds:.1f} s ({cpu_seconds:.1f} s of CPU time)",
        flush=True,
    )
    return row


def seams(name: str, sample: NormalMap, size: int, patch: int, overlap: int, folder) -> dict:
    """Roughness across overlaps and cuts over that inside, and repetition."""
    synthesis = synthesise(sample, size, patch, overlap)
    normals = synthesis.explicit()
    features = lobe_features(normals, 0.9)
    index = np.arange(size)
    source = np.concatenate(
        [synthesis.source(*np.broadcast_arrays(y[:, None], index)) for y in np.split(index, 8)]
    )
    across, cut, inside = [], [], []
    for axis in (0, 1):
        difference = ((features - np.roll(features, 1, axis)) ** 2).sum(axis=2)
        place = (synthesis.starts[:-1, None] + np.arange(overlap + 1)) % size
        in_overlap = np.isin(index, place)
        step = sample.width if axis == 0 else 1
        cut.append(difference[source - np.roll(source, 1, axis) != step])
        difference = np.moveaxis(difference, axis, 0)
        across.append(difference[in_overlap].ravel())
        inside.append(difference[~in_overlap].ravel())
    across, cut, inside = (np.concatenate(v) for v in (across, cut, inside))
    row = {
        "sample": name, "patch": patch, "overlap": overlap,
        "mean": across.mean() / inside.mean(),
        "99 %": np.percentile(across, 99) / np.percentile(inside, 99),
        "cut": cut.mean() / inside.mean(),
        "repetition": repetition(normals, patch),
        "best_only": synthesis.best_only / synthesis.patch.size,
        "most_frequent_patch": np.bincount(synthesis.patch.ravel()).max() / synthesis.patch.size,
    }  # fmt: skip
    row = {key: v if isinstance(v, str | int) else float(v) for key, v in row.items()}
    print(
        f"  {name:<12} {patch:<6} {overlap:<8} {row['mean']:<7.2f} "
        f"{row['99 %']:<7.2f} {row['cut']:<7.2f} {row['repetition']:<11.3f} "
        f"{row['best_only']:<10.2f} {row['most_frequent_patch']:.3f}",
        flush=True,
    )
    if folder:
        z = np.sqrt(1 - (normals**2).sum(axis=2, keepdims=True))
        shown = np.concatenate((0.5 + normals, z), axis=2)[:768, :768]
        path = folder / f"mip_map_{name}_{patch}_{overlap}.png"
        mi.util.write_bitmap(str(path), np.clip(shown, 0, 1).astype(np.float32))
    return row


def repetition(normals: np.ndarray, patch: int) -> float:
    """The highest autocorrelation of a map at distances from half a patch to four patches."""
    spectrum = np.fft.rfft2(normals - normals.mean(axis=(0, 1)), axes=(0, 1))
    correlation = np.fft.irfft2((np.abs(spectrum) ** 2).sum(axis=2), s=normals.shape[:2])
    shift = np.minimum(np.arange(len(normals)), len(normals) - np.arange(len(normals)))
    distance = np.maximum(shift[:, None], shift)
    near = (distance > patch / 2) & (distance < 4 * patch)
    return float(correlation[near].max() / correlation[0, 0])


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--quick", action="store_true", help="one map, seams of smaller ones")
    parser.add_argument("-o", "--output", type=Path, help="directory for JSON and pictures")
    options = parser.parse_args()
    if options.output:
        options.output.mkdir(parents=True, exist_ok=True)
    results = {"storage": [storage(256, 4096, 64)], "seams": []}
    if not options.quick:
        results["storage"].append(storage(512, 7168, 64))
    samples = {
        "isotropic": maps.isotropic(256, seed=3),
        "leather": maps.leather(256, seed=3),
        "brushed": maps.brushed(256, seed=3),
        "scratched": maps.scratched(256, seed=3),
        "flakes": maps.flakes(256, seed=3),
        "noise": white_noise(256),
    }
    print(
        "  sample       patch  overlap  mean    99 %    cut     repetition  best only  "
        "most frequent patch"
    )
    sizes = ((64, 2), (64, 6)) if options.quick else ((64, 2), (64, 6), (64, 12), (128, 12))
    for name, sample in samples.items():
        for patch, overlap in sizes:
            size = 512 if options.quick else 1024
            results["seams"].append(seams(name, sample, size, patch, overlap, options.output))
    if options.output:
        about = {"machine": platform.processor() or platform.machine(),
                 "glintbsdf": glintbsdf.__version__}  # fmt: skip
        path = options.output / "mip_synthesis.json"
        path.write_text(json.dumps({**about, "results": results}, indent=1) + "\n")


if __name__ == "__main__":
    main()
