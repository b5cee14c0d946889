"""A plugin's P-NDF beside an independent estimate of it, with the difference and the time.

With a map, the estimate is the binned reference, which shares no code with the plugins. Without a
map, it is a histogram of the plugin's own samples, which compares the density with the sampler.
"""

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
from glintbsdf.core.progress import progress
from glintbsdf.footprint.gaussian import Footprint
from glintbsdf.maps.normalmap import NormalMap
from glintbsdf.pndf.base import PNDF

# Points per bin and axis at which the density is evaluated: the reference is the mean over a bin.
_SUBSAMPLES = 4

# Without a map, the grid of bins holds all samples but for this share on each side, and a margin.
_TAIL = 1e-3

#: Number of queries between two reports of progress.
_TOGETHER = 1 << 16


@dataclass(frozen=True)
class Comparison:
    """A P-NDF in the bins of its reference.

    Attributes:
        title: what the density is of.
        density: mean of D over random points of each bin, res x res, rows from low to high y.
        standard_error: standard error of these means.
        reference: the binned reference, or the histogram of samples.
        queries: number of evaluations of the density.
        seconds: their time, without the compilation.
        footprint: mean and axes in UV.
        normal_map: the map; None without one.
        predicted: a bound on the relative L1 error that the method itself predicts; 0 if exact.
    """

    title: str
    density: np.ndarray
    standard_error: np.ndarray
    reference: BinnedPNDF
    queries: int
    seconds: float
    footprint: Footprint
    normal_map: NormalMap | None
    predicted: float = 0.0

    def __str__(self) -> str:
        return (
            f"relative L1 difference {self.difference:.2%}, where noise alone makes "
            f"{self.noise:.2%}: {self.verdict}\n"
            f"{self.queries} queries in {self.seconds:.3g} s ({self.queries / self.seconds:.3g}/s)"
        )

    def __repr__(self) -> str:
        return f"Comparison({self.title}: {str(self).replace(chr(10), '; ')})"

    @property
    def difference(self) -> float:
        """The relative L1 difference ``Σ|density - reference| / Σ reference``."""
        return self.reference.relative_l1(self.density)

    @property
    def noise(self) -> float:
        """The expected relative L1 difference of an exact density, from the noise of both grids.

        The mean of ``|x|`` is √(2/π) times the standard deviation, for a Gaussian. Bins without a
        sample of the reference have no noise of the reference.
        """
        reference = np.where(self.reference.density > 0, self.reference.standard_error, 0)
        deviation = np.hypot(self.standard_error, reference)
        return float(np.sqrt(2 / np.pi) * deviation.sum() / self.reference.density.sum())

    @property
    def verdict(self) -> str:
        """What the two numbers mean, in words."""
        if self.difference < 1.3 * self.noise:
            return "they agree within the noise"
        if self.normal_map is None:
            return "the method draws from another distribution, and weighs what it draws"
        if self.difference < self.predicted + 1.3 * self.noise:
            return f"they differ by no more than the method predicts, {self.predicted:.2g}"
        return "the method differs from the reference by more than the noise"

    def save(self, path: str | Path) -> None:
        """Write the arrays to a NumPy archive, ``.npz``: ``density``, ``standard_error``,
        ``reference``, ``reference_standard_error`` and ``bounds``."""
        np.savez(
            path,
            density=self.density,
            standard_error=self.standard_error,
            reference=self.reference.density,
            reference_standard_error=self.reference.standard_error,
            bounds=self.reference.bounds,
        )


