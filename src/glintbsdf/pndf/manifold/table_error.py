"""The error of tables of normals: its prediction, and how it is calibrated on the map.

Interpolation between the nodes gives a P-NDF under a kernel that differs a little from the
footprint's. The relative L1 error is at most the L1 norm of that difference, whatever the map. It
is smaller, the more independent places of the map show a normal under the footprint, since their
errors average out. For rough maps of all kinds it is, for standard deviations σ₁, σ₂,

    ½ (K(spacing / σ₁) + K(spacing / σ₂)) · g / (g + √(σ₁ σ₂)),

where K is the norm, and g the *grain*: how far apart independent places are. g is taken from the
errors themselves under round footprints of a few sizes, for every level and every kernel: their
mean over some places plus a standard deviation, so that most places err less.
"""

from __future__ import annotations

from collections.abc import Iterator
from math import sqrt

import drjit as dr
import numpy as np

from glintbsdf.footprint.kernels import KERNELS, REACH, VARIANCE

#: Largest share of a footprint's variance that the functions of the nodes may add.
MAX_NARROWING = 0.6

#: Spacings over standard deviations of the footprints at which grains are measured, over the
#: largest that :data:`MAX_NARROWING` allows.
KNOTS = {"gaussian": (0.45, 0.7, 0.95), "disk": (0.25, 0.55, 0.95), "box": (0.25, 0.55, 0.95)}

#: Places at which grains are measured; at the first few, the finest level is compared with the map.
PLACES, PLACES_ON_MAP = 16, 6

#: Number of bins in which grains are measured, about.
CALIBRATION_BINS = 3000


def kernel_error(kernel: str, x, mixed: bool = False):
    """L1 norm of the difference of a kernel and its interpolation, K(x).

    ``x``: spacing of the nodes over the kernel's standard deviation; ``mixed``: whether the nodes'
    functions are mixtures of finer splines. Fitted to the norms, averaged over the nodes' places; a
    kernel with an edge is known there to a fraction of the spacing only.
    """
    if kernel != "gaussian":
        return 0.6 * x
    of_splines = x * (0.016 + x * x * (0.012 + 0.008 * (x * x) * (x * x)))
    return dr.maximum(0.0355 * x, 1.12 * of_splines) if mixed else of_splines


def narrowing(variance: float, kernel: str = "gaussian") -> float:
    """Variance to take off a footprint against what the functions of the nodes add, texels².

    ``variance`` (texels²): variance of the function of a node.
    """
    return variance / VARIANCE[kernel]


def widest(kernel: str) -> float:
    """The largest spacing of nodes over the standard deviation of the footprint."""
    return sqrt(MAX_NARROWING * 4 * VARIANCE[kernel])


def interpolated(grains, kernel: str, x):
    """The grain at a spacing of ``x`` standard deviations from those at the knots."""
    knots = [k * widest(kernel) for k in KNOTS[kernel]]
    grain = grains[0]
    for k in range(len(knots) - 1):
        part = (x - knots[k]) * (1 / (knots[k + 1] - knots[k]))
        grain = grain + (grains[k + 1] - grains[k]) * dr.clip(part, 0, 1)
    return grain


def fitted(kernel: str, grains, spacing: float, mixed: bool, minor, mean):
    """Relative L1 error of a level for footprints, on average.

    ``grains``: the level's for this kernel; ``spacing`` (texels) of its nodes, ``mixed`` as in
    :func:`kernel_error`; ``minor``, ``mean`` (texels): standard deviation along the minor axis, and
    geometric mean of both.
    """
    across = kernel_error(kernel, spacing / minor, mixed)
    along = kernel_error(kernel, spacing * minor / (mean * mean), mixed)
    grain = interpolated(grains, kernel, spacing / mean)
    return 0.5 * (across + along) * grain / (grain + mean)


def predicted(kernel: str, grains, spacing: float, mixed: bool, minor, mean):
    """As :func:`fitted`, with a margin, so that measured errors are below."""
    return margin(kernel, spacing / mean) * fitted(kernel, grains, spacing, mixed, minor, mean)


