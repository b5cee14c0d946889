"""Direct light, indirect light, indirect light denoised, and all together, on one sheet.

``python scenes/separated.py scenes/interreflection.xml -o separated.png``

For scenes whose integrator is ``glint_path`` with ``separate`` light. The last picture is that of
``glintbsdf render --denoise``; direct light is the same in all, bit for bit.
"""

from __future__ import annotations

import argparse
from pathlib import Path

import mitsuba as mi
import numpy as np

import glintbsdf  # noqa: F401  (makes the plugins known)
from glintbsdf.core.progress import progress
from glintbsdf.scene import rendering


def pictures(scene: mi.Scene, spp: int | None) -> list[np.ndarray]:
    """The four pictures, (H, W, 3), linear."""
    with progress("Rendering") as report:
        layers = rendering.render(scene, spp, report=lambda done: report(done / 2))
        whole = rendering.render(
            scene, spp, report=lambda done: report(0.5 + done / 2), denoise=True
        )
    layers = {name: np.array(layer) for name, layer in layers.split()}
    direct, whole = layers["direct"], np.array(whole)[..., :3]
    return [direct, layers["indirect"], whole - direct, whole]


def sheet(images: list[np.ndarray]) -> mi.Bitmap:
    """Two rows of two pictures, 8-bit sRGB."""
    linear = np.vstack([np.hstack(images[:2]), np.hstack(images[2:])]).astype(np.float32)
    return mi.Bitmap(linear).convert(mi.Bitmap.PixelFormat.RGB, mi.Struct.Type.UInt8, True)


def main(arguments: list[str] | None = None) -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("scene", type=Path)
    parser.add_argument("-o", "--output", type=Path, default="separated.png", help="PNG to write")
    parser.add_argument("-m", "--variant", default="llvm_ad_rgb")
    parser.add_argument("--spp", type=int, help="samples per pixel (default: the scene's)")
    parser.add_argument("-D", "--define", action="append", default=[], metavar="KEY=VALUE",
                        help="parameter of the scene; may be repeated")  # fmt: skip
    options = parser.parse_args(arguments)
    if options.spp is not None and options.spp < 1:
        parser.error("--spp must be at least 1")
    if not all("=" in definition for definition in options.define):
        parser.error("-D must be KEY=VALUE")
    if not options.scene.is_file():
        parser.error(f'there is no file "{options.scene}"')

    mi.set_variant(options.variant)
    scene = rendering.load_scene(options.scene, dict(d.split("=", 1) for d in options.define))
    if not getattr(scene.integrator(), "separate", False):
        parser.error('the scene\'s integrator must be "glint_path" with "separate" on')
    with rendering.replacing(options.output) as unfinished:
        sheet(pictures(scene, options.spp)).write(str(unfinished))
    print(options.output)


if __name__ == "__main__":
    main()
