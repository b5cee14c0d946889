"""The test suite for glint BSDFs, as functions: each takes a BSDF, or a P-NDF where it says so, and
raises if the test fails.

The footprint is set through ``si.duv_dx`` and ``si.duv_dy``, as ``glint_path`` does. The BSDFs must
have ``footprint_sigma`` 1, so that a :class:`View` gives standard deviations.

A P-NDF has narrow spikes, which no histogram over the sphere of directions would resolve. So
densities are compared on the disk of projected normals, where ``pdf(wo) 4 |wo·m| / cosθ_m`` is the
density D, and bins can be as small as the map's normals require.
"""

from __future__ import annotations

import os
import re
import tempfile
from dataclasses import dataclass, replace
from pathlib import Path

import drjit as dr
import mitsuba as mi
import numpy as np
import scipy.stats

from glintbsdf import NormalMap
from glintbsdf.check.reference import binned_pndf
from glintbsdf.footprint.gaussian import Footprint
from glintbsdf.footprint.query import Query
from glintbsdf.pndf.base import PNDF

Pair = tuple[float, float]
Bounds = tuple[Pair, Pair]

# Significance of all χ² tests of a module together; test_count is for Šidák's correction.
SIGNIFICANCE = 0.01


@dataclass(frozen=True)
class View:
    """A direction of view and a footprint.

    Attributes:
        uv: centre of the footprint, UV.
        du, dv: axes of the footprint (standard deviations), UV.
        wi: direction of view; it need not be normalised.
        dp_du, dp_dv: derivatives of the position with respect to UV.
    """

    uv: Pair = (0.37, 0.61)
    du: Pair = (0.0, 0.0)
    dv: Pair = (0.0, 0.0)
    wi: tuple[float, float, float] = (0.0, 0.0, 1.0)
    dp_du: tuple[float, float, float] = (1.0, 0.0, 0.0)
    dp_dv: tuple[float, float, float] = (0.0, 1.0, 0.0)

    def interaction(self, count: int = 1) -> mi.SurfaceInteraction3f:
        """``count`` equal surface interactions on the plane z = 0."""
        si = dr.zeros(mi.SurfaceInteraction3f, count)
        si.uv, si.duv_dx, si.duv_dy = self.uv, self.du, self.dv
        si.wi = wide(dr.normalize(mi.Vector3f(self.wi)), count)
        si.t, si.n = 1, mi.Normal3f(0, 0, 1)
        si.dp_du, si.dp_dv = mi.Vector3f(self.dp_du), mi.Vector3f(self.dp_dv)
        s = dr.normalize(si.dp_du)
        si.sh_frame = mi.Frame3f(s, dr.cross(si.n, s), si.n)
        if mi.is_spectral:
            si.wavelengths = [440, 510, 580, 650]
        dr.make_opaque(si)  # one compiled kernel serves all views
        return si

    def covariance(self) -> np.ndarray:
        """The footprint's covariance, UV²."""
        return np.outer(self.du, self.du) + np.outer(self.dv, self.dv)


def square(
    bsdf: dict,
    integrator: dict | None = None,
    from_below: bool = False,
    lights: dict | None = None,
    spp: int = 16,
) -> np.ndarray:
    """An image of a square in the plane z = 0, 24 × 24 pixels, with one bounce; by default under a
    constant sky."""
    camera = mi.ScalarTransform4f().look_at([0.3, -1.5, 1.5], [0, 0, 0], [0, 0, 1])
    if from_below:
        camera = mi.ScalarTransform4f().rotate([1, 0, 0], 180) @ camera
    scene = mi.load_dict(
        {
            "type": "scene",
            "integrator": integrator or {"type": "path", "max_depth": 2, "hide_emitters": True},
            "sensor": {
                "type": "perspective",
                "fov": 40,
                "to_world": camera,
                "film": {"type": "hdrfilm", "width": 24, "height": 24},
                "sampler": {"type": "independent", "sample_count": spp},
            },
            **(lights or {"sky": {"type": "constant"}}),
            "square": {"type": "rectangle", "bsdf": bsdf},
        }
    )
    image = np.array(mi.render(scene, seed=1))
    assert np.isfinite(image).all() and (image >= 0).all()
    return image


