"""The GPU: numbers against LLVM's, throughput, the curved patch, and Tan22's full-HD P-NDF.

It runs in ``cuda_ad_rgb`` where there is a GPU, whatever ``-m`` says, else in the given variant and
with fewer queries, and it says which. On a GPU it takes less than 8 minutes.
"""

from __future__ import annotations

import gc
from collections.abc import Callable
from contextlib import contextmanager
from functools import cache, partial

import drjit as dr
import mitsuba as mi
import numpy as np

from benchmarks.cases import PATCH_MAP, Ellipse, Surface, maps_of, queries
from benchmarks.commands.cost import on_patch
from benchmarks.commands.front import PLUGINS, STOCK, WITHOUT_MAP
from benchmarks.harness import Run, family, seconds, seconds_in_turn
from benchmarks.methods import METHODS, Method
from glintbsdf import Footprint, NormalMap
from glintbsdf.check import suite
from glintbsdf.core.loops import arrays_in

#: Standard deviations of footprints, texels; width and height of the picture of Tan22.
SIGMAS, FULL_HD = (1.3, 10.0), (1920, 1080)


@contextmanager
def on_device(run: Run):
    """The variant that is measured: yields whether it is on a GPU."""
    given, gpu = mi.variant(), bool(dr.has_backend(dr.JitBackend.CUDA))
    mi.set_variant("cuda_ad_rgb" if gpu else given)
    if not gpu:
        run.console.print(f"No GPU was found: these are numbers of {given}.")
    try:
        yield gpu
    finally:
        mi.set_variant(given)


def sample_map(size: int) -> NormalMap:
    """The isotropic map of all parts."""
    (make,) = maps_of(Run(), size, "isotropic").values()
    return make()


# --------------------------------------------------------------------------------------------------
#  Agreement
# --------------------------------------------------------------------------------------------------


def made(name: str, normal_map: NormalMap) -> mi.BSDF:
    """A BSDF of :data:`~benchmarks.commands.front.PLUGINS` in the active variant."""
    plugin = PLUGINS[name]
    if plugin["type"] not in WITHOUT_MAP:
        plugin = plugin | {"data": mi.TensorXf(normal_map.normals)}
    if plugin["type"] == "glint_mip":
        plugin |= {"output_size": 4 * normal_map.width}
    return mi.load_dict(plugin)


def values(bsdf: mi.BSDF, view: suite.View, count: int) -> tuple[np.ndarray, np.ndarray]:
    """Values (N,) and densities (N,) of fixed directions."""
    u, v = suite.random_numbers(count, 2, 3)
    wo = dr.normalize(mi.Vector3f(0.4 * u - 0.2, 0.4 * v - 0.2, 1))
    value, pdf = bsdf.eval_pdf(mi.BSDFContext(), view.interaction(count), wo)
    return np.array(suite.intensity(value), np.float64)[0], np.array(pdf, np.float64)


def agreement_of(name: str, normal_map: NormalMap, count: int) -> dict:
    """A row: relative L1 differences from LLVM, and what the checks of the suite say."""
    device = mi.variant()
    sigma = 3 / normal_map.width
    view = suite.View(du=(sigma, 0), dv=(0, sigma), wi=(0.1, 0.05, 1))
    bsdf = made(name, normal_map)
    found = values(bsdf, view, count)
    failed = []
    for check in (suite.check_eval_pdf, suite.check_weights, suite.check_horizon):
        try:
            check(bsdf, view)
        except AssertionError as error:
            failed.append(f"{check.__name__}: {error}")
    mi.set_variant("llvm_ad_rgb")
    expected = values(made(name, normal_map), view, count)
    mi.set_variant(device)
    value, pdf = (
        float(np.abs(a - b).sum() / np.abs(b).sum()) for a, b in zip(found, expected, strict=True)
    )
    return {"value": value, "pdf": pdf, "suite": "; ".join(failed) or "passed"}


def agreement(run: Run) -> None:
    """Every plugin: relative L1 difference of values and densities from those of LLVM, and the
    consistency checks of the shared suite. Expected: 1e-4, from another order of sums."""
    normal_map, count = sample_map(64 if run.quick else 256), 1000 if run.quick else 100_000
    names = (
        ["glint_manifold", "glint_filtered"] if run.quick else [n for n in PLUGINS if n != STOCK]
    )
    with on_device(run), run.table("agreement") as table:
        for name in names:
            table.measure({"plugin": name}, partial(agreement_of, name, normal_map, count))


