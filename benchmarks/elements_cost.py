"""Whole renders of the curved patch: glint_elements against roughconductor; building; memory.

``python benchmarks/elements_cost.py [--pixels 0.0625 1] [--skip-building] [-o RESULT.json]``

400², 16 spp, stock ``path``. A footprint of f pixels is a ``pixel_spread`` of f times a pixel's
angle. ``roughconductor`` is as rough as the map. All materials render in turn in every repetition,
after a first frame that compiles; the figures are medians of the ratio to ``roughconductor``
within the same repetition. Then a map of 2048² is built, without the cache: time, and memory
beside the paper's 720 MB of elements and 400 MB of hierarchy at h = ½, a quarter of that at h = 1.

Expected before measuring: 1.4 × at 1/16 pixel (the paper's figure for its kettle), 6 × at 1 pixel;
500 MB and half a minute of building at h = ½.
"""

from __future__ import annotations

import argparse
import os
import time
from functools import partial
from pathlib import Path

os.environ["GLINTBSDF_CACHE"] = "off"  # building is timed

import mitsuba as mi
import numpy as np

import glintbsdf

mi.set_variant("llvm_ad_rgb")

from _common import ratios_to_first, save_results, seconds, seconds_in_turn  # noqa: E402
from curved_patch import MAP, UV_SCALE, curved_patch  # noqa: E402

from glintbsdf.pndf import Elements  # noqa: E402
from glintbsdf.scene.rendering import pixel_angle  # noqa: E402

#: Megabytes that the paper's elements and hierarchy take for 2048², by step.
PAPER = {0.5: 1120, 1.0: 280}


def frame(scene: mi.Scene, spp: int, seed: int) -> mi.TensorXf:
    return mi.render(scene, spp=spp, seed=seed)


def render(options: argparse.Namespace) -> list[dict]:
    alpha_u, alpha_v = glintbsdf.NormalMap.load(MAP).roughness()
    rough = {"type": "roughconductor", "material": "Cr", "alpha_u": alpha_u, "alpha_v": alpha_v}
    rough = curved_patch(rough, options.size, options.spp)
    angle = pixel_angle(rough.sensors()[0])
    seconds(frame, rough, options.spp, 0)
    results = []
    print("footprint   step   × roughconductor   seconds   first frame")
    for pixels in options.pixels:
        scenes, first = {"roughconductor": rough}, {}
        for step in options.steps:
            scenes[step] = curved_patch(
                {
                    "type": "glint_elements",
                    "filename": str(MAP),
                    "to_uv": mi.ScalarTransform4f().scale([UV_SCALE, UV_SCALE, 1]),
                    "material": "Cr",
                    "step": step,
                    "pixel_spread": pixels * angle,
                },
                options.size,
                options.spp,
            )
            first[step] = seconds(frame, scenes[step], options.spp, 0)
        times = seconds_in_turn(
            [partial(frame, scene, options.spp) for scene in scenes.values()], options.repetitions
        )
        for k, step in enumerate(options.steps, 1):
            ratio, median = float(ratios_to_first(times)[k]), float(np.median(times[:, k]))
            print(
                f"{pixels:7.4f} px {step:6g} {ratio:15.2f} {median:13.3f} {first[step]:13.2f}",
                flush=True,
            )
            results.append(
                {
                    "pixels": pixels,
                    "step": step,
                    "ratio": ratio,
                    "seconds": median,
                    "seconds_roughconductor": float(np.median(times[:, 0])),
                    "seconds_first_frame": first[step],
                }
            )
    return results


def build(size: int) -> list[dict]:
    normal_map = glintbsdf.maps.isotropic(size, seed=1)
    results = []
    for step, paper in PAPER.items():
        start = time.perf_counter()
        pndf = Elements(normal_map, step=step)
        elapsed = time.perf_counter() - start
        texels, lists = pndf.element_bytes / 1e6, pndf.lists.nbytes / 1e6
        allowed = paper * (size / 2048) ** 2
        print(
            f"{size}² at h = {step:g}: built in {elapsed:.1f} s; {texels:.0f} MB + {lists:.0f} MB, "
            f"{(texels + lists) / allowed:.2f} × the paper's {allowed:.0f} MB"
        )
        results.append(
            {"size": size, "step": step, "seconds": elapsed, "texels_mb": texels, "lists_mb": lists}
        )
    return results


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--pixels", type=float, nargs="+", default=[0.0625, 1])
    parser.add_argument("--steps", type=float, nargs="+", default=[0.5, 1])
    parser.add_argument("--size", type=int, default=400)
    parser.add_argument("--spp", type=int, default=16)
    parser.add_argument("--repetitions", type=int, default=5)
    parser.add_argument("--build-size", type=int, default=2048)
    parser.add_argument("--skip-building", action="store_true")
    parser.add_argument("-o", "--output", type=Path, help="JSON file to write")
    options = parser.parse_args()

    results = {"renders": render(options)}
    if not options.skip_building:
        results["building"] = build(options.build_size)
    if options.output:
        save_results(options.output, {"spp": options.spp, "size": options.size, **results})


if __name__ == "__main__":
    main()
