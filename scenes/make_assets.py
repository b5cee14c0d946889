"""Make every mesh, environment and normal map of the scenes: ``python scenes/make_assets.py``.

The results are committed, so a fresh clone renders without this script. Everything is computed in
float64 from formulas and fixed seeds, but for a photograph that scikit-image brings along; nothing
is downloaded. Lengths are scene units, y is up.

UV coordinates measure lengths along the surface (the curved patch apart, whose UVs fill the unit
square), so that one ``uv_scale`` gives every part of a scene the same size of texel.
"""

from __future__ import annotations

import sys
from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

import numpy as np
import OpenEXR
import skimage.data
import skimage.io
from scipy.interpolate import CubicSpline
from scipy.ndimage import gaussian_filter
from scipy.spatial import cKDTree

from glintbsdf import maps

MAP_SIZE = 1024


# --------------------------------------------------------------------------------------------------
# Meshes
# --------------------------------------------------------------------------------------------------


class Mesh(NamedTuple):
    """A triangle mesh: positions, unit normals (N, 3), UVs (N, 2), triangles (M, 3) of indices."""

    positions: np.ndarray
    normals: np.ndarray
    uvs: np.ndarray
    triangles: np.ndarray


def write_ply(filename: Path, mesh: Mesh) -> None:
    """Write ``mesh`` as a binary little-endian PLY with the property names that Mitsuba reads."""
    properties = ("x", "y", "z", "nx", "ny", "nz", "u", "v")
    vertices = np.hstack([mesh.positions, mesh.normals, mesh.uvs]).astype("<f4")
    faces = np.empty(len(mesh.triangles), dtype=[("count", "u1"), ("indices", "<i4", 3)])
    faces["count"], faces["indices"] = 3, mesh.triangles
    header = ["ply", "format binary_little_endian 1.0", f"element vertex {len(vertices)}"]
    header += [f"property float {name}" for name in properties]
    header += [f"element face {len(faces)}", "property list uchar int vertex_indices", "end_header"]
    content = "\n".join(header).encode("ascii") + b"\n" + vertices.tobytes() + faces.tobytes()
    filename.write_bytes(content)


def parametric(
    position: Callable[[np.ndarray, np.ndarray], np.ndarray],
    s: np.ndarray,
    t: np.ndarray,
    uv: Callable[[np.ndarray, np.ndarray], np.ndarray],
) -> Mesh:
    """Tessellate ``position(s, t)`` on the grid of the parameter values ``s`` × ``t``.

    Normals are the normalised ∂p/∂s × ∂p/∂t by central differences of the formula itself, not of
    the mesh, so they are smooth at every tessellation. A pole (∂p/∂s = 0) must not be a grid value.
    """
    step = 1e-5
    s, t = np.meshgrid(s, t)
    dp_ds = position(s + step, t) - position(s - step, t)
    dp_dt = position(s, t + step) - position(s, t - step)
    normals = np.cross(dp_ds, dp_dt)
    normals /= np.linalg.norm(normals, axis=-1, keepdims=True)

    rows, columns = s.shape
    corner = (np.arange(rows - 1)[:, None] * columns + np.arange(columns - 1)).ravel()
    right, below, opposite = corner + 1, corner + columns, corner + columns + 1
    triangles = np.concatenate(
        [np.stack([corner, right, below], axis=1), np.stack([opposite, below, right], axis=1)]
    )
    flat = (a.reshape(-1, a.shape[-1]) for a in (position(s, t), normals, uv(s, t)))
    return Mesh(*flat, triangles)


def lathe(
    outline: CubicSpline, *, start: float, end: float, segments: int, rings: int, repeats: int = 0
) -> Mesh:
    """Turn ``outline``, which maps arc length to (radius, height), about the y axis.

    Where ``repeats`` is positive, u runs from 0 to ``repeats`` around the axis and v along the
    outline. Where it is 0 the UVs are polar about the axis (arc length and angle), which has no
    pole: right for lids and bottoms.
    """

    def position(s: np.ndarray, t: np.ndarray) -> np.ndarray:
        radius, height = np.moveaxis(outline(t), -1, 0)
        return np.stack([radius * np.cos(s), height, -radius * np.sin(s)], axis=-1)

    def uv(s: np.ndarray, t: np.ndarray) -> np.ndarray:
        if repeats:
            return np.stack([s * repeats / (2 * np.pi), t], axis=-1)
        return np.stack([t * np.cos(s), -t * np.sin(s)], axis=-1)

    angle = np.linspace(0, 2 * np.pi, segments + 1)
    return parametric(position, angle, np.linspace(start, end, rings + 1), uv)


