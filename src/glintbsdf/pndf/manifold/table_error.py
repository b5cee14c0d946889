"""The error of tables of normals: its prediction, and its calibration on the map.

Interpolation between the nodes gives a P-NDF under a kernel that differs a little from the
footprint's. The relative L1 error is at most the L1 norm of this difference, whatever the map. It
is smaller where many independent places of the map show a normal under the footprint, as their
errors average out. For rough maps of all kinds, and a footprint with the standard deviations σ₁ and
σ₂, the error is

    ½ (K(spacing / σ₁) + K(spacing / σ₂)) · g / (g + √(σ₁ σ₂)),

where K is the norm, and g a *correlation length*: the distance of independent places. To find g,
errors are measured under round footprints of a few sizes, for every level and every kernel. The
mean over some places plus one standard deviation counts, so that the error of most places is less.
"""

from __future__ import annotations

from collections.abc import Iterator
from math import sqrt

import drjit as dr
import numpy as np

from glintbsdf.footprint.kernels import KERNELS, REACH, VARIANCE

#: Largest share of a footprint's variance that the functions of the nodes may add.
MAX_NARROWING = 0.6

#: Footprints under which errors are measured: the spacing of nodes over the footprint's standard
#: deviation, relative to its largest value (:func:`largest_spacing`).
KNOTS = {"gaussian": (0.45, 0.7, 0.95), "disk": (0.25, 0.55, 0.95), "box": (0.25, 0.55, 0.95)}

#: Number of places at which errors are measured, and number of places at which the finest level is
#: compared with the map.
PLACES, PLACES_ON_MAP = 16, 6

#: Approximate number of bins in which errors are measured.
CALIBRATION_BINS = 3000


def kernel_error(kernel: str, x, mixed: bool = False):
    """K(x): the L1 norm of the difference of a kernel and its interpolation.

    ``x`` is the spacing of the nodes over the kernel's standard deviation. ``mixed`` says whether
    the nodes' functions are mixtures of finer splines. The formula is fitted to the norms, averaged
    over positions of the nodes. The edge of a disk or a box is resolved to a fraction of the
    spacing, so their norm is linear in ``x``.
    """
    if kernel != "gaussian":
        return 0.6 * x
    of_splines = x * (0.016 + x * x * (0.012 + 0.008 * (x * x) * (x * x)))
    return dr.maximum(0.0355 * x, 1.12 * of_splines) if mixed else of_splines


def narrowing(variance: float, kernel: str = "gaussian") -> float:
    """Variance to subtract from a footprint's, texels², as the functions of the nodes add to it.

    ``variance`` (texels²): variance of the function of a node.
    """
    return variance / VARIANCE[kernel]


def largest_spacing(kernel: str) -> float:
    """The largest spacing of nodes allowed, over the standard deviation of the footprint."""
    return sqrt(MAX_NARROWING * 4 * VARIANCE[kernel])


def interpolated(lengths, kernel: str, x):
    """The correlation length for nodes that are ``x`` standard deviations apart, interpolated
    between its values at the knots."""
    knots = [k * largest_spacing(kernel) for k in KNOTS[kernel]]
    length = lengths[0]
    for k in range(len(knots) - 1):
        part = (x - knots[k]) * (1 / (knots[k + 1] - knots[k]))
        length = length + (lengths[k + 1] - lengths[k]) * dr.clip(part, 0, 1)
    return length


def average_error(kernel: str, lengths, spacing: float, mixed: bool, minor, mean):
    """Average relative L1 error of a level.

    Args:
        kernel (str): name of the footprint's kernel.
        lengths: correlation lengths of the level for this kernel, at the knots, texels.
        spacing (float): distance of the level's nodes, texels.
        mixed (bool): as in :func:`kernel_error`.
        minor: standard deviation of the footprint along its minor axis, texels.
        mean: geometric mean of its standard deviations along both axes, texels.
    """
    across = kernel_error(kernel, spacing / minor, mixed)
    along = kernel_error(kernel, spacing * minor / (mean * mean), mixed)
    length = interpolated(lengths, kernel, spacing / mean)
    return 0.5 * (across + along) * length / (length + mean)


def predicted_error(kernel: str, lengths, spacing: float, mixed: bool, minor, mean):
    """As :func:`average_error`, with a margin, so that measured errors are smaller."""
    return margin(kernel, spacing / mean) * average_error(
        kernel, lengths, spacing, mixed, minor, mean
    )


def margin(kernel: str, x):
    """Factor from the average error to the predicted one; ``x`` as in :func:`kernel_error`.

    It is largest where nodes are close. There the errors are below one per cent, and
    :func:`average_error` is up to a fifth too low.
    """
    return 1.06 + 0.5 * dr.clip(1.3 - x, 0, 0.4) if kernel == "gaussian" else 1.15


# ------------------------------------------------------------------------------------------------
#  Calibration
# ------------------------------------------------------------------------------------------------


def cases() -> Iterator[tuple[str, float]]:
    """Pairs (kernel, spacing of nodes over standard deviation) for which errors are measured."""
    return (
        (kernel, knot * largest_spacing(kernel)) for kernel in KERNELS for knot in KNOTS[kernel]
    )


