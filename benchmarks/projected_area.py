"""Projected areas, the masking made of them, and diffuse reflection (Wu24, Fig. 8, 12 and 14).

``python benchmarks/projected_area.py [areas] [masking] [diffuse] [-o FOLDER]``

``areas`` (Fig. 8): root mean square error of P(ω) over the hemisphere against Monte Carlo, for
three maps and footprints of standard deviation σ: the analytic sum for the Gaussian and the box
kernel, and the GGX fit. Expected before measuring: 0.002 and 0.005, the fit worst at grazing
angles.

``masking`` (Fig. 12): renders of the curved patch with each masking, their error against the
analytic one, and their time as a ratio to that without masking. Expected: the fit within 1 %, at
1.2 × the time; the analytic one 10 ×.

``diffuse`` (Fig. 14): a rough diffuse plane under a directional light, whose only noise is
aliasing. Error at few samples per pixel against many, of ``diffuse`` in ``normalmap`` and of
``glint_diffuse``. The reference of ``glint_diffuse`` is its own with footprints of points, as it
converges to facets that count with their own area. Expected: a tenth of the aliasing at 1 sample
per pixel.

Pictures go to FOLDER: rows and columns as printed.
"""

from __future__ import annotations

import argparse
import json
import os
import time
from functools import partial
from pathlib import Path

os.environ["GLINTBSDF_CACHE"] = "off"

import drjit as dr
import mitsuba as mi
import numpy as np

import glintbsdf

mi.set_variant("llvm_ad_rgb")

from glintbsdf import maps  # noqa: E402
from glintbsdf.footprint import Footprint  # noqa: E402
from glintbsdf.pndf.manifold import TexelMesh  # noqa: E402
from glintbsdf.projected_area import GgxFit, ProjectedArea  # noqa: E402
from glintbsdf.rendering import load_scene, pixel_angle  # noqa: E402

SCENES = Path(__file__).parent.parent / "scenes"


def rmse(image: np.ndarray, reference: np.ndarray) -> float:
    return float(np.sqrt(np.mean((image - reference) ** 2)))


def timed(evaluate, *arguments):
    """Result and seconds of the second call: the first one compiles."""
    dr.eval(evaluate(*arguments))
    dr.sync_thread()
    start = time.perf_counter()
    result = evaluate(*arguments)
    dr.eval(result)
    dr.sync_thread()
    return result, time.perf_counter() - start


def save(path: Path, rows: list[list[np.ndarray]]) -> None:
    """Write a table of pictures of equal size, each (H, W) or (H, W, 3)."""
    cells = [[np.broadcast_to(np.atleast_3d(x), (*x.shape[:2], 3)) for x in row] for row in rows]
    table = np.concatenate([np.concatenate(row, 1) for row in cells], 0).astype(np.float32)
    path.parent.mkdir(parents=True, exist_ok=True)
    mi.Bitmap(table).convert(mi.Bitmap.PixelFormat.RGB, mi.Struct.Type.UInt8, True).write(str(path))


# --------------------------------------------------------------------------------------------------
#  Fig. 8
# --------------------------------------------------------------------------------------------------


def monte_carlo(mesh: TexelMesh, footprint: Footprint, w: np.ndarray, side: int) -> np.ndarray:
    """P of one footprint for directions (3, N), by jittered points of the kernel, in float64."""
    jitter = np.random.default_rng(1).random((2, side, side))
    u = np.float32((jitter + np.mgrid[:side, :side]) / side).reshape(2, -1)
    kernel = mesh.texel_kernel(footprint)
    m = np.array(mesh.normal_at(kernel.mean + kernel.sample(mi.Point2f(u))), np.float64)
    z = np.sqrt(1 - (m**2).sum(0))
    slopes = np.concatenate([m / z, np.ones((1, m.shape[1]))])
    return np.array([np.maximum(x @ slopes, 0).mean() for x in w.T])


