"""Whole renders of the curved patch: the filters of glint_filtered against roughconductor.

``python benchmarks/filtered_cost.py [--pixels 0.0625 1 4] [--max-anisotropy 16] [-o RESULT.json]``

400², 16 spp, stock ``path``. A footprint of f pixels is a ``pixel_spread`` of f times a pixel's
angle. ``roughconductor`` is as rough as the map. All materials render in turn in every repetition,
after a first frame that compiles; the figures are medians of the ratio to ``roughconductor``
within the same repetition. Building the MIP chain and compiling are timed apart. Expected before
measuring: 1.2 × for footprints of up to a pixel, more for stretched ones by their lookups.
"""

from __future__ import annotations

import argparse
import time
from functools import partial
from pathlib import Path

import mitsuba as mi
import numpy as np

import glintbsdf

mi.set_variant("llvm_ad_rgb")

from _common import ratios_to_first, save_results, seconds, seconds_in_turn  # noqa: E402
from curved_patch import MAP, UV_SCALE, curved_patch  # noqa: E402

from glintbsdf.pndf.filters.filters import METHODS  # noqa: E402
from glintbsdf.scene.rendering import pixel_angle  # noqa: E402


def frame(scene: mi.Scene, spp: int, seed: int) -> mi.TensorXf:
    return mi.render(scene, spp=spp, seed=seed)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--pixels", type=float, nargs="+", default=[0.0625, 1, 4])
    parser.add_argument("--methods", nargs="+", default=list(METHODS), choices=list(METHODS))
    parser.add_argument("--max-anisotropy", type=float, default=16.0)
    parser.add_argument("--size", type=int, default=400)
    parser.add_argument("--spp", type=int, default=16)
    parser.add_argument("--repetitions", type=int, default=7)
    parser.add_argument("-o", "--output", type=Path, help="JSON file to write")
    options = parser.parse_args()

    alpha_u, alpha_v = glintbsdf.NormalMap.load(MAP).roughness()
    rough = {"type": "roughconductor", "material": "Cr", "alpha_u": alpha_u, "alpha_v": alpha_v}
    rough = curved_patch(rough, options.size, options.spp)
    angle = pixel_angle(rough.sensors()[0])
    seconds(frame, rough, options.spp, 0)
    results = []
    print("footprint   method      × roughconductor   milliseconds   building   first frame")
    for pixels in options.pixels:
        scenes, building, first = {"roughconductor": rough}, {}, {}
        for method in options.methods:
            start = time.perf_counter()
            scenes[method] = curved_patch(
                {
                    "type": "glint_filtered",
                    "method": method,
                    "filename": str(MAP),
                    "to_uv": mi.ScalarTransform4f().scale(UV_SCALE),
                    "material": "Cr",
                    "max_anisotropy": options.max_anisotropy,
                    "pixel_spread": pixels * angle,
                },
                options.size,
                options.spp,
            )
            building[method] = time.perf_counter() - start
            first[method] = seconds(frame, scenes[method], options.spp, 0)
        frames = [partial(frame, scene, options.spp) for scene in scenes.values()]
        times = seconds_in_turn(frames, options.repetitions)
        ratios = ratios_to_first(times)[1:]
        for method, ratio, taken in zip(
            options.methods, ratios, np.median(times, axis=0)[1:], strict=True
        ):
            print(
                f"{pixels:9.4f}   {method:9} {ratio:18.2f} {1e3 * taken:14.0f}"
                f" {building[method]:8.2f} s {first[method]:11.2f} s",
                flush=True,
            )
            results.append(
                {
                    "pixels": pixels,
                    "method": method,
                    "ratio": float(ratio),
                    "seconds": float(taken),
                    "seconds_building": building[method],
                    "seconds_first_frame": first[method],
                }
            )
    if options.output:
        save_results(
            options.output,
            {
                "size": options.size,
                "spp": options.spp,
                "max_anisotropy": options.max_anisotropy,
                "results": results,
            },
        )


if __name__ == "__main__":
    main()
