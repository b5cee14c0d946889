"""How near the filters of glint_filtered are to the map: moments, distributions, hand-over.

``python benchmarks/filtered_accuracy.py [--size 512] [-o RESULT.json]``

Three tables. *Moments*: mean and mean squares of slopes, of LEAN's lobe against sums over the map's
mesh of triangles in float64, for random footprints; errors relative to the root mean square slope
of the map, and to its square. Expected: a few tenths of a per cent at the levels' own footprints,
below 1 % where two levels mix or footprints are stretched, several per cent from one texel down,
where a lookup mixes the texels themselves in. *Distribution*: LEAN's lobe
against the binned P-NDF, blurred by the same roughness, relative L1; expected: the noise floor and
a few per cent on Gaussian maps at 128 texels. *Hand-over*: the same against the footprint's size,
for the blur of the sun's disk (half vectors of 0.0023 radians): how large a footprint must be for
glints to be gone. Expected: inversely proportional to the footprint's size in bumps on Gaussian
maps; never on scratches, whose slopes are not Gaussian at all.
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

from glintbsdf import maps  # noqa: E402
from glintbsdf.check.reference import binned_pndf, texel_covariance  # noqa: E402
from glintbsdf.check.truth import refined, wrapped  # noqa: E402
from glintbsdf.footprint.gaussian import Footprint  # noqa: E402
from glintbsdf.pndf import Filtered  # noqa: E402

#: Standard deviations of footprints, texels: levels of the chain, between levels, stretched.
FOOTPRINTS = [
    (0.5, 0.5),
    (1, 1),
    (2**0.5, 2**0.5),
    (8, 8),
    (16, 16),
    (1.2, 1.2),
    (3.4, 3.4),
    (7, 7),
    (27, 27),
    (3, 2),
    (4, 2),
    (8, 2),
    (16, 2),
    (30, 1.5),
]
SUN = 0.0023


def slope_maps(size: int) -> dict[str, glintbsdf.NormalMap]:
    return {
        "isotropic": maps.isotropic(size, seed=1),
        "brushed": maps.brushed(size, seed=1),
        "leather": maps.leather(size, seed=1),
        "scratched": maps.scratched(size, seed=1),
        "flakes": maps.flakes(size, seed=1),
    }


def mesh_moments(normal_map, uv, axes) -> np.ndarray:
    """Weighted sums over the map's mesh, to 4 standard deviations.

    9² points per texel: 3² would find mean squares of scratches too small by 3 %.
    """
    k = 9
    s = refined(normal_map, k)
    rows = []
    for place, axis in zip(uv, axes, strict=True):
        centre = place * [normal_map.width, normal_map.height]
        reach = np.ceil(4 * np.sqrt((axis**2).sum(axis=1))).astype(int)
        first = np.floor(centre).astype(int) - reach
        column, row = (
            np.arange(k * f, k * (f + 2 * r + 1)) for f, r in zip(first, reach, strict=True)
        )
        offset = np.stack(
            np.meshgrid((column + 0.5) / k - centre[0], (row + 0.5) / k - centre[1]), axis=-1
        )
        inverse = np.linalg.inv(axis @ axis.T)
        weight = np.exp(-0.5 * np.einsum("...i,ij,...j", offset, inverse, offset))
        taken = s[
            np.ix_(
                wrapped(row, k * normal_map.height, normal_map.wrap_mode),
                wrapped(column, k * normal_map.width, normal_map.wrap_mode),
            )
        ].astype(np.float64)
        x, y = np.moveaxis(taken / np.sqrt(1 - (taken**2).sum(axis=2, keepdims=True)), 2, 0)
        rows.append([np.average(m, weights=weight) for m in (x, y, x * x, y * y, x * y)])
    return np.array(rows)


def moment_errors(name: str, normal_map, count: int) -> list[dict]:
    pndf = Filtered(normal_map, "lean")
    mean_square = (np.linalg.norm(normal_map.roughness()) ** 2) / 2
    size = np.array([normal_map.width, normal_map.height])
    results = []
    for major, minor in FOOTPRINTS:
        rng = np.random.default_rng(3)
        angle = rng.uniform(0, np.pi, count)
        turn = np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])
        axes, uv = turn.transpose(2, 0, 1) * [major, minor], rng.random((count, 2))
        du, dv = np.float32(axes / size[:, None]).transpose(2, 1, 0)
        footprint = Footprint(mi.Point2f(np.float32(uv.T)), mi.Vector2f(du), mi.Vector2f(dv))
        got = np.stack([np.array(x) for x in pndf.pyramid.average(footprint)], axis=1)
        error = got - mesh_moments(normal_map, uv, axes)
        first = np.abs(error[:, :2]) / np.sqrt(mean_square)
        second = np.abs(error[:, 2:]) / mean_square
        row = {
            "map": name,
            "major": major,
            "minor": minor,
            "first_rms": float(np.sqrt((first**2).mean())),
            "first_max": float(first.max()),
            "second_rms": float(np.sqrt((second**2).mean())),
            "second_max": float(second.max()),
        }
        results.append(row)
        print(
            f"{name:10} {major:6.2f} {minor:6.2f} "
            + " ".join(
                f"{100 * row[key]:10.2f} %"
                for key in ("first_rms", "first_max", "second_rms", "second_max")
            ),
            flush=True,
        )
    return results


def distance(
    normal_map, method: str, uv, sigma: float, alpha: float, samples: int, res: int = 48
) -> tuple[float, float]:
    """Relative L1 between a lobe and the blurred binned P-NDF, and the noise's part of it."""
    reference = binned_pndf(
        normal_map,
        uv,
        texel_covariance(normal_map, sigma),
        sigma_r=alpha / np.sqrt(2),
        res=res,
        samples=samples,
    )
    points = 4
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
    density = Filtered(normal_map, method, alpha).eval(m, footprint).numpy()
    density = density.reshape(res, points, res, points).mean(axis=(1, 3))
    return reference.relative_l1(density), reference.noise_floor


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--size", type=int, default=512, help="side of the maps")
    parser.add_argument("--footprints", type=int, default=24, help="random ones per size")
    parser.add_argument("--samples", type=int, default=4_000_000, help="of each binned P-NDF")
    parser.add_argument("-o", "--output", type=Path, help="JSON file to write")
    options = parser.parse_args()

    print("Moments      σ, texels     first: rms, max            second: rms, max")
    moments = [
        row
        for name, normal_map in slope_maps(options.size).items()
        for row in moment_errors(name, normal_map, options.footprints)
    ]

    print("\nDistribution: σ 128 texels, alpha 0.05, relative L1 (noise)")
    gaussian = {
        "isotropic": maps.isotropic(options.size, seed=1),
        "fine": maps.isotropic(options.size, correlation_length=3, seed=2),
        "brushed": maps.brushed(options.size, streak_length=50, seed=1),
    }
    distributions = []
    for name, normal_map in gaussian.items():
        for method in ("lean", "leadr", "clean", "variance", "toksvig"):
            l1, noise = distance(normal_map, method, (0.4, 0.7), 128, 0.05, options.samples)
            distributions.append({"map": name, "method": method, "l1": l1, "noise": noise})
            print(f"{name:10} {method:9} {100 * l1:6.1f} % ({100 * noise:.1f} %)", flush=True)

    print("\nHand-over: LEAN against the P-NDF blurred by the sun's disk, relative L1 (noise)")
    hand_over = []
    for name, normal_map in slope_maps(options.size).items():
        for sigma in (4, 16, 64, 128, 256):
            l1, noise = distance(
                normal_map, "lean", (0.4, 0.7), sigma, np.sqrt(2) * SUN, options.samples
            )
            hand_over.append({"map": name, "sigma": sigma, "l1": l1, "noise": noise})
            print(f"{name:10} {sigma:5} texels {100 * l1:6.1f} % ({100 * noise:.1f} %)", flush=True)

    if options.output:
        options.output.write_text(
            json.dumps(
                {
                    "mitsuba": mi.__version__,
                    "drjit": dr.__version__,
                    "size": options.size,
                    "moments": moments,
                    "distributions": distributions,
                    "hand_over": hand_over,
                },
                indent=1,
            )
            + "\n"
        )


if __name__ == "__main__":
    main()
