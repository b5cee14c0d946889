"""Projected areas, the masking made of them, and diffuse reflection (Wu24, Fig. 8 and 12 to 14).

``python benchmarks/projected_area.py [areas] [triangles] [furnace] [masking] [diffuse]
[appearance] [--quick] [-o FOLDER]``

``areas`` (Fig. 8): root mean square error of P(ω) over the hemisphere against Monte Carlo, for
three maps and footprints of standard deviation σ: the analytic sum for the Gaussian and the box
kernel, and the GGX fit. Expected before measuring: 0.002 and 0.005, the fit worst at grazing
angles.

``triangles``: the area of 1,000 random triangles in 1,000 random directions, half of them grazing,
for each of three orders of quadrature, against an adaptive Monte Carlo estimate in float64 whose
standard error is printed beside it. Expected: relative errors below 1e-3 plus the noise.

``furnace``: what the facets reflect of uniform light, by stratified points of the footprint, with
the masking of each estimate of P, height-correlated or separable: the largest energy of random
places and directions, less three standard errors, and the share above 1.002. Expected: 1. Measured:
1.0015, of grooves seen through a hundredth of a texel.

``masking`` (Fig. 12): renders of the curved patch with each masking, their error against the
analytic one, and their time as a ratio to that without masking. Expected: the fit within 1 %, at
1.2 × the time; the analytic one 10 ×.

``appearance`` (Fig. 13): spheres with maps of growing roughness, footprints of 16² and of 32²
texels in the middle, ``glint_diffuse`` above Oren and Nayar's model. Expected: flat shading at
great roughness, and Oren and Nayar's brighter, as in the paper. Measured: darker, as facets count
with their own area here.

``diffuse`` (Fig. 14): a rough diffuse plane under a directional light, whose only noise is
aliasing. Error at few samples per pixel against many, of ``diffuse`` in ``normalmap`` and of
``glint_diffuse``. The reference of ``glint_diffuse`` is its own with footprints of points, as it
converges to facets that count with their own area. Expected: a tenth of the aliasing at 1 sample
per pixel. Measured, relative to the mean: 0.067 against 0.49 where a pixel sees 25 texels; 0.21
against 0.40 where it sees 6, the width of a bump.

Pictures go to FOLDER: rows and columns as printed.
"""

from __future__ import annotations

import argparse
import os
from functools import partial
from pathlib import Path

os.environ["GLINTBSDF_CACHE"] = "off"

import drjit as dr
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

from glintbsdf import maps  # noqa: E402
from glintbsdf.footprint.gaussian import Footprint  # noqa: E402
from glintbsdf.microfacet.frame import normal_from_projection  # noqa: E402
from glintbsdf.pndf.manifold.mesh import TexelMesh  # noqa: E402
from glintbsdf.pndf.manifold.projected_area import (  # noqa: E402
    ORDERS,
    Corners,
    GgxFit,
    ProjectedArea,
    ProjectedAreaMasking,
    clipped_mean,
)
from glintbsdf.scene.rendering import load_scene, pixel_angle  # noqa: E402

SCENES = Path(__file__).parent.parent / "scenes"


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


def areas(folder: Path | None, quick: bool) -> list[dict]:
    side, samples, places = (12, 128, 1) if quick else (24, 256, 3)
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
                works = [partial(e.eval, directions, footprint) for e in (exact["gaussian"], fit)]
                analytic, fitted = (work() for work in works)
                dr.eval(analytic, fitted)
                taken, taken_fit = (seconds(work) for work in works)
                box = np.array(exact["box"].eval(directions, footprint))
                errors["analytic"].append(rmse(np.array(analytic), reference["gaussian"]))
                errors["box"].append(rmse(box, reference["box"]))
                errors["ggx_fit"].append(rmse(np.array(fitted), reference["gaussian"]))
                errors["Monte Carlo"].append(rmse(half, reference["gaussian"]) / 4)
            row = {"map": name, "sigma": sigma} | {k: float(np.mean(v)) for k, v in errors.items()}
            row |= {"us": 1e6 * taken / w.shape[1], "us_fit": 1e6 * taken_fit / w.shape[1]}
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
        save_pictures(folder / "areas.png", pictures)
    return results


