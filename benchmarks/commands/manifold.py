"""glint_manifold (Wu24): errors of tables.

``error_vs_time`` measures errors, times and memory of a query for values of ``max_error`` and τ.
"""

from __future__ import annotations

from functools import cache

import numpy as np

from benchmarks.cases import Ellipse, maps_of
from benchmarks.harness import Run, family
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


manifold = family("manifold", tables)