# Views that break careless code, for a map of any size.
EXTREME_VIEWS = {
    "point": View(),
    "tiny": View(du=(1e-7, 0), dv=(0, 1e-7)),
    "line": View(du=(0.2, 0.1)),
    "parallel_axes": View(du=(0.1, 0.05), dv=(0.2, 0.1)),
    "1000:1": View(du=(0.3, 0.2), dv=(-0.0002, 0.0003)),
    "one_map": View(du=(1, 0), dv=(0, 1)),
    "hundred_maps": View(du=(100, 0), dv=(0, 100)),
    "far_uv": View(uv=(1e5 + 0.25, -1e5 - 0.5), du=(0.02, 0), dv=(0, 0.02)),
    "not_finite": View(du=(float("nan"), 0), dv=(0, float("inf"))),
    "oblique": View(du=(0.02, 0), dv=(0, 0.02), wi=(1, 0.3, 1)),
    "grazing": View(du=(0.02, 0), dv=(0, 0.02), wi=(1, 0, 1e-3)),
    "almost_horizontal": View(du=(0.02, 0), dv=(0, 0.02), wi=(0, 1, 1e-7)),
    "horizontal": View(du=(0.02, 0), dv=(0, 0.02), wi=(0, 1, 0)),
}


def random_numbers(count: int, dimensions: int, seed: int) -> list[mi.Float]:
    """Uniform numbers in [0, 1), ``dimensions`` arrays of ``count``."""
    table = np.random.default_rng(seed).random((dimensions, count), dtype=np.float32)
    return [mi.Float(row) for row in table]


def sample(bsdf: mi.BSDF, view: View, count: int, seed: int = 0, everywhere: bool = False) -> tuple:
    """Draw ``count`` directions: ``(si, BSDFSample3f, weight)``; where the view is, or
    ``everywhere`` on the map."""
    u = random_numbers(count, 5 if everywhere else 3, seed)
    si = view.interaction(count)
    if everywhere:
        si.uv = mi.Point2f(u[3], u[4])
    bs, weight = bsdf.sample(mi.BSDFContext(), si, u[0], mi.Point2f(u[1], u[2]))
    dr.eval(bs, weight)
    return si, bs, weight


# Most of the time of a check is LLVM's. So directions are evaluated and have one width: then the
# kernels of eval, pdf, eval_pdf and sample serve all checks of a BSDF.


def wide(v: mi.Vector3f, count: int) -> mi.Vector3f:
    """A vector with ``count`` lanes, evaluated."""
    v = mi.Vector3f(v) + dr.zeros(mi.Vector3f, count)
    dr.make_opaque(v)
    return v


def value_and_pdf(bsdf: mi.BSDF, si: mi.SurfaceInteraction3f, wo: mi.Vector3f) -> tuple:
    """``eval_pdf``, evaluated; the value by :func:`intensity`."""
    value, pdf = bsdf.eval_pdf(mi.BSDFContext(), si, wide(wo, dr.width(si.wi)))
    value = intensity(value)
    dr.eval(value, pdf)
    return value, pdf


def intensity(spectrum: mi.Spectrum) -> mi.UnpolarizedSpectrum:
    """The channels of a spectrum. For a Mueller matrix this is its first entry, which acts on the
    intensity."""
    return spectrum[0, 0] if mi.is_polarized else spectrum


def density(bsdf: mi.BSDF, view: View, s: mi.Vector2f) -> mi.Float:
    """D(s), recovered from ``bsdf.pdf``; zero where ``s`` reflects the view below the horizon."""
    m = mi.Vector3f(s.x, s.y, dr.safe_sqrt(1 - dr.squared_norm(s)))
    si = view.interaction(dr.width(s))
    wo = wide(mi.reflect(si.wi, mi.Normal3f(m)), dr.width(s))
    pdf = bsdf.pdf(mi.BSDFContext(), si, wo)
    dr.eval(pdf)
    return pdf * 4 * dr.abs(dr.dot(wo, m)) / m.z


