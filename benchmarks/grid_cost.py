"""Time of whole renders with glint_grid relative to roughconductor.

``python benchmarks/grid_cost.py [-o RESULT.json]``

A plane fills a picture of 400², 16 samples per pixel, stock ``path``, seen along its normal and
at 10° to it, from two distances. All materials render in turn within every repetition, after a
first frame that compiles; figures are medians, and ratios are taken within a repetition. Expected:
at most 1.5 along the normal and 3 at 10°, whatever the distance and density.
"""

from __future__ import annotations

import argparse
import math
from functools import partial
from pathlib import Path

import mitsuba as mi
import numpy as np

import glintbsdf  # noqa: F401  (registers the plugins)

mi.set_variant("llvm_ad_rgb")

from _common import ratios_to_first, save_results, seconds, seconds_in_turn  # noqa: E402

SIZE, SPP, FOV = 400, 16, 30.0
GLINTS = {
    "type": "glint_grid",
    "material": "Al",
    "pixel_spread": math.radians(FOV) / SIZE / SPP**0.5,
}
MATERIALS = {
    "roughconductor": {
        "type": "roughconductor",
        "distribution": "beckmann",
        "alpha": 0.3,
        "material": "Al",
    },
    "density 4": {**GLINTS, "density": 4.0},
    "density 8": GLINTS,
    "density 12": {**GLINTS, "density": 12.0},
    "wheel": {**GLINTS, "colors": "wheel"},
    "grooves": {**GLINTS, "detail_alpha_u": 0.3},
    "equal sizes": {**GLINTS, "size_variation": 0.0},
}


def scene(bsdf: dict, elevation: float, distance: float) -> mi.Scene:
    """The plane z = 0 seen from ``elevation`` degrees above it, under a sky and a small lamp."""
    angle = math.radians(elevation)
    origin = [0, -distance * math.cos(angle), distance * math.sin(angle)]
    camera = mi.ScalarTransform4f().look_at(origin, [0, 0, 0], [0, math.sin(angle), 1])
    sky = np.full((64, 128, 3), 0.5, np.float32)
    return mi.load_dict({
        "type": "scene", "integrator": {"type": "path", "max_depth": 4},
        "sensor": {"type": "perspective", "fov": FOV, "to_world": camera,
                   "film": {"type": "hdrfilm", "width": SIZE, "height": SIZE},
                   "sampler": {"type": "independent", "sample_count": SPP}},
        "sky": {"type": "envmap", "bitmap": mi.Bitmap(sky)},
        "lamp": {"type": "sphere", "center": [1, 1, 3], "radius": 0.1,
                 "emitter": {"type": "area", "radiance": {"type": "rgb", "value": 50.0}}},
        "plane": {"type": "rectangle", "to_world": mi.ScalarTransform4f().scale([500, 500, 1]),
                  "bsdf": {**bsdf, **({"to_uv": mi.ScalarTransform4f().scale([1000, 1000, 1])}
                                      if bsdf["type"] == "glint_grid" else {})}},
    })  # fmt: skip


def frame(scene: mi.Scene, seed: int) -> mi.TensorXf:
    return mi.render(scene, seed=seed)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--repetitions", type=int, default=5)
    parser.add_argument("-o", "--output", type=Path, help="JSON file to write")
    options = parser.parse_args()
    results = []
    print("elevation  distance  material        first frame   frame (s)   × roughconductor")
    for elevation in (90, 10):
        for distance in (1.0, 30.0):
            scenes = {k: scene(bsdf, elevation, distance) for k, bsdf in MATERIALS.items()}
            first = {name: seconds(frame, s, 0) for name, s in scenes.items()}
            times = seconds_in_turn(
                [partial(frame, s) for s in scenes.values()], options.repetitions
            )
            for name, taken, ratio in zip(
                scenes, np.median(times, axis=0), ratios_to_first(times), strict=True
            ):
                row = {
                    "elevation": elevation,
                    "distance": distance,
                    "material": name,
                    "first_frame": first[name],
                    "frame": float(taken),
                    "ratio": float(ratio),
                }
                results.append(row)
                print(f"{elevation:8}° {distance:9} {name:15} {row['first_frame']:10.2f} s"
                      f" {row['frame']:11.3f} {row['ratio']:18.2f}")  # fmt: skip
    if options.output:
        save_results(
            options.output, {"bytes": mi.load_dict(GLINTS).pndf.nbytes, "results": results}
        )


if __name__ == "__main__":
    main()
