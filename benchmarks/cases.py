"""Maps, footprints and scenes that the benchmarks measure on."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass
from functools import cache, partial
from math import cos, radians, sin
from pathlib import Path

import drjit as dr
import mitsuba as mi
import numpy as np

from benchmarks.harness import ROOT, Run
from glintbsdf import Footprint, NormalMap, maps
from glintbsdf.core.garbage import collect_former_scenes
from glintbsdf.maps.quilting import synthesise
from glintbsdf.pndf.manifold.mesh import TexelMesh
from glintbsdf.scene.rendering import pixel_spread

# --------------------------------------------------------------------------------------------------
#  Maps
# --------------------------------------------------------------------------------------------------

#: Procedural maps by name; each takes its side in texels.
MAPS: dict[str, Callable[..., NormalMap]] = {
    "isotropic": partial(maps.isotropic, seed=1),
    "brushed": partial(maps.brushed, seed=1),
    "scratched": partial(maps.scratched, seed=1),
    "flakes": partial(maps.flakes, seed=1),
    "leather": partial(maps.leather, seed=1),
    "smooth": partial(maps.isotropic, correlation_length=48, seed=1),
    "fine": partial(maps.isotropic, correlation_length=3, seed=2),
    "rough": partial(maps.isotropic, alpha=0.5, seed=1),
    "flat": maps.flat,
    "tilted": partial(maps.tilted, tilt=0.3, azimuth=0.5),
}


def maps_of(
    run: Run, size: int, *names: str, **options: object
) -> dict[str, Callable[[], NormalMap]]:
    """Functions that make the procedural maps of these names, or return the maps from files."""
    made = {name: cache(partial(MAPS[name], size, **options)) for name in names}
    return made | {name: (lambda given=given: given) for name, given in run.maps.items()}


@dataclass(frozen=True)
class Surface:
    """A map, the clamp of its triangles' Jacobian, and the sample that it is synthesised from."""

    name: str
    normal_map: NormalMap
    epsilon: float = 1e-6
    sample: NormalMap | None = None


@dataclass(frozen=True)
class Case:
    """A kind of map; ``sampled`` if it is synthesised from a sample, ``given`` if from a file."""

    name: str
    surface: Callable[[int], Surface]
    sampled: bool = False
    given: bool = False


def procedural(name: str, epsilon: float = 1e-6) -> Case:
    """A map of :data:`MAPS`, with the size that the report uses."""
    return Case(name, lambda size: Surface(name, MAPS[name](size), epsilon))


def synthesised(name: str, sample: str, sample_size: int = 256) -> Case:
    """A map of patches of a smaller one; ``glint_mip`` gets only the smaller one."""

    def surface(size: int) -> Surface:
        small = MAPS[sample](sample_size)
        return Surface(name, synthesise(small, size, **SYNTHESIS).normal_map(), sample=small)

    return Case(name, surface, sampled=True)


def given(path: Path) -> Case:
    """A map from a file, with its own size."""
    return Case(path.stem, lambda size: Surface(path.stem, NormalMap.load(path)), given=True)


#: Parameters of the synthesis of maps.
SYNTHESIS = {"patch_size": 64, "overlap": 2, "balance": 0.9, "seed": 0}

#: Six kinds of maps, and a synthesised one. Flat facets are points on the disk of normals, and
#: their highlight has the area ``epsilon``. With 1e-6, the highlight of flakes would be a spike
#: that no grid of points finds.
CASES = [
    *(procedural(name) for name in ("isotropic", "brushed", "scratched")),
    procedural("flakes", epsilon=1e-3),
    *(procedural(name) for name in ("leather", "smooth")),
    synthesised("isotropic patches", "isotropic"),
]

# --------------------------------------------------------------------------------------------------
#  Footprints and queries
# --------------------------------------------------------------------------------------------------


#: Positions of footprints (UV) over which errors are averaged.
PLACES = ((0.37, 0.61), (0.81, 0.22), (0.13, 0.45))


