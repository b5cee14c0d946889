"""Measures of a BSDF's numerical robustness: functions that return numbers and do not judge them.

The footprint is set through ``si.duv_dx`` and ``si.duv_dy``, as in :mod:`glintbsdf.check.suite`,
whose views are used here.
"""

from __future__ import annotations

import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, replace
from math import radians
from types import ModuleType
from typing import TYPE_CHECKING, Any

import drjit as dr
import mitsuba as mi
import numpy as np

from glintbsdf.check import suite
from glintbsdf.check.suite import View
from glintbsdf.core.garbage import collect_former_scenes
from glintbsdf.footprint.gaussian import Footprint
from glintbsdf.footprint.query import Query
from glintbsdf.pndf import Grid

if TYPE_CHECKING:
    from glintbsdf.bridge.bsdf import GlintBSDF

Array = np.ndarray

# --------------------------------------------------------------------------------------------------
#  Extremes: many lanes, each with a combination of values that break careless code
# --------------------------------------------------------------------------------------------------

#: Larger standard deviation of a footprint (maps), ratio of both standard deviations, and
#: inclination of a direction (degrees).
SIZES = (0, 1e-7, 1e-5, 1e-4, 1e-3, 1e-2, 0.1, 100)
RATIOS = (1, 10, 1e2, 1e4)
INCLINATIONS = (0, 30, 60, 85, 89.9, 89.9999, 90)
#: Size of the UV coordinates.
PLACES = (0, 1, 1e3, 1e6)
#: Radiance of a light: its reflection must be finite, too.
RADIANCE = 1e6


def direction(inclination: Array, azimuth: Array) -> Array:
    """Unit vectors (3, N) from angles in radians; 90° is horizontal to the last digit."""
    horizontal = inclination >= radians(90)
    z = np.where(horizontal, 0, np.cos(inclination))
    return np.stack(
        [np.sin(inclination) * np.cos(azimuth), np.sin(inclination) * np.sin(azimuth), z]
    )


