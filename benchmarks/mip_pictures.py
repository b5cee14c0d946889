"""Pictures of glint_mip beside those of glint_elements on the same explicit map.

``python benchmarks/mip_pictures.py [--size 160] [--spp 64] [-o DIRECTORY]``

A ball under three point lights, whose map of 1024² texels is made from a sample of 256², rendered
with: elements half a texel apart on the explicit map (the reference); k = 16, 32 and 64 clusters
(Fig. 13 of Tan22); 32 clusters without interpolation between levels (Fig. 14); and C_P = 0.25, 0.75
and 1 (Fig. 17). Every sample has the footprint of a whole pixel, so that images converge fast; the
ball repeats the map so often that pixels are some ten to some hundred texels wide. Printed are the
root mean square of the difference of tone-mapped images (sRGB) to the reference, that of two
references of different seeds, the noise, and the CPU time of a rendering, compilation apart.

Expected before measuring: differences of k = 32 two to three times the noise, smaller with k = 64,
largest for C_P = 1, which blurs; renderings several times faster than the reference.
"""

from __future__ import annotations

import argparse
import json
import time
from math import radians
from pathlib import Path

import drjit as dr
import mitsuba as mi
import numpy as np

import glintbsdf  # noqa: F401

mi.set_variant("llvm_ad_rgb")

from mip_lobes import NearestLevel  # noqa: E402

SAMPLE = Path(__file__).parents[1] / "scenes" / "maps" / "isotropic_sample.exr"
FIELD_OF_VIEW = 24
SETTINGS = {
    "k = 16": {"clusters": 16},
    "k = 32": {},
    "k = 64": {"clusters": 64},
    "k = 32, nearest level": {},
    "C_P = 0.25": {"lod_scale": 0.25},
    "C_P = 0.75": {"lod_scale": 0.75},
    "C_P = 1": {"lod_scale": 1.0},
}


def scene(options, bsdf: dict) -> mi.Scene:
    """The ball."""
    look_at = mi.ScalarTransform4f().look_at([0, 0, 5], [0, 0, 0], [0, 1, 0])
    lights = {
        f"light_{k}": {"type": "point", "position": place, "intensity": 15.0}
        for k, place in enumerate(([2, 3, 4], [-3, 1, 3], [0.5, -3, 3]))
    }
    film = {"type": "hdrfilm", "width": options.size, "height": options.size,
            "rfilter": {"type": "box"}}  # fmt: skip
    return mi.load_dict(
        {
            "type": "scene",
            "integrator": {"type": "direct"},
            "sensor": {
                "type": "perspective",
                "fov": FIELD_OF_VIEW,
                "to_world": look_at,
                "film": film,
                "sampler": {"type": "independent", "sample_count": options.spp},
            },  # fmt: skip
            "ball": {
                "type": "sphere",
                "to_world": mi.ScalarTransform4f().rotate([1, 0, 0], -70),
                "bsdf": {
                    **bsdf,
                    "to_uv": mi.ScalarTransform4f().scale([options.uv_scale, options.uv_scale, 1]),
                    "material": "Cu",
                    "sigma_r": options.sigma_r,
                    "pixel_spread": radians(FIELD_OF_VIEW) / options.size,
                },
            },
            **lights,
        }
    )


def rendered(scene: mi.Scene, spp: int, seed: int = 1) -> tuple[np.ndarray, float]:
    """Tone-mapped image and CPU seconds."""
    dr.eval(mi.render(scene, seed=0, spp=1))  # compiles
    dr.sync_thread()
    start = time.process_time()
    image = np.array(mi.render(scene, seed=seed, spp=spp))
    seconds = time.process_time() - start
    bitmap = mi.Bitmap(image).convert(mi.Bitmap.PixelFormat.RGB, mi.Struct.Type.UInt8, True)
    return np.asarray(bitmap).astype(float) / 255, seconds


def rmse(a: np.ndarray, b: np.ndarray) -> float:
    return float(np.sqrt(np.mean((a - b) ** 2)))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--map", type=Path, default=SAMPLE, help="the sample")
    parser.add_argument("--size", type=int, default=160, help="of the images, pixels")
    parser.add_argument("--spp", type=int, default=64)
    parser.add_argument("--uv-scale", type=float, default=4.0, help="repetitions of the map")
    parser.add_argument("--sigma-r", type=float, default=0.01)
    parser.add_argument("-o", "--output", type=Path, default=Path("mip_pictures"))
    options = parser.parse_args()
    options.output.mkdir(parents=True, exist_ok=True)

    scenes = {
        name: scene(
            options,
            {"type": "glint_mip", "filename": str(options.map), "output_size": 1024, **changes},
        )
        for name, changes in SETTINGS.items()
    }
    bsdf = {name: one.shapes()[0].bsdf() for name, one in scenes.items()}
    bsdf["k = 32, nearest level"].pndf.__class__ = NearestLevel
    explicit = mi.TensorXf(bsdf["k = 32"].pndf.normal_map.normals)
    elements = scene(options, {"type": "glint_elements", "data": explicit, "step": 0.5})

    reference, seconds = rendered(elements, options.spp)
    noise = rmse(rendered(elements, options.spp, seed=2)[0], reference)
    rows = [{"setting": "elements", "rmse": noise, "cpu_seconds": seconds}]
    panels = [reference]
    for name, one in scenes.items():
        image, seconds = rendered(one, options.spp, seed=2)
        panels.append(image)
        rows.append({"setting": name, "rmse": rmse(image, reference), "cpu_seconds": seconds})
    for row in rows:
        print(f"{row['setting']:<24} RMSE {row['rmse']:.4f}   {row['cpu_seconds']:.2f} s")
    sheet = np.concatenate([np.concatenate(panels[k : k + 4], axis=1) for k in (0, 4)])
    path = options.output / "mip_pictures.png"
    mi.Bitmap(np.uint8(np.round(255 * sheet))).write(str(path))
    path.with_suffix(".json").write_text(json.dumps(rows, indent=1) + "\n")


if __name__ == "__main__":
    main()
