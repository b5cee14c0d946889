"""Stiff maps and settings: those on which careless code breaks.

Every method of the register is tested on them; a method that has no settings here is tested with
the settings that it is registered with.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from functools import cache, partial

import numpy as np

from glintbsdf import maps
from glintbsdf.maps.normalmap import NormalMap
from glintbsdf.pndf import methods
from glintbsdf.pndf.manifold.mesh import equilateral

# --------------------------------------------------------------------------------------------------
#  Maps
# --------------------------------------------------------------------------------------------------

#: Side of the stiff maps, texels: the smallest one with clusters.
STIFF_SIZE = 32


def step_edge() -> NormalMap:
    """Two planes: all triangles are degenerate, and those across the edge are very long."""
    normals = np.zeros((STIFF_SIZE, STIFF_SIZE, 2))
    half = STIFF_SIZE // 2
    normals[:, :half], normals[:, half:] = (-0.3, 0), (0.6, 0.1)
    return NormalMap(normals)


def rank_one() -> NormalMap:
    """Grooves: normals on a line, which vary in one direction only; every Jacobian is singular."""
    wave = 0.6 * np.sin(2 * np.pi * np.arange(STIFF_SIZE) / STIFF_SIZE * 3)
    normals = wave[None, :, None] * np.array([0.8, 0.6])
    return NormalMap(np.broadcast_to(normals, (STIFF_SIZE, STIFF_SIZE, 2)))


def white_noise(shape: tuple[int, int], wrap_mode: str = "repeat") -> NormalMap:
    """Independent normals, uniform over the disk up to slopes of 200."""
    rng = np.random.default_rng(1)
    radius, angle = np.sqrt(rng.random(shape)), rng.uniform(0, 2 * np.pi, shape)
    normals = 0.99999 * radius * np.stack([np.cos(angle), np.sin(angle)])
    return NormalMap(np.moveaxis(normals, 0, -1), wrap_mode)


STIFF_MAPS: dict[str, Callable[[], NormalMap]] = {
    "isotropic": partial(maps.isotropic, STIFF_SIZE, seed=1),
    "flat": partial(maps.flat, STIFF_SIZE),
    "tilted": partial(maps.tilted, STIFF_SIZE, 0.5, 0.3),
    "rank-one": rank_one,
    "step edge": step_edge,
    "white noise": partial(white_noise, (STIFF_SIZE, STIFF_SIZE)),
    "single texel": partial(maps.tilted, 1, 0.3, 1.0),
    "3×5, mirror": lambda: NormalMap(maps.isotropic((3, 5), 0.4).normals, "mirror"),
    "1×17, clamp": partial(white_noise, (1, 17), "clamp"),
}

# --------------------------------------------------------------------------------------------------
#  Settings, and the energy that each method promises
# --------------------------------------------------------------------------------------------------

EVERYWHERE, VERTICAL = "everywhere", "vertical"
NO_MAP = ("none",)


@dataclass(frozen=True)
class Stiff:
    """A plugin with parameters, and how to test it.

    ``furnace``: views from which it must not reflect more light than arrives: everywhere, or from
    the vertical. ``sweep``: the stiff parameter and its values. ``lanes``: number of queries for
    NaN, smaller if a query is expensive. ``double``: whether it can compute in float64. ``large``:
    whether to test its density under a footprint of half the map as well.
    """

    plugin: str
    parameters: dict = field(default_factory=dict)
    furnace: str = EVERYWHERE
    sweep: tuple[str, tuple[float, ...]] = ("", ())
    maps: tuple[str, ...] = tuple(STIFF_MAPS)
    lanes: int = 512
    double: bool = True
    large: bool = False


def decades(first: int, last: int) -> tuple[float, ...]:
    """Powers of ten from 10^``first`` to 10^``last``."""
    return tuple(10.0**k for k in range(first, last + 1))


wu = partial(Stiff, "glint_manifold")
yan = partial(Stiff, "glint_elements")
zirr = partial(Stiff, "glint_grid", maps=NO_MAP)
filtered = partial(Stiff, "glint_filtered")
#: Samples for ``glint_mip``, whose map has twice their side; they must be larger than a patch.
SQUARE_MAPS = tuple(STIFF_MAPS)[:6]
SMALL_MIP = {"output_size": 2 * STIFF_SIZE, "patch_size": STIFF_SIZE // 2, "overlap": 4,
             "clusters": 8}  # fmt: skip

STIFF: dict[str, Stiff] = {
    "manifold": wu(sweep=("epsilon", decades(-10, -2))),
    "manifold, disk, beckmann": wu({"kernel": "disk", "masking": "beckmann"}, VERTICAL),
    "manifold, box, analytic": wu({"kernel": "box", "masking": "analytic"}, lanes=64),
    "manifold, no masking": wu({"masking": "none"}, VERTICAL),
    "manifold, threshold": wu({"threshold": 1e-2}, sweep=("threshold", decades(-6, 2))),
    "manifold, max_error": wu({"max_error": 0.1}, sweep=("max_error", decades(-6, 2)), large=True),
    # For large footprints it is LEAN's lobe, with the masking of the map.
    "manifold, hand_over": wu({"hand_over": 0.7}, VERTICAL),
    "elements": yan({}, VERTICAL, ("sigma_r", decades(-8, 0))),
    "elements, flat": yan({"elements": "flat", "step": 2.0}, VERTICAL),
    "elements, flakes": yan({"flake_density": 1e3, "flake_alpha": 0.2}, VERTICAL, maps=NO_MAP),
    "mip": Stiff(
        "glint_mip", SMALL_MIP, VERTICAL, ("sigma_r", decades(-8, 0)), SQUARE_MAPS, large=True
    ),
    "diffuse": Stiff("glint_diffuse", {"reflectance": 1.0}, lanes=64),
    # Mitsuba's frames exist in float32 only.
    "diffuse, Oren–Nayar": Stiff(
        "glint_diffuse", {"reflectance": 1.0, "method": "oren_nayar"}, double=False
    ),
    "grid": zirr(sweep=("density", (-20, -10, -3, 0, 3, 6, 12, 20))),
    "grid, grooves": zirr({"detail_alpha_u": 0.3, "detail_alpha_v": 1e-4}),
    "grid, wheel": zirr({"colors": "wheel", "size_variation": 2.0}),
    "lean": filtered({"method": "lean"}, VERTICAL, ("alpha", decades(-7, 1))),
    "leadr": filtered({"method": "leadr"}),
    "clean": filtered({"method": "clean"}, VERTICAL),
    "toksvig": filtered({"method": "toksvig"}, VERTICAL),
    "toksvig, GGX": filtered({"method": "toksvig", "distribution": "ggx"}, VERTICAL),
    "variance": filtered({"method": "variance"}, VERTICAL),
    "variance, GGX": filtered({"method": "variance", "distribution": "ggx"}, VERTICAL),
}
STIFF |= {
    entry.title: Stiff(
        entry.plugin,
        dict(entry.settings),
        VERTICAL,
        maps=tuple(STIFF_MAPS) if entry.takes_map else NO_MAP,
    )
    for entry in methods().values()
    if entry.plugin and entry.plugin not in {known.plugin for known in STIFF.values()}
}

#: Width of the lobe of normals for the value of a parameter; for a degenerate triangle, the radius
#: of its incircle. Narrower lobes than NARROWEST_LOBE are not judged: float32 half vectors are 6e-8
#: apart, and have an error of about 1e-7 if they are computed from two directions.
WIDTHS: dict[str, Callable[[float], float]] = {
    "alpha": lambda alpha: alpha,
    "sigma_r": lambda sigma_r: sigma_r,
    "epsilon": lambda epsilon: equilateral(epsilon)[0][1] / 2,
}
NARROWEST_LOBE = 1e-5


@cache
def stiff_map(name: str) -> NormalMap:
    """A map of :data:`STIFF_MAPS`, made once."""
    return STIFF_MAPS[name]()