@dataclass(frozen=True)
class Ellipse:
    """The shape of a footprint: standard deviations in texels, rotation in degrees."""

    major: float
    minor: float
    turn: float = 0.0

    @classmethod
    def round(cls, sigma: float) -> Ellipse:
        """A round one of standard deviation ``sigma`` texels."""
        return cls(sigma, sigma)

    def __str__(self) -> str:
        if self.major == self.minor:
            return f"{self.major:g}"
        return f"{self.major:g} × {self.minor:g} at {self.turn:g}°"

    def axes(self, normal_map: NormalMap) -> np.ndarray:
        """Both axes (2, 2), one in a row, UV."""
        c, s = cos(radians(self.turn)), sin(radians(self.turn))
        axes = np.array([[self.major * c, self.major * s], [-self.minor * s, self.minor * c]])
        return axes / [normal_map.width, normal_map.height]

    def covariance(self, normal_map: NormalMap) -> np.ndarray:
        """The covariance (2, 2), UV²."""
        axes = self.axes(normal_map)
        return axes.T @ axes

    def at(self, normal_map: NormalMap, uv: Iterable) -> Footprint:
        """Footprints at ``uv`` (2,) or (2, N), one lane for each."""
        du, dv = (
            mi.Vector2f(*(dr.opaque(mi.Float, float(x)) for x in axis))
            for axis in self.axes(normal_map)
        )
        centre = mi.Point2f(*(mi.Float(np.float32(x)) for x in np.asarray(uv)))
        return Footprint(centre, du, dv)


def queries(normal_map: NormalMap, ellipse: Ellipse, count: int, epsilon: float = 1e-6) -> tuple:
    """``(m, footprint)``: random places on the map, each with a normal drawn from its exact P-NDF.

    Samples of a BSDF are such queries. Samples of lights have other normals, too, with D often 0.
    """
    uv, u = np.random.default_rng(7).random((2, 2, count), dtype=np.float32)
    footprint = ellipse.at(normal_map, uv)
    mesh = TexelMesh(normal_map, epsilon=epsilon)
    kernel = mesh.texel_kernel(footprint)
    m = mesh.normal_at(kernel.mean + kernel.sample(mi.Point2f(u)))
    dr.eval(m, footprint.uv)
    return m, footprint


def grid_of_normals(bounds, res: int, jitter: np.random.Generator | None = None) -> mi.Vector2f:
    """Normals at the centres of ``res``² cells of the rectangle ``bounds``, or jittered in them."""
    lower, upper = np.array(bounds)
    offset = 0.5 if jitter is None else jitter.random((2, res, res))
    row, column = (np.indices((res, res)) + offset) / res
    place = lower[:, None] + (upper - lower)[:, None] * np.stack([column, row]).reshape(2, -1)
    return mi.Vector2f(*(mi.Float(np.float32(x)) for x in place))


# --------------------------------------------------------------------------------------------------
#  Scenes
# --------------------------------------------------------------------------------------------------

SCENES = ROOT / "scenes"

#: The map of ``curved_patch.xml``, and its repetitions there.
PATCH_MAP, UV_SCALE = SCENES / "maps" / "isotropic.exr", 2

#: Radius and radiance of the lights of ``curved_patch.xml``.
LIGHT_RADIUS, LIGHT_RADIANCE = 0.025, 400