def mass_in_bins(
    bsdf: mi.BSDF, view: View, bounds: Bounds, res: int, points: int = 12, repetitions: int = 8
) -> tuple[np.ndarray, np.ndarray]:
    """Mass of D in each of ``res``² bins over ``bounds``, and the standard error of the quadrature.

    D jumps at the edges of triangles and of the kernel. So the quadrature uses jittered points,
    with ``points``² strata per bin, and its error is measured from ``repetitions`` independent
    runs.
    """
    lower, upper = np.array(bounds)
    n = res * points
    rng = np.random.default_rng(7)
    column, row = np.meshgrid(np.arange(n), np.arange(n))
    runs = []
    for _ in range(repetitions):
        x, y = ((k + rng.random((n, n))) / n for k in (column, row))
        s = mi.Vector2f(
            *(np.float32(lower[i] + p.ravel() * (upper - lower)[i]) for i, p in enumerate((x, y)))
        )
        values = np.array(density(bsdf, view, s), np.float64)
        runs.append(values.reshape(res, points, res, points).mean(axis=(1, 3)))
    runs = np.array(runs) * np.prod((upper - lower) / res)
    return runs.mean(axis=0), runs.std(axis=0, ddof=1) / np.sqrt(repetitions)


# --------------------------------------------------------------------------------------------------
#  Densities
# --------------------------------------------------------------------------------------------------


def p_value(counts: np.ndarray, total: int, mass: np.ndarray, error: np.ndarray) -> float:
    """The p-value of Pearson's χ² test of ``counts`` in bins, out of ``total``, against ``mass``.

    ``mass`` is the expected share of each bin. The error of the quadrature (``error``, a standard
    deviation) adds to the variance of a count. The emptiest bins are pooled until their expected
    count is five.
    """
    order = np.argsort(mass, axis=None)
    counts, expected = counts.ravel()[order], total * mass.ravel()[order]
    variance = expected + (total * error.ravel()[order]) ** 2
    pooled = np.searchsorted(np.cumsum(expected), 5) + 1
    counts, expected, variance = (
        np.append(x[pooled:], x[:pooled].sum()) for x in (counts, expected, variance)
    )
    statistic = ((counts - expected) ** 2 / variance).sum()
    return float(scipy.stats.chi2.sf(statistic, len(counts)))


def assert_distributed(
    counts: np.ndarray,
    total: int,
    mass: np.ndarray,
    error: np.ndarray,
    test_count: int,
    bounds: Bounds | None = None,
) -> None:
    """Raise AssertionError if :func:`p_value` is too small, for one of ``test_count`` tests.

    :data:`SIGNIFICANCE` is the significance of all tests together, by Šidák's correction. The
    message names a file with the table of the test, see :func:`dumped`.
    """
    p = p_value(counts, total, mass, error)
    significance = 1 - (1 - SIGNIFICANCE) ** (1 / test_count)
    if not p > significance:
        table = dumped(counts, total, mass, error, bounds)
        raise AssertionError(
            f"p = {p:.3g} is below {significance:.3g}: {total} samples are not distributed as "
            f"stated; observed and expected counts of all bins are in {table}"
        )


#: Environment variable with the folder for tables of failed χ² tests; the folder is created.
TABLES = "GLINTBSDF_CHI2_TABLES"