# --------------------------------------------------------------------------------------------------
#  Triangles and furnaces
# --------------------------------------------------------------------------------------------------


def directions_to_the_horizon(rng, count: int) -> np.ndarray:
    """Unit vectors (3, N), a third uniform in their height, the others down to 1e-4."""
    z = np.where(rng.random(count) < 0.3, rng.random(count), 10 ** rng.uniform(-4, 0, count))
    phi, r = 2 * np.pi * rng.random(count), np.sqrt(1 - z * z)
    return np.stack([r * np.cos(phi), r * np.sin(phi), z])


def triangles(folder: Path | None, quick: bool) -> list[dict]:
    count, side = (200, 300) if quick else (1000, 1000)
    results = []
    print("triangles within   order   worst less 3 standard errors   median error   median noise")
    for size, order in zip((0.012, 0.12, 0.99), (order for _, order in ORDERS), strict=True):
        rng = np.random.default_rng(5)
        # The order is for chords of unit normals; far from the rim they are little longer.
        centre = (
            (0.8 - min(size, 0.7))
            * np.sqrt(rng.random(count))
            * np.exp(2j * np.pi * rng.random(count))
        )
        corner = (
            size * np.sqrt(rng.random((3, count))) * np.exp(2j * np.pi * rng.random((3, count)))
        )
        corner = (centre + corner) if size < 0.9 else corner
        a, b, c = (mi.Vector2f(np.float32([x.real, x.imag])) for x in corner)
        w = np.float32(directions_to_the_horizon(rng, count))
        corners = Corners(a, b - a, c - a, mi.Vector3f(w))
        area = np.array(clipped_mean(corners, mi.Float(w[2]), order))
        first, e1, e2 = (np.array(v, np.float64) for v in (a, b - a, c - a))
        w = np.float64(w) / np.linalg.norm(np.float64(w), axis=0)
        error, noise = [], []
        for k in range(count):
            u = (np.mgrid[:side, :side] + rng.random((2, side, side))) / side
            s, t = np.sqrt(u[0]), u[1]
            m = first[:, k, None, None] + np.multiply.outer(e1[:, k], s * (1 - t))
            m += np.multiply.outer(e2[:, k], s * t)
            z = np.sqrt(np.maximum(1 - (m**2).sum(0), 1e-12))
            seen = np.maximum(w[0, k] * m[0] + w[1, k] * m[1] + w[2, k] * z, 0) / z
            if seen.mean() > 1e-6:
                # Of neighbouring strata: their difference has twice the variance of one.
                spread = np.sqrt(((seen[:, ::2] - seen[:, 1::2]) ** 2).sum()) / seen.size
                error.append(abs(area[k] - seen.mean()) / seen.mean())
                noise.append(spread / seen.mean())
        error, noise = np.array(error), np.array(noise)
        row = {
            "size": size,
            "order": order,
            "triangles": len(error),
            "worst": float((error - 3 * noise).max()),
            "median": float(np.median(error)),
            "noise": float(np.median(noise)),
        }
        results.append(row)
        print(
            f"{size:16} {order:7} {row['worst']:30.1e} {row['median']:14.1e} {row['noise']:14.1e}",
            flush=True,
        )
    return results


