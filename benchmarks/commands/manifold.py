"""glint_manifold (Wu24): errors of tables; images for tables, clusters, kernels and maskings.

``error_vs_time`` measures errors, times and memory of a query for values of ``max_error`` and τ.
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

#: Footprints whose smaller axes have radii r = 3σ of 16 to 512 texels.
ELLIPSES = (
    *(Ellipse.round(radius / 3) for radius in (16, 32, 64, 128, 256, 512)),
    Ellipse(128 / 3, 64 / 3, 30),
    Ellipse(256 / 3, 128 / 3, 115),
)


def table_errors(pndf: TabulatedManifold, ellipse: Ellipse) -> dict:
    """Level, mean predicted and measured error, and ratio of both: of the means, and the largest.

    The level is −1 where evaluation is exact.
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
    """Predicted and measured errors of tables with ``max_error`` 0.05, for all kernels.

    Measured errors are those of the masses in the tables' bins, without sampling noise, averaged
    over places. Expected: a measured error is between half of the predicted one and the whole.
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
#  Images
# --------------------------------------------------------------------------------------------------


def compare(
    run: Run, part: str, name: str, radius: float, settings: dict[str, dict], noise: int = 0
) -> None:
    """Images of the curved patch for each setting: differences from the first setting, and times.

    ``name`` is the name of the map, ``radius`` the radius of footprints, texels. Images are clipped
    to [0, 1], as on a screen; otherwise the brightest glints would dominate a mean square. The seed
    of the reference, which has the first setting, is larger by ``noise``.
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
    """The material of all images of a comparison, without the setting."""
    return {
        "type": "glint_manifold",
        "data": mi.TensorXf(MAPS[name](texels).normals),
        "to_uv": scaled(UV_SCALE),
        "material": "Cr",
        "pixel_spread": spread_for(radius, texels, 96),
        "masking": "beckmann",
    }


def renders(run: Run) -> None:
    """Scratches by clusters and by tables, with 64² texels per footprint (Fig. 15, Table 3).

    The row "exact" is the noise. Expected: errors of clusters grow with τ, as in the paper; errors
    of tables are within the noise.
    """
    settings = {"exact": {}} | {f"τ = {t:g}": {"threshold": t} for t in (0.01, 0.1, 1.0, 10.0)}
    settings |= {f"max_error = {e:g}": {"max_error": e} for e in (0.02, 0.05, 0.2)}
    compare(run, "renders", "scratched", 32, settings, noise=98)


def kernels(run: Run) -> None:
    """The isotropic map with the Gaussian of 128² texels, the disk and the box of 64² (Fig. 16).

    Expected: disk and box look the same, and take half of the time.
    """
    settings = {kernel: {"kernel": kernel} for kernel in KERNELS}
    compare(run, "kernels", "isotropic", 64, settings)


def masking(run: Run) -> None:
    """Each masking against the analytic one (Fig. 12).

    Expected: the fit differs by less than 1 %, and takes a tenth of the time.
    """
    settings = {m: {"masking": m} for m in ("analytic", "ggx_fit", "beckmann", "none")}
    compare(run, "masking", "isotropic", 4, settings)


manifold = family("manifold", tables, renders, kernels, masking)
