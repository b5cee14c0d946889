"""Whole renders of the curved patch: glint_manifold against roughconductor.

``python benchmarks/whole_render.py [--pixels 0.0625 1 4] [--map FILE] [-o RESULT.json]``

400², 16 spp, stock ``path``. A footprint of f pixels is a ``pixel_spread`` of f times a pixel's
angle. Both materials render in turn in every repetition, after a first frame that compiles; the
figures are the median time and the median of the ratio within the same repetition. First frames
start without Dr.Jit's kernel cache on disk; building and loading are timed apart. Expected before
measuring: 1.5 × at 1/16 pixel, 4 × at 1 pixel, 15 × at 4 pixels. Measured, on a machine with other
work: 1.1 to 1.2 ×, 2.5 to 2.6 × (2.8 to 2.9 × with ``-D masking=ggx_fit``) and 8.6 ×.
"""

from __future__ import annotations

import argparse
import os
import tempfile
import time
from functools import partial
from pathlib import Path

os.environ["GLINTBSDF_CACHE"] = "off"  # building is timed
_kernels = tempfile.TemporaryDirectory()
os.environ["DRJIT_CACHE_DIR"] = _kernels.name  # and so is compiling

import mitsuba as mi  # noqa: E402  (the environment comes first)
import numpy as np  # noqa: E402

import glintbsdf  # noqa: E402, F401  (registers the plugins)

mi.set_variant("llvm_ad_rgb")

from _common import ratios_to_first, save_results, seconds, seconds_in_turn  # noqa: E402

from glintbsdf.scene.rendering import load_scene, pixel_angle  # noqa: E402

SCENE = Path(__file__).parent.parent / "scenes" / "curved_patch.xml"


def frame(scene: mi.Scene, spp: int, seed: int) -> mi.TensorXf:
    return mi.render(scene, spp=spp, seed=seed)


def smooth(size: int, spp: int) -> mi.Scene:
    """The scene with a ``roughconductor`` as rough as the map."""
    text = SCENE.read_text()
    start, end = text.index('<bsdf type="glint_manifold">'), text.index("</bsdf>")
    text = (
        text[:start] + '<bsdf type="roughconductor"><string name="material" value="Cr"/>'
        '<float name="alpha" value="0.15"/>' + text[end:]
    )
    mi.file_resolver().append(str(SCENE.parent))
    used = {"spp": str(spp), "resx": str(size), "resy": str(size)}
    return mi.load_string(text, **used)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--pixels", type=float, nargs="+", default=[0.0625, 1, 4])
    parser.add_argument("--map", help="map of the patch; default: the scene's own")
    parser.add_argument("--size", type=int, default=400)
    parser.add_argument("--spp", type=int, default=16)
    parser.add_argument("--repetitions", type=int, default=5)
    parser.add_argument("-o", "--output", type=Path, help="JSON file to write")
    parser.add_argument(
        "-D",
        dest="define",
        metavar="KEY=VALUE",
        action="append",
        default=[],
        help="parameter of the scene, as for glintbsdf render",
    )
    options = parser.parse_args()

    defines = dict(item.split("=", 1) for item in options.define)
    defines |= {"spp": str(options.spp), "resx": str(options.size), "resy": str(options.size)}
    if options.map:
        defines["map"] = options.map
    rough = smooth(options.size, options.spp)
    first = {"roughconductor": seconds(frame, rough, options.spp, 0)}
    print(f"roughconductor: first frame {first['roughconductor']:.2f} s")

    results = []
    for pixels in options.pixels:
        angle = pixel_angle(rough.sensors()[0])
        start = time.perf_counter()
        scene = load_scene(SCENE, {**defines, "pixel_spread": str(pixels * angle)})
        loading = time.perf_counter() - start
        first_frame = seconds(frame, scene, options.spp, 0)
        frames = [partial(frame, s, options.spp) for s in (rough, scene)]
        times = seconds_in_turn(frames, options.repetitions)
        ratio = float(ratios_to_first(times)[1])
        medians = np.median(times, axis=0)
        print(
            f"footprint {pixels:7.4f} pixels: {ratio:5.2f} × roughconductor "
            f"({medians[1]:.2f} s, {medians[0]:.2f} s); loading and building {loading:.2f} s, "
            f"first frame {first_frame:.2f} s",
            flush=True,
        )
        results.append(
            {
                "pixels": pixels,
                "ratio": ratio,
                "seconds": medians[1],
                "seconds_roughconductor": medians[0],
                "seconds_loading": loading,
                "seconds_first_frame": first_frame,
            }
        )
    if options.output:
        save_results(options.output, {"size": options.size, "spp": options.spp, "results": results})


if __name__ == "__main__":
    main()
