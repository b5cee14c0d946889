"""The P-NDF level: error against the binned reference, time per query, memory, building."""

from __future__ import annotations

import os
import shutil
import time
from dataclasses import dataclass
from functools import partial

import drjit as dr
import mitsuba as mi
import numpy as np
from _common import seconds, seconds_in_turn

from glintbsdf import NormalMap
from glintbsdf.check.reference import BinnedPNDF, binned_pndf, normal_bounds, texel_covariance
from glintbsdf.footprint.gaussian import Footprint
from glintbsdf.pndf.manifold.mesh import TexelMesh

from .methods import EXACT, SIGMA_R, Method, Surface

#: Clamp of the Jacobian of those who have none: their own roughness hides it.
UNCLAMPED = 1e-6

#: Queries of a call that takes little more than to be traced.
FEW = 64

#: Most queries of a batch.
MOST = 2**18

#: Seconds that a query takes at least: where queries take no longer than tracing does, noise may
#: leave nothing of them.
LEAST = 1e-9

#: Independent sets of points, whose spread tells the noise of a bin's mean; and the mean of a
#: sample standard deviation of so many Gaussian numbers over the true one.
SETS, BIAS = 4, 0.9213

#: Most points of a set per bin and axis, if time allows.
MOST_POINTS = 16


@dataclass(frozen=True)
class Settings:
    """How the P-NDF level is measured.

    ``radii`` are 3σ of round footprints, texels; ``samples`` those of one reference; ``points``
    the most at which a density is averaged over bins, in ``patience`` seconds, if they took as long
    as random queries in one thread, which they do not; ``batch`` the seconds of a timed batch.
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


def build(method: Method, surface: Surface):
    """The estimator of a method. Without masking, which is no part of a P-NDF."""
    parameters = {"masking": "none"}
    if method.plugin["type"] == "glint_manifold":
        parameters["epsilon"] = surface.epsilon
    return mi.load_dict({**method.describe(surface), **parameters}).pndf


def structure(method: Method, surface: Surface, with_compiling: bool):
    """The estimator, and the seconds to build it, its memory, and the seconds to compile it.

    Nothing comes from the cache on disk. Compiling, of the code that builds and of that of the
    first query, is what takes longer the first time, with Dr.Jit's own cache emptied; None where
    it is not asked for, as it hardly depends on the map.
    """
    m, footprint = queries(surface, 16.0, FEW)
    compiling = None
    if with_compiling:
        forget_kernels()
        pndf, cold = timed(lambda: build(method, surface))
        cold += seconds(pndf.eval, m, footprint)
    pndf, building = timed(lambda: build(method, surface))
    if with_compiling:
        seconds(pndf.eval, m, footprint)
        compiling = max(cold - building - seconds(pndf.eval, m, footprint), 0.0)
    return pndf, {
        "build_seconds": building,
        "compile_seconds": compiling,
        "bytes": int(pndf.nbytes),
    }


def timed(action):
    """What an action returns, and the seconds it took, all kernels done."""
    dr.sync_thread()
    start = time.perf_counter()
    result = action()
    dr.sync_thread()
    return result, time.perf_counter() - start


def forget_kernels() -> None:
    """Make Dr.Jit compile again what it has compiled before."""
    dr.flush_kernel_cache()
    folder = os.environ["DRJIT_CACHE_DIR"]
    shutil.rmtree(folder, ignore_errors=True)
    os.makedirs(folder)


def texel_footprint(normal_map: NormalMap, uv: np.ndarray, sigma: float) -> Footprint:
    """Round footprints of ``sigma`` texels at ``uv``, 2×N: as many lanes as places."""
    u, v = (dr.opaque(mi.Float, sigma / n) for n in (normal_map.width, normal_map.height))
    centre = mi.Point2f(*(mi.Float(np.float32(x)) for x in uv))
    return Footprint(centre, mi.Vector2f(u, 0), mi.Vector2f(0, v))


def queries(surface: Surface, radius: float, count: int):
    """Random places on the map, each with a normal drawn from its own exact P-NDF.

    So a BSDF's samples ask; light sampling asks for other normals too, where D is often 0.
    """
    uv, u = np.random.default_rng(7).random((2, 2, count), dtype=np.float32)
    footprint = texel_footprint(surface.normal_map, uv, radius / 3)
    mesh = TexelMesh(surface.normal_map, epsilon=surface.epsilon)
    kernel = mesh.texel_kernel(footprint)
    m = mesh.normal_at(kernel.mean + kernel.sample(mi.Point2f(u)))
    dr.eval(m, footprint.uv)
    return m, footprint


def first(count: int, m, footprint):
    """The first of many queries."""
    index = dr.arange(mi.UInt32, count)
    part = type(footprint)(dr.gather(mi.Point2f, footprint.uv, index), footprint.du, footprint.dv)
    m = dr.gather(mi.Vector2f, m, index)
    dr.eval(m, part.uv)
    return m, part


# ------------------------------------------------------------------------------------------------
#  One footprint size of one map: all methods
# ------------------------------------------------------------------------------------------------


def measure(structures: dict[Method, object], surface: Surface, radius: float, settings: Settings):
    """A unit of the store: errors and times of all methods under footprints of one size."""
    per_query, ratios = times(structures, surface, radius, settings)
    # One grid of bins for all, as wide as the roughest needs.
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
                    texel_covariance(surface.normal_map, radius / 3),
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
            footprint = texel_footprint(surface.normal_map, np.array(place)[:, None], radius / 3)
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
                "times_faster_than_exact": ratios[method],
                **mean_of(results[method]),
            }
            for method, pndf in structures.items()
        ],
    }, pictures


def roughness(pndf) -> float:
    """σ_r that a P-NDF has besides the map's normals."""
    alpha = getattr(pndf, "alpha", None)
    if alpha is not None:  # a filter's: α² = 2σ²
        return round(float(alpha[0]) / 2**0.5, 9)
    return round(float(np.ravel(getattr(pndf, "sigma_r", 0.0))[0]), 9)


