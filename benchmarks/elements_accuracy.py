"""Elements against the binned reference: error, time and memory by step (Yan16, Fig. 5 and 7).

``python benchmarks/elements_accuracy.py [--sigma 2 8 32] [--steps 0.5 1 2] [-o DIR]``

P-NDFs on 96² bins under round footprints, σ_r = 0.005, three procedural maps of 256². The
reference draws from the map's mesh with the same roughness, without its clamp of flat triangles,
which roughness makes needless. Next to it stands the same density without noise, normals at a
regular grid of positions and their roughness a convolution: the error to that is the elements' own,
a mean over four places and the largest. Time is per query of one fifth of a million, of normals on
a grid, as a ratio to the exact manifold; memory in bytes per texel. Pictures: the reference, the
elements in the order of the table, a row for each map at the middle footprint.

Expected before measuring: at h = ½ 3 % and less, noise included; a third of the error with every
halving of h; flat elements ten times the error of curved ones; footprints of few texels worse, as
kinks of the mesh average out in large ones.

What is left at two texels and h = ½ is the elements' own first-order error, not noise: measured
3.3 % on average over the places, and 1.1 % at h = ¼ and 0.4 % at h = ⅛ (``--steps``). Other seeds
(every offset in the quad), other widths σ_h than h/√(8 ln 2), moments of the mesh under each
Gaussian instead of values at its seed, halves on both sides of the diagonal: none is better on
both maps.
"""

from __future__ import annotations

import argparse
from pathlib import Path

import mitsuba as mi
import numpy as np
from scipy.ndimage import gaussian_filter

mi.set_variant("llvm_ad_rgb")

from _common import (  # noqa: E402
    ratios_to_first,
    save_pictures,
    save_results,
    seconds,
    seconds_in_turn,
)

from glintbsdf import Footprint, NormalMap, maps  # noqa: E402
from glintbsdf.check.plot import colour_map  # noqa: E402
from glintbsdf.check.reference import _normals_at, binned_pndf, texel_covariance  # noqa: E402
from glintbsdf.pndf import Elements, Manifold  # noqa: E402

SIZE, RES, POINTS = 256, 96, 5
SIGMA_R = 0.005
PLACES = ((0.37, 0.61), (0.2, 0.3), (0.71, 0.13), (0.55, 0.87))
UV = PLACES[0]  # of the binned reference, and of the pictures
MAPS = {
    "isotropic": lambda: maps.isotropic(SIZE, seed=1),
    "brushed": lambda: maps.brushed(SIZE, seed=1),
    "scratched": lambda: maps.scratched(SIZE, seed=1),
}


def kinds(steps: list[float]) -> dict[str, tuple[float, bool]]:
    """Step, and whether curved, of the elements compared, by name."""
    return {f"curved {h:g}": (h, True) for h in steps} | {"flat 0.5": (0.5, False)}