def furnace(folder: Path | None, quick: bool) -> list[dict]:
    count, side = (200, 16) if quick else (1000, 24)
    cases = {
        name: getattr(maps, name)(128, seed=1)
        for name in ("isotropic", "brushed", "scratched", "leather", "flakes")
    } | {"rough": maps.isotropic(128, alpha=0.5, seed=1), "flat": maps.flat(128)}
    results = []
    print("map        σ texels  masking   G           worst energy   at ω_z   share   mean energy")
    for name, normal_map in cases.items():
        mesh = TexelMesh(normal_map)
        estimates = {"analytic": ProjectedArea(mesh), "ggx_fit": GgxFit(mesh)}
        for sigma in (0.01, 0.3, 1, 4) if quick else (0.01, 0.1, 0.3, 0.6, 1, 1.4, 2, 4, 8, 16):
            for estimate, area in estimates.items():
                if estimate == "analytic" and sigma > 4:
                    continue
                for correlated in (True, False):
                    masking = ProjectedAreaMasking(area, correlated)
                    energy, error, z = energies(mesh, masking, sigma / 128, count, side)
                    worst = int(np.argmax(energy - 3 * error))
                    row = {
                        "map": name,
                        "sigma": sigma,
                        "masking": estimate,
                        "height_correlated": correlated,
                        "worst": float((energy - 3 * error)[worst]),
                        "at": float(z[worst]),
                        "share": float((energy - 3 * error > 1.002).mean()),
                        "mean": float(energy.mean()),
                    }
                    results.append(row)
                    print(
                        f"{name:10} {sigma:8}  {estimate:9}"
                        f" {'correlated' if correlated else 'separable':10} {row['worst']:13.4f}"
                        f" {row['at']:8.4f} {row['share']:7.3f} {row['mean']:13.4f}",
                        flush=True,
                    )
    return results


def energies(mesh: TexelMesh, masking: ProjectedAreaMasking, sigma: float, count: int, side: int):
    """Reflected share of uniform light for random views and places, its error, and their ω_z.

    For a footprint of standard deviation ``sigma`` (UV), by ``side``² stratified points of it.
    """
    rng = np.random.default_rng(4)
    w, uv = directions_to_the_horizon(rng, count), rng.random((2, count))
    u = np.mgrid[:count, :side, :side][1:] + rng.random((2, count, side, side))
    u = np.minimum(np.float32(u / side), np.float32(1 - 2**-24)).reshape(2, -1)
    wi, uv = (np.float32(v).repeat(side * side, axis=1) for v in (w, uv))
    wi, footprint = (
        mi.Vector3f(wi),
        Footprint.isotropic(mi.Point2f(uv), dr.opaque(mi.Float, sigma)),
    )
    kernel = mesh.texel_kernel(footprint)
    m = normal_from_projection(mesh.normal_at(kernel.mean + kernel.sample(mi.Point2f(u))))
    facing = dr.dot(wi, m)
    wo = 2 * facing * m - wi
    up = (facing > 0) & (wo.z > 0)
    wo = dr.select(up, wo, mi.Vector3f(0, 0, 1))
    value = facing / (m.z * wi.z) * masking.eval(wi, wo, footprint, up)
    value = np.array(dr.select(up, value, 0), np.float64).reshape(count, -1)
    return value.mean(1), value.std(1) / side, w[2]


# --------------------------------------------------------------------------------------------------
#  Fig. 12
# --------------------------------------------------------------------------------------------------


def masking(folder: Path | None, quick: bool) -> list[dict]:
    size, spp = (64, 4) if quick else (128, 16)
    used = {"resx": str(size), "resy": str(size), "spp": str(spp)}
    angle = pixel_angle(load_scene(SCENES / "curved_patch.xml", used).sensors()[0])
    images, frames = {}, {}
    for name in ("none", "beckmann", "ggx_fit", "analytic"):
        scene = load_scene(
            SCENES / "curved_patch.xml", {**used, "masking": name, "pixel_spread": str(angle)}
        )
        frames[name] = lambda seed, scene=scene: mi.render(scene, spp=spp, seed=seed)
        images[name] = np.array(frames[name](3))
    times = ratios_to_first(seconds_in_turn(list(frames.values()), 2 if quick else 5))
    results = []
    print("masking    RMSE from analytic, relative to its mean   time / without")
    for (name, image), ratio in zip(images.items(), times, strict=True):
        error = rmse(image, images["analytic"]) / float(images["analytic"].mean())
        results.append({"masking": name, "rmse": error, "ratio": float(ratio)})
        print(f"{name:10} {error:12.5f} {ratio:37.2f}", flush=True)
    if folder:
        save_pictures(folder / "masking.png", [list(images.values())])
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


