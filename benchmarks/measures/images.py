"""Errors of images against a brute-force reference, at equal numbers of samples and times."""

from __future__ import annotations

import multiprocessing
import signal
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass

import glintbsdf  # noqa: F401  (first in a renderer's process: it names Dr.Jit's LLVM library)

import mitsuba as mi  # isort: skip
import numpy as np
import scipy.stats

from benchmarks.cases import Surface, curved_patch, scaled
from benchmarks.harness import ratios_to_first, seconds, seconds_in_turn, timed
from benchmarks.methods import BASELINES, Method
from glintbsdf.check.truth import Truth, reference_render

#: Radius of the lights; brute force finds the scene's smaller ones too rarely.
LIGHT_RADIUS = 0.07

#: Field of view, degrees: the patch fills the image, and lights are visible in it only.
FIELD_OF_VIEW = 30.0

#: Seconds that a process gets to end by itself.
PATIENCE = 20


@dataclass(frozen=True)
class Settings:
    """Settings of the comparison of images.

    ``maps`` are the names of the cases; maps from files are always compared. ``scales`` are the
    repetitions of the map on the patch, which determine the texels per pixel. ``budgets`` are
    samples per pixel; each is rendered with ``seeds`` seeds.
    """

    map_size: int
    maps: tuple[str, ...]
    scales: tuple[float, ...]
    size: int
    truth_spp: int
    budgets: tuple[int, ...]
    seeds: int


class Renderer:
    """A process with the scene of one material.

    Dr.Jit traces every BSDF that exists in a process into every kernel, so scenes need separate
    processes. Also, each build and first frame then takes as long as for a user.

    Attributes:
        building, first_frame (float): seconds; the first frame has one sample per pixel, and
            compiles.
    """

    def __init__(self, *arguments: object) -> None:
        context = multiprocessing.get_context("spawn")
        self.connection, other = context.Pipe()
        self.process = context.Process(target=serve, args=(other, *arguments), daemon=True)
        self.process.start()
        other.close()
        self.building, self.first_frame = self.receive()

    def receive(self):
        try:
            return self.connection.recv()
        except EOFError:
            raise RuntimeError("a process that renders has failed, see above") from None

    def render(self, spp: int, seed: int) -> tuple[np.ndarray, float]:
        """An image of ``spp`` samples per pixel, and its seconds."""
        self.connection.send((spp, seed))
        return self.receive()

    def close(self) -> None:
        """End the process, after the image that it may be rendering."""
        self.connection.close()
        self.process.join(PATIENCE)
        if self.process.is_alive():
            self.process.terminate()


def serve(connection, variant: str, *arguments: object) -> None:
    """The loop of a :class:`Renderer`'s process, until the other end of the connection closes.

    ``arguments`` are arguments of :func:`load`.
    """
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # the parent ends this process
    mi.set_variant(variant)
    scene, building = timed(lambda: load(*arguments))
    connection.send((building, render(scene, 1, 0)[1]))
    while True:
        try:
            spp, seed = connection.recv()
        except EOFError:
            return
        connection.send(render(scene, spp, seed))


def load(material: Method | str, surface: Surface, scale: float, settings: Settings) -> mi.Scene:
    """Load the scene with a material, which is a method or the name of a baseline. Methods have the
    integrator ``glint_path``, as in ``glintbsdf render``, and baselines have ``path``."""
    shared = {"material": "Cr", "to_uv": scaled(scale)}
    if isinstance(material, str):
        described, integrator = BASELINES[material](surface.normal_map, **shared), "path"
    else:
        described, integrator = material.describe(surface) | shared, "glint_path"
    return curved_patch(described, settings.size, 1, LIGHT_RADIUS, FIELD_OF_VIEW, integrator)


@contextmanager
def renderers(
    methods: list[Method], surface: Surface, scale: float, settings: Settings
) -> Iterator[dict[str, Renderer]]:
    """A context with a :class:`Renderer` for each material, by name; it ends their processes."""
    materials = {name: name for name in BASELINES} | {method.name: method for method in methods}
    made: dict[str, Renderer] = {}
    try:
        for name, material in materials.items():
            made[name] = Renderer(mi.variant(), material, surface, scale, settings)
        yield made
    finally:
        for renderer in made.values():
            renderer.close()


