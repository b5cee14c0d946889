"""Truth, glint methods and filters side by side, as in RTR's Figure 9.51 and as images.

``python benchmarks/filtered_pictures.py [--map FILE] [--sigma 12] [-o FOLDER]``

The first picture shows the distribution of normals under one footprint of a few dozen bumps: the
binned reference, every glint method, every filter. The second shows the curved patch: brute force
with its measured noise, then the same materials, whose footprints have the variance of a pixel,
whatever the number of samples. Needs matplotlib. What is printed is the relative L1 difference to
the reference, and the relative root mean square difference to the truth, whose own noise is
subtracted. Expected: glint methods nearest to the truth, but not at its noise, for a Gaussian is no
pixel; filters far from it.
"""

from __future__ import annotations

import argparse
import json
from pathlib import Path

import matplotlib
import mitsuba as mi
import numpy as np

import glintbsdf

mi.set_variant("llvm_ad_rgb")
matplotlib.use("Agg")

import matplotlib.pyplot as plt  # noqa: E402
from curved_patch import MAP, UV_SCALE, curved_patch  # noqa: E402

from glintbsdf.check.reference import binned_pndf, texel_covariance  # noqa: E402
from glintbsdf.check.truth import mirrors, reference_render  # noqa: E402
from glintbsdf.footprint.gaussian import Footprint  # noqa: E402
from glintbsdf.pndf.filters.filters import METHODS  # noqa: E402
from glintbsdf.scene.rendering import pixel_angle  # noqa: E402

#: Radius of the lights of the images: brute force finds the scene's own too seldom.
LIGHT_RADIUS = 0.07

#: Glint methods of a normal map, by their titles: a new one is one more line.
GLINTS = {
    "manifold": {"type": "glint_manifold"},
    "manifold, max_error 0.1": {"type": "glint_manifold", "max_error": 0.1},
}
FILTERS = {name: {"type": "glint_filtered", "method": name, "alpha": 0.01} for name in METHODS}


def distributions(normal_map, sigma: float, res: int) -> dict[str, np.ndarray]:
    """The reference and every estimate, on one grid over the map's normals."""
    uv, points = (0.43, 0.57), 4
    reference = binned_pndf(
        normal_map, uv, texel_covariance(normal_map, sigma), res=res, samples=20_000_000
    )
    (x_min, y_min), (x_max, y_max) = reference.bounds
    row, column = (np.indices((res * points,) * 2) + 0.5) / (res * points)
    m = mi.Vector2f(
        np.float32((x_min + (x_max - x_min) * column).ravel()),
        np.float32((y_min + (y_max - y_min) * row).ravel()),
    )
    footprint = Footprint(
        mi.Point2f(uv),
        mi.Vector2f(sigma / normal_map.width, 0),
        mi.Vector2f(0, sigma / normal_map.height),
    )
    panels = {"truth": reference.density}
    for title, description in (GLINTS | FILTERS).items():
        bsdf = mi.load_dict({**description, "data": mi.TensorXf(normal_map.normals)})
        density = bsdf.pndf.eval(m, footprint).numpy().reshape(res, points, res, points)
        panels[title] = density.mean(axis=(1, 3))
        print(
            f"P-NDF  {title:24} relative L1 {reference.relative_l1(panels[title]):6.3f}"
            f" (noise {reference.noise_floor:.3f})",
            flush=True,
        )
    return panels


def images(map_file: Path, size: int, spp: int, truth_spp: int) -> tuple[dict, dict]:
    """The truth and an image by every material; and how far they are apart."""
    normal_map = glintbsdf.NormalMap.load(map_file)
    to_uv = mi.ScalarTransform4f().scale([UV_SCALE, UV_SCALE, 1])
    material = mirrors(normal_map, to_uv=to_uv, material="Cr")
    scene = curved_patch(material, size, truth_spp, LIGHT_RADIUS)
    truth = reference_render(scene, spp=truth_spp)
    angle = pixel_angle(scene.sensors()[0])
    print(f"truth: {truth_spp} samples per pixel, noise {truth.relative_error:.3f} of the mean")
    panels, errors = {"truth": truth.image}, {"noise of the truth": truth.relative_error}
    for title, description in (GLINTS | FILTERS).items():
        material = {
            **description,
            "filename": str(map_file),
            "to_uv": to_uv,
            "material": "Cr",
            "pixel_spread": angle,
            "footprint_sigma": 12**-0.5,
        }
        scene = curved_patch(material, size, spp, LIGHT_RADIUS)
        panels[title] = np.array(mi.render(scene, spp=spp))[..., :3]
        errors[title] = truth.relative_rmse(panels[title])
        print(
            f"image  {title:24} relative RMSE {errors[title]:6.3f}, mean"
            f" {panels[title].mean() / truth.image.mean():.3f} of the truth's",
            flush=True,
        )
    return panels, errors


def save(panels: dict[str, np.ndarray], path: Path) -> None:
    """All panels in two rows, with the brightness of the first."""
    columns = -(-len(panels) // 2)
    figure, axes = plt.subplots(2, columns, figsize=(2.6 * columns, 5.6), layout="constrained")
    white = np.quantile(next(iter(panels.values())), 0.999)
    for axis in axes.flat:
        axis.axis("off")
    for axis, (title, panel) in zip(axes.flat, panels.items(), strict=False):
        shown = np.clip(panel / white, 0, 1) ** (1 / 2.2)
        axis.imshow(
            shown, cmap="inferno", vmin=0, vmax=1, origin="lower" if panel.ndim == 2 else "upper"
        )
        axis.set_title(title)
    figure.savefig(path, dpi=110)
    plt.close(figure)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--map", type=Path, default=MAP)
    parser.add_argument("--sigma", type=float, default=12.0, help="of the P-NDF, texels")
    parser.add_argument("--res", type=int, default=128, help="bins per axis of the P-NDF")
    parser.add_argument("--size", type=int, default=160, help="pixels per axis of the images")
    parser.add_argument("--spp", type=int, default=512)
    parser.add_argument("--truth-spp", type=int, default=8192)
    parser.add_argument("-o", "--output", type=Path, default=Path("."), help="folder to write to")
    options = parser.parse_args()

    options.output.mkdir(parents=True, exist_ok=True)
    pndfs = distributions(glintbsdf.NormalMap.load(options.map), options.sigma, options.res)
    save(pndfs, options.output / "filtered_pndf.png")
    panels, errors = images(options.map, options.size, options.spp, options.truth_spp)
    save(panels, options.output / "filtered_images.png")
    (options.output / "filtered_pictures.json").write_text(
        json.dumps(
            {
                "map": str(options.map),
                "sigma": options.sigma,
                "relative_rmse": errors,
                "relative_l1": {
                    title: float(np.abs(panel - pndfs["truth"]).sum() / pndfs["truth"].sum())
                    for title, panel in pndfs.items()
                },
            },
            indent=1,
        )
        + "\n"
    )


if __name__ == "__main__":
    main()