def margin(kernel: str, x):
    """How far the prediction stays above the fit; ``x`` as for :func:`kernel_error`.

    It is largest where the nodes of a level are close: there the errors are below one per cent, and
    the fit is up to a fifth too low.
    """
    return 1.06 + 0.5 * dr.clip(1.3 - x, 0, 0.4) if kernel == "gaussian" else 1.15


# ------------------------------------------------------------------------------------------------
#  Calibration
# ------------------------------------------------------------------------------------------------


def cases() -> Iterator[tuple[str, float]]:
    """The kernels, and spacings over standard deviations, at which errors are measured."""
    return ((kernel, knot * widest(kernel)) for kernel in KERNELS for knot in KNOTS[kernel])


def weights(kernel: str, y: np.ndarray, x: np.ndarray) -> np.ndarray:
    """A kernel at offsets in standard deviations, with a sum of 1."""
    if kernel == "box":
        inside = np.maximum(np.abs(y), np.abs(x)) <= REACH[kernel]
    else:
        inside = y * y + x * x <= REACH[kernel] ** 2
    value = np.exp(-0.5 * (y * y + x * x)) if kernel == "gaussian" else 1.0
    value = np.where(inside, value, 0)
    return (value / value.sum()).astype(np.float32)


def lattice(mean, half: float, spacing) -> tuple[np.ndarray, np.ndarray]:
    """The points (y, x) of a lattice with centres of cells within ``half`` of ``mean``, texels."""
    axes = (
        np.arange(int(np.floor((m - half) / s)), int(np.ceil((m + half) / s)) + 1)
        for m, s in zip(mean, spacing, strict=True)
    )
    return tuple(v.ravel() for v in np.meshgrid(*axes, indexing="ij"))


def true_masses(places, spacing: float, spread, bins: np.ndarray) -> np.ndarray:
    """Masses in bins under round footprints, from the map: (places × cases, bins)."""
    sigmas = [spacing / x for _, x in cases()]
    half = max(REACH[kernel] * s for (kernel, _), s in zip(cases(), sigmas, strict=True))
    found = []
    for mean in places:
        y, x = lattice(mean, half, (1, 1))
        normals = spread(y, x)
        for (kernel, _), sigma in zip(cases(), sigmas, strict=True):
            weight = weights(kernel, (y + 0.5 - mean[0]) / sigma, (x + 0.5 - mean[1]) / sigma)
            found.append((normals.T @ weight)[bins])
    return np.array(found)


def table_masses(places, spacing: float, periods, count, variances, masses) -> np.ndarray:
    """The same from a level of ``count`` nodes (y, x) with the ``masses`` (nodes, bins).

    ``variances`` (y, x; texels²): variances of the functions of its nodes.
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


def grains(periods, counts, variances, mixed, levels, spread, bins: np.ndarray) -> np.ndarray:
    """The grains of all levels, texels: (levels, kernels, knots).

    The finest level is compared with the map, the others with one about three times finer, whose
    own error counts as independent.

    Args:
        periods (pair of ints): quads along y and x.
        counts (list of pairs): nodes (y, x) of every level.
        variances (list of pairs): variances of the nodes' functions, texels², for every level.
        mixed (list of bools): whether these are mixtures of finer splines.
        levels (list of arrays): masses (nodes, bins) of every level in ``bins``.
        spread: ``spread(row, column)`` returns the matrix (quads, all bins).
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
            truth = true_masses(here, spacing, spread, bins)
        else:
            truth = table_masses(*where, counts[finer], variances[finer], levels[finer])
        errors = np.abs(table - truth).sum(1) / truth.sum(1)
        errors = errors.reshape(len(here), *found.shape[1:])
        errors = errors.mean(0) + errors.std(0)  # places differ: most are to be below
        for k, (kernel, x) in enumerate(cases()):
            which, sigma = divmod(k, knots), spacing / x
            error = errors[which]
            if level > 0:
                reference = found[finer, which[0]], spacings[finer], mixed[finer]
                error = np.hypot(error, fitted(kernel, *reference, sigma, sigma))
            share = min(error / kernel_error(kernel, x, mixed[level]), 0.99)
            found[level][which] = sigma * share / (1 - share)
    return found