def tube(path: CubicSpline, radius: Callable, *, length: float, segments: int, rings: int) -> Mesh:
    """Sweep a circle of ``radius(t)`` along ``path(t)``, a curve in the plane z = 0, by arc length.

    The curve stays in its plane, so its normal in the plane and the z axis frame it without twist.
    """

    def position(s: np.ndarray, t: np.ndarray) -> np.ndarray:
        tangent = path(t, 1)
        tangent /= np.linalg.norm(tangent, axis=-1, keepdims=True)
        across = np.stack([-tangent[..., 1], tangent[..., 0], np.zeros_like(t)], axis=-1)
        beside = np.cross(tangent, across)
        r = radius(t)[..., None]
        return path(t) + r * (np.cos(s)[..., None] * across + np.sin(s)[..., None] * beside)

    mean_girth = 2 * np.pi * float(np.mean(radius(np.linspace(0, length, 64))))

    def uv(s: np.ndarray, t: np.ndarray) -> np.ndarray:
        return np.stack([s / (2 * np.pi) * mean_girth, t], axis=-1)

    angle = np.linspace(0, 2 * np.pi, segments + 1)
    return parametric(position, angle, np.linspace(0, length, rings + 1), uv)


def spline(points: list[tuple[float, ...]]) -> tuple[CubicSpline, float]:
    """A smooth curve through ``points`` parametrised by arc length, and that length.

    The first spline runs by chord length; resampling it at equal arc lengths gives the second.
    """
    points = np.asarray(points, dtype=np.float64)
    chord = np.concatenate([[0], np.cumsum(np.linalg.norm(np.diff(points, axis=0), axis=1))])
    rough = CubicSpline(chord, points)
    t = np.linspace(0, chord[-1], 4001)
    samples = rough(t)
    arc = np.concatenate([[0], np.cumsum(np.linalg.norm(np.diff(samples, axis=0), axis=1))])
    knots = np.linspace(0, arc[-1], 65)
    return CubicSpline(knots, rough(np.interp(knots, arc, t))), float(arc[-1])


def curved_patch() -> Mesh:
    """A sail-like square dome, 1.26 wide and 0.45 high, above the origin; UVs [0, 1]²."""

    def position(s: np.ndarray, t: np.ndarray) -> np.ndarray:
        x, z = 1.26 * s - 0.63, 1.26 * t - 0.63
        y = 0.62 * np.cos(1.6 * x) * np.cos(1.6 * z) + 0.12 * x * z
        return np.stack([x, y, z], axis=-1)

    grid = np.linspace(0, 1, 49)
    # t runs along +z and s along +x: swap them, so that the normals point up.
    return parametric(lambda s, t: position(t, s), grid, grid, lambda s, t: np.stack([t, s], -1))


KETTLE_AXIS_EPSILON = 1e-3  # radius of the hole at a pole, much smaller than a pixel


def kettle_body() -> Mesh:
    """The kettle's belly from the table (y = 0) to the rim of its lid (radius 0.46)."""
    outline, length = spline(
        [
            (0.78, 0.0),
            (0.90, 0.03),
            (0.985, 0.15),
            (1.0, 0.33),
            (0.95, 0.55),
            (0.83, 0.78),
            (0.65, 0.97),
            (0.52, 1.06),
            (0.47, 1.085),
            (0.46, 1.06),
        ]
    )
    # The outline runs upwards and the angle about +y: the normals point outwards.
    return lathe(outline, start=0.0, end=length, segments=96, rings=64, repeats=6)


def kettle_lid() -> Mesh:
    """A shallow dome that rests in the rim."""
    outline, length = spline(
        [
            (KETTLE_AXIS_EPSILON, 1.20),
            (0.12, 1.195),
            (0.25, 1.17),
            (0.36, 1.13),
            (0.425, 1.095),
            (0.45, 1.065),
        ]
    )
    return flipped(lathe(outline, start=0.0, end=length, segments=72, rings=24))


