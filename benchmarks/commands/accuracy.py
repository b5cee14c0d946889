"""Errors of P-NDFs that error_vs_time does not measure.

Beside an error, every part prints the noise of the reference: the relative L1 difference of an
exact density.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import cache, partial

import numpy as np

from benchmarks.cases import PLACES, Ellipse, grid_of_normals, maps_of
from benchmarks.harness import Run, family
from benchmarks.measures import pndf as errors
from glintbsdf import NormalMap
from glintbsdf.check.reference import binned_pndf
from glintbsdf.footprint.kernels import KERNELS
from glintbsdf.pndf import Filtered, Manifold

# --------------------------------------------------------------------------------------------------
#  Exactness
# --------------------------------------------------------------------------------------------------

#: Clamp of the Jacobian: the bins must resolve the clamped triangles.
EPSILON = 1e-3

ELLIPSES = (
    *(Ellipse.round(sigma) for sigma in (0.5, 2, 20, 200)),
    Ellipse(4, 0.5, 30),
    Ellipse(60, 2),
    Ellipse(60, 2, 115),
    Ellipse(200, 3, 63),
)
SETS = 16


def exactness(
    build: Callable[[], Manifold], make: Callable[[], NormalMap], kernel: str, ellipse: Ellipse
) -> dict:
    """Error of the exact P-NDF, the error from noise alone, and the p-value of Pearson's χ²
    test."""
    manifold, normal_map = build(), make()
    area, samples = ellipse.major * ellipse.minor, 1_000_000
    # Enough points for the spikes of small footprints, within a minute.
    res, points = (32, 24) if area <= 20 else (32, 8) if area <= 1000 else (16, 4)
    options = {"kernel": kernel, "epsilon": EPSILON, "res": res, "samples": samples, "seed": 1}
    reference = binned_pndf(normal_map, PLACES[0], ellipse.covariance(normal_map), **options)
    footprint = ellipse.at(normal_map, np.array(PLACES[0])[:, None])
    density, deviation = errors.in_bins(
        manifold, footprint, reference, SETS * res**2 * points**2, SETS, points
    )
    return {
        "relative_l1": reference.relative_l1(density),
        "noise": errors.noise(reference, deviation)["l1"],
        "p_value": errors.p_value(reference, density, deviation, samples, SETS),
    }


def exact(run: Run) -> None:
    """The exact manifold P-NDF on every procedural map, with all kernels.

    Footprints have 0.5 to 200 texels, are round or stretched, and along the axes or rotated. The
    counts of the reference have noise, and so have the averages of the density over a bin, whose
    error is measured. Expected: p-values uniform in [0, 1], so the smallest of n is about 1/n.
    """
    names = ("isotropic", "brushed", "scratched", "flakes", "leather", "flat", "tilted")
    with run.table("exact") as table:
        for name, make in maps_of(run, 512, *names[:1] if run.quick else names).items():
            for kernel in KERNELS:
                build = cache(lambda make=make, kernel=kernel: Manifold(make(), kernel, EPSILON))
                for ellipse in ELLIPSES:
                    if ellipse.major > 60 and (run.quick or kernel == "disk"):
                        continue
                    key = {"map": name, "kernel": kernel, "footprint": str(ellipse)}
                    work = partial(exactness, build, make, kernel, ellipse)
                    table.measure(key, work)


# --------------------------------------------------------------------------------------------------
#  Filters
# --------------------------------------------------------------------------------------------------

#: Radius of the sun's half vectors, in projected normals.
SUN = 0.0023


def distance(make: Callable[[], NormalMap], sigma: float, samples: int) -> dict:
    """Relative L1 difference of LEAN's lobe and the blurred binned P-NDF, and that of noise
    alone."""
    normal_map, ellipse, res, points = make(), Ellipse.round(sigma), 48, 4
    options = {"sigma_r": SUN, "res": res, "samples": samples}
    reference = binned_pndf(normal_map, (0.4, 0.7), ellipse.covariance(normal_map), **options)
    m = grid_of_normals(reference.bounds, res * points)
    footprint = ellipse.at(normal_map, np.array([[0.4], [0.7]]))
    density = Filtered(normal_map, "lean", 2**0.5 * SUN).eval(m, footprint).numpy()
    density = density.reshape(res, points, res, points).mean(axis=(1, 3))
    return {"relative_l1": reference.relative_l1(density), "noise": reference.noise_floor}


def hand_over(run: Run) -> None:
    """LEAN's lobe against the P-NDF, both blurred by the sun's disk, for sizes of the footprint.

    It answers for which footprints glints are gone.
    """
    size, samples = (256, 500_000) if run.quick else (512, 4_000_000)
    names = ("isotropic", "brushed", "leather", "scratched", "flakes")
    with run.table("hand_over") as table:
        for name, make in maps_of(run, size, *names).items():
            for sigma in (4, 64) if run.quick else (4, 16, 64, 128, 256):
                work = partial(distance, make, sigma, samples)
                table.measure({"map": name, "sigma": sigma}, work)


accuracy = family("accuracy", exact, hand_over)