def dumped(
    counts: np.ndarray, total: int, mass: np.ndarray, error: np.ndarray, bounds: Bounds | None
) -> Path:
    """Write the table of a χ² test, with a line for each bin, and return the file.

    The columns are the row and the column of the bin; its centre on the disk of projected normals,
    if ``bounds`` are given; the observed and the expected count; the standard deviation of their
    difference, from sampling and from the quadrature; and their difference over this deviation. The
    file is a CSV in the folder of the environment variable :data:`TABLES`, or in the system's
    temporary folder.
    """
    rows, columns = np.indices(np.atleast_2d(counts).shape).reshape(2, -1)
    position = np.full((2, counts.size), np.nan)
    if bounds is not None:
        lower, upper = np.array(bounds)
        size = (upper - lower) / counts.shape[::-1]
        position = (lower + size * (np.stack([columns, rows], axis=1) + 0.5)).T
    observed, expected = counts.ravel(), total * mass.ravel()
    deviation = np.sqrt(np.maximum(expected, 0) + (total * error.ravel()) ** 2)
    with np.errstate(divide="ignore", invalid="ignore"):
        pull = (observed - expected) / deviation
    folder = Path(os.environ.get(TABLES) or tempfile.gettempdir())
    folder.mkdir(parents=True, exist_ok=True)
    handle, name = tempfile.mkstemp(prefix="glintbsdf-chi2-", suffix=".csv", dir=folder)
    with os.fdopen(handle, "w") as file:
        names = "row,column,x,y,observed,expected,deviation,pull"
        table = np.stack([rows, columns, *position, observed, expected, deviation, pull], axis=1)
        np.savetxt(file, table, fmt="%.9g", delimiter=",", header=names, comments="")
    return Path(name)


def check_chi2(
    bsdf: mi.BSDF,
    view: View,
    bounds: Bounds,
    test_count: int,
    samples: int = 100_000,
    res: int = 25,
) -> None:
    """``sample`` draws from the density ``pdf``, and this integrates to one.

    ``bounds`` is a rectangle of the disk that contains all normals. Nothing may be reflected below
    the horizon from this view. At most 1e-4 of the samples may be lost: a sample on the edge of a
    clamped triangle, which has no neighbour, may lie outside of it after float32 rounding.
    """
    si, bs, _ = sample(bsdf, view, samples)
    m = np.array(dr.normalize(si.wi + bs.wo))[:2, np.array(bs.pdf) > 0]
    (x_min, y_min), (x_max, y_max) = bounds
    counts, _, _ = np.histogram2d(m[1], m[0], res, ((y_min, y_max), (x_min, x_max)))
    lost = samples - counts.sum()
    assert lost <= 1e-4 * samples, f"{lost} samples are invalid or outside of the bounds"

    mass, error = mass_in_bins(bsdf, view, bounds, res)
    assert_distributed(counts, samples, mass, error, test_count, bounds)
    # 1e-4 is for float32 rounding, above all in the area of triangles.
    assert abs(mass.sum() - 1) <= 4 * np.sqrt((error**2).sum()) + 1e-4, mass.sum()


def check_against_reference(
    bsdf: mi.BSDF,
    normal_map: NormalMap,
    view: View,
    test_count: int,
    samples: int = 200_000,
    res: int = 25,
    seed: int = 1,
    **options,
) -> None:
    """D agrees with :func:`~glintbsdf.reference.binned_pndf` within the statistical error.

    ``options`` are arguments of the reference, such as ``kernel`` and ``epsilon``.
    """
    reference = binned_pndf(
        normal_map, view.uv, view.covariance(), res=res, samples=samples, seed=seed, **options
    )
    counts = reference.density * reference.bin_area * samples
    mass, error = mass_in_bins(bsdf, view, reference.bounds, res)
    assert_distributed(counts, samples, mass, error, test_count, reference.bounds)


# --------------------------------------------------------------------------------------------------
#  Consistency
# --------------------------------------------------------------------------------------------------


def check_eval_pdf(bsdf: mi.BSDF, view: View, count: int = 2000) -> None:
    """``eval_pdf`` returns the same as ``eval`` and ``pdf``."""
    si, bs, _ = sample(bsdf, view, count)
    ctx = mi.BSDFContext()
    value, pdf = value_and_pdf(bsdf, si, bs.wo)
    for together, alone in ((value, bsdf.eval), (pdf, bsdf.pdf)):
        found = alone(ctx, si, bs.wo)
        dr.eval(found)
        assert dr.allclose(together, found if together is pdf else intensity(found), rtol=1e-5)