def compare(
    plugin: str,
    map_file: Path | None,
    uv: tuple[float, float],
    sigma: float,
    res: int,
    parameters: Mapping[str, str],
    samples_per_bin: int = 200,
) -> Comparison:
    """Evaluate the P-NDF of a plugin under a round footprint, and its reference.

    Args:
        plugin: type of a glint BSDF.
        map_file: its map; None for a plugin without one.
        uv: centre of the footprint in UV.
        sigma: standard deviation of the footprint, in texels of the map, or in UV without a map.
        res: bins along each axis, over the range of the normals.
        parameters: further parameters of the plugin, as strings.
        samples_per_bin: mean number of samples of the reference in a bin.

    Raises:
        ParameterError: the plugin has no P-NDF to draw.
    """
    source = {} if map_file is None else {"filename": str(map_file)}
    bsdf = mi.load_dict({"type": plugin, **source, **_typed(parameters)})
    pndf = bsdf.pndf if hasattr(bsdf, "pndf") else bsdf
    check(hasattr(pndf, "normal_map"), "pndf", "type", "a glint BSDF", plugin)
    normal_map = pndf.normal_map
    height, width = (1, 1) if normal_map is None else normal_map.shape[:2]
    du, dv = mi.Vector2f(sigma / width, 0), mi.Vector2f(0, sigma / height)
    footprint = Footprint(mi.Point2f(uv), du, dv)

    samples = samples_per_bin * res * res
    with progress("Sampling the reference"):
        if normal_map is None:
            reference = histogram(pndf, footprint, res, samples)
        else:
            reference = binned_pndf(
                normal_map,
                uv,
                texel_covariance(normal_map, sigma),
                kernel=pndf.kernel,
                epsilon=pndf.epsilon,
                sigma_r=pndf.sigma_r[0] if hasattr(pndf, "sigma_r") else 0.0,
                res=res,
                samples=samples,
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
    seconds, parts = 0.0, []
    with progress("Evaluating the density") as report:
        _values(pndf, few, footprint)  # compiles the kernel
        for first in range(0, count * count, _TOGETHER):
            part = dr.arange(mi.UInt32, first, min(first + _TOGETHER, count * count))
            normals = dr.gather(mi.Vector2f, m, part)
            dr.eval(normals)
            dr.sync_thread()
            start = time.perf_counter()
            parts.append(_values(pndf, normals, footprint))
            seconds += time.perf_counter() - start
            report((first + len(parts[-1])) / (count * count))
    density = np.concatenate(parts)

    points = density.reshape(res, _SUBSAMPLES, res, _SUBSAMPLES)
    mean = points.mean(axis=(1, 3), dtype=np.float64)
    # An upper bound: stratified points have less noise.
    standard_error = points.std(axis=(1, 3), dtype=np.float64, ddof=1) / _SUBSAMPLES
    return Comparison(
        plugin,
        mean,
        standard_error,
        reference,
        count * count,
        seconds,
        footprint,
        normal_map,
        float(np.array(pndf.relative_error(footprint)).item()),
    )


def _values(pndf: PNDF, m: mi.Vector2f, footprint: Footprint) -> np.ndarray:
    """D(m); the mean of the channels for a P-NDF with colours."""
    density = pndf.eval(m, footprint)
    return (density if pndf.colors is None else dr.mean(density)).numpy()


def histogram(pndf: PNDF, footprint: Footprint, res: int, samples: int) -> BinnedPNDF:
    """Count normals that the P-NDF draws, in res x res bins around almost all of them."""
    rng = np.random.default_rng(1)
    u = mi.Point3f(rng.random((3, samples), dtype=np.float32))
    drawn = np.array(pndf.sample(footprint, u.x, mi.Point2f(u.y, u.z)), np.float64)
    drawn = drawn[:, (drawn**2).sum(axis=0) < 1]
    low, high = np.quantile(drawn, [_TAIL, 1 - _TAIL], axis=1)
    margin = 0.1 * (high - low) + 1e-4
    low, high = np.maximum(low - margin, -1), np.minimum(high + margin, 1)
    counts, _, _ = np.histogram2d(drawn[1], drawn[0], res, ((low[1], high[1]), (low[0], high[0])))
    scale = 1 / (samples * np.prod(high - low) / res**2)
    # Counts are Poisson's; where there is none, the error is that of one.
    error = np.sqrt(np.maximum(counts, 1)) * scale
    bounds = (low[0], low[1]), (high[0], high[1])
    return BinnedPNDF(counts * scale, error, bounds)


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
