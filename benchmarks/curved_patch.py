"""The scene ``scenes/curved_patch.xml`` with any material, for benchmarks."""

from __future__ import annotations

from pathlib import Path

import drjit as dr
import mitsuba as mi

SCENES = Path(__file__).parent.parent / "scenes"
MAP = SCENES / "maps" / "isotropic.exr"

#: The scene's own scale of the map, and what the glint materials of benchmarks share.
UV_SCALE = 2


#: Radius and radiance of the scene's lights.
RADIUS, RADIANCE = 0.025, 400


def curved_patch(
    material: dict, size: int = 400, spp: int = 16, light_radius: float = RADIUS
) -> mi.Scene:
    """The scene with ``material``, the dictionary of a BSDF, on the patch; both sides reflect.

    Lights of another radius keep their power.
    """
    dr.set_thread_count(max(2, dr.thread_count()))  # Mitsuba reads no image with a single one
    text = (SCENES / "curved_patch.xml").read_text()
    start = text.index('<bsdf type="glint_manifold">')
    end = text.index("</bsdf>", start) + len("</bsdf>")
    text = text[:start] + '<bsdf type="diffuse"/>' + text[end:]
    text = text.replace(f'name="radius" value="{RADIUS}"', f'name="radius" value="{light_radius}"')
    radiance = RADIANCE * (RADIUS / light_radius) ** 2
    text = text.replace(
        f'name="radiance" value="{RADIANCE}"', f'name="radiance" value="{radiance}"'
    )
    if str(SCENES) not in [str(path) for path in mi.file_resolver()]:
        mi.file_resolver().append(str(SCENES))
    scene = mi.load_string(text, spp=str(spp), resx=str(size), resy=str(size))
    # A scene in XML cannot take a dictionary: the material replaces the one of the loaded shape.
    patch = next(shape for shape in scene.shapes() if not shape.is_emitter())
    patch.set_bsdf(mi.load_dict({"type": "twosided", "nested": material}))
    return scene