def kettle_knob() -> Mesh:
    """The lid's knob, black."""
    outline, length = spline(
        [
            (KETTLE_AXIS_EPSILON, 1.42),
            (0.06, 1.415),
            (0.115, 1.375),
            (0.12, 1.33),
            (0.075, 1.28),
            (0.05, 1.24),
            (0.06, 1.19),
        ]
    )
    return flipped(lathe(outline, start=0.0, end=length, segments=48, rings=24))


def kettle_spout() -> Mesh:
    """A tapering spout towards +x."""
    path, length = spline(
        [(0.74, 0.34, 0), (1.02, 0.45, 0), (1.22, 0.68, 0), (1.36, 0.95, 0), (1.54, 1.12, 0)]
    )
    return tube(
        path, lambda t: 0.085 + 0.135 * (1 - t / length) ** 2, length=length, segments=48, rings=40
    )


def kettle_handle() -> Mesh:
    """The handle, an arch over the lid in the plane z = 0, black."""
    path, length = spline(
        [
            (0.73, 0.90, 0),
            (0.83, 1.20, 0),
            (0.70, 1.56, 0),
            (0.36, 1.78, 0),
            (0, 1.84, 0),
            (-0.36, 1.78, 0),
            (-0.70, 1.56, 0),
            (-0.83, 1.20, 0),
            (-0.73, 0.90, 0),
        ]
    )
    return tube(
        path,
        lambda t: 0.04 + 0.03 * np.exp(-(((t / length - 0.5) / 0.22) ** 4)),
        length=length,
        segments=32,
        rings=72,
    )


def cove() -> Mesh:
    """A photographer's sweep: the floor y = 0 that bends up, in a quarter circle, into a wall."""
    floor, bend, wall = 9.0, 2.5, 3.0
    arc = bend * np.pi / 2

    def position(s: np.ndarray, t: np.ndarray) -> np.ndarray:
        angle = np.clip((t - floor) / bend, 0, np.pi / 2)
        z = 7.0 - np.minimum(t, floor) - bend * np.sin(angle)
        y = bend * (1 - np.cos(angle)) + np.maximum(t - floor - arc, 0)
        return np.stack([s, y, z], axis=-1)

    return parametric(
        position,
        np.array([-9.0, 9.0]),
        np.linspace(0, floor + arc + wall, 65),
        lambda s, t: np.stack([s, t], axis=-1),
    )


def plate() -> Mesh:
    """A square plate, side 2 about the origin, with one stamped boss inside a stamped ring."""

    def position(s: np.ndarray, t: np.ndarray) -> np.ndarray:
        r = np.hypot(s, t)
        boss = 0.09 * np.exp(-((r / 0.24) ** 4))
        ring = -0.03 * np.exp(-(((r - 0.42) / 0.05) ** 2))
        return np.stack([s, boss + ring, -t], axis=-1)

    grid = np.linspace(-1, 1, 97)
    return parametric(position, grid, grid, lambda s, t: np.stack([s, t], axis=-1) / 2 + 0.5)


def dress() -> Mesh:
    """A bell of cloth, 2 high, whose folds deepen from the waist (radius 0.22) to the hem."""
    outline, length = spline(
        [(0.30, 2.0), (0.24, 1.78), (0.22, 1.6), (0.34, 1.3), (0.52, 0.8), (0.74, 0.3), (0.95, 0.0)]
    )

    def position(s: np.ndarray, t: np.ndarray) -> np.ndarray:
        radius, height = np.moveaxis(outline(t), -1, 0)
        depth = 0.13 * np.clip((t / length - 0.3) / 0.7, 0, 1) ** 2
        radius = radius * (1 + depth * np.cos(9 * s + 0.8 * np.sin(2 * s)))
        return np.stack([radius * np.cos(s), height, -radius * np.sin(s)], axis=-1)

    mesh = parametric(
        position,
        np.linspace(0, 2 * np.pi, 145),
        np.linspace(0, length, 33),
        lambda s, t: np.stack([4 * s / (2 * np.pi), t], axis=-1),
    )
    return flipped(mesh)  # the outline runs downwards


