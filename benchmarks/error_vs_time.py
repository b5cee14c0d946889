"""Error against run time of every method: P-NDFs and images, at a ladder of settings.

``python benchmarks/error_vs_time.py [--quick] -o DIR [--map FILE]…``

*P-NDF level*: six procedural maps and any map given, round footprints of radius r = 3σ from 1 to
512 texels. Relative L1, L2 and maximum error against the binned reference, whose own noise is
measured too, against time per query (random places, normals drawn from the P-NDF, one thread) and
memory. Elements, lobes and filters have a roughness of their own, and are compared with a reference
that is as rough. *Image level*: the curved patch against brute force at log-spaced numbers of
samples, several seeds; footprints shrink with the number of samples, as ``glintbsdf render`` has
it. All methods run in turn within every repetition; building and compiling are timed apart.

Expected before measuring: exact at the noise of the reference; tables within their ``max_error``
and far ahead in time from 64 texels on; elements at a few per cent, falling with their step; lobes
at 10 to 20 %; filters a hundred times faster, and wrong but for large footprints on Gaussian bumps.
In images, brute force needs several times the samples of the glints' methods at small budgets and
catches up at large ones, and ``roughconductor`` stops converging.

DIR gets ``report.html``, one page with everything in it; ``report.json`` (see
``benchmarks/report/schema.json``), ``pndf.csv``, ``images.csv`` and ``which_when.csv``, the fastest
method per map, footprint and error; and ``figures``. The fronts of error against time are printed.
What has been measured is kept in ``DIR/measured``: after Ctrl-C the same command goes on where it
stopped. Other settings, another machine or a change of the package's source measure anew. Needs the
``docs`` extra (matplotlib, Jinja2).
"""

from __future__ import annotations

import argparse
import os
import sys
import tempfile
import time
from dataclasses import asdict, dataclass
from functools import partial
from pathlib import Path

os.environ["GLINTBSDF_CACHE"] = "off"  # building is timed
_kernels = tempfile.TemporaryDirectory()
os.environ["DRJIT_CACHE_DIR"] = _kernels.name  # and so is compiling

import glintbsdf  # noqa: E402, F401  (the environment comes first)

import drjit as dr  # isort: skip # noqa: E402
import mitsuba as mi  # isort: skip # noqa: E402

mi.set_variant("llvm_ad_rgb")

from glintbsdf.cli.main import interruptible  # noqa: E402
from report import grid, images, output, pndf  # noqa: E402
from report.methods import BASELINES, CASES, METHODS, Case, Method, given  # noqa: E402
from report.store import Store, machine  # noqa: E402
from rich.console import Console  # noqa: E402
from rich.progress import (  # noqa: E402
    BarColumn,
    MofNCompleteColumn,
    Progress,
    TextColumn,
    TimeElapsedColumn,
)

from glintbsdf.check.truth import Truth  # noqa: E402


@dataclass(frozen=True)
class Settings:
    """How much is measured."""

    pndf: pndf.Settings
    images: images.Settings
    grid: grid.Settings


QUICK = Settings(
    pndf.Settings(
        size=512,
        radii=(2, 16, 128),
        places=((0.37, 0.61),),
        res=64,
        samples=1_000_000,
        points=2**17,
        patience=4.0,
        repetitions=3,
        batch=0.02,
    ),
    images.Settings(
        map_size=512,
        maps=("isotropic patches",),
        scales=(2.0,),
        size=64,
        truth_spp=8192,
        budgets=(1, 4, 16, 64, 256),
        seeds=3,
    ),
    grid.Settings(places=100_000, repetitions=3),
)

FULL = Settings(
    pndf.Settings(
        size=1024,
        radii=(1, 4, 16, 64, 256, 512),
        places=((0.37, 0.61),),
        res=64,
        samples=5_000_000,
        points=2**19,
        patience=8.0,
        repetitions=5,
        batch=0.05,
    ),
    images.Settings(
        map_size=1024,
        maps=("scratched", "isotropic patches"),
        scales=(2.0, 8.0),
        size=96,
        truth_spp=16384,
        budgets=(1, 4, 16, 64, 256),
        seeds=5,
    ),
    grid.Settings(places=1_000_000, repetitions=5),
)


