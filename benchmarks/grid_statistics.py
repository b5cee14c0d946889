"""The mean and the noise of glint_grid against the smooth surface that it is from afar.

``python benchmarks/grid_statistics.py [-o RESULT.json]``

1. Mean over 10⁶ places that share no cells, in units of Beckmann's ``roughconductor``, for several
   materials, with its standard error. Expected: 1 within four errors and 0.35 %, the error of
   roughconductor's rational masking function.
2. Standard deviation over places against density, for a fixed footprint. Expected: none of it
   larger than before; with many microdetails per pixel, a tenth for a hundred times as many.
3. A picture at density 12 against roughconductor's with the same random numbers, and the latter's
   own noise. Expected: below it by far.
"""

from __future__ import annotations

import argparse
import json
from pathlib import Path

import drjit as dr
import mitsuba as mi
import numpy as np

import glintbsdf

mi.set_variant("llvm_ad_rgb")

MATERIALS = {
    "default": {},
    "anisotropic": {"alpha_u": 0.4, "alpha_v": 0.1, "detail_alpha": 0.04},
    "grooves": {"detail_alpha_u": 0.3, "detail_alpha_v": 0.03},
    "grooves along v": {"detail_alpha_u": 0.03, "detail_alpha_v": 0.3},
    "colour wheel": {"colors": "wheel"},
    "coloured grooves": {"colors": "wheel", "detail_alpha_u": 0.3},
    "wide light": {"light_spread": 0.2},
    "large variation": {"size_variation": 2.0},
    "equal sizes": {"size_variation": 0.0},
    "fine details": {"detail_alpha": 0.03},
}


def smooth(alpha_u=0.3, alpha_v=0.3, **_) -> dict:
    return {"type": "roughconductor", "distribution": "beckmann",
            "alpha_u": alpha_u, "alpha_v": alpha_v}  # fmt: skip


def relative_values(parameters: dict, count: int, extent: float, sigma: float) -> np.ndarray:
    """Values at random places of [0, extent]², channels × places, relative to the smooth surface.

    ``sigma``: standard deviation of the round footprint, UV.
    """
    si = dr.zeros(mi.SurfaceInteraction3f, count)
    rng = np.random.default_rng(1)
    si.uv = mi.Point2f(*(np.float32(x) for x in extent * rng.random((2, count))))
    si.duv_dx, si.duv_dy = mi.Vector2f(sigma, 0), mi.Vector2f(0, sigma)
    si.wi = dr.normalize(mi.Vector3f(0.3, 0.1, 1))
    wo = dr.normalize(mi.Vector3f(0.1, -0.2, 1))
    bsdf = mi.load_dict({"type": "glint_grid", "footprint_sigma": 1.0, **parameters})
    value, expected = (
        np.array(b.eval(mi.BSDFContext(), si, wo), np.float64)
        for b in (bsdf, mi.load_dict(smooth(**parameters)))
    )
    return value / expected


def means(count: int) -> dict:
    print(f"Mean over {count} places, relative to roughconductor (red, green, blue)")
    results = {}
    for name, parameters in MATERIALS.items():
        # Cells of 3e-3 and 6e-3: over a million even along one axis, which is all that grooves have
        values = relative_values({"density": 5.0, **parameters}, count, 1e4, 3e-3)
        mean, error = values.mean(axis=1), values.std(axis=1) / count**0.5
        results[name] = {"mean": mean.tolist(), "standard_error": error.tolist()}
        print(f"  {name:20}", *(f"{m:.4f} ± {e:.4f} " for m, e in zip(mean, error, strict=True)))
    return results


def deviations(count: int) -> dict:
    print("Standard deviation over places, relative to the mean; pixels 0.002 wide")
    results = {}
    for density in range(2, 15):
        values = relative_values({"density": float(density)}, count, 1.0, 1e-3)
        results[density] = float(values[0].std())
        print(f"  density {density:2}: {results[density]:.2e}")
    return results


def picture(bsdf: dict, seed: int, spp: int = 64, size: int = 200) -> np.ndarray:
    fov = 40
    camera = mi.ScalarTransform4f().look_at([0.3, -1.5, 1.5], [0, 0, 0], [0, 0, 1])
    scene = mi.load_dict({
        "type": "scene", "integrator": {"type": "path", "hide_emitters": True},
        "sensor": {"type": "perspective", "fov": fov, "to_world": camera,
                   "film": {"type": "hdrfilm", "width": size, "height": size,
                            "rfilter": {"type": "box"}},
                   "sampler": {"type": "independent", "sample_count": spp}},
        "sky": {"type": "constant", "radiance": 0.5},
        "lamp": {"type": "sphere", "center": [0, 1, 2], "radius": 0.1,
                 "emitter": {"type": "area", "radiance": {"type": "rgb", "value": 50.0}}},
        "square": {"type": "rectangle", "bsdf": bsdf},
    })  # fmt: skip
    return np.array(mi.render(scene, seed=seed), np.float64)


def dense_picture() -> dict:
    spread = np.radians(40) / 200 / 64**0.5
    glints = {"type": "glint_grid", "density": 12.0, "pixel_spread": spread}
    other, same, reference = picture(glints, 2), picture(glints, 1), picture(smooth(), 1)
    noise = np.abs(picture(smooth(), 2) - reference).mean() / reference.mean()
    result = {
        "same_random_numbers": np.abs(same - reference).mean() / reference.mean(),
        "other_random_numbers": np.abs(other - reference).mean() / reference.mean(),
        "noise_of_roughconductor": noise,
        "ratio_of_means": same.mean() / reference.mean(),
    }
    print("Density 12 against roughconductor, mean absolute difference of pixels over the mean")
    for name, value in result.items():
        print(f"  {name.replace('_', ' '):24} {value:.5f}")
    return result


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--places", type=int, default=1_000_000)
    parser.add_argument("-o", "--output", type=Path, help="JSON file to write")
    options = parser.parse_args()
    results = {
        "version": glintbsdf.__version__,
        "means": means(options.places),
        "deviations": deviations(options.places // 10),
        "dense_picture": dense_picture(),
    }
    if options.output:
        options.output.write_text(json.dumps(results, indent=1) + "\n")


if __name__ == "__main__":
    main()