def terrain() -> Mesh:
    """Rolling ground, 8 by 8, within 0.7 of y = 0: waves of falling length, seeded directions."""
    rng = np.random.default_rng(5)
    frequencies = 0.9 * 1.5 ** np.arange(7)
    angles, phases = rng.uniform(0, 2 * np.pi, (2, len(frequencies)))

    def position(s: np.ndarray, t: np.ndarray) -> np.ndarray:
        height = np.zeros_like(s)
        for frequency, angle, phase in zip(frequencies, angles, phases, strict=True):
            wave = np.sin(frequency * (np.cos(angle) * s + np.sin(angle) * t) + phase)
            height = height + 0.3 * wave / frequency**1.7
        return np.stack([s, height, -t], axis=-1)

    grid = np.linspace(-4, 4, 81)
    return parametric(position, grid, grid, lambda s, t: np.stack([s, t], axis=-1))


def disc() -> Mesh:
    """A flat ring of radii 0.06 and 0.9 in the plane y = 0; u is the arc at radius 0.5, v the
    radius, so that grooves along u are circles."""

    def position(s: np.ndarray, t: np.ndarray) -> np.ndarray:
        return np.stack([t * np.cos(s), np.zeros_like(s), -t * np.sin(s)], axis=-1)

    mesh = parametric(
        position,
        np.linspace(0, 2 * np.pi, 129),
        np.linspace(0.06, 0.9, 9),
        lambda s, t: np.stack([0.5 * s, t], axis=-1),
    )
    return flipped(mesh)


def car_door() -> Mesh:
    """A car's door in the plane z = 0, 4 wide and 2 high: bulged, with a crease, a hollow below it
    and a shut line. UVs are x and y."""
    shut_line = -1.25

    def position(s: np.ndarray, t: np.ndarray) -> np.ndarray:
        bulge = 0.45 * np.cos(0.75 * (t - 0.7)) - 0.035 * s**2
        crease = -0.32 * np.hypot(t - 1.2 - 0.05 * s, 0.02)
        hollow = -0.09 * np.exp(-(((t - 0.3 - 0.03 * s) / 0.22) ** 2))
        gap = -0.05 * np.exp(-(((s - shut_line - 0.04 * np.sin(1.5 * t)) / 0.014) ** 4))
        return np.stack([s, t, bulge + crease + hollow + gap], axis=-1)

    around_gap = shut_line + np.linspace(-0.08, 0.08, 33)
    s = np.unique(np.concatenate([np.linspace(-2, 2, 41), around_gap]))
    t = np.unique(np.concatenate([np.linspace(0, 2, 41), np.linspace(1.0, 1.4, 33)]))
    return parametric(position, s, t, lambda s, t: np.stack([s, t], axis=-1))


def car_handle() -> Mesh:
    """The door's handle, an arch over the plane y = 0, along x; 0.5 wide."""
    path, length = spline(
        [(-0.25, -0.02, 0), (-0.235, 0.05, 0), (-0.12, 0.085, 0), (0.12, 0.085, 0),
         (0.235, 0.05, 0), (0.25, -0.02, 0)]
    )  # fmt: skip
    return tube(path, lambda t: 0.032 + 0 * t, length=length, segments=32, rings=48)


def nail() -> Mesh:
    """A finger nail on the plane y = 0, 0.7 wide and 1.3 long towards -z: arched, with a round tip.
    UVs are x and -z."""

    def position(s: np.ndarray, t: np.ndarray) -> np.ndarray:
        width = np.sqrt(1 - np.clip((t - 0.7) / 0.6, 0, 1) ** 2.5)
        x = 0.35 * width * np.sin(1.2 * s) / np.sin(1.2)
        arch = 0.2 * width * (np.cos(1.2 * s) - np.cos(1.2))
        return np.stack([x, arch + 0.1 * np.cos(1.1 * (t - 0.4)), -t], axis=-1)

    def uv(s: np.ndarray, t: np.ndarray) -> np.ndarray:
        return position(s, t)[..., [0, 2]] * [1, -1]

    # The tip is a pole, from which the grid keeps away.
    rows = 1.2999 - 1.2999 * np.linspace(1, 0, 49) ** 2
    return parametric(position, np.linspace(-1, 1, 33), rows, uv)


