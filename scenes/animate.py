"""Ten frames of a scene while its camera circles, on one contact sheet: do the glints hold still?

``python scenes/animate.py scenes/dress.xml -o dress_sheet.png``

The camera turns about the scene's vertical axis by ``--degrees`` in all; the sheet shows the frames
in rows of five. Frames share their random numbers, so that what changes is the glints and the view.
"""

from __future__ import annotations

import argparse
from pathlib import Path

import mitsuba as mi
import numpy as np

import glintbsdf  # noqa: F401  (makes the plugins known)
from glintbsdf.core.progress import progress
from glintbsdf.scene import rendering

COLUMNS = 5


def frames(scene: mi.Scene, count: int, degrees: float, spp: int | None):
    """Render ``count`` frames and yield each as an array of 8-bit sRGB pixels."""
    parameters = mi.traverse(scene.sensors()[0])
    start = mi.ScalarTransform4f(np.array(parameters["to_world"].matrix).reshape(4, 4))
    for index in range(count):
        angle = degrees * (index / max(count - 1, 1) - 0.5)
        parameters["to_world"] = mi.ScalarTransform4f().rotate([0, 1, 0], angle) @ start
        parameters.update()
        bitmap = rendering.render(scene, spp)
        yield np.array(bitmap.convert(mi.Bitmap.PixelFormat.RGB, mi.Struct.Type.UInt8, True))


def contact_sheet(images: list[np.ndarray]) -> np.ndarray:
    """The images in rows of ``COLUMNS``; what the last row lacks is black."""
    missing = -len(images) % COLUMNS
    images = images + [np.zeros_like(images[0])] * missing
    return np.vstack([np.hstack(images[k : k + COLUMNS]) for k in range(0, len(images), COLUMNS)])


def main(arguments: list[str] | None = None) -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("scene", type=Path)
    parser.add_argument("-o", "--output", type=Path, help="PNG to write (default: SCENE_sheet.png)")
    parser.add_argument("-m", "--variant", default="llvm_ad_rgb")
    parser.add_argument("--frames", type=int, default=10)
    parser.add_argument("--degrees", type=float, default=2.0)
    parser.add_argument("--spp", type=int, help="samples per pixel (default: the scene's)")
    parser.add_argument("-D", "--define", action="append", default=[], metavar="KEY=VALUE",
                        help="parameter of the scene; may be repeated")  # fmt: skip
    options = parser.parse_args(arguments)
    if options.frames < 1 or (options.spp is not None and options.spp < 1):
        parser.error("--frames and --spp must be at least 1")
    if not all("=" in definition for definition in options.define):
        parser.error("-D must be KEY=VALUE")
    if not options.scene.is_file():
        parser.error(f'there is no file "{options.scene}"')

    mi.set_variant(options.variant)
    scene = rendering.load_scene(options.scene, dict(d.split("=", 1) for d in options.define))
    output = options.output or Path(f"{options.scene.stem}_sheet.png")
    images = []
    with rendering.replacing(output) as unfinished, progress("Rendering") as report:
        for image in frames(scene, options.frames, options.degrees, options.spp):
            images.append(image)
            report(len(images) / options.frames)
        mi.Bitmap(contact_sheet(images)).write(str(unfinished))
    print(output)


if __name__ == "__main__":
    main()
