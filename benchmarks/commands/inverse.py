"""Inverse rendering: derivatives of images, what they cost, and microstructure from photographs."""

from __future__ import annotations

import importlib.util
from functools import partial
from types import ModuleType

import drjit as dr
import mitsuba as mi
import numpy as np

from benchmarks.harness import ROOT, Run, family, ratios_to_first, seconds_in_turn
from glintbsdf.check.derivatives import INTEGRATORS, Grown, examples, plate, render_derivatives


def example() -> ModuleType:
    """The script docs/examples/inverse.py."""
    place = ROOT / "docs" / "examples" / "inverse.py"
    spec = importlib.util.spec_from_file_location("inverse_example", place)
    module = importlib.util.module_from_spec(spec)  # type: ignore[arg-type]
    spec.loader.exec_module(module)  # type: ignore[union-attr]
    return module


def photographs(run: Run) -> None:
    """Microstructure from photographs, see docs/examples/inverse.py.

    Expected: roughness and tint within 1 %; roughness and density of flakes within 5 %; a normal
    map whose mean angle to the truth is at most 20 % of a flat start's, with pictures under new
    lamps that differ at most half as much as those of normalmap and roughconductor; all three in
    ten minutes on two cores.
    """
    task, shown = example(), {}
    share = 0.25 if run.quick else 1.0
    works = {
        "roughness and tint": partial(task.roughness_and_tint, int(80 * share)),
        "flakes": partial(task.flakes, int(100 * share)),
        "normal map": partial(task.normal_map, share, shown),
    }
    with run.table("photographs") as table:
        for name, work in works.items():
            table.measure(
                {"task": name},
                lambda work=work: [{"figure": k, "value": v} for k, v in work().items()],
            )
    if shown:
        white = 2 * np.quantile(shown["truth"][1], 0.95)
        maps, pictures = zip(*shown.values(), strict=True)
        rows = [[seen(normals) for normals in maps], [picture / white for picture in pictures]]
        rows = [[image.repeat(4, 0).repeat(4, 1) for image in row] for row in rows]
        run.save_pictures("normal map", rows)


def seen(normals: np.ndarray) -> np.ndarray:
    """Projected normals as colours, two and a half times as steep."""
    return np.pad(0.5 + 1.25 * normals, ((0, 0), (0, 0), (0, 1)), constant_values=0.5)


def derivatives(run: Run) -> None:
    """Derivatives of an image against central differences of the same random numbers.

    Both are per relative change of the parameter; noise is three standard errors of the mean
    difference. Expected: they agree within 2 % or the noise, and no step compiles a kernel.
    """
    with run.table("derivatives") as table:
        for method, (bsdf, keys, settings) in examples().items():
            for integrator in ["prb"] if run.quick else INTEGRATORS:
                arguments = {**settings, **INTEGRATORS[integrator]}
                work = partial(render_derivatives, bsdf, keys, integrator, **arguments)
                table.measure(
                    {"method": method, "integrator": integrator},
                    lambda work=work: [derivative.row() for derivative in work()],
                )


#: Mitsuba's own metal, to compare with.
ROUGH = {"type": "twosided", "nested": {"type": "roughconductor", "alpha": 0.2}}


def cost(run: Run) -> None:
    """Time of an iteration, over that of a forward rendering of the same samples per pixel.

    An iteration renders, and takes the derivatives with respect to one parameter, in ``direct``
    without samples of the BSDF, and in ``prb``. Expected: at most 4, and more where the BSDF takes
    nearly all of the time: Mitsuba evaluates it seven times where ``prb`` goes back, and twice
    where it goes forward.
    """
    methods = {"roughconductor": (ROUGH, ("alpha.value",)), **examples()}
    with run.table("cost") as table:
        for method, (bsdf, keys, *_) in methods.items():
            for integrator in ("direct", "prb"):
                work = partial(ratio, bsdf, keys[0], integrator, run.repetitions)
                table.measure({"method": method, "integrator": integrator}, work)


def ratio(bsdf: dict, key: str, integrator: str, repetitions: int) -> dict:
    """A row of :func:`cost`."""
    description = plate(bsdf, integrator, size=64)
    if integrator == "direct":
        description["integrator"] |= {"emitter_samples": 1, "bsdf_samples": 0}
    scene = mi.load_dict(description)
    grown = Grown.of_plate(scene, [key])
    (name,) = grown.names.values()

    def forward(seed: int) -> object:
        grown.set(1, False)
        return mi.render(scene, spp=64, seed=seed)

    def iteration(seed: int) -> object:
        grown.set(1, True)
        dr.backward(dr.mean(mi.render(scene, grown.params, spp=64, seed=seed), axis=None))
        return dr.grad(grown.params[name])

    forward(0), iteration(0)
    times = seconds_in_turn([forward, iteration], repetitions)
    return {"parameter": key, "forward, s": float(np.median(times[:, 0])),
            "iteration over forward": float(ratios_to_first(times)[1])}  # fmt: skip


inverse = family("inverse", photographs, derivatives, cost)