def cushion(width: float, height: float, depth: float, rounding: float, swelling: float) -> Mesh:
    """An upholstered block about the origin, its edges rounded and its faces swollen.

    Each of its six faces is a patch of the cube, from which the surface stands off along the
    direction to an inner box; UVs are lengths on the patch.
    """
    half = np.array([width, height, depth]) / 2
    inner = half - rounding

    def face(axis: int, sign: int) -> Mesh:
        i, j = (axis + 1) % 3, (axis + 2) % 3

        def position(s: np.ndarray, t: np.ndarray) -> np.ndarray:
            p = np.empty((*s.shape, 3))
            p[..., axis], p[..., i], p[..., j] = sign * half[axis], sign * s, t
            away = p - np.clip(p, -inner, inner)
            away /= np.linalg.norm(away, axis=-1, keepdims=True)
            swell = swelling * np.cos(s / half[i] * np.pi / 2) * np.cos(t / half[j] * np.pi / 2)
            return np.clip(p, -inner, inner) + (rounding + swell[..., None]) * away

        grids = (np.linspace(-half[k], half[k], 25) for k in (i, j))
        return parametric(position, *grids, lambda s, t: np.stack([s, t], axis=-1))

    return joined([face(axis, sign) for axis in range(3) for sign in (1, -1)])


def joined(meshes: list[Mesh]) -> Mesh:
    """All of them as one mesh."""
    offsets = np.cumsum([0] + [len(mesh.positions) for mesh in meshes[:-1]])
    triangles = [mesh.triangles + k for mesh, k in zip(meshes, offsets, strict=True)]
    vertices = (np.concatenate(arrays) for arrays in list(zip(*meshes, strict=True))[:3])
    return Mesh(*vertices, np.concatenate(triangles))


def flipped(mesh: Mesh) -> Mesh:
    """The same surface seen from its other side."""
    return mesh._replace(normals=-mesh.normals, triangles=mesh.triangles[:, ::-1])


MESHES = {
    "curved_patch.ply": curved_patch,
    "kettle_body.ply": kettle_body,
    "kettle_lid.ply": kettle_lid,
    "kettle_knob.ply": kettle_knob,
    "kettle_spout.ply": kettle_spout,
    "kettle_handle.ply": kettle_handle,
    "cove.ply": cove,
    "plate.ply": plate,
    "dress.ply": dress,
    "terrain.ply": terrain,
    "disc.ply": disc,
    "car_door.ply": car_door,
    "car_handle.ply": car_handle,
    "nail.ply": nail,
    "sofa_seat.ply": lambda: cushion(1.6, 0.5, 1.6, 0.16, 0.10),
    "sofa_back.ply": lambda: cushion(1.6, 1.2, 0.5, 0.16, 0.12),
    "sofa_arm.ply": lambda: cushion(0.45, 1.1, 1.9, 0.2, 0.03),
    "sofa_base.ply": lambda: cushion(3.2, 0.4, 1.8, 0.06, 0.0),
}


# --------------------------------------------------------------------------------------------------
# Images
# --------------------------------------------------------------------------------------------------


def studio(height: int = 128) -> np.ndarray:
    """A dim studio with softboxes: (height, 2·height, 3) radiance, laid out as for ``envmap``.

    Each softbox is a rectangle in the plane that faces it, with soft edges.
    """
    angle = np.pi * (np.arange(2 * height) + 0.5) / height
    azimuth, polar = np.meshgrid(angle, angle[:height])
    direction = np.stack(
        [np.sin(azimuth) * np.sin(polar), np.cos(polar), -np.cos(azimuth) * np.sin(polar)], axis=-1
    )

    # Walls: darkest towards the floor, a little cooler above.
    up = 0.5 + 0.5 * direction[..., 1:2]
    radiance = 0.015 + up**2 * np.array([0.035, 0.04, 0.05])

    # Azimuth and elevation in degrees; half width, half height, soft edge as tangents; radiance.
    softboxes = [
        (80, 65, 0.42, 0.28, 0.12, (1.20, 1.12, 1.00)),
        (-60, 28, 0.18, 0.80, 0.10, (0.60, 0.80, 1.10)),
        (175, 30, 0.50, 0.20, 0.10, (0.90, 0.62, 0.40)),
        (262, 14, 1.10, 0.08, 0.08, (0.25, 0.33, 0.45)),
    ]
    for degrees, elevation, width, tall, edge, colour in softboxes:
        a, e = np.radians(degrees), np.radians(elevation)
        facing = np.array([np.sin(a) * np.cos(e), np.sin(e), -np.cos(a) * np.cos(e)])
        right = np.array([np.cos(a), 0.0, np.sin(a)])
        depth = direction @ facing
        x = direction @ right / np.maximum(depth, 1e-3)
        y = direction @ np.cross(facing, right) / np.maximum(depth, 1e-3)
        shape = smooth_step((width - np.abs(x)) / edge) * smooth_step((tall - np.abs(y)) / edge)
        radiance += (shape * (depth > 0))[..., None] * np.array(colour)
    return radiance


