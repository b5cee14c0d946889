"""glint_manifold (Wu24): errors of its tables; pictures by tables, clusters, kernels and masking.

Errors, times and memory of a query by ``max_error`` and by τ are in ``error_vs_time``.
"""

from __future__ import annotations

from functools import cache, partial

import mitsuba as mi
import numpy as np

from benchmarks.cases import MAPS, UV_SCALE, Ellipse, curved_patch, maps_of, scaled, spread_for
from benchmarks.harness import Run, family, rmse
from benchmarks.measures.images import in_turn
from glintbsdf.footprint.kernels import KERNELS
from glintbsdf.pndf import TabulatedManifold

NAMES = ("isotropic", "smooth", "brushed", "scratched", "flakes", "leather")

#: Their smaller axes have radii r = 3σ of 16 to 512 texels.
ELLIPSES = (
    *(Ellipse.round(radius / 3) for radius in (16, 32, 64, 128, 256, 512)),
    Ellipse(128 / 3, 64 / 3, 30),
    Ellipse(256 / 3, 128 / 3, 115),
)


def table_errors(pndf: TabulatedManifold, ellipse: Ellipse) -> dict:
    """Level in use, predicted and measured error, their ratio, of the means and at the worst place.

    The level is −1 where the lists answer, exactly.
    """
    predicted, measured = [], []
    for place in ((0.47, 0.52), (0.13, 0.77), (0.86, 0.31)):
        footprint = ellipse.at(pndf.normal_map, np.array(place)[:, None])
        level = int(np.array(pndf.level(footprint)).item())
        if level < 0:
            return {"level": level, "measured": 0.0}
        predicted.append(float(np.array(pndf.error(pndf.texel_kernel(footprint), level)).item()))
        measured.append(pndf.measured_error(footprint))
    return {
        "level": level,
        "predicted": float(np.mean(predicted)),
        "measured": float(np.mean(measured)),
        "ratio": float(np.mean(measured) / np.mean(predicted)),
        "worst": float(np.max(np.divide(measured, predicted))),
    }


def tables(run: Run) -> None:
    """Errors of tables of ``max_error`` 0.05, predicted and measured, for all kernels.

    The measured ones are on the tables' bins, without sampling noise, and averaged over places.
    Expected: between a half and the whole of the predicted ones.
    """
    size, names = (512, NAMES[:1]) if run.quick else (1024, NAMES)
    with run.table("tables") as table:
        for name, make in maps_of(run, size, *names).items():
            for kernel in KERNELS:
                options = {"kernel": kernel, "max_error": 0.05}
                build = cache(lambda make=make, o=options: TabulatedManifold(make(), **o))
                for ellipse in ELLIPSES[:4] if run.quick else ELLIPSES:
                    key = {"map": name, "kernel": kernel, "sigma": str(ellipse)}
                    table.measure(key, lambda b=build, e=ellipse: table_errors(b(), e))


# --------------------------------------------------------------------------------------------------
#  Pictures
# --------------------------------------------------------------------------------------------------


def compare(
    run: Run, part: str, name: str, radius: float, settings: dict[str, dict], noise: int = 0
) -> None:
    """Pictures of the curved patch by setting: differences from the first one's, and times.

    ``name`` is that of the map, and ``radius`` that of footprints, texels. Pictures are clipped to
    [0, 1], what a screen shows: the brightest glints would outweigh all else in a mean square. The
    first one's is rendered once more with a seed that is ``noise`` larger, for the differences.
    """
    size, spp = (96, 16) if run.quick else (192, 64)
    shared = cache(lambda: shared_by_all(name, radius, 512 if run.quick else 1024))
    first = next(iter(settings))

    def scene(title: str) -> mi.Scene:
        return curved_patch(shared() | settings[title], size, spp)

    @cache
    def picture(title: str, seed: int) -> np.ndarray:
        return np.clip(np.array(mi.render(scene(title), spp=spp, seed=seed)), 0, 1)

    def measured(title: str) -> dict:
        reference, image = picture(first, 1 + noise), picture(title, 1)
        run.save_pictures(f"{part}_{title}", [[image]])
        times = in_turn((scene(first), scene(title)), spp, run.repetitions)
        error = rmse(image, reference) / float(reference.mean())
        return {"relative_rmse": error, "time": times["ratio"]}

    with run.table(part) as table:
        for title in settings:
            table.measure({"setting": title}, partial(measured, title))


def shared_by_all(name: str, radius: float, texels: int) -> dict:
    """The material of all pictures of a comparison, but for the setting."""
    return {
        "type": "glint_manifold",
        "data": mi.TensorXf(MAPS[name](texels).normals),
        "to_uv": scaled(UV_SCALE),
        "material": "Cr",
        "pixel_spread": spread_for(radius, texels, 96),
        "masking": "beckmann",
    }


def renders(run: Run) -> None:
    """Scratches by clusters and by tables, 64² texels a footprint (Fig. 15, Table 3).

    The row "exact" is the noise. Expected: errors grow with τ, as in the paper; those of tables
    stay within the noise.
    """
    settings = {"exact": {}} | {f"τ = {t:g}": {"threshold": t} for t in (0.01, 0.1, 1.0, 10.0)}
    settings |= {f"max_error = {e:g}": {"max_error": e} for e in (0.02, 0.05, 0.2)}
    compare(run, "renders", "scratched", 32, settings, noise=98)


def kernels(run: Run) -> None:
    """The isotropic map by the Gaussian of 128² texels, the disk and the box, of 64² (Fig. 16).

    Expected: half the time; the same look.
    """
    settings = {kernel: {"kernel": kernel} for kernel in KERNELS}
    compare(run, "kernels", "isotropic", 64, settings)


def masking(run: Run) -> None:
    """Each masking beside the analytic one (Fig. 12).

    Expected: the fit within 1 %, at a tenth of the time.
    """
    settings = {m: {"masking": m} for m in ("analytic", "ggx_fit", "beckmann", "none")}
    compare(run, "masking", "isotropic", 4, settings)


manifold = family("manifold", tables, renders, kernels, masking)