def areas(folder: Path | None, side: int = 24, samples: int = 256, places: int = 3) -> list[dict]:
    y, x = 2 * (np.mgrid[:side, :side] + 0.5) / side - 1
    inside = x * x + y * y < 1
    w = np.stack([x, y, np.sqrt(np.maximum(1 - x * x - y * y, 0))])[:, inside]
    directions = mi.Vector3f(np.ascontiguousarray(w, np.float32))
    results, pictures = [], []
    print(
        "map          σ texels   analytic   analytic, box    ggx_fit   |  MC error  |  µs per query"
    )
    for name in ("isotropic", "brushed", "scratched"):
        normal_map = getattr(maps, name)(512, seed=1)
        meshes = {kernel: TexelMesh(normal_map, kernel) for kernel in ("gaussian", "box")}
        exact = {kernel: ProjectedArea(mesh) for kernel, mesh in meshes.items()}
        fit = GgxFit(meshes["gaussian"])
        for sigma in (0.5, 4, 16, 64):
            errors = {"analytic": [], "box": [], "ggx_fit": [], "Monte Carlo": []}
            rng = np.random.default_rng(2)
            for _ in range(places):
                footprint = Footprint.isotropic(mi.Point2f(*rng.random(2).tolist()), sigma / 512)
                reference = {k: monte_carlo(m, footprint, w, samples) for k, m in meshes.items()}
                half = monte_carlo(meshes["gaussian"], footprint, w, samples // 2)
                analytic, seconds = timed(exact["gaussian"].eval, directions, footprint)
                fitted, seconds_fit = timed(fit.eval, directions, footprint)
                box = np.array(exact["box"].eval(directions, footprint))
                errors["analytic"].append(rmse(np.array(analytic), reference["gaussian"]))
                errors["box"].append(rmse(box, reference["box"]))
                errors["ggx_fit"].append(rmse(np.array(fitted), reference["gaussian"]))
                errors["Monte Carlo"].append(rmse(half, reference["gaussian"]) / 4)
            row = {"map": name, "sigma": sigma} | {k: float(np.mean(v)) for k, v in errors.items()}
            row |= {"us": 1e6 * seconds / w.shape[1], "us_fit": 1e6 * seconds_fit / w.shape[1]}
            results.append(row)
            print(
                f"{name:10} {sigma:8} {row['analytic']:13.5f} {row['box']:14.5f}"
                f" {row['ggx_fit']:12.5f}   |  {row['Monte Carlo']:.5f}   |"
                f"  {row['us']:.1f}, fit {row['us_fit']:.1f}",
                flush=True,
            )
            disks = []
            for values in (reference["gaussian"], np.array(analytic), np.array(fitted)):
                disk = np.zeros((side, side))
                disk[inside] = values
                disks.append(disk.repeat(6, 0).repeat(6, 1))
            pictures.append(disks)
    if folder:
        save(folder / "areas.png", pictures)
    return results


# --------------------------------------------------------------------------------------------------
#  Fig. 12
# --------------------------------------------------------------------------------------------------


def masking(folder: Path | None, size: int = 128, spp: int = 16) -> list[dict]:
    used = {"resx": str(size), "resy": str(size), "spp": str(spp)}
    angle = pixel_angle(load_scene(SCENES / "curved_patch.xml", used).sensors()[0])
    images, seconds = {}, {}
    for name in ("none", "beckmann", "ggx_fit", "analytic"):
        scene = load_scene(
            SCENES / "curved_patch.xml", {**used, "masking": name, "pixel_spread": str(angle)}
        )
        image, seconds[name] = timed(partial(mi.render, scene, spp=spp, seed=3))
        images[name] = np.array(image)
    results = []
    print("masking    RMSE from analytic, relative to its mean   time / without")
    for name, image in images.items():
        error = rmse(image, images["analytic"]) / float(images["analytic"].mean())
        results.append({"masking": name, "rmse": error, "ratio": seconds[name] / seconds["none"]})
        print(f"{name:10} {error:12.5f} {seconds[name] / seconds['none']:37.2f}", flush=True)
    if folder:
        save(folder / "masking.png", [list(images.values())])
    return results


# --------------------------------------------------------------------------------------------------
#  Fig. 14
# --------------------------------------------------------------------------------------------------


def plane(bsdf: dict, size: int) -> mi.Scene:
    """A plane that fills the picture, seen obliquely, under one directional light."""
    return mi.load_dict(
        {
            "type": "scene",
            "integrator": {"type": "path", "max_depth": 2},
            "sensor": {
                "type": "perspective",
                "fov": 45,
                "to_world": mi.ScalarTransform4f().look_at([0, -2, 1.2], [0, 0, 0], [0, 0, 1]),
                "film": {
                    "type": "hdrfilm",
                    "width": size,
                    "height": size,
                    "rfilter": {"type": "box"},
                },
            },
            "light": {"type": "directional", "direction": [0.8, 0.3, -0.5], "irradiance": 3.0},
            "shape": {
                "type": "rectangle",
                "to_world": mi.ScalarTransform4f().scale([10, 10, 1]),
                "bsdf": bsdf,
            },
        }
    )


def diffuse(folder: Path | None) -> list[dict]:
    """At 6 and at 25 texels per pixel in the middle: one facet's width a pixel, and a quarter."""
    return [row for scale in (25, 100) for row in diffuse_at(scale, folder)]


def diffuse_at(scale: float, folder: Path | None, size: int = 96, many: int = 4096) -> list[dict]:
    normal_map = maps.isotropic(256, alpha=0.5, seed=1)
    to_uv = mi.ScalarTransform4f().scale([scale, scale, 1])
    n = normal_map.normals.astype(np.float64)
    xyz = np.concatenate([n, np.sqrt(1 - (n**2).sum(2, keepdims=True))], 2)
    colours = mi.Bitmap(np.float32(0.5 * xyz + 0.5))
    usual = {
        "type": "normalmap",
        "bsdf": {"type": "diffuse"},
        "normalmap": {"type": "bitmap", "bitmap": colours, "raw": True, "to_uv": to_uv},
    }
    ours = {"type": "glint_diffuse", "data": mi.TensorXf(normal_map.normals), "to_uv": to_uv}
    spread = pixel_angle(plane(usual, size).sensors()[0])

    def render(bsdf: dict, spp: int, block: int = 64) -> np.ndarray:
        scene = plane(bsdf, size)
        runs = [
            np.array(mi.render(scene, spp=min(spp, block), seed=seed))
            for seed in range(max(spp // block, 1))
        ]
        return np.mean(runs, axis=0)

    materials = {
        "normalmap": (usual, {}),
        "manifold": (ours, {}),
        "oren_nayar": (ours, {"method": "oren_nayar"}),
    }
    references = {
        "normalmap": render(usual, many),
        "manifold": render({**ours, "pixel_spread": 1e-9}, many),
    }
    references["oren_nayar"] = references["normalmap"]
    results, pictures = [], []
    print(f"map repeated {scale} times; RMSE / mean")
    print(f"material      spp            from its {many} spp   from normalmap's {many} spp")
    for spp in (1, 64):
        row = []
        for name, (bsdf, more) in materials.items():
            # The footprint of a sample shrinks as Mitsuba shrinks ray differentials.
            footprint = {} if name == "normalmap" else {"pixel_spread": spread / spp**0.5}
            image = render({**bsdf, **more, **footprint}, spp)
            own, other = (
                rmse(image, references[key]) / float(references[key].mean())
                for key in (name, "normalmap")
            )
            results.append(
                {"scale": scale, "material": name, "spp": spp, "own": own, "normalmap": other}
            )
            print(f"{name:12} {spp:4} {own:26.4f} {other:32.4f}", flush=True)
            row.append(image)
        pictures.append(row)
    if folder:
        save(folder / f"diffuse_{scale}.png", [[*row, references["normalmap"]] for row in pictures])
    return results


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parts = {"areas": areas, "masking": masking, "diffuse": diffuse}
    parser.add_argument("parts", nargs="*", metavar="PART", help="areas, masking, diffuse (all)")
    parser.add_argument("-o", "--output", type=Path, help="folder for JSON and pictures")
    options = parser.parse_args()
    unknown = set(options.parts) - set(parts)
    if unknown:
        parser.error(f"unknown part {', '.join(sorted(unknown))}; known are {', '.join(parts)}")
    results = {}
    for part in options.parts or parts:
        print(f"\n{part}")
        results[part] = parts[part](options.output)
    if options.output:
        versions = {"glintbsdf": glintbsdf.__version__, "mitsuba": mi.__version__}
        (options.output / "projected_area.json").write_text(
            json.dumps(versions | results, indent=1) + "\n"
        )


if __name__ == "__main__":
    main()
