"""What separated illumination costs and saves, and what denoising its indirect part saves.

``python benchmarks/separation.py [--size 160] [--spp 16] [--reference 32] [-o RESULT.json]``

interreflection.xml, where glints meet glints, with a coarse and a fine map: behind a rough bounce
footprints are wide, and hold the more texels the finer the map. Their cost is bounded by
``max_error`` 0.1; exact, the coarse map takes hundreds of times as long with ``separate`` off.

``glint_path`` renders each with ``separate`` off and on, in turn; the figures are the median time
and the median of the ratio within the same repetition, after a first frame that compiles. Errors
are mean absolute differences of an image from the mean of ``--reference`` images of the same kind,
relative to the mean of those: how far each is from what it converges to. What it converges to with
``separate`` on differs from that with ``separate`` off as far as smooth lobes differ from glints in
indirect light; that is printed too, with the part of it that noise makes up.

Expected before measuring: separate costs 1.3 times where glints are cheap (two evaluations at the
first bounce, one ray more), and less than off where wide footprints are dear; its indirect light
has half of the error; denoising leaves a quarter of that. Measured, ``--size 90 --reference 24``:
0.46 and 0.76 times the time; no less error, for it is that of light which diffuse walls gather from
the balls. Denoising halves the error of indirect light, as measured: few paths that are very bright
make most of the noise, 1 % of the pixels 59 % of it, and the limit has more of that than is left in
a denoised image. Nor is it for the guides: with none of them, with both prefiltered and declared
clean, or without the flag for high dynamic range, the error is 1 to 3 % larger.
"""

from __future__ import annotations

import argparse
from pathlib import Path

import mitsuba as mi
import numpy as np
from _common import ratios_to_first, save_results, seconds, seconds_in_turn

import glintbsdf  # noqa: F401  (registers the plugins)

mi.set_variant("llvm_ad_rgb")

from glintbsdf.scene import denoising  # noqa: E402
from glintbsdf.scene.rendering import load_scene  # noqa: E402

SCENE = Path(__file__).parent.parent / "scenes" / "interreflection.xml"
SCENES = {
    "coarse map": {"uv_scale": "0.5", "max_error": "0.1"},
    "fine map": {"uv_scale": "4", "max_error": "0.1"},
}


def image(scene: mi.Scene, separate: bool, spp: int, seed: int) -> mi.TensorXf:
    """Red, green and blue, and with ``separate`` those of direct and indirect light."""
    integrator = scene.integrator()
    integrator.separate = separate
    return integrator.render(scene, scene.sensors()[0], seed=seed, spp=spp)


def guides(scene: mi.Scene, spp: int) -> tuple[np.ndarray, np.ndarray]:
    """Albedo and normals, as the command line renders them."""
    with denoising.guided(scene.integrator()) as integrator:
        integrator.render(scene, scene.sensors()[0], spp=spp)
    layers = {name: np.array(layer) for name, layer in scene.sensors()[0].film().bitmap().split()}
    return layers[denoising.ALBEDO], layers[denoising.NORMAL]


def error(images: np.ndarray, reference: np.ndarray, level: float) -> float:
    return float(np.abs(images - reference).mean() / level)


def measure(parameters: dict[str, str], spp: int, count: int) -> dict[str, float]:
    """All figures of one scene."""
    scene = load_scene(SCENE, {"spp": str(spp), **parameters})
    images = {False: [], True: []}

    def render(separate: bool):
        def work(seed: int) -> mi.TensorXf:
            images[separate].append(image(scene, separate, spp, seed))
            return images[separate][-1]

        return work

    works = render(False), render(True)
    first = [seconds(work, 0) for work in works]
    times = seconds_in_turn(works, count)
    off, on = (np.array([np.array(x) for x in images[s][1:]]) for s in (False, True))
    on = np.stack([on[..., -6:-3], on[..., -3:]], axis=1)
    wholes = on.sum(axis=1)
    reference_off, reference_on = off.mean(axis=0), wholes.mean(axis=0)
    indirect = on[:, 1].mean(axis=0)
    level = reference_off.mean()

    albedo, normal = guides(scene, spp)
    few = range(4)
    filtered = np.array([denoising.denoise(on[k, 1], albedo, normal) for k in few])
    halves = [half.mean(axis=0) for half in (off[::2], off[1::2], wholes[::2], wholes[1::2])]
    noise = (error(halves[0], halves[1], level) + error(halves[2], halves[3], level)) / 4
    return {
        "first_frame_off": first[0],
        "first_frame_on": first[1],
        "seconds_off": float(np.median(times[:, 0])),
        "seconds_on": float(np.median(times[:, 1])),
        "ratio": float(ratios_to_first(times)[1]),
        "error_off": error(off, reference_off, level),
        "error_on": error(wholes, reference_on, level),
        "error_denoised": error(on[few, 0] + filtered, reference_on, level),
        "error_indirect": error(on[:, 1], indirect, level),
        "error_indirect_denoised": error(filtered, indirect, level),
        "noise_of_indirect": error(on[::2, 1].mean(axis=0), on[1::2, 1].mean(axis=0), level) / 2,
        "mean_off": float(level),
        "mean_on": float(reference_on.mean()),
        "difference_of_limits": error(reference_on, reference_off, level),
        "noise_of_limits": noise,
    }


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--size", type=int, default=160, help="width; two thirds of it high")
    parser.add_argument("--spp", type=int, default=16)
    parser.add_argument("--reference", type=int, default=32, help="images whose mean is the limit")
    parser.add_argument("-o", "--output", type=Path, help="JSON file to write")
    options = parser.parse_args()

    size = {"resx": str(options.size), "resy": str(options.size * 2 // 3)}
    results = {}
    for name, parameters in SCENES.items():
        r = measure({**size, **parameters}, options.spp, options.reference)
        results[name] = r
        print(
            f"{name}: {r['seconds_off']:.2f} s off, {r['seconds_on']:.2f} s on, ratio "
            f"{r['ratio']:.2f}; first frames {r['first_frame_off']:.1f} s, "
            f"{r['first_frame_on']:.1f} s\n"
            f"  error of the image: off {r['error_off']:.3f}, on {r['error_on']:.3f}, denoised "
            f"{r['error_denoised']:.3f}\n"
            f"  error of indirect light: {r['error_indirect']:.3f}, denoised "
            f"{r['error_indirect_denoised']:.3f}; noise of its limit {r['noise_of_indirect']:.3f}\n"
            f"  means: off {r['mean_off']:.4f}, on {r['mean_on']:.4f}; the limits differ by "
            f"{r['difference_of_limits']:.3f}, of which noise {r['noise_of_limits']:.3f}",
            flush=True,
        )
    if options.output:
        settings = {"size": options.size, "spp": options.spp, "reference": options.reference}
        save_results(options.output, settings | {"results": results})


if __name__ == "__main__":
    main()
