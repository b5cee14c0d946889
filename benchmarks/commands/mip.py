"""Lobes of glint_mip (Tan22): the blend of their levels, and the seams of the map.

The samples have 256² texels, the maps 2048². Footprints are round and w = 2σ texels wide.
Differences are relative L1 differences on a grid of 128² normals over the range of the map's
normals, with σ_r = 0.005. ``error_vs_time`` measures errors, times and memory for numbers of lobes
and values of C_P; ``front`` measures building.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import partial

import drjit as dr
import mitsuba as mi
import numpy as np

from benchmarks.cases import (
    PLACES,
    SYNTHESIS,
    Ellipse,
    grid_of_normals,
    maps_of,
)
from benchmarks.harness import Run, family
from benchmarks.methods import SIGMA_R
from glintbsdf import NormalMap
from glintbsdf.check import suite
from glintbsdf.check.stiff import white_noise
from glintbsdf.maps.quilting import lobe_features, synthesise
from glintbsdf.pndf import Mip

RES = 128


class NearestLevel(Mip):
    """Lobes without interpolation between levels."""

    def level(self, kernel):
        below, above, fraction = super().level(kernel)
        nearest = dr.select(fraction < 0.5, below, above)
        return nearest, nearest, mi.Float(0)


def samples_of(run: Run) -> dict[str, Callable[[], NormalMap]]:
    """The samples to make maps from."""
    return maps_of(run, 256, *("isotropic", "scratched")[: 1 if run.quick else 2], seed=3)


def all_normals(normal_map: NormalMap) -> mi.Vector2f:
    """A grid of normals over the range of the map's normals."""
    normals = normal_map.normals.reshape(-1, 2)
    return grid_of_normals((normals.min(axis=0), normals.max(axis=0)), RES)


def density_at(pndf, uv: tuple, width: float, m: mi.Vector2f) -> np.ndarray:
    """The P-NDF of a footprint ``width`` texels across."""
    footprint = Ellipse.round(width / 2).at(pndf.normal_map, np.array(uv)[:, None])
    return pndf.eval(m, footprint).numpy()


def largest_jump(pndf: Mip, widest: float) -> dict:
    """The largest relative L1 change while the footprint grows by 1 % from 16 texels on."""
    m, before, jumps = all_normals(pndf.normal_map), None, []
    for width in 16 * 1.01 ** np.arange(0, np.log(widest / 16) / np.log(1.01)):
        now = density_at(pndf, PLACES[0], width, m)
        jumps += [] if before is None else [suite.relative_l1(now, before)]
        before = now
    return {"largest_jump": max(jumps)}


def interpolation(run: Run) -> None:
    """The largest change of the P-NDF while the footprint grows by 1 % (Fig. 14).

    Two levels are blended, or only the nearest one is used. Expected: jumps as large as the error,
    0.2, without interpolation, and below 0.02 with it.
    """
    size, widest = (1024, 32) if run.quick else (2048, 128)
    with run.table("interpolation") as table:
        for sample, make in samples_of(run).items():
            for levels, kind in (("blended", Mip), ("nearest", NearestLevel)):
                options = {"output_size": size, "sigma_r": SIGMA_R}
                table.measure(
                    {"sample": sample, "levels": levels},
                    lambda kind=kind, make=make, o=options: largest_jump(kind(make(), **o), widest),
                )


# --------------------------------------------------------------------------------------------------
#  Seams
# --------------------------------------------------------------------------------------------------


def seam(run: Run, make: Callable[[], NormalMap], sample: str, patch: int, overlap: int) -> dict:
    """Roughness across overlaps and cuts, relative to the inside of patches; and repetition."""
    size, given = 512 if run.quick else 1024, make()
    synthesis = synthesise(given, size, patch, overlap)
    normals = synthesis.explicit()
    features = lobe_features(normals, SYNTHESIS["balance"])
    index = np.arange(size)
    source = np.concatenate(
        [synthesis.source(*np.broadcast_arrays(y[:, None], index)) for y in np.split(index, 8)]
    )
    across, cut, inside = [], [], []
    for axis in (0, 1):
        difference = ((features - np.roll(features, 1, axis)) ** 2).sum(axis=2)
        place = (synthesis.starts[:-1, None] + np.arange(overlap + 1)) % size
        in_overlap = np.isin(index, place)
        step = given.width if axis == 0 else 1
        cut.append(difference[source - np.roll(source, 1, axis) != step])
        difference = np.moveaxis(difference, axis, 0)
        across.append(difference[in_overlap].ravel())
        inside.append(difference[~in_overlap].ravel())
    across, cut, inside = (np.concatenate(v) for v in (across, cut, inside))
    z = np.sqrt(1 - (normals**2).sum(axis=2, keepdims=True))
    shown = np.clip(np.concatenate((0.5 + normals, z), axis=2)[:768, :768], 0, 1)
    run.save_pictures(f"mip_map_{sample}_{patch}_{overlap}", [[shown]])
    row = {
        "mean": across.mean() / inside.mean(),
        "percentile_99": np.percentile(across, 99) / np.percentile(inside, 99),
        "cut": cut.mean() / inside.mean(),
        "repetition": repetition(normals, patch),
        "best_only": synthesis.best_only / synthesis.patch.size,
        "most_frequent": np.bincount(synthesis.patch.ravel()).max() / synthesis.patch.size,
    }
    return {key: float(value) for key, value in row.items()}


def repetition(normals: np.ndarray, patch: int) -> float:
    """The largest autocorrelation of a map at distances from half a patch to four patches."""
    spectrum = np.fft.rfft2(normals - normals.mean(axis=(0, 1)), axes=(0, 1))
    correlation = np.fft.irfft2((np.abs(spectrum) ** 2).sum(axis=2), s=normals.shape[:2])
    shift = np.minimum(np.arange(len(normals)), len(normals) - np.arange(len(normals)))
    distance = np.maximum(shift[:, None], shift)
    near = (distance > patch / 2) & (distance < 4 * patch)
    return float(correlation[near].max() / correlation[0, 0])


def seams(run: Run) -> None:
    """Seams of maps that are made of patches, and their repetition.

    The table has the squared difference (Eq. 7) of neighbouring texels in overlaps, relative to the
    inside of patches (mean and 99th percentile), and the same for texels on either side of a cut.
    ``repetition`` is the largest autocorrelation of normals at distances from half a patch to four
    patches; ``most_frequent`` is the largest share of cells with the same patch.
    """
    samples = maps_of(run, 256, "isotropic", "leather", "brushed", "scratched", "flakes", seed=3)
    samples["noise"] = partial(white_noise, (256, 256))
    sizes = ((64, 2), (64, 6)) if run.quick else ((64, 2), (64, 6), (64, 12), (128, 12))
    with run.table("seams") as table:
        for name, make in samples.items():
            for patch, overlap in sizes:
                key = {"sample": name, "patch": patch, "overlap": overlap}
                table.measure(key, partial(seam, run, make, **key))


mip = family("mip", interpolation, seams)
