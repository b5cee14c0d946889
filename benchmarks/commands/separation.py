"""Cost and gain of separated illumination, and of denoising its indirect part.

The scene is interreflection.xml, where light meets glints several times, with two maps. Behind a
rough bounce footprints are wide; the finer the map, the more texels they cover. ``max_error`` 0.1
bounds their cost.

``glint_path`` renders each scene with ``separate`` off and on, in turn. The table has the median
time, and the median ratio within a repetition, after a first frame that compiles. An error is the
mean absolute difference of an image from its limit, relative to the mean; the limit is the mean of
32 images of the same kind. The limits with ``separate`` on and off differ, as smooth lobes differ
from glints in indirect light; the table has this difference, and the part of it that is noise.
"""

from __future__ import annotations

from functools import partial

import mitsuba as mi
import numpy as np

from benchmarks.cases import SCENES as FOLDER
from benchmarks.harness import Run, family, ratios_to_first, seconds, seconds_in_turn
from glintbsdf.scene import denoising
from glintbsdf.scene.rendering import load_scene

SCENE = FOLDER / "interreflection.xml"
SCENES = {
    "coarse map": {"uv_scale": "0.5", "max_error": "0.1"},
    "fine map": {"uv_scale": "4", "max_error": "0.1"},
}


def image(scene: mi.Scene, separate: bool, spp: int, seed: int) -> mi.TensorXf:
    """The image, with ``separate`` also its direct and indirect light."""
    integrator = scene.integrator()
    integrator.separate = separate
    return integrator.render(scene, scene.sensors()[0], seed=seed, spp=spp)


def error(images: np.ndarray, reference: np.ndarray, level: float) -> float:
    """Mean absolute difference over ``level``."""
    return float(np.abs(images - reference).mean() / level)


def measure(parameters: dict[str, str], spp: int, count: int) -> dict[str, float]:
    """The row of one scene."""
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

    # Albedo and normals, as the command line renders them.
    with denoising.guided(scene.integrator()) as integrator:
        integrator.render(scene, scene.sensors()[0], spp=spp)
    layers = {name: np.array(layer) for name, layer in scene.sensors()[0].film().bitmap().split()}
    albedo, normal = layers[denoising.ALBEDO], layers[denoising.NORMAL]
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


def light(run: Run) -> None:
    """Times and errors with ``separate`` off and on, and with indirect light denoised."""
    width, spp, count = (60, 4, 6) if run.quick else (160, 16, 32)
    size = {"resx": str(width), "resy": str(width * 2 // 3)}
    with run.table("light") as table:
        for name, parameters in SCENES.items():
            work = partial(measure, {**size, **parameters}, spp, count)
            table.measure({"scene": name}, work)


separation = family("separation", light)