def in_bins(pndf, footprint: Footprint, reference: BinnedPNDF, affordable: float):
    """Mean of D over every bin of the reference, and its standard error, by jittered points.

    Bins in which the reference has found something share about ``affordable`` points; the others,
    which are empty or nearly so, have one in each of the sets.
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
        # As many lanes of the footprint as normals, like the queries that are timed.
        lanes = Footprint(dr.repeat(footprint.uv, dr.width(m)), footprint.du, footprint.dv)
        density = pndf.eval(m, lanes).numpy()
        return density.reshape(len(row), n * n).mean(axis=1, dtype=np.float64)

    found = reference.density > 0
    points = int(np.clip(np.sqrt(affordable / (SETS * found.sum())), 1, MOST_POINTS))
    mean, deviation = np.zeros((2, *found.shape))
    for bins, n in ((found, points), (~found, 1)):
        sets = [means(bins, n) for _ in range(SETS)]
        mean[bins] = np.mean(sets, axis=0)
        deviation[bins] = np.std(sets, axis=0, ddof=1) / (BIAS * SETS**0.5)
    return mean, deviation


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
    """What :func:`errors` an exact density would show, from the noise of both grids, in the mean.

    ``deviation`` is the standard error of the density. Bins in which the reference has found
    nothing are left out, as in :attr:`BinnedPNDF.noise_floor`.
    """
    own = np.where(reference.density > 0, reference.standard_error, 0)
    total = np.hypot(own, deviation)
    draws = np.random.default_rng(0).standard_normal((16, *total.shape))
    return mean_of([norms(np.abs(total * draw), reference) for draw in draws])


def mean_of(rows: list[dict[str, float]]) -> dict[str, float]:
    return {name: float(np.mean([row[name] for row in rows])) for name in rows[0]}


def times(structures: dict[Method, object], surface: Surface, radius: float, settings: Settings):
    """Median seconds per query of every method, and how many times faster than exact it is.

    One thread. All methods in turn within every repetition, after a warm-up that compiles and finds
    how many queries make a batch. The time of a call with few queries, which is that of tracing, is
    taken off.
    """
    many = queries(surface, radius, MOST)
    few = first(FEW, *many)
    threads = dr.thread_count()
    dr.set_thread_count(1)
    try:
        works, counts = [], []
        for pndf in structures.values():
            counts.append(batch_size(pndf, many, settings.batch))
            works.append(partial(batch, pndf, *few))
            works.append(partial(batch, pndf, *first(counts[-1], *many)))
        taken = seconds_in_turn(works, settings.repetitions)
        taken = (taken[:, 1::2] - taken[:, ::2]) / (np.array(counts) - FEW)
        taken = np.maximum(taken, LEAST)
    finally:
        dr.set_thread_count(threads)
    per_query = np.median(taken, axis=0)
    names = [method.name for method in structures]
    ratios = [None] * len(names)
    if EXACT.name in names:
        exact = taken[:, [names.index(EXACT.name)]]
        ratios = np.median(exact / taken, axis=0).tolist()
    return dict(zip(structures, per_query.tolist(), strict=True)), dict(
        zip(structures, ratios, strict=True)
    )


def batch_size(pndf, many, wanted: float) -> int:
    """How many of many queries take about ``wanted`` seconds besides tracing, from 2 ``FEW`` on."""
    traced = min(seconds(pndf.eval, *first(FEW, *many)) for _ in range(3))  # the first one compiles
    count = FEW
    while True:
        count *= 4
        taken = seconds(pndf.eval, *first(count, *many)) - traced
        if taken > 0.25 * wanted or count == MOST:
            break
    size = wanted / max(taken, LEAST) * count
    return int(np.clip(size, 2 * FEW, MOST)) // 8 * 8


def batch(pndf, m, footprint, repetition: int) -> mi.Float:
    """The same queries in every repetition."""
    return pndf.eval(m, footprint)