def check_weights(bsdf: mi.BSDF, view: View, count: int = 2000, strays: float = 0.01) -> None:
    """For samples, ``weight · pdf = eval``, and their pdf is ``pdf(wo)``.

    The half vector of ``wo`` differs from the sampled normal by float32 rounding. This carries a
    few samples across the edge of a triangle or of the kernel, where D jumps. A share of ``strays``
    may differ for this reason.
    """
    si, bs, weight = sample(bsdf, view, count)
    value, pdf = value_and_pdf(bsdf, si, bs.wo)
    valid = np.array(bs.pdf) > 0
    assert valid.any()
    for ours, theirs in ((intensity(weight) * bs.pdf, value), (bs.pdf, pdf)):
        ours, theirs = np.atleast_2d(np.array(ours)), np.atleast_2d(np.array(theirs))
        ours, theirs = ours[:, valid], theirs[:, valid]
        apart = (np.abs(ours - theirs) > 2e-3 * (np.abs(ours) + np.abs(theirs))).any(axis=0)
        assert apart.mean() <= strays, apart.mean()


def check_horizon(bsdf: mi.BSDF, view: View, count: int = 500) -> None:
    """Value, pdf and weight are 0 wherever the view or the light is at or below the horizon."""
    mirrored, horizontal = mi.Vector3f(1, 1, -1), mi.Vector3f(1, 0, 0)
    si, bs, _ = sample(bsdf, view, count)
    up = mi.Vector3f(bs.wo.x, bs.wo.y, dr.abs(bs.wo.z))
    for wi, wo in (
        (si.wi, up * mirrored),
        (si.wi * mirrored, up),
        (-si.wi, -up),
        (si.wi, -si.wi),
        (horizontal, up),
        (si.wi, horizontal),
    ):
        below = view.interaction(count)
        below.wi = wide(wi, count)
        value, pdf = value_and_pdf(bsdf, below, wo)
        assert dr.all(value == 0, axis=None) and dr.all(pdf == 0)
    below = sample(bsdf, replace(view, wi=(0.3, 0, -1)), count)
    assert dr.all(below[1].pdf == 0) and dr.all(intensity(below[2]) == 0, axis=None)


def check_finite(bsdf: mi.BSDF, view: View, count: int = 200) -> None:
    """Values, densities, weights and the albedo are finite and not negative."""
    si, bs, weight = sample(bsdf, view, count)
    value, pdf = value_and_pdf(bsdf, si, bs.wo)
    u = random_numbers(count, 2, seed=1)
    elsewhere = value_and_pdf(
        bsdf, si, mi.warp.square_to_uniform_hemisphere(mi.Point2f(u[0], u[1]))
    )
    albedo = bsdf.eval_diffuse_reflectance(si)
    assert dr.all(dr.isfinite(bs.wo), axis=None)
    for x in (
        intensity(weight),
        bs.pdf,
        value,
        pdf,
        *elsewhere,
        intensity(albedo),
    ):
        assert dr.all(dr.isfinite(x) & (x >= 0), axis=None)


