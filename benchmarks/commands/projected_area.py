"""Projected areas and diffuse reflection (Wu24, Fig. 8 and 14)."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial

import mitsuba as mi
import numpy as np

from benchmarks.cases import MAPS, maps_of, picture_of, scaled
from benchmarks.harness import Run, family, rmse, seconds
from benchmarks.measures.pndf import mean_of
from glintbsdf import Footprint, NormalMap
from glintbsdf.pndf.manifold.mesh import TexelMesh
from glintbsdf.pndf.manifold.projected_area import GgxFit, ProjectedArea
from glintbsdf.scene.rendering import pixel_spread

# --------------------------------------------------------------------------------------------------
#  Fig. 8
# --------------------------------------------------------------------------------------------------


def monte_carlo(mesh: TexelMesh, footprint: Footprint, w: np.ndarray, side: int) -> np.ndarray:
    """P(ω) of one footprint for directions (3, N), by jittered points of the kernel, in float64."""
    jitter = np.random.default_rng(1).random((2, side, side))
    u = np.float32((jitter + np.mgrid[:side, :side]) / side).reshape(2, -1)
    kernel = mesh.texel_kernel(footprint)
    m = np.array(mesh.normal_at(kernel.mean + kernel.sample(mi.Point2f(u))), np.float64)
    z = np.sqrt(1 - (m**2).sum(0))
    slopes = np.concatenate([m / z, np.ones((1, m.shape[1]))])
    return np.array([np.maximum(x @ slopes, 0).mean() for x in w.T])


def area_errors(make: Callable[[], NormalMap], sigma: float, quick: bool) -> dict:
    """Errors of P(ω) under random round footprints of ``sigma`` texels."""
    side, samples, places = (12, 128, 1) if quick else (24, 256, 3)
    normal_map = make()
    y, x = 2 * (np.mgrid[:side, :side] + 0.5) / side - 1
    inside = x * x + y * y < 1
    w = np.stack([x, y, np.sqrt(np.maximum(1 - x * x - y * y, 0))])[:, inside]
    directions = mi.Vector3f(np.ascontiguousarray(w, np.float32))
    meshes = {kernel: TexelMesh(normal_map, kernel) for kernel in ("gaussian", "box")}
    exact = {kernel: ProjectedArea(mesh) for kernel, mesh in meshes.items()}
    fit = GgxFit(meshes["gaussian"])
    errors = []
    rng = np.random.default_rng(2)
    for _ in range(places):
        place = mi.Point2f(*rng.random(2).tolist())
        footprint = Footprint.isotropic(place, sigma / normal_map.width)
        reference = {k: monte_carlo(m, footprint, w, samples) for k, m in meshes.items()}
        half = monte_carlo(meshes["gaussian"], footprint, w, samples // 2)
        works = [partial(e.eval, directions, footprint) for e in (exact["gaussian"], fit)]
        analytic, fitted = (np.array(work()) for work in works)
        taken, taken_fit = (seconds(work) for work in works)
        box = np.array(exact["box"].eval(directions, footprint))
        errors.append({
            "analytic": rmse(analytic, reference["gaussian"]),
            "box": rmse(box, reference["box"]),
            "ggx_fit": rmse(fitted, reference["gaussian"]),
            "monte_carlo": rmse(half, reference["gaussian"]) / 4,
        })  # fmt: skip
    taken = {"us": 1e6 * taken / w.shape[1], "us_fit": 1e6 * taken_fit / w.shape[1]}
    return mean_of(errors) | taken


def areas(run: Run) -> None:
    """Root mean square error of P(ω) over the hemisphere, against Monte Carlo (Fig. 8).

    It compares the analytic sum for the Gaussian and the box kernel, and the GGX fit, with
    microseconds per query. Expected: 0.002 and 0.005; the fit is worst at grazing angles.
    """
    with run.table("areas") as table:
        for name, make in maps_of(run, 512, "isotropic", "brushed", "scratched").items():
            for sigma in (0.5, 4, 16, 64):
                work = partial(area_errors, make, sigma, run.quick)
                table.measure({"map": name, "sigma": sigma}, work)


# --------------------------------------------------------------------------------------------------
#  Fig. 14
# --------------------------------------------------------------------------------------------------


def diffuse_plane(bsdf: dict, size: int) -> mi.Scene:
    """A plane that fills the image, seen obliquely."""
    wide = mi.ScalarTransform4f().scale([10, 10, 1])
    sun = {"type": "directional", "irradiance": 3.0, "direction": [0.8, 0.3, -0.5]}
    shape = {"type": "rectangle", "to_world": wide, "bsdf": bsdf}
    return picture_of(shape, [0, -2, 1.2], [0, 0, 1], 45, size, {"sun": sun})


def diffuse_errors(scale: float, size: int, many: int, run: Run) -> list[dict]:
    """Errors at 1 and 64 samples per pixel, against ``many`` of the same and of ``normalmap``."""
    normal_map, to_uv = MAPS["rough"](256), scaled(scale)
    n = normal_map.normals.astype(np.float64)
    xyz = np.concatenate([n, np.sqrt(1 - (n**2).sum(2, keepdims=True))], 2)
    texture = {"type": "bitmap", "bitmap": mi.Bitmap(np.float32(0.5 * xyz + 0.5)), "raw": True}
    usual = {"type": "normalmap", "bsdf": {"type": "diffuse"},
             "normalmap": texture | {"to_uv": to_uv}}  # fmt: skip
    ours = {"type": "glint_diffuse", "data": mi.TensorXf(normal_map.normals), "to_uv": to_uv}
    spread = pixel_spread(diffuse_plane(usual, size).sensors()[0])

    def render(bsdf: dict, spp: int, block: int = 64) -> np.ndarray:
        scene, passes = diffuse_plane(bsdf, size), max(spp // block, 1)
        return np.mean(
            [np.array(mi.render(scene, spp=min(spp, block), seed=s)) for s in range(passes)], axis=0
        )

    materials = {"normalmap": usual, "manifold": ours,
                 "oren_nayar": ours | {"method": "oren_nayar"}}  # fmt: skip
    references = {"normalmap": render(usual, many)}
    references["manifold"] = render({**ours, "pixel_spread": 1e-9}, many)
    references["oren_nayar"] = references["normalmap"]
    rows, pictures = [], []
    for spp in (1, 64):
        pictures.append([])
        for name, bsdf in materials.items():
            # The footprint of a sample shrinks as Mitsuba shrinks ray differentials.
            footprint = {} if name == "normalmap" else {"pixel_spread": spread / spp**0.5}
            image = render(bsdf | footprint, spp)
            own, other = (
                rmse(image, references[key]) / float(references[key].mean())
                for key in (name, "normalmap")
            )
            rows.append({"material": name, "spp": spp, "own": own, "normalmap": other})
            pictures[-1].append(image)
        pictures[-1].append(references["normalmap"])
    run.save_pictures(f"diffuse_{scale:g}", pictures)
    return rows


def diffuse(run: Run) -> None:
    """A rough diffuse plane under a directional light, whose only noise is aliasing (Fig. 14).

    The map repeats so often that a pixel in the middle covers 6 or 25 texels: the width of a bump,
    and four times this width. The table has the errors of ``diffuse`` in ``normalmap`` and of
    ``glint_diffuse``, relative to the mean, against many samples. The reference of
    ``glint_diffuse`` is its own image with point footprints, as its facets count with their own
    area. Expected: a tenth of the aliasing at 1 sample per pixel.
    """
    size, many = (48, 512) if run.quick else (96, 4096)
    with run.table("diffuse") as table:
        for scale in (25, 100):
            work = partial(diffuse_errors, scale, size, many, run)
            table.measure({"repetitions": scale}, work)


projected_area = family("projected_area", areas, diffuse)