def curved_patch(
    material: dict,
    size: int = 400,
    spp: int = 16,
    light_radius: float = LIGHT_RADIUS,
    field_of_view: float = 45,
    integrator: str = "path",
) -> mi.Scene:
    """``scenes/curved_patch.xml`` with ``material``, the dictionary of a BSDF, on both sides.

    Lights keep their power with another radius.
    """
    dr.set_thread_count(max(2, dr.thread_count()))  # Mitsuba hangs with one
    collect_former_scenes()
    text = (SCENES / "curved_patch.xml").read_text()
    start = text.index('<bsdf type="glint_manifold">')
    end = text.index("</bsdf>", start) + len("</bsdf>")
    text = text[:start] + '<bsdf type="diffuse"/>' + text[end:]
    radiance = LIGHT_RADIANCE * (LIGHT_RADIUS / light_radius) ** 2
    for name, own, new in (
        ("radius", LIGHT_RADIUS, light_radius),
        ("radiance", LIGHT_RADIANCE, radiance),
        ("fov", 45, field_of_view),
    ):
        text = text.replace(f'name="{name}" value="{own}"', f'name="{name}" value="{new}"')
    if str(SCENES) not in [str(path) for path in mi.file_resolver()]:
        mi.file_resolver().append(str(SCENES))
    given = {"spp": spp, "resx": size, "resy": size, "integrator": integrator}
    scene = mi.load_string(text, **{name: str(value) for name, value in given.items()})
    # A scene in XML cannot take a dictionary: the material replaces the one of the loaded shape.
    patch = next(shape for shape in scene.shapes() if not shape.is_emitter())
    patch.set_bsdf(mi.load_dict({"type": "twosided", "nested": material}))
    return scene


def scaled(scale: float) -> mi.ScalarTransform4f:
    """The ``to_uv`` that repeats a map ``scale`` times along both axes."""
    return mi.ScalarTransform4f().scale([scale, scale, 1])


def spread_for(radius: float, texels: int, size: int) -> float:
    """The ``pixel_spread`` with which footprints on the curved patch have this radius, 3σ (texels).

    σ is half a pixel. The radius is the geometric mean of both axes, and its median over the patch.
    ``texels`` is the side of the map, ``size`` the side of the image.
    """
    scene = curved_patch({"type": "diffuse"}, size, 1)
    sensor = scene.sensors()[0]
    place = (np.mgrid[:size, :size].reshape(2, -1) + 0.5) / size
    ray, _ = sensor.sample_ray_differential(0, 0.5, mi.Point2f(np.float32(place)), 0.5)
    si = scene.ray_intersect(ray)
    si.compute_uv_partials(ray)
    area = np.abs(np.array(si.duv_dx.x * si.duv_dy.y - si.duv_dx.y * si.duv_dy.x))
    area = area[np.array(si.is_valid()) & (area > 0)]
    seen = 3 * 0.5 * texels * UV_SCALE * np.sqrt(np.median(area))
    return radius / seen * pixel_spread(sensor)


def picture_of(
    shape: dict, origin: list, up: list, fov: float, size: int, lights: dict, **options
) -> mi.Scene:
    """A scene of one shape for a square image; ``options`` are spp, max_depth and rfilter."""
    collect_former_scenes()
    film = {"type": "hdrfilm", "width": size, "height": size}
    film["rfilter"] = {"type": options.get("rfilter", "box")}
    sampler = {"type": "independent", "sample_count": options.get("spp", 16)}
    to_world = mi.ScalarTransform4f().look_at(origin, [0, 0, 0], up)
    return mi.load_dict({
        "type": "scene",
        "integrator": {"type": "path", "max_depth": options.get("max_depth", 2)},
        "sensor": {"type": "perspective", "fov": fov, "to_world": to_world, "film": film,
                   "sampler": sampler},
        **lights,
        "shape": shape,
    })  # fmt: skip


def plane(
    bsdf: dict, elevation: float, distance: float, fov: float, size: int, spp: int
) -> mi.Scene:
    """The plane z = 0, seen from ``elevation`` degrees above it, under a sky and a small lamp."""
    angle = radians(elevation)
    lights = {
        "sky": {"type": "envmap", "bitmap": mi.Bitmap(np.full((64, 128, 3), 0.5, np.float32))},
        "lamp": {"type": "sphere", "center": [1, 1, 3], "radius": 0.1,
                 "emitter": {"type": "area", "radiance": {"type": "rgb", "value": 50.0}}},
    }  # fmt: skip
    wide = mi.ScalarTransform4f().scale([500, 500, 1])
    return picture_of(
        {"type": "rectangle", "to_world": wide, "bsdf": bsdf},
        [0, -distance * cos(angle), distance * sin(angle)], [0, sin(angle), 1], fov, size, lights,
        spp=spp, max_depth=4, rfilter="gaussian",
    )  # fmt: skip
