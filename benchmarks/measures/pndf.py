"""Errors of P-NDFs against the binned reference, their noise, and the time of queries."""

from __future__ import annotations

import os
import shutil
from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial
from math import gamma

import drjit as dr
import mitsuba as mi
import numpy as np

from benchmarks.cases import Ellipse, Surface, queries
from benchmarks.harness import seconds, seconds_in_turn, single_thread, timed
from benchmarks.methods import EXACT, SIGMA_R, Method
from glintbsdf import Footprint
from glintbsdf.check import suite
from glintbsdf.check.reference import BinnedPNDF, binned_pndf, normal_bounds

#: Clamp of the Jacobian in the reference for methods that have a roughness instead of a clamp.
UNCLAMPED = 1e-6

#: A call with FEW queries takes little more than its tracing. A batch has at most MOST queries.
FEW, MOST = 64, 2**18

#: Smallest time of a query, seconds, as noise may exceed the time of a call that takes no longer
#: than its tracing.
LEAST = 1e-9

#: Number of independent sets of points for a bin's mean; their differences give its noise.
SETS = 4

#: Largest number of points per bin and axis in a set.
MOST_POINTS = 24


@dataclass(frozen=True)
class Settings:
    """Settings of the comparison of P-NDFs.

    ``radii`` are 3σ of round footprints, texels; ``samples`` is the number of samples of a
    reference. ``points`` is the largest number of points for averages over bins; fewer are used if
    they would take more than ``patience`` seconds. ``batch`` is the time of a timed batch, seconds.
    """

    size: int
    radii: tuple[float, ...]
    places: tuple[tuple[float, float], ...]
    res: int
    samples: int
    points: int
    patience: float
    repetitions: int
    batch: float


def structure(method: Method, surface: Surface, with_compiling: bool) -> tuple:
    """The P-NDF, and the seconds to build it, its memory, and the seconds to compile it.

    Caches on disk are not used. The time to compile is the additional time of a first build and
    query with Dr.Jit's cache empty. It hardly depends on the map; None without ``with_compiling``.
    """
    m, footprint = queries(surface.normal_map, Ellipse.round(16 / 3), FEW, surface.epsilon)
    compiling = None
    if with_compiling:
        forget_kernels()
        pndf, cold = timed(lambda: method.build(surface))
        cold += seconds(pndf.eval, m, footprint)
    pndf, building = timed(lambda: method.build(surface))
    if with_compiling:
        seconds(pndf.eval, m, footprint)
        compiling = max(cold - building - seconds(pndf.eval, m, footprint), 0.0)
    figures = {"build_seconds": building, "compile_seconds": compiling, "bytes": int(pndf.nbytes)}
    return pndf, figures


def forget_kernels() -> None:
    """Empty Dr.Jit's caches, so that it compiles every kernel again."""
    dr.flush_kernel_cache()
    folder = os.environ["DRJIT_CACHE_DIR"]
    shutil.rmtree(folder, ignore_errors=True)
    os.makedirs(folder)


# --------------------------------------------------------------------------------------------------
#  One footprint size of one map: all methods
# --------------------------------------------------------------------------------------------------


