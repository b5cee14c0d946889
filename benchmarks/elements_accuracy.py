"""Elements against the binned reference: error, time and memory by step (Yan16, Fig. 5 and 7).

``python benchmarks/elements_accuracy.py [--sigma 2 8 32] [-o DIR]``

P-NDFs on 96² bins under round footprints, σ_r = 0.005, three procedural maps of 256². The
reference draws from the map's mesh with the same roughness, without its clamp of flat triangles,
which roughness makes needless. Time is per query of one fifth of a million, of normals on a grid,
as a ratio to the exact manifold; memory in bytes per texel. Pictures: the reference, curved
elements at h = ½, 1, 2, flat ones at ½, a row for each map at the middle footprint.

Expected before measuring: at h = ½ 3 % and less, noise included; a third of the error with every
halving of h; flat elements ten times the error of curved ones; footprints of few texels worse, as
kinks of the mesh average out in large ones.
"""

from __future__ import annotations

import argparse
from pathlib import Path

import mitsuba as mi
import numpy as np

mi.set_variant("llvm_ad_rgb")

from _common import (  # noqa: E402
    ratios_to_first,
    save_pictures,
    save_results,
    seconds,
    seconds_in_turn,
)

from glintbsdf import Footprint, maps  # noqa: E402
from glintbsdf.pndf import Elements, Manifold  # noqa: E402
from glintbsdf.pndf_plot import colour_map  # noqa: E402
from glintbsdf.reference import binned_pndf, texel_covariance  # noqa: E402

SIZE, RES, POINTS = 256, 96, 5
SIGMA_R = 0.005
UV = (0.37, 0.61)
MAPS = {
    "isotropic": lambda: maps.isotropic(SIZE, seed=1),
    "brushed": lambda: maps.brushed(SIZE, seed=1),
    "scratched": lambda: maps.scratched(SIZE, seed=1),
}
KINDS = {
    "curved 1/2": (0.5, True),
    "curved 1": (1.0, True),
    "curved 2": (2.0, True),
    "flat 1/2": (0.5, False),
}


def grid(bounds) -> mi.Vector2f:
    """Normals at POINTS² places of every bin."""
    (x0, y0), (x1, y1) = bounds
    g = (np.arange(RES * POINTS) + 0.5) / (RES * POINTS)
    x, y = np.meshgrid(x0 + (x1 - x0) * g, y0 + (y1 - y0) * g)
    return mi.Vector2f(mi.Float(x.ravel()), mi.Float(y.ravel()))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--sigma", type=float, nargs="+", default=[2.0, 8.0, 32.0])
    parser.add_argument("--samples", type=int, default=20_000_000)
    parser.add_argument("--repetitions", type=int, default=3)
    parser.add_argument("-o", "--output", type=Path, help="directory for results and pictures")
    options = parser.parse_args()

    results, pictures = [], []
    print("map        footprint  elements     error  (noise)   × manifold's time   bytes/texel")
    for name, make in MAPS.items():
        normal_map = make()
        manifold = Manifold(normal_map)
        pndfs = {kind: Elements(normal_map, SIGMA_R, *v) for kind, v in KINDS.items()}
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
            footprint = Footprint.isotropic(mi.Point2f(UV), sigma / SIZE)

            def work(pndf, m=m, footprint=footprint):
                return lambda _seed: pndf.eval(m, footprint)

            works = [work(pndf) for pndf in (manifold, *pndfs.values())]
            for each in works:
                seconds(each, 0)
            times = ratios_to_first(seconds_in_turn(works, options.repetitions))[1:]
            row = [reference.density]
            for (kind, pndf), ratio in zip(pndfs.items(), times, strict=True):
                density = pndf.eval(m, footprint).numpy().astype(np.float64)
                density = density.reshape(RES, POINTS, RES, POINTS).mean(axis=(1, 3))
                error, per_texel = reference.relative_l1(density), pndf.nbytes / SIZE**2
                row.append(density)
                noise = f"({reference.noise_floor:.2%})"
                print(
                    f"{name:10} {sigma:6g} tx  {kind:11} {error:6.2%}  {noise}"
                    f" {ratio:15.2f} {per_texel:17.0f}",
                    flush=True,
                )
                results.append(
                    {
                        "map": name,
                        "sigma": sigma,
                        "elements": kind,
                        "relative_l1": error,
                        "noise": reference.noise_floor,
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
