"""How long a rendering will take, told before it begins, and what would make it shorter.

A few of the image's pixels are rendered with one sample each, and only the time that kernels run
is counted: neither recording nor compiling them grows with the image.
"""

from __future__ import annotations

from dataclasses import dataclass

import drjit as dr

from glintbsdf.core.memory import amount
from glintbsdf.core.progress import duration
from glintbsdf.scene import passes, rendering
from glintbsdf.scene.passes import Tile

#: Numbers of pixels that are tried one after the other, until one takes so many seconds. A
#: rendering that is very short by the first trial needs no other.
TRIED, ENOUGH = (64, 1024), 0.2

#: Seconds from which on an estimate is worth telling.
LONG = 30.0


@dataclass(frozen=True)
class Estimate:
    """What a rendering takes.

    Attributes:
        seconds (float): time of all samples on this machine, as it is busy now.
        nbytes (int): memory of the structures of all glint BSDFs.
        remedies (list[str]): what would take less, in words.
    """

    seconds: float
    nbytes: int
    remedies: list[str]

    def __str__(self) -> str:
        return (
            f"rendering takes about {duration(self.seconds)}, and glints {amount(self.nbytes)} of "
            f"memory. What helps: {'; '.join(self.remedies)}"
        )


def estimate(renderer: rendering.Renderer, seed: int = 0) -> Estimate | None:
    """What the image of a renderer, which has been entered, will take.

    None for integrators that do not follow the rays of a sensor: they cannot be tried.
    """
    plan = renderer.plan(seed)
    if not plan.divisible:
        return None
    bsdfs = rendering.glint_bsdfs(renderer.scene)
    remedies = sorted({f"{bsdf.owner}: {text}" for bsdf in bsdfs for text in bsdf.remedies()})
    remedies.append("--until-error or --time-limit, which end with what is done")
    nbytes = sum(sum(bsdf.parts().values()) for bsdf in bsdfs)
    expected = 0.0
    for pixels in TRIED:
        tile = column_of(plan.film, pixels)
        seconds = seconds_of(renderer, tile, seed)
        expected = seconds / tile.pixels * plan.film.pixels * plan.spp
        if seconds >= ENOUGH or 10 * expected < LONG:
            break
    return Estimate(expected, nbytes, remedies)


def column_of(film: Tile, pixels: int) -> Tile:
    """Columns in the middle of a film, of so many pixels about: from the sky to the ground."""
    height = min(film.height, pixels)
    width = min(film.width, max(1, pixels // height))
    x, y = film.x + (film.width - width) // 2, film.y + (film.height - height) // 2
    return Tile(x, y, width, height)


def seconds_of(renderer: rendering.Renderer, tile: Tile, seed: int) -> float:
    """Seconds that kernels run for one sample in each pixel of a tile.

    The first sample may find structures unbuilt. Building them does not grow with the image, so
    only kernels with one lane per pixel count.
    """
    with dr.scoped_set_flag(dr.JitFlag.KernelHistory, True):
        dr.kernel_history()  # what was before does not count
        passes.sums_of_samples(
            renderer.scene,
            renderer.sensor,
            renderer.integrator,
            tile,
            1,
            renderer.spp,
            seed,
            renderer.shared,
        )
        history = dr.kernel_history()
    return sum(k["execution_time"] for k in history if k["size"] == tile.pixels) / 1e3