def measure(structures: dict[Method, object], surface: Surface, radius: float, settings: Settings):
    """Return errors and times of all methods under footprints of one size: a unit of the store."""
    ellipse = Ellipse.round(radius / 3)
    many = queries(surface.normal_map, ellipse, MOST, surface.epsilon)
    taken, ratios = times(structures.values(), many, settings.repetitions, settings.batch)
    per_query = dict(zip(structures, taken.tolist(), strict=True))
    if EXACT not in structures:
        ratios = [None] * len(ratios)
    # All have the same grid of bins, as wide as the roughest method needs.
    rough = any(roughness(pndf) > 0 for pndf in structures.values())
    bounds = normal_bounds(surface.normal_map, surface.epsilon, SIGMA_R if rough else 0.0)
    nothing = np.zeros((settings.res, settings.res))
    results = {method: [] for method in structures}
    floors: dict[float, list[dict]] = {}
    pictures = {}
    for place in settings.places:
        references: dict[float, BinnedPNDF] = {}
        for method, pndf in structures.items():
            sigma_r = roughness(pndf)
            if sigma_r not in references:
                references[sigma_r] = binned_pndf(
                    surface.normal_map,
                    place,
                    ellipse.covariance(surface.normal_map),
                    epsilon=surface.epsilon if sigma_r == 0 else UNCLAMPED,
                    sigma_r=sigma_r,
                    res=settings.res,
                    bounds=bounds,
                    samples=settings.samples,
                )
                floors.setdefault(sigma_r, []).append(noise(references[sigma_r], nothing))
                pictures.setdefault(
                    f"reference {sigma_r:g}", references[sigma_r].density.astype(np.float32)
                )
            footprint = ellipse.at(surface.normal_map, np.array(place)[:, None])
            affordable = min(settings.patience / per_query[method], settings.points)
            density, deviation = in_bins(pndf, footprint, references[sigma_r], affordable)
            pictures.setdefault(method.name, density.astype(np.float32))
            own_noise = noise(references[sigma_r], deviation)
            results[method].append(
                errors(references[sigma_r], density)
                | {f"noise_{name}": value for name, value in own_noise.items()}
            )
    return {
        "map": surface.name,
        "radius": radius,
        "noise_floor": {f"{sigma_r:g}": mean_of(rows) for sigma_r, rows in floors.items()},
        "points": [
            {
                "method": method.name,
                "family": method.family,
                "setting": method.setting,
                "sigma_r": roughness(pndf),
                "bytes": int(pndf.nbytes),
                "seconds_per_query": per_query[method],
                "times_faster_than_exact": ratio,
                **mean_of(results[method]),
            }
            for (method, pndf), ratio in zip(structures.items(), ratios, strict=True)
        ],
    }, pictures


def roughness(pndf) -> float:
    """Return the roughness σ_r that a P-NDF adds to the map's normals."""
    alpha = getattr(pndf, "alpha", None)
    if alpha is not None:  # a filter's: α² = 2σ²
        return round(float(alpha[0]) / 2**0.5, 9)
    return round(float(np.ravel(getattr(pndf, "sigma_r", 0.0))[0]), 9)


def in_bins(
    pndf,
    footprint: Footprint,
    reference: BinnedPNDF,
    affordable: float,
    sets: int = SETS,
    empty: int = 1,
) -> tuple[np.ndarray, np.ndarray]:
    """Mean of D over every bin of the reference, and its standard error, by jittered points.

    Bins with samples of the reference share about ``affordable`` points. All other bins, which are
    almost empty, have ``empty``² points in each of the ``sets``.
    """
    lower, upper = np.array(reference.bounds)
    size = (upper - lower) / reference.density.shape[::-1]
    rng = np.random.default_rng(0)

    def means(bins: np.ndarray, n: int) -> np.ndarray:
        """Mean of D over n×n points in each of the bins."""
        row, column = np.nonzero(bins)
        corner = np.stack([column, row], axis=-1)[:, None]
        stratum = np.stack(np.divmod(np.arange(n * n), n), axis=-1)
        place = corner + (stratum + rng.random((len(row), n * n, 2))) / n
        m = mi.Vector2f(np.float32((lower + size * place).reshape(-1, 2).T))
        # The footprint has a lane for each normal, like the queries that are timed.
        lanes = Footprint(dr.repeat(footprint.uv, dr.width(m)), footprint.du, footprint.dv)
        density = pndf.eval(m, lanes).numpy()
        return density.reshape(len(row), n * n).mean(axis=1, dtype=np.float64)

    found = reference.density > 0
    points = int(np.clip(np.sqrt(affordable / (sets * found.sum())), 1, MOST_POINTS))
    mean, deviation = np.zeros((2, *found.shape))
    for bins, n in ((found, points), (~found, empty)):
        found_means = [means(bins, n) for _ in range(sets)]
        mean[bins] = np.mean(found_means, axis=0)
        deviation[bins] = np.std(found_means, axis=0, ddof=1) / (bias(sets) * sets**0.5)
    return mean, deviation


def bias(count: int) -> float:
    """Mean of the sample standard deviation of ``count`` Gaussian numbers, over the true one."""
    return (2 / (count - 1)) ** 0.5 * gamma(count / 2) / gamma((count - 1) / 2)