def weights(kernel: str, y: np.ndarray, x: np.ndarray) -> np.ndarray:
    """Values of a kernel at offsets (standard deviations), normalised to a sum of 1."""
    if kernel == "box":
        inside = np.maximum(np.abs(y), np.abs(x)) <= REACH[kernel]
    else:
        inside = y * y + x * x <= REACH[kernel] ** 2
    value = np.exp(-0.5 * (y * y + x * x)) if kernel == "gaussian" else 1.0
    value = np.where(inside, value, 0)
    return (value / value.sum()).astype(np.float32)


def lattice(mean, half: float, spacing) -> tuple[np.ndarray, np.ndarray]:
    """Cells (y, x) of a lattice whose centres lie within ``half`` of ``mean``, both in texels."""
    axes = (
        np.arange(int(np.floor((m - half) / s)), int(np.ceil((m + half) / s)) + 1)
        for m, s in zip(mean, spacing, strict=True)
    )
    return tuple(v.ravel() for v in np.meshgrid(*axes, indexing="ij"))


def true_masses(places, spacing: float, rasterize, bins: np.ndarray) -> np.ndarray:
    """Masses in bins under round footprints, computed from the map: (places × cases, bins)."""
    sigmas = [spacing / x for _, x in cases()]
    half = max(REACH[kernel] * s for (kernel, _), s in zip(cases(), sigmas, strict=True))
    found = []
    for mean in places:
        y, x = lattice(mean, half, (1, 1))
        normals = rasterize(y, x)
        for (kernel, _), sigma in zip(cases(), sigmas, strict=True):
            weight = weights(kernel, (y + 0.5 - mean[0]) / sigma, (x + 0.5 - mean[1]) / sigma)
            found.append((normals.T @ weight)[bins])
    return np.array(found)


def table_masses(places, spacing: float, periods, count, variances, masses) -> np.ndarray:
    """Masses in bins under round footprints, computed from a level: (places × cases, bins).

    Args:
        count: number of nodes (y, x) of the level.
        variances: variances (y, x) of the functions of its nodes, texels².
        masses: masses (nodes, bins) of the level.
    """
    from scipy.sparse import csr_matrix

    spacings = [p / n for p, n in zip(periods, count, strict=True)]
    rows = []
    for mean in places:
        for kernel, x in cases():
            sigma = spacing / x
            narrowed = [sqrt(sigma**2 - narrowing(v, kernel)) for v in variances]
            nodes = lattice(mean, REACH[kernel] * sigma, spacings)
            offsets = (
                ((k + 0.5) * s - m) / width
                for k, s, m, width in zip(nodes, spacings, mean, narrowed, strict=True)
            )
            weight = weights(kernel, *offsets)
            used = np.flatnonzero(weight)
            index = (nodes[0] % count[0]) * count[1] + nodes[1] % count[1]
            rows.append((weight[used], index[used]))
    begin = np.cumsum([0, *(len(index) for _, index in rows)])
    values, index = (np.concatenate(v) for v in zip(*rows, strict=True))
    matrix = csr_matrix((values, index, begin), (len(rows), np.prod(count)))
    return matrix @ masses / np.float32(np.prod(spacings))


def correlation_lengths(
    periods, counts, variances, mixed, levels, rasterize, bins: np.ndarray
) -> np.ndarray:
    """The correlation lengths of all levels, texels: (levels, kernels, knots).

    The finest level is compared with the map. Any other level is compared with one about three
    times finer, whose own error counts as independent.

    Args:
        periods (pair of ints): quads along y and x.
        counts (list of pairs): nodes (y, x) of every level.
        variances (list of pairs): variances of the nodes' functions, texels², for every level.
        mixed (list of bools): for every level, whether these functions are mixtures of finer
            splines.
        levels (list of arrays): masses (nodes, bins) of every level in ``bins``.
        rasterize: function ``(row, column)`` that returns the matrix (quads, all bins).
        bins: indices of the bins in which errors are measured.
    """
    places = np.random.default_rng(0).random((PLACES, 2)) * periods
    spacings = [max(p / n for p, n in zip(periods, count, strict=True)) for count in counts]
    knots = len(KNOTS["gaussian"])
    found = np.zeros((len(counts), len(KERNELS), knots))
    for level, spacing in enumerate(spacings):
        if level > 0 and min(counts[level]) < 4:  # footprints as large as the map
            found[level] = found[level - 1]
            continue
        finer = max((k for k in range(level) if spacings[k] <= 0.35 * spacing), default=0)
        here = places if level else places[:PLACES_ON_MAP]
        where = here, spacing, periods
        table = table_masses(*where, counts[level], variances[level], levels[level])
        if level == 0:
            truth = true_masses(here, spacing, rasterize, bins)
        else:
            truth = table_masses(*where, counts[finer], variances[finer], levels[finer])
        errors = np.abs(table - truth).sum(1) / truth.sum(1)
        errors = errors.reshape(len(here), *found.shape[1:])
        errors = errors.mean(0) + errors.std(0)  # most places have a smaller error
        for k, (kernel, x) in enumerate(cases()):
            which, sigma = divmod(k, knots), spacing / x
            error = errors[which]
            if level > 0:
                reference = found[finer, which[0]], spacings[finer], mixed[finer]
                error = np.hypot(error, average_error(kernel, *reference, sigma, sigma))
            share = min(error / kernel_error(kernel, x, mixed[level]), 0.99)
            found[level][which] = sigma * share / (1 - share)
    return found
