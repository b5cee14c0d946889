"""Integrals of densities of half vectors by adaptive quadrature, however narrow their spikes.

A P-NDF may have half of its mass in spikes with a width of 1e-5, which no grid of bins resolves. So
cells are shaped around points that are drawn from the P-NDF, and refined where points and density
disagree.
"""

from __future__ import annotations

from collections.abc import Callable

import drjit as dr
import mitsuba as mi
import numpy as np

from glintbsdf.check import suite
from glintbsdf.check.suite import View

Array = np.ndarray

#: Cells narrower than this are not cut: a normal recovered from ``wo`` has errors of about 1e-7.
NARROWEST = 2e-5
#: A cell with at most this many training points is not cut.
LEAF = 32
#: The quadrature refines until its standard error is TARGET, but for at most ROUNDS rounds, and
#: about MOST_BOXES boxes.
TARGET, ROUNDS, MOST_BOXES = 3e-4, 24, 16_000
#: Points along each side of a box.
STRATA = 4


def partition(points: Array) -> tuple[Array, Array]:
    """Cut the square [−1, 1]² into cells that have few of ``points`` (N, 2) each.

    Empty margins and gaps are cut off first, so that cells enclose clusters of points of any size
    tightly. Further cuts halve the number of points. Returns the cells (K, 2, 2: lower and upper
    corner), and the index of the cell of each point.
    """
    cells: list[np.ndarray] = []
    cell_of = np.empty(len(points), np.int64)
    open_cells = [(np.array([[-1.0, -1.0], [1.0, 1.0]]), np.arange(len(points)))]
    while open_cells:
        box, inside = open_cells.pop()
        cut = cut_of(box, points[inside]) if len(inside) > LEAF else None
        if cut is None:
            cell_of[inside] = len(cells)
            cells.append(box)
            continue
        axis, place = cut
        left, right = box.copy(), box.copy()
        left[1, axis] = right[0, axis] = place
        below = points[inside, axis] < place
        open_cells += [(left, inside[below]), (right, inside[~below])]
    return np.array(cells), cell_of


def cut_of(box: Array, points: Array) -> tuple[int, float] | None:
    """The axis and the position at which to cut a cell; None if it should not be cut."""
    low, high = points.min(0), points.max(0)
    margin = 0.1 * (high - low) + NARROWEST
    empty = np.stack([low - margin - box[0], box[1] - high - margin]) / (box[1] - box[0])
    side, axis = np.unravel_index(np.argmax(empty), empty.shape)
    if empty[side, axis] > 0.25:
        return int(axis), (low - margin, high + margin)[side][axis]
    axis = int(np.argmax(high - low))
    if high[axis] - low[axis] < NARROWEST:
        return None
    ordered = np.sort(points[:, axis])
    gaps = np.diff(ordered)
    widest = int(np.argmax(gaps))
    if gaps[widest] < 0.25 * (high[axis] - low[axis]):
        widest = len(ordered) // 2
    place = 0.5 * (ordered[widest] + ordered[widest + 1])
    # Half of the points may be equal, as float32 normals of a narrow lobe are.
    return axis, place if place > low[axis] else 0.5 * (low[axis] + high[axis])


def count_in(cells: Array, points: Array) -> Array:
    """The number of ``points`` (N, 2) in each cell."""
    return np.array([((points >= low) & (points < high)).all(1).sum() for low, high in cells])


