"""Small scenes in files, which several tests share: a square with a map, and plates of a mesh."""

from __future__ import annotations

from pathlib import Path

import mitsuba as mi
import numpy as np

_SQUARE = """<scene version="3.0.0">
    <default name="plugin" value="{plugin}"/>
    <default name="integrator" value="path"/>
    <default name="depth" value="{depth}"/>
    <default name="size" value="16"/>
    <default name="spp" value="{spp}"/>
    <default name="sampler" value="independent"/>
    <default name="spread" value="0"/>
    <default name="scale" value="1"/>
    <integrator type="$integrator"><integer name="max_depth" value="$depth"/></integrator>
    <sensor type="perspective">
        <float name="fov" value="{fov}"/>
        <transform name="to_world"><lookat origin="{origin}" target="0,0,0" up="0,1,0"/></transform>
        <film type="hdrfilm">
            <integer name="width" value="$size"/>
            <integer name="height" value="$size"/>
            <rfilter type="{rfilter}"/>
        </film>
        <sampler type="$sampler"><integer name="sample_count" value="$spp"/></sampler>
    </sensor>
    <emitter type="constant"/>
    <shape type="rectangle">
        <bsdf type="twosided">
            <bsdf type="$plugin" id="metal">
                <string name="filename" value="map.exr"/>
                <float name="pixel_spread" value="$spread"/>
                <transform name="to_uv"><scale value="$scale"/></transform>
            </bsdf>
        </bsdf>
    </shape>
{more}</scene>
"""


def square(
    more: str = "",
    *,
    fov: float = 30,
    origin: str = "0,0,4",
    rfilter: str = "box",
    spp: int = 16,
    depth: int = 2,
    plugin: str = "glint_manifold",
) -> str:
    """A scene in XML: a square of 2 × 2 with the map ``map.exr``, from above, under a white sky.

    Its parameters are ``plugin``, ``integrator``, ``depth``, ``size`` (pixels along each axis),
    ``spp``, ``sampler``, ``spread`` and ``scale`` (of UVs).

    Args:
        more: further elements.
        fov: field of view, degrees.
        origin: where the camera is.
        rfilter: the film's filter.
        spp, depth, plugin: the values of these parameters by default.
    """
    return _SQUARE.format(
        more=more, fov=fov, origin=origin, rfilter=rfilter, spp=spp, depth=depth, plugin=plugin
    )


def ball(x: float, y: float, z: float, radius: float) -> str:
    """A diffuse ball, in XML."""
    return (
        f'<shape type="sphere"><point name="center" x="{x}" y="{y}" z="{z}"/>'
        f'<float name="radius" value="{radius}"/><bsdf type="diffuse"/></shape>\n'
    )


def write_heights(path: Path, size: int = 16) -> None:
    """A map of random heights."""
    heights = np.random.default_rng(1).random((size, size, 1), dtype=np.float32)
    mi.Bitmap(heights).write(str(path))


_PLATE = """v -1 -1 0
v 1 -1 0
v 1 1 0
v -1 1 0
vt {0} 0
vt {1} 0
vt {1} 1
vt {0} 1
vn 0 0 1
f 1/1/1 2/2/1 3/3/1
f 1/1/1 3/3/1 4/4/1
"""


def write_plates(folder: Path) -> None:
    """``plate.obj``, a square of 2 × 2, and ``mirrored.obj``, whose u runs the other way. Mitsuba
    turns v of OBJ files over, so that the UVs of the first are left-handed."""
    for name, ends in (("plate", (0, 1)), ("mirrored", (1, 0))):
        (folder / f"{name}.obj").write_text(_PLATE.format(*ends))
