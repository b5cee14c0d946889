"""Error against run time of every method, for P-NDFs and for images, with a series of settings.

*P-NDFs*: six procedural maps and given maps; round footprints of radius r = 3σ from 1 to 512
texels. The relative L1, L2 and maximum error, against the binned reference and its noise, over time
per query (random places, normals drawn from the P-NDF, one thread) and over memory. Elements, lobes
and filters have an intrinsic roughness, and their reference has the same. *Images*: the curved
patch against brute force, for log-spaced numbers of samples and several seeds, by ``glint_path``,
as in ``glintbsdf render``. All methods run in turn within every
repetition; building and compiling are timed separately.

The folder gets ``report.html``, one page with everything; the same as JSON and CSV;
``which_when.csv``, the fastest method for each map, footprint and error; and ``figures``.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from contextlib import ExitStack
from dataclasses import asdict, dataclass, replace
from functools import cache, partial
from pathlib import Path

import click
import drjit as dr
import mitsuba as mi
from rich.console import Console
from rich.progress import MofNCompleteColumn, Progress

from benchmarks.cases import CASES, Case, given
from benchmarks.harness import VARIANT, Store, machine, open_store, output_option
from benchmarks.measures import glitter, images, pndf
from benchmarks.methods import BASELINES, METHODS, Method
from benchmarks.report import output as files
from glintbsdf.check.truth import Truth


@dataclass(frozen=True)
class Settings:
    """Settings of all measurements."""

    pndf: pndf.Settings
    images: images.Settings
    grid: glitter.Settings


QUICK = Settings(
    pndf.Settings(
        size=512, radii=(2, 16, 128), places=((0.37, 0.61),), res=64, samples=1_000_000,
        points=2**17, patience=4.0, repetitions=3, batch=0.02,
    ),
    images.Settings(
        map_size=512, maps=("isotropic patches",), scales=(2.0,), size=64, truth_spp=8192,
        budgets=(1, 4, 16, 64, 256), seeds=3,
    ),
    glitter.Settings(places=100_000, repetitions=3),
)  # fmt: skip

FULL = Settings(
    replace(
        QUICK.pndf, size=1024, radii=(1, 4, 16, 64, 256, 512), samples=5_000_000, points=2**19,
        patience=8.0, repetitions=5, batch=0.05,
    ),
    replace(
        QUICK.images, map_size=1024, maps=("scratched", "isotropic patches"), scales=(2.0, 8.0),
        size=96, truth_spp=16384, seeds=5,
    ),
    glitter.Settings(places=1_000_000, repetitions=5),
)  # fmt: skip


class Measurement:
    """All units of the report; each is measured, or found in the store."""

    def __init__(self, settings: Settings, cases: list[Case], methods: list[Method], store: Store):
        self.settings, self.store, self.cases = settings, store, cases
        self.image_cases = [c for c in cases if c.given or c.name in settings.images.maps]
        self.pndf_methods = [method for method in methods if method.pndf]
        self.image_methods = [method for method in methods if method.image]

    def run(self, progress: Progress) -> dict:
        """All data of the report: lists of (values, arrays)."""
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
        found["grid"] = [self.unit("glint_grid", key, lambda: glitter.measure(s.grid))]
        return found

    def unit(self, label: str, key: dict, measure: Callable[[], tuple]) -> tuple:
        """A unit from the store; ``measure`` is called if it is not there."""
        self.progress.update(self.task, description=label)
        start = time.perf_counter()
        result = self.store.get(key, measure)
        self.progress.advance(self.task)
        if not self.progress.console.is_terminal:  # a log has no bar
            self.progress.console.print(f"{label}: {time.perf_counter() - start:.1f} s")
        return result

    def pndf_case(self, case: Case, compiled: set[Method], found: dict) -> None:
        """All methods on a map: building, then every footprint. ``compiled``: methods so far."""
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
                if method not in built:  # an earlier run has timed the build
                    built[method] = method.build(surface)
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
        """All materials on a map: the reference, then every number of samples."""
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
        with ExitStack() as stack:
            made = cache(
                lambda: stack.enter_context(images.renderers(methods, surface, scale, settings))
            )

            def budget(spp: int) -> tuple:
                return images.measure(made(), reference, spp, settings)

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


def measure_all(
    settings: Settings, cases: list[Case], methods: list[Method], folder: Path, profile: str
) -> dict:
    """Measure all that is not in the store, write the report to ``folder``, and return its JSON."""
    dr.set_thread_count(max(2, dr.thread_count()))  # Mitsuba hangs with one
    store, console = open_store(folder), Console(stderr=True)
    columns = (*Progress.get_default_columns(), MofNCompleteColumn())
    with Progress(*columns, console=console) as progress:
        found = Measurement(settings, cases, methods, store).run(progress)
    described = {
        "profile": profile,
        "settings": asdict(settings),
        "maps": [case.name for case in cases],
        "methods": [
            {key: getattr(method, key) for key in ("name", "family", "setting", "plugin", "rung")}
            for method in methods
        ],
        "baselines": list(BASELINES),
    }
    return files.write(folder, machine(), described, found, console)


def compared(quick: bool, families: tuple[str, ...]) -> list[Method]:
    """The methods of the report; only methods of ``families`` if any are named."""
    return [
        method
        for method in METHODS
        if (method.pndf or method.image)
        and (method.quick or not quick)
        and (not families or method.family in families)
    ]


FAMILIES = list(dict.fromkeys(m.family for m in METHODS if m.pndf or m.image))


@click.command(help=__doc__, short_help=__doc__.splitlines()[0])
@click.option("--quick", is_flag=True, help="Fewer and smaller cases, in five minutes.")
@click.option("--map", "others", multiple=True, type=click.Path(path_type=Path), metavar="FILE",
              help="A further map.")  # fmt: skip
@click.option("--maps", multiple=True, type=click.Choice([case.name for case in CASES]),
              help="Procedural maps; default: all.")  # fmt: skip
@click.option("--families", multiple=True, type=click.Choice(FAMILIES),
              help="Families of methods; default: all.")  # fmt: skip
def error_vs_time(
    quick: bool,
    others: tuple[Path, ...],
    maps: tuple[str, ...],
    families: tuple[str, ...],
    output: Path,
    variant: str,
) -> None:
    mi.set_variant(variant)
    cases = [case for case in CASES if not maps or case.name in maps]
    cases += [given(path) for path in others]
    output.mkdir(parents=True, exist_ok=True)
    profile, settings = ("quick", QUICK) if quick else ("full", FULL)
    measure_all(settings, cases, compared(quick, families), output, profile)


error_vs_time.params += [output_option(required=True), VARIANT]