def window(size: int = 256) -> np.ndarray:
    """The light that comes through a window of coloured glass: (size, size, 3) radiance.

    A rose of two rings of panes around a bright centre, in a lead frame, with a few lamps behind
    it that are six hundred times as bright as the glass.
    """
    y, x = (np.mgrid[:size, :size] + 0.5) / size * 2 - 1
    radius, angle = np.hypot(x, y), np.arctan2(y, x) / (2 * np.pi)
    radiance = np.zeros((size, size, 3))
    for inner, outer, panes, saturation in ((0.0, 0.2, 1, 0.15), (0.24, 0.56, 8, 0.8),
                                            (0.6, 0.94, 16, 0.9)):  # fmt: skip
        place = angle * panes
        hue = np.floor(place) / panes * 3 + 0.15
        colour = 1 - 2 * saturation * np.abs(
            np.mod(hue[..., None] - np.array([0, 1, 2]) / 3, 1) - 0.5
        )
        distance = (np.abs(place - np.round(place))) * 2 * np.pi * radius / panes
        lead = (distance > 0.025) | (panes == 1)
        radiance += (((radius > inner) & (radius < outer) & lead)[..., None]) * colour
    for lamp_x, lamp_y in ((0.0, 0.0), (0.4, 0.1), (-0.28, 0.3), (-0.1, -0.42), (0.55, -0.55)):
        radiance[np.hypot(x - lamp_x, y - lamp_y) < 0.013] = 600.0
    return radiance


def grain(shape: tuple[int, int], widths: tuple[float, float], seed: int) -> np.ndarray:
    """Periodic smooth noise of unit variance; ``widths`` in texels along rows and columns."""
    noise = np.random.default_rng(seed).standard_normal(shape)
    noise = gaussian_filter(noise, widths, mode="wrap")
    return noise / noise.std()


PLANKS, PLANKS_SIZE = 6, 768  # planks across the square of texels


def planks() -> tuple[np.ndarray, np.ndarray]:
    """Which plank each texel lies on, (size, size) int, and its distance to the next joint."""
    y, x = np.mgrid[:PLANKS_SIZE, :PLANKS_SIZE] + 0.5
    width = PLANKS_SIZE / PLANKS
    row = np.floor(y / width).astype(int)
    start = np.array([0.1, 0.55, 0.3, 0.8, 0.2, 0.65])[row] * PLANKS_SIZE
    along, across = np.mod(x - start, PLANKS_SIZE), np.mod(y, width)
    return row, np.minimum(np.minimum(across, width - across),
                           np.minimum(along, PLANKS_SIZE - along))  # fmt: skip


def wood_colour() -> np.ndarray:
    """A floor of oak planks, (size, size, 3) sRGB in [0, 1]."""
    row, joint = planks()
    size = (PLANKS_SIZE, PLANKS_SIZE)
    tone = np.array([0.05, -0.4, 0.3, -0.1, 0.5, -0.25])[row]
    rings = np.sin(9 * grain(size, (14, 160), seed=11) + 7 * row)
    tone = tone + 0.35 * rings + 0.25 * grain(size, (0.8, 30), seed=12)
    colour = np.array([0.50, 0.34, 0.21]) * np.exp(0.28 * tone)[..., None] ** [1, 1.1, 1.25]
    return np.clip(colour * (0.35 + 0.65 * np.clip(joint / 2.5, 0, 1))[..., None], 0, 1)


def wood_height() -> np.ndarray:
    """The same floor's relief, (size, size), in texels: worn edges, and pores along the grain."""
    _, joint = planks()
    edge = -2.0 * np.exp(-((joint / 3.0) ** 2))
    return edge + 0.12 * grain((PLANKS_SIZE, PLANKS_SIZE), (1.5, 40), seed=12)


