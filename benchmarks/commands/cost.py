"""Rendering times of every method relative to roughconductor.

The methods are the ones in ``benchmarks/methods.py`` that are marked for ``cost``.
"""

from __future__ import annotations

from functools import partial
from math import radians

import mitsuba as mi

from benchmarks.cases import PATCH_MAP, UV_SCALE, Surface, curved_patch, maps_of, plane, scaled
from benchmarks.harness import Run, family, timed
from benchmarks.measures.images import in_turn
from benchmarks.methods import METHODS, Method, rough
from glintbsdf import NormalMap
from glintbsdf.scene.rendering import pixel_spread

#: Sizes of footprints on the curved patch, pixels.
PIXELS = (1 / 16, 1, 4)

#: Elevations (degrees) and distances of the views of the plane.
ELEVATIONS, DISTANCES, FIELD_OF_VIEW = (90, 10), (1.0, 30.0), 30.0


def on_patch(
    method: Method, footprints: tuple[float, ...], normal_map: NormalMap, size: int, run: Run
) -> list[dict]:
    """A method on the curved patch, for footprints of several sizes; its structure is built
    once."""
    shared = {"material": "Cr", "to_uv": scaled(UV_SCALE)}
    smooth = curved_patch(rough(normal_map, **shared), size, 16)
    angle = pixel_spread(smooth.sensors()[0])
    material = method.describe(Surface("patch", normal_map)) | shared | {"pixel_spread": angle}
    glints, loading = timed(lambda: curved_patch(material, size, 16))
    parameters = mi.traverse(glints)
    (key,) = (key for key in parameters.keys() if key.endswith("pixel_spread"))
    rows = []
    for pixels in footprints:
        parameters[key] = mi.Float(pixels * angle)
        parameters.update()
        times = in_turn((smooth, glints), 16, run.repetitions)
        rows.append({"footprint": f"{pixels:g} pixels", "loading": loading} | times)
    return rows


def on_plane(method: Method, elevation: float, distance: float, size: int, run: Run) -> dict:
    """A method without a map on the plane, for footprints of a pixel."""
    view = {"elevation": elevation, "distance": distance, "fov": FIELD_OF_VIEW}
    conductor = {"type": "roughconductor", "distribution": "beckmann", "alpha": 0.3}
    smooth = plane(conductor | {"material": "Al"}, **view, size=size, spp=16)
    spread = radians(FIELD_OF_VIEW) / size / 16**0.5
    material = method.plugin | {"pixel_spread": spread, "to_uv": scaled(1000), "material": "Al"}
    glints, loading = timed(lambda: plane(material, **view, size=size, spp=16))
    return {"loading": loading} | in_turn((smooth, glints), 16, run.repetitions)


def renders(run: Run) -> None:
    """Times of frames relative to roughconductor: 400², 16 samples per pixel, Mitsuba's ``path``.

    Methods with a map are on the curved patch. A footprint of f pixels is a ``pixel_spread`` of f
    times a pixel's angle, and ``roughconductor`` has the roughness of the map. ``glint_grid`` is on
    a plane, seen along its normal and from 10° above it, from two distances. A method and
    ``roughconductor`` render in turn in every repetition, after a first frame that compiles. No
    other material exists then, as Dr.Jit compiles all that exist into every frame. Ratios are
    medians of the ratios within a repetition. Loading includes building.
    """
    size = 100 if run.quick else 400
    maps = {"isotropic": partial(NormalMap.load, PATCH_MAP), **maps_of(run, 0)}
    with run.table("renders") as table:
        for method in METHODS:
            if not method.cost or (run.quick and not method.quick):
                continue
            if method.mapped:
                for name, make in maps.items():
                    footprints = PIXELS[:2] if run.quick else PIXELS
                    work = partial(on_patch, method, footprints, make(), size, run)
                    table.measure({"method": method.name, "map": name}, work)
                continue
            for elevation in ELEVATIONS:
                for distance in DISTANCES:
                    where = {"footprint": f"at {elevation}°, {distance:g} away"}
                    work = partial(on_plane, method, elevation, distance, size, run)
                    table.measure({"method": method.name, **where}, work)


cost = family("cost", renders)