class Measurement:
    """The walk over all units, each of which is measured or found in the store."""

    def __init__(self, settings: Settings, cases: list[Case], methods: list[Method], store: Store):
        self.settings, self.store, self.cases = settings, store, cases
        self.image_cases = [c for c in cases if c.given or c.name in settings.images.maps]
        self.pndf_methods = [method for method in methods if method.pndf]
        self.image_methods = [method for method in methods if method.image]

    def run(self, progress: Progress) -> dict:
        """Everything that the report shows: lists of (values, arrays)."""
        s = self.settings
        total = len(self.image_cases) * len(s.images.scales) * (1 + len(s.images.budgets)) + 1
        total += len(self.cases) * len(s.pndf.radii)
        total += sum(method.suits(case) for case in self.cases for method in self.pndf_methods)
        self.progress, self.task = progress, progress.add_task("", total=total)
        found: dict[str, list] = {"structures": [], "pndf": [], "truths": [], "images": []}
        compiled: set[Method] = set()
        for case in self.cases:
            self.pndf_case(case, compiled, found)
        for case in self.image_cases:
            for scale in s.images.scales:
                self.image_case(case, scale, found)
        key = {"unit": "grid", "settings": asdict(s.grid)}
        found["grid"] = [self.unit("glint_grid", key, lambda: grid.measure(s.grid))]
        return found

    def unit(self, label: str, key: dict, measure):
        """A unit from the store; ``measure`` is called where it has none."""
        self.progress.update(self.task, description=label)
        start = time.perf_counter()
        result = self.store.get(key, measure)
        self.progress.advance(self.task)
        if not self.progress.console.is_terminal:  # a log has no bar
            self.progress.console.print(f"{label}: {time.perf_counter() - start:.1f} s")
        return result

    def pndf_case(self, case: Case, compiled: set[Method], found: dict) -> None:
        """All methods on a map: building, then every footprint. ``compiled``: methods seen."""
        settings = self.settings.pndf
        surface = case.surface(settings.size)
        shared = {"map": surface.normal_map.content_hash, "epsilon": surface.epsilon}
        methods = [method for method in self.pndf_methods if method.suits(case)]
        built: dict[Method, object] = {}

        def structure(method: Method, with_compiling: bool):
            built[method], values = pndf.structure(method, surface, with_compiling)
            return {"map": case.name, "method": method.name, **values}, {}

        def footprint(radius: float):
            for method in methods:
                if method not in built:  # an earlier run has timed it
                    built[method] = pndf.build(method, surface)
            return pndf.measure({m: built[m] for m in methods}, surface, radius, settings)

        for method in methods:
            first = method not in compiled
            compiled.add(method)
            key = {"unit": "structure", **shared, "method": asdict(method), "compiling": first}
            label = f"{case.name}: building {method.name}"
            found["structures"].append(self.unit(label, key, partial(structure, method, first)))
        for radius in settings.radii:
            key = {
                "unit": "pndf",
                **shared,
                "radius": radius,
                "methods": [asdict(method) for method in methods],
                "settings": asdict(settings),
            }
            label = f"{case.name}: footprint of {radius:g} texels"
            found["pndf"].append(self.unit(label, key, partial(footprint, radius)))
        built.clear()
        dr.flush_malloc_cache()

    def image_case(self, case: Case, scale: float, found: dict) -> None:
        """All materials on a map: the truth, then every number of samples."""
        settings = self.settings.images
        surface = case.surface(settings.map_size)
        methods = [method for method in self.image_methods if method.suits(case)]
        shared = {
            "map": surface.normal_map.content_hash,
            "scale": scale,
            "settings": asdict(settings),
        }
        where = {"map": case.name, "scale": scale}
        values, arrays = self.unit(
            f"{case.name}: truth of the image",
            {"unit": "truth", **shared},
            lambda: images.truth(surface, scale, settings),
        )
        found["truths"].append(({**where, **values}, arrays))
        reference = Truth(arrays["image"], arrays["standard_error"])
        made: dict[str, images.Renderer] = {}

        def budget(spp: int):
            if not made:
                made.update(images.renderers(methods, surface, scale, settings))
            return images.measure(made, reference, spp, settings)

        try:
            for spp in settings.budgets:
                key = {
                    "unit": "images",
                    **shared,
                    "spp": spp,
                    "methods": [asdict(method) for method in methods],
                }
                label = f"{case.name}: images of {spp} samples per pixel"
                values, arrays = self.unit(label, key, partial(budget, spp))
                found["images"].append(({**where, "samples_per_pixel": spp, **values}, arrays))
        finally:
            images.close(made)


def report(
    settings: Settings, cases: list[Case], methods: list[Method], folder: Path, profile: str
) -> dict:
    """Measure what is not measured yet, and write the report to ``folder``; returns its JSON."""
    # Mitsuba never returns from reading an image where Dr.Jit has a single thread.
    dr.set_thread_count(max(2, dr.thread_count()))
    here = machine()
    store = Store(folder / "measured", {key: here[key] for key in here if key != "commit"})
    console = Console(stderr=True)
    columns = (
        TextColumn("{task.description}"),
        BarColumn(),
        MofNCompleteColumn(),
        TimeElapsedColumn(),
    )
    with Progress(*columns, console=console) as progress:
        found = Measurement(settings, cases, methods, store).run(progress)
    described = {
        "profile": profile,
        "settings": asdict(settings),
        "maps": [case.name for case in cases],
        "methods": [asdict(method) | {"name": method.name} for method in methods],
        "baselines": list(BASELINES),
    }
    return output.write(folder, here, described, found, console)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--quick", action="store_true", help="in five minutes: fewer of everything")
    parser.add_argument("--map", type=Path, action="append", default=[], help="a further map")
    parser.add_argument("--maps", nargs="+", choices=[case.name for case in CASES],
                        help="procedural maps; default: all")  # fmt: skip
    families = list(dict.fromkeys(method.family for method in METHODS))
    parser.add_argument("--families", nargs="+", choices=families, help="methods; default: all")
    parser.add_argument("-o", "--output", type=Path, required=True, help="folder to write to")
    options = parser.parse_args()

    settings = QUICK if options.quick else FULL
    cases = [case for case in CASES if options.maps is None or case.name in options.maps]
    cases += [given(path) for path in options.map]
    methods = [
        method
        for method in METHODS
        if (method.quick or not options.quick)
        and (options.families is None or method.family in options.families)
    ]
    options.output.mkdir(parents=True, exist_ok=True)
    try:
        with interruptible():
            report(settings, cases, methods, options.output, "quick" if options.quick else "full")
    except KeyboardInterrupt:
        sys.exit("Interrupted. The same command goes on from here.")


if __name__ == "__main__":
    main()