def check_adjoint(bsdf: mi.BSDF, view: View, count: int = 500, strays: float = 0.01) -> None:
    """The BSDF for importance is the adjoint of the BSDF for radiance.

    ``f(wi, wo)`` transports radiance from ``wo`` to ``wi``. Light tracing uses the adjoint, with
    ``wi`` towards the light: ``f*(wo, wi) = f(wi, wo)``. This holds for every BSDF, even if it is
    not reciprocal, as its normals lean differently from the surface. A share of ``strays`` may
    differ, as half vectors at an edge may be rounded differently.
    """
    si, bs, _ = sample(bsdf, view, count)
    wo = bs.wo
    importance = mi.BSDFContext()
    importance.mode = mi.TransportMode.Importance
    back = view.interaction(count)
    back.wi = wo
    f = value_and_pdf(bsdf, si, wo)[0] / wo.z
    adjoint = bsdf.eval(importance, back, si.wi)
    dr.eval(adjoint)
    adjoint = intensity(adjoint) / si.wi.z
    valid = np.array((bs.pdf > 0) & (wo.z > 1e-3))
    f, adjoint = (np.atleast_2d(np.array(x))[:, valid] for x in (f, adjoint))
    apart = (np.abs(f - adjoint) > 1e-3 * (np.abs(f) + np.abs(adjoint)) + 1e-6).any(axis=0)
    assert apart.mean() <= strays, apart.mean()


def check_furnace(bsdf: mi.BSDF, *views: View, count: int = 20_000) -> None:
    """The views together reflect no more of uniform light than arrives, within noise (3 sigma)."""
    weights = [intensity(sample(bsdf, view, count)[2]) for view in views]
    weight = np.hstack([np.atleast_2d(np.array(w)) for w in weights])
    noise = weight.std(axis=1) / np.sqrt(weight.shape[1])
    assert (weight.mean(axis=1) <= 1 + 3 * noise + 1e-6).all()


# --------------------------------------------------------------------------------------------------
#  Lights: the spread and the turn of a query
# --------------------------------------------------------------------------------------------------


def golden_spiral(count: int) -> np.ndarray:
    """``count`` points of the unit disk (2×N), each of which stands for the same area."""
    k = np.arange(count) + 0.5
    radius, angle = np.sqrt(k / count), k * np.pi * (3 - 5**0.5)
    return radius * np.stack([np.cos(angle), np.sin(angle)])


def binned_density(
    pndf: PNDF, query: Query | Footprint, bounds: Bounds, res: int, points: int, moved=None
) -> np.ndarray:
    """Mass of D in each of ``res``² bins over ``bounds``, by ``points``² points of each bin.

    ``moved``: offsets of normals (2×N); the result is then the mean over all of them, the k-th lane
    of ``query`` being for the k-th one.
    """
    lower, upper = np.array(bounds, float)
    n, count = res * points, 1 if moved is None else moved.shape[1]
    place = np.stack(np.meshgrid(*[(np.arange(n) + 0.5) / n] * 2)).reshape(2, -1)
    m = lower[:, None] + (upper - lower)[:, None] * place
    if moved is not None:
        m = (m[:, :, None] + moved[:, None]).reshape(2, -1)
    values = np.array(pndf.eval(mi.Vector2f(m.astype(np.float32)), query), np.float64)
    values = values.reshape(-1, n * n, count).mean(axis=(0, 2))  # of all colours as well
    area = np.prod((upper - lower) / n)
    return values.reshape(res, points, res, points).sum(axis=(1, 3)) * area


def relative_l1(found: np.ndarray, expected: np.ndarray) -> float:
    """The sum of all differences, relative to the sum of what is expected."""
    return float(np.abs(found - expected).sum() / expected.sum())


def assert_close(
    found: np.ndarray, plain: np.ndarray, expected: np.ndarray, tolerance: float, mass: float
) -> None:
    """Masses in bins agree: their relative L1 error is less than the ``tolerance``, and that of the
    whole mass is less than ``mass``. The error of the ``plain`` ones, which leave out what is
    tested, is more than twice as large as the tolerance."""
    error, missing = relative_l1(found, expected), found.sum() / expected.sum() - 1
    assert error < tolerance, f"relative L1 error {error:.3g}, tolerance {tolerance:.3g}"
    assert abs(missing) < mass, f"relative difference of mass {missing:.3g}, tolerance {mass:.3g}"
    without = relative_l1(plain, expected)
    assert without > 2 * tolerance, f"a test without power: {without:.3g} without the effect"