def diffuse(folder: Path | None, quick: bool) -> list[dict]:
    """At 6 and at 25 texels per pixel in the middle: one facet's width a pixel, and a quarter."""
    size, many = (48, 512) if quick else (96, 4096)
    return [row for scale in (25, 100) for row in diffuse_at(scale, folder, size, many)]


def diffuse_at(scale: float, folder: Path | None, size: int, many: int) -> list[dict]:
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
        save_pictures(
            folder / f"diffuse_{scale}.png", [[*row, references["normalmap"]] for row in pictures]
        )
    return results


# --------------------------------------------------------------------------------------------------
#  Fig. 13
# --------------------------------------------------------------------------------------------------

ROUGHNESSES = (0.2, 0.5, 1.0)


def appearance(folder: Path | None, quick: bool) -> list[dict]:
    size, texels = (48 if quick else 160), 256
    results, pictures = [], []
    print("footprint  method       mean of the picture over that of diffuse, α = 0.2, 0.5, 1")
    smooth = np.array(mi.render(sphere({"type": "diffuse"}, size), spp=16))
    for across in (16, 32):
        for method in ("manifold", "oren_nayar"):
            row = []
            for alpha in ROUGHNESSES:
                normal_map = maps.isotropic(texels, alpha=alpha, seed=1)
                # A pixel in the middle of the sphere sees `across` texels, six standard deviations.
                scale = across / 3 * size / 2 / texels * np.pi
                material = {
                    "type": "glint_diffuse",
                    "method": method,
                    "data": mi.TensorXf(normal_map.normals),
                    "to_uv": mi.ScalarTransform4f().scale([2 * scale, scale, 1]),
                    "pixel_spread": pixel_angle(sphere({"type": "diffuse"}, 4).sensors()[0])
                    * 4
                    / size,
                }
                row.append(np.array(mi.render(sphere(material, size), spp=16)))
            pictures.append(row)
            means = [float(image.mean() / smooth.mean()) for image in row]
            results.append({"texels": across, "method": method, "means": means})
            print(
                f"{across:6}²    {method:12} {', '.join(f'{mean:.4f}' for mean in means)}",
                flush=True,
            )
    if folder:
        save_pictures(folder / "appearance.png", pictures)
    return results


def sphere(bsdf: dict, size: int) -> mi.Scene:
    """A sphere, seen from afar, under a directional light from the upper left."""
    return mi.load_dict(
        {
            "type": "scene",
            "integrator": {"type": "path", "max_depth": 2},
            "sensor": {
                "type": "perspective",
                "fov": 12,
                "to_world": mi.ScalarTransform4f().look_at([0, -10, 0], [0, 0, 0], [0, 0, 1]),
                "film": {"type": "hdrfilm", "width": size, "height": size},
            },
            "light": {"type": "directional", "direction": [0.5, 1, -0.5], "irradiance": 3.0},
            "ball": {"type": "sphere", "bsdf": bsdf},
        }
    )


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    functions = (areas, triangles, furnace, masking, diffuse, appearance)
    parts = {function.__name__: function for function in functions}
    parser.add_argument("parts", nargs="*", metavar="PART", help=f"{', '.join(parts)} (all)")
    parser.add_argument("--quick", action="store_true", help="few samples and pixels")
    parser.add_argument("-o", "--output", type=Path, help="folder for JSON and pictures")
    options = parser.parse_args()
    unknown = set(options.parts) - set(parts)
    if unknown:
        parser.error(f"unknown part {', '.join(sorted(unknown))}; known are {', '.join(parts)}")
    results = {}
    for part in options.parts or parts:
        print(f"\n{part}")
        results[part] = parts[part](options.output, options.quick)
    if options.output:
        save_results(options.output / "projected_area.json", results)


if __name__ == "__main__":
    main()