def p_value(
    reference: BinnedPNDF, density: np.ndarray, deviation: np.ndarray, samples: int, sets: int
) -> float:
    """The p-value of a χ² test of the reference's ``samples`` against a density from ``sets``."""
    area = reference.bin_area
    # With a variance that is estimated from n sets, a square follows the square of Student's t
    # distribution, whose mean is this factor.
    deviation = deviation * bias(sets) * ((sets - 1) / (sets - 3)) ** 0.5
    return suite.p_value(
        samples * area * reference.density, samples, area * density, area * deviation
    )


def errors(reference: BinnedPNDF, density: np.ndarray) -> dict[str, float]:
    """Relative L1, L2 and maximum difference to a reference."""
    return norms(np.abs(density - reference.density), reference)


def norms(difference: np.ndarray, reference: BinnedPNDF) -> dict[str, float]:
    truth = reference.density
    return {
        "l1": float(difference.sum() / truth.sum()),
        "l2": float(np.sqrt((difference**2).sum() / (truth**2).sum())),
        "maximum": float(difference.max() / truth.max()),
    }


def noise(reference: BinnedPNDF, deviation: np.ndarray) -> dict[str, float]:
    """The expected :func:`errors` of an exact density, from the noise of both grids.

    ``deviation`` is the standard error of the density. In bins without samples, the reference has
    no noise, as in :attr:`BinnedPNDF.noise_floor`.
    """
    own = np.where(reference.density > 0, reference.standard_error, 0)
    total = np.hypot(own, deviation)
    draws = np.random.default_rng(0).standard_normal((16, *total.shape))
    return mean_of([norms(np.abs(total * draw), reference) for draw in draws])


def mean_of(rows: list[dict[str, float]]) -> dict[str, float]:
    return {name: float(np.mean([row[name] for row in rows])) for name in rows[0]}


# --------------------------------------------------------------------------------------------------
#  Times
# --------------------------------------------------------------------------------------------------


def times(
    pndfs: Sequence, many: tuple, repetitions: int, batch_seconds: float = 0.05
) -> tuple[np.ndarray, list[float]]:
    """Median seconds per query of every P-NDF, and how many times faster than the first it is.

    One thread is used. All P-NDFs run in turn within every repetition. A warm-up compiles, and
    finds the size of a batch of the ``many`` queries. The time of a call with few queries, which is
    the time of tracing, is subtracted.
    """
    few = first(FEW, *many)
    with single_thread():
        works, counts = [], []
        for pndf in pndfs:
            counts.append(batch_size(pndf, many, batch_seconds))
            works.append(partial(batch, pndf, *few))
            works.append(partial(batch, pndf, *first(counts[-1], *many)))
        taken = seconds_in_turn(works, repetitions)
    taken = (taken[:, 1::2] - taken[:, ::2]) / (np.array(counts) - FEW)
    taken = np.maximum(taken, LEAST)
    return np.median(taken, axis=0), np.median(taken[:, :1] / taken, axis=0).tolist()


def first(count: int, m: mi.Vector2f, footprint: Footprint) -> tuple:
    """Return the first of many queries."""
    index = dr.arange(mi.UInt32, count)
    part = type(footprint)(dr.gather(mi.Point2f, footprint.uv, index), footprint.du, footprint.dv)
    m = dr.gather(mi.Vector2f, m, index)
    dr.eval(m, part.uv)
    return m, part


def batch_size(pndf, many: tuple, wanted: float) -> int:
    """The number of queries, at least 2 ``FEW``, that take ``wanted`` seconds besides tracing."""
    most = dr.width(many[0])
    traced = min(seconds(pndf.eval, *first(FEW, *many)) for _ in range(3))  # the first one compiles
    count = FEW
    while True:
        count = min(4 * count, most)
        taken = seconds(pndf.eval, *first(count, *many)) - traced
        if taken > 0.25 * wanted or count == most:
            break
    size = wanted / max(taken, LEAST) * count
    return int(np.clip(size, 2 * FEW, most)) // 8 * 8


def batch(pndf, m: mi.Vector2f, footprint: Footprint, repetition: int) -> mi.Float:
    """Evaluate the same queries, whatever the repetition."""
    return pndf.eval(m, footprint)