# --------------------------------------------------------------------------------------------------
#  Throughput
# --------------------------------------------------------------------------------------------------


def frozen(pndf, m: mi.Vector2f, footprint: Footprint) -> Callable:
    """``pndf.eval(m, footprint)`` as a frozen function of these arrays, recorded here.

    Dr.Jit (1.5) aborts if Python collects garbage with arrays made of NumPy's while it records.
    """
    dr.eval(pndf.eval(m, footprint))  # whatever is made at the first use
    arrays = arrays_in(pndf)

    @dr.freeze(state_fn=lambda *_: arrays)
    def evaluate(m, uv, du, dv):
        return pndf.eval(m, Footprint(uv, du, dv))

    gc.collect()
    gc.disable()
    try:
        dr.eval(evaluate(m, footprint.uv, footprint.du, footprint.dv))
    finally:
        gc.enable()
    return lambda *_: evaluate(m, footprint.uv, footprint.du, footprint.dv)


def timed_queries(pndf, normal_map: NormalMap, sigma: float, count: int, repetitions: int) -> dict:
    """Times of ``count`` queries: recorded anew each time, and frozen."""
    m, footprint = queries(normal_map, Ellipse.round(sigma), count)
    works = [lambda *_: pndf.eval(m, footprint), frozen(pndf, m, footprint)]
    for work in works:
        seconds(work)
    traced, replayed = np.median(seconds_in_turn(works, repetitions), axis=0)
    return {
        "milliseconds": 1e3 * float(replayed),
        "milliseconds_unfrozen": 1e3 * float(traced),
        "million_per_second": 1e-6 * count / float(replayed),
        "structure_megabytes": pndf.nbytes / 1e6,
        "peak_megabytes": dr.detail.malloc_watermark(dr.backend_v(mi.Float)) / 1e6,
    }


def throughput(run: Run) -> None:
    """Queries per second of every method with a map of 1024² texels, with frozen kernels."""
    normal_map = sample_map(128 if run.quick else 1024)
    with on_device(run) as gpu, run.table("throughput") as table:
        count = (1 << 22) if gpu else (1 << 12 if run.quick else 1 << 16)
        for method in METHODS:
            if not (method.mapped and method.quick) or (run.quick and method.rung):
                continue
            pndf = cache(lambda method=method: of_map(method, normal_map))
            for sigma in SIGMAS:
                table.measure(
                    {"method": method.name, "sigma": sigma},
                    lambda pndf=pndf, s=sigma: timed_queries(
                        pndf(), normal_map, s, count, run.repetitions
                    ),
                )


def of_map(method: Method, normal_map: NormalMap):
    """The P-NDF of a method; one that synthesises its map does so from a corner of this one."""
    corner = NormalMap(np.ascontiguousarray(normal_map.normals[:256, :256]))
    return method.build(Surface("isotropic", normal_map, sample=corner))


def patch(run: Run) -> None:
    """Frames of the curved patch for footprints of a pixel, relative to roughconductor."""
    normal_map = sample_map(64) if run.quick else NormalMap.load(PATCH_MAP)
    with on_device(run), run.table("patch") as table:
        for method in METHODS:
            if not (method.cost and method.mapped and method.quick) or (run.quick and method.rung):
                continue
            work = partial(on_patch, method, (1,), normal_map, 32 if run.quick else 400, run)
            table.measure({"method": method.name}, work)


def full_hd(run: Run) -> None:
    """The P-NDF alone, 1920 × 1080 queries, of a map of 4096² from a sample of 256².

    Expected: Tan22 takes 9.4 ms on a TITAN RTX; 1 ms or less on a GPU of today.
    """
    (method,) = (m for m in METHODS if m.synthesises and m.rung == 32 and m.quick)
    side = 512 if run.quick else 4096
    with on_device(run), run.table("full_hd") as table:
        normal_map = sample_map(side)
        pndf = cache(lambda: of_map(method, normal_map))
        count = FULL_HD[0] * FULL_HD[1] // (100 if run.quick else 1)
        for sigma in SIGMAS:
            table.measure(
                {"method": method.name, "sigma": sigma},
                lambda s=sigma: timed_queries(pndf(), normal_map, s, count, run.repetitions),
            )


gpu = family("gpu", agreement, throughput, patch, full_hd)