def lit(pndf: PNDF) -> PNDF:
    """The P-NDF, prepared for queries with a spread or a turn; it must say that it knows them."""
    assert pndf.integrates_lights
    pndf.prepare_for_lights()
    return pndf


def check_spread(
    pndf: PNDF,
    footprint: Footprint,
    spread: tuple[Pair, Pair],
    bounds: Bounds,
    tolerance: float,
    mass: float = 0.01,
    res: int = 10,
    points: int = 6,
    lights: int = 80,
) -> None:
    """D under a light's spread is the mean of D, without a spread, over points of its ellipse.

    Args:
        pndf: a P-NDF that integrates lights.
        spread: two vectors whose outer products add up to the covariance of the ellipse.
        bounds: of projected normals.
        tolerance: relative L1 error of masses in ``res``² bins.
        mass: relative error of the whole mass.
        lights: number of points of the ellipse.
    """
    vectors = tuple(mi.Vector2f(*(dr.opaque(mi.Float, x) for x in v)) for v in spread)
    bins = bounds, res, points
    found = binned_density(lit(pndf), Query(footprint, spread=vectors), *bins)
    # The radius of a disk is twice its standard deviation along an axis.
    moved = 2 * np.transpose(spread) @ golden_spiral(lights)
    expected = binned_density(pndf, footprint, *bins, moved)
    assert_close(found, binned_density(pndf, footprint, *bins), expected, tolerance, mass)


def check_turn(
    pndf: PNDF,
    view: View,
    turn: np.ndarray,
    bounds: Bounds,
    tolerance: float,
    mass: float = 0.01,
    share: float = 0.96,
    res: int = 10,
    points: int = 6,
    parts: int = 120,
) -> None:
    """With a half vector that turns over the footprint, D is the mean of D over small footprints
    inside of it, each with the half vector of its centre.

    Args:
        pndf: a P-NDF that integrates lights.
        view: the footprint.
        turn: H, 2×2, per unit of UV.
        bounds, tolerance, mass: as of :func:`check_spread`.
        share: of the variance of the footprint, that of the centres of the small ones.
        parts: number of small footprints.
    """

    def footprint(uv, scale: float) -> Footprint:
        return Footprint(
            mi.Point2f(uv),
            *(mi.Vector2f(*(float(scale * x) for x in axis)) for axis in (view.du, view.dv)),
        )

    whole, bins = footprint(view.uv, 1.0), (bounds, res, points)
    query = Query(whole, mi.Matrix2f(np.asarray(turn, np.float32)))
    found = binned_density(lit(pndf), query, *bins)
    disk = golden_spiral(parts)
    squared = (disk**2).sum(axis=0)
    normal = disk * np.sqrt(-2 * np.log1p(-squared) / squared)  # Box and Muller
    offset = np.sqrt(share) * np.transpose([view.du, view.dv]) @ normal
    uv = np.array(view.uv)[:, None] + np.tile(offset, (res * points) ** 2)
    small = footprint(uv.astype(np.float32), np.sqrt(1 - share))
    expected = binned_density(pndf, small, *bins, np.asarray(turn) @ offset)
    assert_close(found, binned_density(pndf, whole, *bins), expected, tolerance, mass)


#: Spreads (standard deviations) and turns (per footprint) that break careless code: none, below
#: rounding, wider than the disk of normals.
EXTREME_SPREADS = (0.0, 1e-12, 1e-4, 0.3, 3.0)
EXTREME_TURNS = (0.0, 1e-9, 1.0, 100.0)