def extreme_interaction(count: int, seed: int) -> mi.SurfaceInteraction3f:
    """Interactions with random combinations of the extremes; a quarter has no UV partials.

    The parameterisation is orthonormal, mirrored (inverted UVs), with parallel partial derivatives,
    almost parallel ones, or none.
    """
    rng = np.random.default_rng(seed)
    # Sorted, so that lanes that run together take about the same time.
    size = np.repeat(SIZES, -(-count // len(SIZES)))[:count]
    ratio, place = rng.choice(RATIOS, count), rng.choice(PLACES, count)
    angle = rng.uniform(0, 2 * np.pi, count)
    given = rng.random(count) < 0.75
    axes = np.stack([np.cos(angle), np.sin(angle)]), np.stack([-np.sin(angle), np.cos(angle)])
    dx, dy = size * given * axes[0], size / ratio * given * axes[1]
    dp_du = np.array([[1, 0, 0], [1, 0, 0], [1, 0, 0], [1, 0, 0], [0, 0, 0]])
    dp_dv = np.array([[0, 1, 0], [0, -1, 0], [2, 0, 0], [1, 1e-7, 0], [0, 0, 0]])
    frame = rng.integers(0, len(dp_du), count)
    wi = direction(np.radians(rng.choice(INCLINATIONS, count)), rng.uniform(0, 2 * np.pi, count))

    si = View().interaction(count)
    si.uv = vector(mi.Point2f, place * rng.uniform(-1, 1, (2, count)))
    si.duv_dx, si.duv_dy = vector(mi.Vector2f, dx), vector(mi.Vector2f, dy)
    si.dp_du, si.dp_dv = (vector(mi.Vector3f, d[frame].T) for d in (dp_du, dp_dv))
    si.wi = vector(mi.Vector3f, wi)
    si.t = mi.Float(np.float32(10 ** rng.uniform(-3, 6, count)))
    return si


def vector(kind: type, values: Array):
    """An array of vectors in float32 from NumPy (D, N)."""
    return kind(*(mi.Float(np.float32(row)) for row in values))


def extremes(bsdf: mi.BSDF, count: int, seed: int = 1) -> dict[str, int]:
    """The number of lanes with a value that is not finite (``nan``), or ``negative``.

    The values are the direction, density and weight of samples; values and densities of the BSDF in
    these directions, and in others down to the horizon; and the albedo. The light has the radiance
    :data:`RADIANCE`.
    """
    si = extreme_interaction(count, seed)
    u = suite.random_numbers(count, 3, seed)
    ctx = mi.BSDFContext()
    bs, weight = bsdf.sample(ctx, si, u[0], mi.Point2f(u[1], u[2]))
    rng = np.random.default_rng(seed + 1)
    elsewhere = direction(
        np.radians(rng.choice(INCLINATIONS, count)), rng.uniform(0, 2 * np.pi, count)
    )
    dr.eval(bs, weight)
    lost, negative = ~dr.all(dr.isfinite(bs.wo)), mi.Bool(False)

    def look(*numbers) -> None:
        nonlocal lost, negative
        for number in numbers:
            lost = lost | ~dr.all(dr.isfinite(mi.Color3f(number)))
            negative = negative | dr.any(mi.Color3f(number) < 0)
        dr.eval(lost, negative)

    look(
        RADIANCE * suite.intensity(weight),
        bs.pdf,
        suite.intensity(bsdf.eval_diffuse_reflectance(si)),
    )
    # In two calls with opaque values, so that one kernel serves both.
    for wo in (bs.wo, vector(mi.Vector3f, elsewhere)):
        dr.make_opaque(wo)
        value, pdf = bsdf.eval_pdf(ctx, si, wo)
        look(RADIANCE * suite.intensity(value), pdf)
    return {
        "nan": int(mi.UInt32(dr.count(lost))[0]),
        "negative": int(mi.UInt32(dr.count(negative))[0]),
    }


# --------------------------------------------------------------------------------------------------
#  Energy
# --------------------------------------------------------------------------------------------------


def energy(bsdf: mi.BSDF, views: list[View], samples: int, spread: float) -> list[dict[str, float]]:
    """The share of uniform light that each view reflects: ``energy``, and its standard ``error``.

    ``spread``: footprints are placed at random, up to this far (UV) from the view's position.
    """
    count = len(views) * samples
    si = View().interaction(count)
    rng = np.random.default_rng(11)

    def lanes(kind: type, values: Array):
        return vector(kind, np.repeat(np.array(values, np.float64), samples, axis=0).T)

    places = np.repeat(np.array([v.uv for v in views]), samples, axis=0).T
    si.uv = vector(mi.Point2f, places + spread * rng.random((2, count)))
    si.duv_dx = lanes(mi.Vector2f, [v.du for v in views])
    si.duv_dy = lanes(mi.Vector2f, [v.dv for v in views])
    si.wi = dr.normalize(lanes(mi.Vector3f, [v.wi for v in views]))
    u = suite.random_numbers(count, 3, seed=4)
    _, weight = bsdf.sample(mi.BSDFContext(), si, u[0], mi.Point2f(u[1], u[2]))
    weight = np.atleast_2d(np.array(suite.intensity(weight), np.float64))
    weight = weight.reshape(-1, len(views), samples)
    mean, error = weight.mean(2), weight.std(2, ddof=1) / np.sqrt(samples)
    channel = mean.argmax(0)
    return [
        {"energy": float(mean[c, k]), "error": float(error[c, k])} for k, c in enumerate(channel)
    ]


def mean_of_grid(bsdf: GlintBSDF, count: int) -> list[dict[str, float | str]]:
    """``mass``: the mean of D over its expectation, minus one, for ``glint_grid``.

    The mean is over random places and normals. The footprints have some hundred microdetails each,
    and do not overlap.
    """
    pndf = bsdf.pndf
    if not isinstance(pndf, Grid):
        raise TypeError("the mean over places is known of glint_grid only")
    smooth = mi.MicrofacetDistribution(
        mi.MicrofacetType.Beckmann, pndf.alpha.x, pndf.alpha.y, sample_visible=False
    )
    u = suite.random_numbers(count, 4, seed=8)
    m, _ = smooth.sample(mi.Vector3f(0, 0, 1), mi.Point2f(u[0], u[1]))
    sigma = 10 * dr.rcp(pndf.scale)
    footprint = Footprint.isotropic(mi.Point2f(u[2], u[3]) * (1000 * sigma), sigma)
    ratio = pndf.eval(mi.Vector2f(m.x, m.y), footprint) / smooth.eval(m)
    ratio = np.atleast_2d(np.array(ratio, np.float64)).mean(0)
    error = ratio.std() / np.sqrt(count)
    return [{"view": "mean", "mass": float(ratio.mean() - 1), "mass_error": float(error)}]


# --------------------------------------------------------------------------------------------------
#  float32 against float64
# --------------------------------------------------------------------------------------------------

#: Modules that keep single precision: they read parameters, or work on Mitsuba's own structures.
SINGLE = ("parameters", "normalmap", "bsdf", "registration", "rendering", "cli")


class DoubleMitsuba:
    """Mitsuba's names with float64 arrays in place of float32 ones.

    Mitsuba's wheels have no variant in double precision, but the array types exist. The mathematics
    of this package looks them up when it is called.
    """

    def __getattr__(self, name: str) -> Any:
        if name in ("Float", "TensorXf"):
            return {"Float": mi.Float64, "TensorXf": mi.TensorXd}[name]
        if name[-1] == "f" and name[-2].isdigit() and not name.startswith("Scalar"):
            return getattr(mi, name[:-1] + "d")
        return getattr(mi, name)


class DoubleDrJit:
    """Dr.Jit's functions. The 32 bits of a float are still those of a float32."""

    def __getattr__(self, name: str) -> Any:
        return getattr(dr, name)

    def reinterpret_array(self, kind: type, value: object) -> object:
        if mi.UInt64 in (kind, type(value)):
            return dr.reinterpret_array(kind, value)
        if kind is mi.Float64:
            return mi.Float64(dr.reinterpret_array(mi.Float32, value))
        return dr.reinterpret_array(kind, mi.Float32(value) if type(value) is mi.Float64 else value)


@contextmanager
def double_precision() -> Iterator[DoubleMitsuba]:
    """A context in which the package computes in float64. Objects that are loaded in it must not be
    used outside."""
    double_mitsuba = DoubleMitsuba()
    double = {"mi": double_mitsuba, "dr": DoubleDrJit()}
    single = {"mi": mi, "dr": dr}
    modules = [
        module
        for name, module in sys.modules.items()
        if name.startswith("glintbsdf.")
        and not name.startswith("glintbsdf.check.")
        and name.rpartition(".")[2] not in SINGLE
        and getattr(module, "mi", None) is mi
    ]
    try:
        for module in modules:
            vars(module).update({k: v for k, v in double.items() if hasattr(module, k)})
        yield double_mitsuba
    finally:
        for module in modules:
            vars(module).update({k: v for k, v in single.items() if hasattr(module, k)})


@dataclass(frozen=True)
class Queries:
    """Directions, normals and footprints in float32 (NumPy, one row per component).

    ``floor``: smallest scale for relative differences of values.
    """

    uv: Array
    du: Array
    dv: Array
    wi: Array
    wo: Array
    m: Array
    floor: Array

    def value(self, bsdf: Any, m: ModuleType | DoubleMitsuba) -> Array:
        """D(m) G of a glossy BSDF, or the value of a diffuse one; ``m``: Mitsuba's names."""
        query = Query(Footprint(m.Point2f(self.uv), m.Vector2f(self.du), m.Vector2f(self.dv)))
        wi, wo = m.Vector3f(self.wi), m.Vector3f(self.wo)
        mode, active = mi.TransportMode.Radiance, mi.Bool(True)
        if getattr(bsdf, "pndf", None) is None:
            value = bsdf.method.eval(wi, wo, mode, query, active)
        else:
            value = bsdf.pndf.eval(m.Vector2f(self.m), query, active)
            if bsdf.masking is not None:
                value = value * bsdf.masking.eval(wi, wo, query, mode, active)
        # One channel is enough: the channels of coloured glints share their density.
        return np.atleast_2d(np.array(value))[0]


def queries(bsdf: mi.BSDF, count: int) -> Queries:
    """Queries with random footprints, for normals that the BSDF draws there."""
    rng = np.random.default_rng(21)
    size, ratio = 10 ** rng.uniform(-4, -0.5, count), 10 ** rng.uniform(0, 4, count)
    angle = rng.uniform(0, 2 * np.pi, count)
    c, s = np.cos(angle), np.sin(angle)
    si = View().interaction(count)
    uv = np.float32(rng.random((2, count)))
    du, dv = np.float32(size * [c, s]), np.float32(size / ratio * [-s, c])
    wi = direction(np.radians(rng.choice((0, 30, 60, 85), count)), rng.uniform(0, 7, count))
    si.uv, si.duv_dx, si.duv_dy = mi.Point2f(uv), mi.Vector2f(du), mi.Vector2f(dv)
    si.wi = vector(mi.Vector3f, wi)
    u = suite.random_numbers(count, 3, seed=6)
    bs, _ = bsdf.sample(mi.BSDFContext(), si, u[0], mi.Point2f(u[1], u[2]))
    m = dr.normalize(si.wi + bs.wo)
    # glint_grid draws from the smooth surface, so D may be almost 0 at a sample. Relative
    # differences are then relative to the smooth density.
    drawn = bs.pdf * 4 * dr.abs(dr.dot(bs.wo, m)) / m.z
    floor = drawn if isinstance(getattr(bsdf, "pndf", None), Grid) else drawn * 0
    valid = np.array(bs.pdf) > 0
    columns = (si.uv, si.duv_dx, si.duv_dy, si.wi, bs.wo, mi.Vector2f(m.x, m.y), floor)
    return Queries(*(np.array(x)[..., valid] for x in columns))


def double_error(bsdf: mi.BSDF, load: Callable[[], mi.BSDF], count: int) -> dict[str, float]:
    """The difference of the same formulas in single and in double precision.

    Args:
        bsdf: the BSDF.
        load: function that makes the same BSDF again; it is called for double precision.
        count: number of queries.

    Returns:
        ``error``: the mean of |a − b| / max(|a|, |b|). ``last_digit``: the same for two results in
        float64, for normals and positions that differ in the last digit of float32; no computation
        can be more accurate than its input.
    """
    question = queries(bsdf, count)
    single = np.float64(question.value(bsdf, mi))
    with double_precision() as names:
        bsdf = load()
        double = question.value(bsdf, names)
        m, uv = (np.nextafter(x, np.float32(2)) for x in (question.m, question.uv))
        beside = replace(question, m=m, uv=uv).value(bsdf, names)
    del bsdf
    collect_former_scenes()  # no BSDF in float64 may exist at the next rendering
    if double.dtype != np.float64:
        raise TypeError(f"computed in {double.dtype}")

    def difference(a: Array) -> float:
        larger = np.maximum(np.maximum(np.abs(a), np.abs(double)), question.floor)
        compared = larger != 0  # true for NaN, too
        return float(np.mean(np.abs(a - double)[compared] / larger[compared]))

    return {"error": difference(single), "last_digit": difference(beside)}


# --------------------------------------------------------------------------------------------------
#  An image
# --------------------------------------------------------------------------------------------------

#: A power of two, about 10⁶: scaling by it changes no digit.
BRIGHT = 2.0**20


def scene_of_squares(bsdf: mi.BSDF) -> mi.Scene:
    """Squares with ordinary, inverted and collapsed UVs, under a lamp and a dim sky."""
    scene: dict[str, object] = {
        "type": "scene",
        "integrator": {"type": "glint_path", "max_depth": 3},
        "sensor": {
            "type": "perspective",
            "fov": 50,
            "to_world": mi.ScalarTransform4f().look_at([0.3, -3, 2.5], [0, 0, 0], [0, 0, 1]),
            "film": {"type": "hdrfilm", "width": 12, "height": 8, "rfilter": {"type": "box"}},
            "sampler": {"type": "independent", "sample_count": 8},
        },
        "lamp": {
            "type": "sphere",
            "center": [0.2, 0.5, 2],
            "radius": 0.3,
            "emitter": {"type": "area", "radiance": {"type": "rgb", "value": 1.0}},
        },
        "sky": {"type": "constant", "radiance": {"type": "rgb", "value": 1e-3}},
    }
    for k, texcoords in enumerate(
        ([0, 0, 1, 0, 1, 1, 0, 1], [1, 0, 0, 0, 0, 1, 1, 1], [0, 0, 1, 1, 2, 2, 3, 3])
    ):
        scene[f"square_{k}"] = square(-1.1 + 1.1 * k, texcoords, bsdf)
    return mi.load_dict(scene)


def square(x: float, texcoords: list[float], bsdf: mi.BSDF) -> mi.Mesh:
    """A unit square in the plane z = 0 with these UVs at its corners."""
    props = mi.Properties()
    props["bsdf"] = bsdf
    mesh = mi.Mesh("square", 4, 2, has_vertex_texcoords=True, props=props)
    parameters = mi.traverse(mesh)
    corners = [(x - 0.5, -0.5, 0), (x + 0.5, -0.5, 0), (x + 0.5, 0.5, 0), (x - 0.5, 0.5, 0)]
    parameters["vertex_positions"] = mi.Float(np.float32(corners).ravel())
    parameters["vertex_texcoords"] = mi.Float(texcoords)
    parameters["faces"] = mi.UInt32([0, 1, 2, 0, 2, 3])
    parameters.update()
    return mesh


def bright_light(bsdf: mi.BSDF) -> dict[str, float]:
    """Two images, with light of radiance 1 and of radiance ``BRIGHT``.

    ``apart`` is their relative L1 difference, after scaling. ``nan`` and ``negative`` count
    channels of pixels in the second image that are not finite, or negative.
    """
    scene = scene_of_squares(bsdf)
    plain = np.array(mi.render(scene, seed=1), np.float64)
    parameters = mi.traverse(scene)
    for key in ("lamp.emitter.radiance.value", "sky.radiance.value"):
        parameters[key] = BRIGHT * parameters[key]
    parameters.update()
    bright = np.array(mi.render(scene, seed=1), np.float64)
    finite = np.isfinite(bright)
    apart = np.abs(bright / BRIGHT - plain)[finite].sum() / np.abs(plain).sum()
    return {
        "apart": float(apart),
        "nan": int((~finite).sum()),
        "negative": int((bright < 0).sum()),
    }


def views(texels: float, quick: bool, large: bool) -> dict[str, View]:
    """Views for densities of a map ``texels`` wide: footprints from a point to a tenth of the map,
    or to half of it if ``large``."""
    texel, slant = 1 / texels, (0.3, 0.1, 1)
    chosen = {
        "texels": View(du=(1.3 * texel, 0.7 * texel), dv=(-0.35 * texel, 0.65 * texel), wi=slant),
        "needle": View(du=(4 * texel, 2.5 * texel), dv=(-0.025 * texel, 0.04 * texel), wi=slant),
    }
    if large:
        chosen["half"] = View(du=(0.5, 0.1), dv=(-0.1, 0.4), wi=(0.1, 0, 1))
    if quick:
        return chosen
    far = replace(chosen["texels"], uv=(1e6 + 0.3, -1e6 - 0.6), wi=(-1, 0.4, 0.5))
    tenth = View(du=(0.1, 0.0), dv=(0.03, 0.1), wi=(0, 0, 1))
    return chosen | {"point": View(wi=slant), "far": far, "tenth": tenth}


def energy_views(texels: float) -> list[View]:
    """Views for the energy: footprints of half a texel, of four texels, and of the whole map."""
    result = []
    for k, sigma in enumerate((0.5 / texels, 4 / texels, 1.0)):
        for n, inclination in enumerate((0, 60, 85, 89.9)):
            azimuth = np.array(0.7 + 2.1 * n + 1.3 * k)
            wi = direction(np.radians(np.array(inclination)), azimuth)
            result.append(View(du=(sigma, 0), dv=(0, sigma), wi=tuple(wi.tolist())))
    return result