def leather_height(size: int = 512, cells: int = 36) -> np.ndarray:
    """Leather's relief, (size, size), in texels: grains parted by creases, periodic."""
    rng = np.random.default_rng(21)
    corner = np.stack(np.mgrid[:cells, :cells], axis=-1).reshape(-1, 2)
    centres = (corner + rng.uniform(0.1, 0.9, corner.shape)) / cells
    texel = (np.stack(np.mgrid[:size, :size], axis=-1).reshape(-1, 2) + 0.5) / size
    nearest, second = cKDTree(centres, boxsize=1.0).query(texel, k=2)[0].T * size
    crease = np.clip((second - nearest) / 7.0, 0, 1).reshape(size, size)
    height = 2.2 * crease * (2 - crease) + 0.8 * grain((size, size), (20, 20), seed=22)
    return gaussian_filter(height, 1.0, mode="wrap")


def smooth_step(x: np.ndarray) -> np.ndarray:
    """0 below −1, 1 above 1, a cubic between."""
    x = np.clip(0.5 + 0.5 * x, 0, 1)
    return x * x * (3 - 2 * x)


def write_exr(filename: Path, channels: dict[str, np.ndarray]) -> None:
    """Write half-float ``channels``; an (H, W, 3) array under "RGB" is three of them."""
    header = {"type": OpenEXR.scanlineimage, "compression": OpenEXR.ZIP_COMPRESSION}
    halves = {name: np.ascontiguousarray(pixels, np.float16) for name, pixels in channels.items()}
    OpenEXR.File(header, halves).write(str(filename))


# Grains of sand, sRGB: quartz, feldspar, iron-stained quartz, lime, garnet, magnetite
SAND = [
    (232, 219, 190),
    (214, 168, 128),
    (196, 134, 70),
    (240, 236, 222),
    (128, 52, 42),
    (48, 44, 44),
]


def write_palette(filename: Path, colors: list[tuple[int, int, int]]) -> None:
    """Write 8-bit sRGB ``colors`` as the pixels of one row of a PNG."""
    skimage.io.imsave(filename, np.uint8([colors]), check_contrast=False)


NORMAL_MAPS = {
    "isotropic.exr": lambda: maps.isotropic(MAP_SIZE, seed=1),
    "scratched.exr": lambda: maps.scratched(
        MAP_SIZE, coverage=0.8, length=400, width=5, slope=0.4, alpha=0.05, seed=2
    ),
    "polished.exr": lambda: maps.scratched(
        MAP_SIZE, coverage=0.15, length=400, width=5, slope=0.3, alpha=0.0, seed=5
    ),
    "brushed.exr": lambda: maps.brushed(
        MAP_SIZE, alpha=0.25, streak_length=60, streak_width=4, seed=3
    ),
    # Small samples, of which glint_mip makes large maps
    "leather_sample.exr": lambda: maps.leather(256, seed=4),
    "isotropic_sample.exr": lambda: maps.isotropic(256, seed=6),
}


# --------------------------------------------------------------------------------------------------


def main(folder: Path) -> None:
    """Write all assets below ``folder``."""
    (folder / "meshes").mkdir(parents=True, exist_ok=True)
    (folder / "maps").mkdir(exist_ok=True)
    for name, make in MESHES.items():
        write_ply(folder / "meshes" / name, make())
    (folder / "palettes").mkdir(exist_ok=True)
    write_palette(folder / "palettes" / "sand.png", SAND)
    write_exr(folder / "studio.exr", {"RGB": studio()})
    (folder / "textures").mkdir(exist_ok=True)
    write_exr(folder / "textures" / "window.exr", {"RGB": window()})
    write_exr(folder / "textures" / "leather.exr", {"Y": leather_height()})
    write_exr(folder / "textures" / "wood_height.exr", {"Y": wood_height()})
    skimage.io.imsave(folder / "textures" / "wood.png", np.uint8(np.round(255 * wood_colour())))
    # A photograph of gravel, in the public domain (CC0)
    skimage.io.imsave(folder / "textures" / "gravel.png", skimage.data.gravel())
    for name, make in NORMAL_MAPS.items():
        normals = make().normals
        write_exr(folder / "maps" / name, {"R": normals[..., 0], "G": normals[..., 1]})


if __name__ == "__main__":
    main(Path(sys.argv[1]) if len(sys.argv) > 1 else Path(__file__).parent)