def check_extreme_lights(pndf: PNDF, sigmas=(0.0, 1e-7, 0.01, 1.0)) -> None:
    """D is finite and not negative under any light and for any turn, and 0 outside of the disk.

    ``sigmas``: of the footprints, UV.
    """
    radius, angle = np.array([0, 1e-4, 0.1, 0.5, 0.9, 0.9999, 1.0, 1.1]), np.arange(7)
    m = np.stack([np.outer(radius, f(angle)).ravel() for f in (np.cos, np.sin)])
    count = m.shape[1]
    cases = np.meshgrid(np.arange(count), EXTREME_SPREADS, EXTREME_TURNS, sigmas, indexing="ij")
    index, spread, turn, sigma = (np.ravel(x) for x in cases)
    spread, sigma = mi.Float(spread.astype(np.float32)), mi.Float(sigma.astype(np.float32))
    turn = mi.Float(turn.astype(np.float32)) / dr.maximum(sigma, 1e-3)
    query = Query(
        Footprint.isotropic(mi.Point2f(0.37, 0.61), sigma),
        mi.Matrix2f(turn, 0.3 * turn, -0.5 * turn, 0.2 * turn),
        (mi.Vector2f(spread, 0.3 * spread), mi.Vector2f(0, 1e-3 * spread)),
    )
    density = np.array(lit(pndf).eval(mi.Vector2f(m[:, index].astype(np.float32)), query))
    assert np.isfinite(density).all() and (density >= 0).all()
    outside = np.hypot(*m[:, index]) > 1
    assert (density[..., outside] == 0).all() and (density > 0).any()


# --------------------------------------------------------------------------------------------------
#  Parameters
# --------------------------------------------------------------------------------------------------

# Values that every plugin with a map must refuse, and the parameter that the error must name.
NAN = float("nan")
BAD_PARAMETERS = [
    ({"wrap_mode": "tile"}, "wrap_mode"),
    ({"wrap_mode": 1}, "wrap_mode"),
    ({"map_type": "bump"}, "map_type"),
    ({"height_scale": NAN}, "height_scale"),
    ({"footprint_sigma": -0.5}, "footprint_sigma"),
    ({"footprint_sigma": NAN}, "footprint_sigma"),
    ({"footprint_sigma": float("inf")}, "footprint_sigma"),
    ({"footprint_sigma": "0.5"}, "footprint_sigma"),
    ({"footprint_sigma": True}, "footprint_sigma"),
    ({"pixel_spread": -1e-3}, "pixel_spread"),
    ({"pixel_spread": NAN}, "pixel_spread"),
    ({"material": "Unobtainium"}, "material"),
    ({"material": 3}, "material"),
    ({"material": "Au", "eta": 0.2}, "material"),
    ({"material": "Au", "int_ior": 1.5}, "material"),
    ({"k": 1.0, "ext_ior": 1.0}, "ext_ior"),
    ({"eta": -0.2}, "eta"),
    ({"k": NAN}, "k"),
    ({"eta": "gold"}, "eta"),
    ({"int_ior": 0.0}, "int_ior"),
    ({"int_ior": NAN}, "int_ior"),
    ({"ext_ior": "ether"}, "ext_ior"),
    ({"specular_reflectance": 1.5}, "specular_reflectance"),
    ({"specular_reflectance": -0.5}, "specular_reflectance"),
    ({"specular_reflectance": NAN}, "specular_reflectance"),
    ({"to_uv": 2.0}, "to_uv"),
    ({"filename": "map.exr"}, "filename"),  # the map has data already
    ({"data": (1.0, 2.0, 3.0)}, "data"),
    ({"data": None, "filename": "does_not_exist.exr"}, "filename"),
    ({"data": None, "filename": 3}, "filename"),
    ({"data": None, "bitmap": "map.exr"}, "bitmap"),
    ({"data": None}, "data"),
]


def check_rejects(good: dict, changes: dict, parameter: str) -> None:
    """Loading ``good`` with ``changes`` fails, and the error names plugin and parameter.

    A change to None removes a parameter.
    """
    description = {k: v for k, v in {**good, **changes}.items() if v is not None}
    try:
        mi.load_dict(description)
    except Exception as error:
        sentence = rf'{good["type"]}: .*"{parameter}".* \(got .*\)'
        assert re.search(sentence, str(error)), f"{changes}: {error}"
    else:
        raise AssertionError(f"{changes} is accepted")