def truth(surface: Surface, scale: float, settings: Settings):
    """Return the truth and its noise, as a unit of the store."""
    scene = load("brute force", surface, scale, settings)
    found = reference_render(scene, spp=settings.truth_spp, seed=1000)
    values = {"samples_per_pixel": settings.truth_spp, "noise": found.relative_error}
    return values, {"image": found.image, "standard_error": found.standard_error}


def render(scene: mi.Scene, spp: int, seed: int) -> tuple[np.ndarray, float]:
    """An image, and the seconds of rendering alone."""
    image, taken = timed(lambda: mi.render(scene, spp=spp, seed=seed))
    return np.array(image)[..., :3].astype(np.float64), taken


def measure(made: dict[str, Renderer], reference: Truth, spp: int, settings: Settings):
    """Render all materials in turn for every seed, with ``spp`` samples: a unit of the store."""
    taken, error, mean = ({name: [] for name in made} for _ in range(3))
    images = {}
    for renderer in made.values():
        renderer.render(spp, 0)  # warms up
    for seed in range(1, settings.seeds + 1):
        for name, renderer in made.items():
            image, time = renderer.render(spp, seed)
            images.setdefault(name, image.astype(np.float32))
            taken[name].append(time)
            error[name].append(reference.relative_rmse(image))
            mean[name].append(float(image.mean() / reference.image.mean()))
    points = [
        {
            "method": name,
            "samples_per_pixel": spp,
            "seconds": float(np.median(taken[name])),
            "build_seconds": renderer.building,
            "first_frame_seconds": renderer.first_frame,
            "mean": float(np.mean(mean[name])),
            **band(error[name]),
        }
        for name, renderer in made.items()
    ]
    return {"points": points}, images


def in_turn(scenes: tuple[mi.Scene, mi.Scene], spp: int, repetitions: int) -> dict:
    """Times of frames of two scenes in turn, the first of which is a baseline.

    The first frame of each compiles, and is timed apart.
    """
    frames = [lambda seed, scene=scene: mi.render(scene, spp=spp, seed=seed) for scene in scenes]
    first = [seconds(frame, 0) for frame in frames]
    times = seconds_in_turn(frames, repetitions)
    median = np.median(times, axis=0)
    return {
        "ratio": float(ratios_to_first(times)[1]),
        "seconds": float(median[1]),
        "seconds_baseline": float(median[0]),
        "first_frame": first[1],
    }


def band(errors: list[float]) -> dict[str, float]:
    """Return the mean over the seeds, and its 95 % interval by Student's t."""
    mean, n = float(np.mean(errors)), len(errors)
    half = float(scipy.stats.t.ppf(0.975, n - 1) * np.std(errors, ddof=1) / n**0.5)
    return {"rmse": mean, "rmse_low": max(mean - half, 0.0), "rmse_high": mean + half}


def at_equal_times(points: list[dict], count: int = 5) -> list[dict]:
    """Errors of all materials at log-spaced times that at least half of them reach.

    Between budgets error is a power of time; beyond the largest or below the smallest budget of a
    material there is no figure for it.
    """
    curves: dict[str, list[tuple[float, float]]] = {}
    for point in points:
        curves.setdefault(point["method"], []).append((point["seconds"], point["rmse"]))
    arrays = {name: np.array(sorted(curve)).T for name, curve in curves.items()}
    low = float(np.median([curve[0][0] for curve in arrays.values()]))
    high = float(np.median([curve[0][-1] for curve in arrays.values()]))
    rows = []
    for taken in np.geomspace(low, high, count):
        error = {
            name: float(np.exp(np.interp(np.log(taken), np.log(t), np.log(e))))
            for name, (t, e) in arrays.items()
            if t[0] <= taken <= t[-1] and (e > 0).all()
        }
        rows.append({"seconds": float(taken), "rmse": error})
    return rows