def without_noise(normal_map: NormalMap, uv, sigma: float, bounds) -> np.ndarray:
    """The binned reference of a round footprint as an integral over a regular grid of positions."""
    (x0, y0), (x1, y1) = bounds
    fine = 2 * POINTS * RES
    lower, size = np.array([x0, y0]), np.array([x1 - x0, y1 - y0]) / fine
    centre = np.array(uv) * SIZE - 0.5
    first, last = np.floor(centre - 3 * sigma), np.ceil(centre + 3 * sigma)
    points = 64 if sigma < 4 else 24 if sigma < 16 else 12  # per texel and axis
    x, y = (np.arange(a, b, 1 / points) + 0.5 / points for a, b in zip(first, last, strict=True))
    vertices = normal_map.normals.astype(np.float64).reshape(-1, 2)
    density = np.zeros((fine + 1) ** 2)
    for rows in np.array_split(y, -(-len(x) * len(y) // (1 << 20))):
        position = np.stack(np.meshgrid(x, rows), -1).reshape(-1, 2)
        rho2 = np.square((position - centre) / sigma).sum(1)
        position, weight = position[rho2 <= 9], np.exp(-0.5 * rho2[rho2 <= 9])
        pixel = (_normals_at(position, vertices, normal_map, 0.0) - lower) / size - 0.5
        corner = np.floor(pixel).astype(np.int64)
        right, down = (pixel - corner).T
        for i, share_y in enumerate((1 - down, down)):
            for j, share_x in enumerate((1 - right, right)):
                index = (corner[:, 1] + i) * (fine + 1) + corner[:, 0] + j
                density += np.bincount(index, weight * share_x * share_y, len(density))
    density = density.reshape(fine + 1, fine + 1)[:fine, :fine]
    # Shared among four pixels, a normal has got a variance of a sixth of a pixel already.
    blur = np.sqrt(np.square(SIGMA_R / size) - 1 / 6)[::-1]
    density = gaussian_filter(density / density.sum(), blur, mode="constant", truncate=6)
    return binned(density, 2 * POINTS) * (2 * POINTS) ** 2 / np.prod(size * 2 * POINTS)


def binned(density: np.ndarray, points: int) -> np.ndarray:
    """Means over the ``points``² values in each of RES² bins."""
    return density.reshape(RES, points, RES, points).mean(axis=(1, 3))


def grid(bounds) -> mi.Vector2f:
    """Normals at POINTS² places of every bin."""
    (x0, y0), (x1, y1) = bounds
    g = (np.arange(RES * POINTS) + 0.5) / (RES * POINTS)
    x, y = np.meshgrid(x0 + (x1 - x0) * g, y0 + (y1 - y0) * g)
    return mi.Vector2f(mi.Float(x.ravel()), mi.Float(y.ravel()))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--sigma", type=float, nargs="+", default=[2.0, 8.0, 32.0])
    parser.add_argument("--steps", type=float, nargs="+", default=[0.5, 1.0, 2.0])
    parser.add_argument("--samples", type=int, default=20_000_000)
    parser.add_argument("--repetitions", type=int, default=3)
    parser.add_argument("-o", "--output", type=Path, help="directory for results and pictures")
    options = parser.parse_args()

    results, pictures = [], []
    print(
        "map        footprint  elements     error  (noise)   without noise  (largest)   "
        "× manifold's time   bytes/texel"
    )
    for name, make in MAPS.items():
        normal_map = make()
        manifold = Manifold(normal_map)
        pndfs = {
            kind: Elements(normal_map, SIGMA_R, *v) for kind, v in kinds(options.steps).items()
        }
        for sigma in options.sigma:
            reference = binned_pndf(
                normal_map,
                UV,
                texel_covariance(normal_map, sigma),
                epsilon=0.0,
                sigma_r=SIGMA_R,
                res=RES,
                samples=options.samples,
            )
            m = grid(reference.bounds)
            exact = [without_noise(normal_map, uv, sigma, reference.bounds) for uv in PLACES]

            def density_at(pndf, uv, m=m, sigma=sigma):
                footprint = Footprint.isotropic(mi.Point2f(uv), sigma / SIZE)
                return pndf.eval(m, footprint)

            def work(pndf, density_at=density_at):
                return lambda _seed: density_at(pndf, UV)

            works = [work(pndf) for pndf in (manifold, *pndfs.values())]
            for each in works:
                seconds(each, 0)
            times = ratios_to_first(seconds_in_turn(works, options.repetitions))[1:]
            row = [reference.density]
            for (kind, pndf), ratio in zip(pndfs.items(), times, strict=True):
                densities = [
                    binned(
                        density_at(pndf, uv).numpy().astype(np.float64).reshape(2 * [RES * POINTS]),
                        POINTS,
                    )
                    for uv in PLACES
                ]
                error = reference.relative_l1(densities[0])
                own = [
                    float(np.abs(a - b).sum() / b.sum())
                    for a, b in zip(densities, exact, strict=True)
                ]
                per_texel = pndf.nbytes / SIZE**2
                row.append(densities[0])
                noise = f"({reference.noise_floor:.2%})"
                print(
                    f"{name:10} {sigma:6g} tx  {kind:11} {error:6.2%}  {noise}"
                    f" {np.mean(own):15.2%}  ({max(own):.2%}) {ratio:18.2f} {per_texel:15.0f}",
                    flush=True,
                )
                results.append(
                    {
                        "map": name,
                        "sigma": sigma,
                        "elements": kind,
                        "relative_l1": error,
                        "noise": reference.noise_floor,
                        "relative_l1_without_noise": own,
                        "time_ratio_to_manifold": float(ratio),
                        "bytes_per_texel": per_texel,
                    }
                )
            if sigma == options.sigma[len(options.sigma) // 2]:
                peak = reference.density.max()
                pictures.append([colour_map(np.minimum(x[::-1] / peak, 1) ** 0.5) for x in row])
    if options.output:
        save_results(options.output / "elements_accuracy.json", {"results": results})
        save_pictures(options.output / "elements_accuracy.png", pictures)


if __name__ == "__main__":
    main()
