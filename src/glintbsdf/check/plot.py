"""A drawing of a plugin's P-NDF beside the binned reference, with the error and the time."""

from __future__ import annotations

import time
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import drjit as dr
import mitsuba as mi
import numpy as np

from glintbsdf.check.reference import BinnedPNDF, binned_pndf, texel_covariance
from glintbsdf.core.errors import check
from glintbsdf.footprint.gaussian import Footprint

# Points per bin and axis at which the density is evaluated: the reference is the mean over a bin.
_SUBSAMPLES = 4

# Brightness is this power of the density: otherwise a few peaks would leave everything else black.
_GAMMA = 0.5


@dataclass(frozen=True)
class Comparison:
    """A P-NDF in the bins of its reference.

    Attributes:
        density: mean of D over random points of each bin, res x res, rows from low to high y.
        standard_error: standard error of these means.
        reference: the binned reference.
        queries: number of evaluations of the density.
        seconds: their time, without the compilation.
    """

    density: np.ndarray
    standard_error: np.ndarray
    reference: BinnedPNDF
    queries: int
    seconds: float

    def __str__(self) -> str:
        return (
            f"relative L1 difference {self.reference.relative_l1(self.density):.2%}, "
            f"where noise alone makes {self.noise:.2%}\n"
            f"{self.queries} queries in {self.seconds:.3g} s ({self.queries / self.seconds:.3g}/s)"
        )

    @property
    def noise(self) -> float:
        """The expected relative L1 difference of an exact density, from the noise of both grids.

        The mean of |x| is √(2/π) times the standard deviation, for a Gaussian. Bins without a
        sample of the reference have no noise of the reference.
        """
        reference = np.where(self.reference.density > 0, self.reference.standard_error, 0)
        deviation = np.hypot(self.standard_error, reference)
        return float(np.sqrt(2 / np.pi) * deviation.sum() / self.reference.density.sum())

    def drawing(self) -> mi.Bitmap:
        """Draw density and reference side by side on one scale, y upwards."""
        gap = np.ones((len(self.density), 8, 3))
        peak = max(self.density.max(), self.reference.density.max())
        left, right = (
            colour_map((values / peak)[::-1] ** _GAMMA)
            for values in (self.density, self.reference.density)
        )
        return mi.Bitmap(np.concatenate([left, gap, right], axis=1).astype(np.float32))


def compare(
    plugin: str,
    map_file: Path,
    uv: tuple[float, float],
    sigma: float,
    res: int,
    parameters: Mapping[str, str],
    samples_per_bin: int = 200,
) -> Comparison:
    """Evaluate the P-NDF of a plugin under a round footprint, and its reference.

    Args:
        plugin: type of a glint BSDF.
        map_file: its map.
        uv: centre of the footprint in UV.
        sigma: standard deviation of the footprint in texels.
        res: bins along each axis, over the range of the map's normals.
        parameters: further parameters of the plugin, as strings.
        samples_per_bin: mean number of samples of the reference in a bin.

    Raises:
        ParameterError: the plugin has no P-NDF to draw.
    """
    bsdf = mi.load_dict({"type": plugin, "filename": str(map_file), **_typed(parameters)})
    pndf = bsdf.pndf if hasattr(bsdf, "pndf") else bsdf
    check(hasattr(pndf, "normal_map"), "pndf", "type", "a glint BSDF with a normal map", plugin)
    normal_map = pndf.normal_map

    reference = binned_pndf(
        normal_map,
        uv,
        texel_covariance(normal_map, sigma),
        kernel=pndf.kernel,
        epsilon=pndf.epsilon,
        sigma_r=pndf.sigma_r[0] if hasattr(pndf, "sigma_r") else 0.0,
        res=res,
        samples=samples_per_bin * res * res,
    )

    footprint = Footprint(
        mi.Point2f(uv),
        mi.Vector2f(sigma / normal_map.width, 0),
        mi.Vector2f(0, sigma / normal_map.height),
    )
    (x_min, y_min), (x_max, y_max) = reference.bounds
    count = res * _SUBSAMPLES
    jitter = np.random.default_rng(0).random((2, count, count))
    row, column = (np.indices((count, count)) + jitter) / count
    x, y = x_min + (x_max - x_min) * column, y_min + (y_max - y_min) * row
    m = mi.Vector2f(mi.Float(x.ravel()), mi.Float(y.ravel()))
    dr.eval(m)

    few = dr.gather(mi.Vector2f, m, dr.arange(mi.UInt32, 16))
    dr.eval(few)
    pndf.eval(few, footprint).numpy()  # compiles the kernel
    start = time.perf_counter()
    density = pndf.eval(m, footprint).numpy()
    seconds = time.perf_counter() - start

    points = density.reshape(res, _SUBSAMPLES, res, _SUBSAMPLES)
    mean = points.mean(axis=(1, 3), dtype=np.float64)
    # An upper bound: stratified points have less noise.
    standard_error = points.std(axis=(1, 3), dtype=np.float64, ddof=1) / _SUBSAMPLES
    return Comparison(mean, standard_error, reference, count * count, seconds)


def colour_map(value: np.ndarray) -> np.ndarray:
    """Map [0, 1] to linear RGB: from black through blue and orange to white, ever brighter."""
    stops = np.linspace(0, 1, 5)
    colours = np.array(
        [[0, 0, 0], [0.05, 0.05, 0.35], [0.55, 0.1, 0.25], [1, 0.5, 0.05], [1, 1, 0.85]]
    )
    return np.stack([np.interp(value, stops, channel) for channel in colours.T], axis=-1)


def _typed(parameters: Mapping[str, str]) -> dict[str, bool | int | float | str]:
    """Convert strings to the types that their spelling suggests, as Mitsuba's dictionaries need."""

    def typed(text: str) -> bool | int | float | str:
        if text in ("true", "false"):
            return text == "true"
        for number in (int, float):
            try:
                return number(text)
            except ValueError:
                continue
        return text

    return {key: typed(text) for key, text in parameters.items()}