def mass_of(density: Callable, cells: Array, points: Array, cell_of: Array) -> tuple[Array, Array]:
    """Integral of ``density`` over each cell, and its standard error, by adaptive quadrature.

    The quadrature uses boxes, which are at first the cells. A box is cut in four where the values
    at its jittered points differ, or where their mean disagrees with the number of ``points`` in
    it, which are samples of the density. With very many boxes, only the second condition counts. At
    the end, new points give the integral.
    """
    rng = np.random.default_rng(5)
    count = max(len(points), 1)  # there is none if all facets reflect the view below the horizon

    def estimate(boxes: Array, strata: int) -> tuple[Array, Array]:
        n = strata * strata
        stratum = np.stack(np.divmod(np.arange(n), strata), -1)
        size = boxes[:, 1] - boxes[:, 0]
        place = (stratum + rng.random((len(boxes), n, 2))) / strata
        values = density((boxes[:, None, 0] + place * size[:, None]).reshape(-1, 2))
        values = values.reshape(len(boxes), n) * size.prod(1, keepdims=True)
        return values.mean(1), values.std(1, ddof=1) / np.sqrt(n)

    boxes, owner, box_of = cells, np.arange(len(cells)), cell_of
    mass, error = estimate(boxes, STRATA)
    for _ in range(ROUNDS):
        share = np.bincount(box_of, minlength=len(boxes)) / count
        # Many points where the quadrature has found almost nothing: it has missed a spike.
        missed = share > mass + 3 * np.sqrt((mass + 0.1 / count) / count) + 2 * error
        doubt = np.maximum(error, np.where(missed, share - mass, 0))
        # Cut the boxes with the largest errors: in the end all have about the same error.
        cut = doubt > min(0.5 * doubt.max(), TARGET / np.sqrt(len(boxes)))
        if len(boxes) > MOST_BOXES:
            cut &= missed
        if np.sqrt((doubt**2).sum()) < TARGET or not cut.any():
            break
        kept = np.cumsum(~cut) - 1
        middle = boxes.mean(1)
        quarter = (points >= middle[box_of]) @ np.array([2, 1])
        after = kept[-1] + 1 + 4 * (np.cumsum(cut) - 1)
        box_of = np.where(cut[box_of], after[box_of] + quarter, kept[box_of])
        parts = quarters(boxes[cut])
        boxes = np.concatenate([boxes[~cut], parts])
        owner = np.concatenate([owner[~cut], np.repeat(owner[cut], 4)])
        mass, error = (
            np.concatenate([old[~cut], new])
            for old, new in zip((mass, error), estimate(parts, STRATA), strict=True)
        )
    mass, error = estimate(boxes, STRATA + 2)
    totals = np.bincount(owner, mass, len(cells))
    return totals, np.sqrt(np.bincount(owner, error**2, len(cells)))


def quarters(boxes: Array) -> Array:
    """Each box cut in four, (4K, 2, 2): lower left, upper left, lower right, upper right."""
    corners = np.stack([boxes[:, 0], boxes.mean(1), boxes[:, 1]])  # (3, K, 2)
    parts = [
        np.stack([np.stack([corners[i + k, :, 0], corners[j + k, :, 1]], -1) for k in (0, 1)], 1)
        for i in (0, 1)
        for j in (0, 1)
    ]
    return np.stack(parts, 1).reshape(-1, 2, 2)


def density(bsdf: mi.BSDF, view: View, samples: int) -> dict[str, float]:
    """Test the density of half vectors on the disk: its normalisation, and the sampler.

    Returns

    * ``mass``: ∫ pdf + share of invalid samples − 1, which must be 0. A sample is invalid if its
      normal reflects the view below the horizon, where the pdf is 0;
    * ``mass_error``: standard error of ``mass``;
    * ``p_value`` of Pearson's χ² test of half of the samples against the pdf, in cells that the
      other half has shaped.
    """
    si, bs, _ = suite.sample(bsdf, view, 2 * samples, seed=3)
    m = np.array(dr.normalize(si.wi + bs.wo), np.float64)[:2].T
    valid = np.array(bs.pdf) > 0
    training, test = (m[k::2][valid[k::2]] for k in (0, 1))

    def at(s: Array) -> Array:
        s = mi.Vector2f(*(mi.Float(np.float32(x)) for x in s.T))
        inside = dr.squared_norm(s) < 1
        value = suite.density(bsdf, view, dr.select(inside, s, 0))
        return np.array(dr.select(inside, value, 0), np.float64)

    cells, cell_of = partition(training)
    mass, error = mass_of(at, cells, training, cell_of)
    lost = 1 - valid.mean()
    # Without a sample to test, the density must be zero, which ``mass`` shows.
    p_value = 1.0
    if valid.any():
        p_value = suite.p_value(count_in(cells, test), samples, mass, error)
    return {
        "mass": float(mass.sum() + lost - 1),
        "mass_error": float(np.sqrt((error**2).sum() + lost * (1 - lost) / (2 * samples))),
        "p_value": p_value,
    }
