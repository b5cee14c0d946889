"""Fuzzing of parameters: values of every kind for every parameter of every plugin.

A case is a plugin, and values of any kind for one or two of its parameters: numbers from 1e-45 to
1e39, NaN, names, colours, vectors, transforms, tensors, images, textures, nested materials. Some
parameters do not exist. A case must end in one of two ways: with an error of one sentence that
names the plugin and the parameter; or with a BSDF whose values and samples are finite from the
zenith to the horizon, for footprints from a point to many maps, or an integrator that renders a
picture.

:func:`cases` and :func:`outcome` work in this process. :func:`fuzz` runs any number of cases in
separate processes, so that crashes and endless loops are outcomes as well. It is part of the
stability report, ``python -m benchmarks stability --fuzz 20000``::

    from glintbsdf.check.fuzz import fuzz
    print(fuzz(1000, seed=1))
"""

from __future__ import annotations

import multiprocessing
import os
import time
from collections import Counter
from collections.abc import Callable, Collection, Iterator
from dataclasses import dataclass, field
from multiprocessing.connection import wait
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

#: Seconds of processor time that a case may take, with the compilation of its kernels; and the
#: factor to the limit in seconds of the clock, for a case that waits for ever.
PATIENCE, CLOCK = 60.0, 20

#: Larger values than these are allowed, but take long to build; cases use these at most.
_COSTLY = {"output_size": 128, "flake_density": 1e5}

#: The good outcomes of a case; any other outcome is a fault.
GOOD = ("used", "refused", "refused by Mitsuba")

_NUMBERS = (0, 1, -1, 7, 2**31, 2**40, -(2**40))
_FLOATS = (
    0.0,
    -0.0,
    1e-45,
    1e-30,
    1e-12,
    1e-8,
    1e-4,
    0.01,
    0.3,
    0.5,
    1.0,
    1.5,
    3.0,
    20.0,
    1e3,
    1e4,
)
_EXTREMES = (1e6, 1e9, 1e20, 1e30, 3e38, 1e39, 1e300, -1e-8, -0.5, -1e30)
_STRANGE = (float("nan"), float("inf"), float("-inf"))
_NAMES = (
    "",
    "none",
    "0.5",
    "true",
    "gauss",
    "ggx",
    "beckmann",
    "Au",
    "bk7",
    "a\nb",
    'a "b" c',
    "x" * 500,
)


class Case(NamedTuple):
    """A plugin and some of its parameters: by name, the kind of a value and a number or name for
    it, see :func:`made`."""

    plugin: str
    changes: dict[str, tuple[str, Any]]

    def __str__(self) -> str:
        values = ", ".join(
            f"{name} = {kind} {value!r}"[:90] for name, (kind, value) in self.changes.items()
        )
        return f"{self.plugin}: {values}"


def cases(seed: int, count: int, plugins: tuple[str, ...] = ()) -> Iterator[Case]:
    """``count`` cases, for ``plugins``, or for all plugins that declare parameters. The same seed
    gives the same cases."""
    from glintbsdf.bridge.parameters import PARAMETERS, Number

    rng = np.random.default_rng(seed)
    plugins = plugins or tuple(PARAMETERS)

    def choose(values):
        return values[int(rng.integers(len(values)))]

    def value(declaration) -> tuple[str, Any]:
        if isinstance(declaration, Number) and rng.random() < 0.25:  # at and about its ends
            low, high = declaration.minimum, declaration.maximum
            number = choose(
                (
                    low,
                    high,
                    low + rng.random() * (high - low),
                    np.nextafter(low, -1e300),
                    np.nextafter(high, 1e300),
                )
            )
            return "number", int(number) if declaration.whole else float(number)
        kind = choose(
            (
                "number",
                "number",
                "float",
                "float",
                "float",
                "extreme",
                "strange",
                "name",
                "name",
                "flag",
                "colour",
                "vector",
                "point",
                "transform",
                "tensor",
                "array",
                "bitmap",
                "texture",
                "spectrum",
                "rgb",
                "bsdf",
            )
        )
        values = {
            "number": _NUMBERS,
            "float": _FLOATS,
            "extreme": _EXTREMES,
            "strange": _STRANGE,
            "name": _NAMES,
            "flag": (False, True),
        }
        return kind, choose(values.get(kind, _FLOATS + _EXTREMES + _STRANGE))

    for _ in range(count):
        plugin = choose(plugins)
        declared = PARAMETERS[plugin]
        names = list(declared)
        changes = {}
        for _ in range(1 if rng.random() < 0.8 else 2):
            name = choose(names)
            if rng.random() < 0.03:  # a slip of the pen
                name = name[:-1] if rng.random() < 0.5 else name + "x"
            kind, given = value(declared.get(name))
            allowed = declared.get(name)
            if name in _COSTLY and isinstance(allowed, Number) and allowed.holds(given):
                given = min(given, _COSTLY[name])
            changes[name] = kind, given
        yield Case(plugin, changes)


# --------------------------------------------------------------------------------------------------
#  One case
# --------------------------------------------------------------------------------------------------


def made(kind: str, value: Any) -> Any:
    """The value of a case as ``mi.load_dict`` takes it."""
    import mitsuba as mi

    number = float(value) if isinstance(value, int | float) else 0.0
    with np.errstate(over="ignore"):
        pixels = np.full((16, 16, 3), number).astype(np.float32)
    makers: dict[str, Callable[[], Any]] = {
        "colour": lambda: mi.ScalarColor3d(number, 0.5, 0.2),
        "vector": lambda: mi.ScalarVector3d(number, 1, 2),
        "point": lambda: [number, 1.0, 2.0],
        "transform": lambda: mi.ScalarTransform4f().scale([number, 1, 1]),
        "tensor": lambda: mi.TensorXf(pixels),
        "array": lambda: mi.Float([number, 1.0]),
        "bitmap": lambda: mi.Bitmap(pixels),
        "texture": lambda: {"type": "checkerboard"},
        "spectrum": lambda: {"type": "spectrum", "value": [(400.0, number), (700.0, 0.5)]},
        "rgb": lambda: {"type": "rgb", "value": [number, 0.5, 0.2]},
        "bsdf": lambda: {"type": "diffuse"},
    }
    return makers[kind]() if kind in makers else value


def base(plugin: str) -> dict:
    """A small valid description of a plugin."""
    import mitsuba as mi

    from glintbsdf.maps import isotropic

    description: dict = {"type": plugin}
    if plugin not in ("glint_grid", "glint_particles", "glint_path"):
        size = 16 if plugin == "glint_mip" else 8
        description["data"] = mi.TensorXf(isotropic(size, alpha=0.2).normals)
    if plugin == "glint_mip":
        description |= {"output_size": 32, "patch_size": 8, "clusters": 2}
    return description


def outcome(case: Case, evaluate: bool = True) -> str:
    """The outcome of a case: one of :data:`GOOD`, or a sentence about the fault.

    ``evaluate``: whether to evaluate the plugin as well, which compiles kernels.
    """
    import mitsuba as mi

    description = base(case.plugin)
    if {"filename", "bitmap", "flake_density"} & set(case.changes):
        description.pop("data", None)
    try:
        description |= {name: made(*value) for name, value in case.changes.items()}
    except Exception:
        return "refused by Mitsuba"  # before any plugin has seen it
    try:
        loaded = mi.load_dict(description)
    except Exception as error:
        return judged(case, str(error))
    try:
        if not evaluate:
            return "used"
        return (judged_values if isinstance(loaded, mi.BSDF) else judged_picture)(loaded)
    except Exception as error:
        return f"evaluation fails: {type(error).__name__}: {str(error)[-300:]}"


def judged(case: Case, message: str) -> str:
    """The outcome of an error: it must be one sentence that names the plugin and a parameter of the
    case."""
    lines = message.strip().splitlines()
    if "Traceback" in message or len(lines) != 1:
        return "no sentence: " + lines[-1]
    _, ours, told = lines[0].partition(f"ParameterError: {case.plugin}: ")
    if not ours:
        # Mitsuba's own: a value that properties cannot hold, or a parameter that is of no use here.
        named = any(f'"{name}"' in message for name in case.changes)
        return "refused by Mitsuba" if named else "other: " + lines[0]
    groups: list[Collection[str]] = [case.changes]
    if {"filename", "bitmap", "flake_density"} & set(case.changes):
        groups.append(("filename", "bitmap", "data"))
    if any(f'"{name}"' in told for group in groups for name in group):
        return "refused"
    return "another parameter is named: " + told


def judged_values(bsdf: Any) -> str:
    """The outcome of a BSDF: its values, densities and samples must be finite and ≥ 0."""
    import drjit as dr
    import mitsuba as mi

    views = [(0.0, 0.0, 1.0), (0.6, 0.2, 0.5), (1.0, 0.0, 1e-3), (0.3, -0.4, 0.9)]
    widths = [0.0, 1e-6, 0.02, 0.3, 1.0, 30.0]
    lanes = [(view, width) for view in views for width in widths]
    si = dr.zeros(mi.SurfaceInteraction3f, len(lanes))
    si.uv = mi.Point2f(0.37, 0.61)
    wi = np.array([view for view, _ in lanes]).T
    si.wi = mi.Vector3f(np.float32(wi / np.linalg.norm(wi, axis=0)))
    width = mi.Float(np.float32([width for _, width in lanes]))
    si.duv_dx, si.duv_dy = mi.Vector2f(width, 0), mi.Vector2f(0.2 * width, 0.7 * width)
    si.t, si.n = 1, mi.Normal3f(0, 0, 1)
    si.sh_frame = mi.Frame3f(mi.Vector3f(si.n))
    si.dp_du, si.dp_dv = mi.Vector3f(1, 0, 0), mi.Vector3f(0, 1, 0)
    if mi.is_spectral:
        si.wavelengths = [440, 510, 580, 650]
    dr.make_opaque(si)
    u = np.random.default_rng(1).random((3, len(lanes)), dtype=np.float32)
    ctx = mi.BSDFContext()
    bs, weight = bsdf.sample(ctx, si, mi.Float(u[0]), mi.Point2f(mi.Float(u[1]), mi.Float(u[2])))
    wo = mi.warp.square_to_uniform_hemisphere(mi.Point2f(mi.Float(u[1]), mi.Float(u[0])))
    at_sample, pdf = bsdf.eval_pdf(ctx, si, bs.wo)
    values = {
        "weight": weight,
        "sampled pdf": bs.pdf,
        "value": bsdf.eval_pdf(ctx, si, wo)[0],
        "value at sample": at_sample,
        "pdf": pdf,
    }
    if mi.is_polarized:
        values = {k: v[0, 0] if isinstance(v, mi.Spectrum) else v for k, v in values.items()}
    dr.eval(values)
    for name, value in values.items():
        if (fault := fault_of(np.array(value))) is not None:
            return f"{name} {fault}"
    return "used"


def judged_picture(integrator: Any) -> str:
    """Whether the picture that an integrator renders is finite and not negative."""
    import mitsuba as mi

    sensor = {
        "type": "perspective",
        "to_world": mi.ScalarTransform4f().look_at([0, 1, 3], [0, 0, 0], [0, 1, 0]),
        "film": {"type": "hdrfilm", "width": 8, "height": 8},
    }
    scene = mi.load_dict(
        {
            "type": "scene",
            "integrator": integrator,
            "sensor": sensor,
            "plate": {"type": "rectangle", "bsdf": base("glint_elements")},
            "lamp": {"type": "sphere", "center": [0, 1, 2], "radius": 0.1,
                     "emitter": {"type": "area", "radiance": 10.0}},
            "sky": {"type": "constant"},
        }
    )  # fmt: skip
    fault = fault_of(np.array(mi.render(scene, spp=4)))
    return "used" if fault is None else f"the picture {fault}"


def fault_of(values: np.ndarray) -> str | None:
    """What is wrong with numbers that must be finite and not negative."""
    if not np.isfinite(values).all():
        return "is not finite"
    return "is negative" if (values < 0).any() else None


# --------------------------------------------------------------------------------------------------
#  Many cases
# --------------------------------------------------------------------------------------------------


@dataclass
class Report:
    """Outcomes of many cases.

    Attributes:
        counts: number of cases with each good outcome, and with "fault".
        faults: the cases that are faults, in words, with their outcomes.
        slowest: seconds of processor time of the slowest case, and the case.
    """

    counts: dict[str, int] = field(default_factory=Counter)
    faults: list[tuple[str, str]] = field(default_factory=list)
    slowest: tuple[float, str] = (0.0, "")

    def add(self, case: Case, result: str, seconds: float = 0.0) -> None:
        """Count the outcome of a case."""
        good = result in GOOD
        faults = [] if good else [(str(case), result)]
        self.include(Report({result if good else "fault": 1}, faults, (seconds, str(case))))

    def include(self, other: Report) -> None:
        """Enter all that another report has."""
        self.counts = Counter(self.counts) + Counter(other.counts)
        self.faults = [*self.faults, *other.faults]
        self.slowest = max(self.slowest, tuple(other.slowest))

    @property
    def cases(self) -> int:
        """How many cases are in."""
        return sum(self.counts.values())

    def __str__(self) -> str:
        counts = ", ".join(f"{count} {name}" for name, count in sorted(self.counts.items()))
        lines = [f"{self.cases} cases: {counts or 'none'}"]
        lines += [f"{case}\n    {result}" for case, result in self.faults]
        return "\n".join([*lines, f"slowest: {self.slowest[0]:.1f} s, {self.slowest[1]}"])


def fuzz(
    count: int,
    seed: int = 0,
    variant: str = "llvm_ad_rgb",
    workers: int = 1,
    plugins: tuple[str, ...] = (),
    report: Callable[[float], None] = lambda fraction: None,
) -> Report:
    """Run ``count`` cases in ``workers`` separate processes. The death of a process is an outcome.

    ``plugins`` as in :func:`cases`; ``report`` is called with the fraction that is done.
    """
    context = multiprocessing.get_context("spawn")
    result = Report()
    waiting = list(range(count))[::-1]
    running: dict = {}
    every = None

    def start() -> None:
        mine, others = context.Pipe()
        process = context.Process(
            target=_work, args=(others, seed, count, variant, plugins), daemon=True
        )
        process.start()
        others.close()
        running[mine] = [process, None, (0.0, 0.0)]

    def give(connection) -> None:
        if waiting:
            now = processor_time(running[connection][0].pid), time.monotonic()
            running[connection][1:] = [waiting.pop(), now]
            connection.send(running[connection][1])
        else:
            connection.send(None)
            running.pop(connection)[0].join()

    for _ in range(max(1, workers)):
        start()
    every = _known_cases(seed, count, variant, plugins)
    while running:
        ready = wait(list(running), timeout=1.0)
        for connection, (process, index, since) in list(running.items()):
            if connection not in ready:
                continue
            try:
                message = connection.recv()
            except EOFError:
                process.join()
                if index is not None:
                    result.add(every[index], f"the process ended with {process.exitcode}")
                del running[connection]
                if waiting:
                    start()
                continue
            if index is not None:
                result.add(every[index], message, processor_time(process.pid) - since[0])
                report(result.cases / count)
            give(connection)
        for connection, (process, index, since) in list(running.items()):
            if index is not None and is_endless(process.pid, since):
                process.kill()
                process.join()
                result.add(every[index], f"no end after {PATIENCE:.0f} s", PATIENCE)
                del running[connection]
                if waiting:
                    start()
    return result


def processor_time(pid: int) -> float:
    """Seconds of processor time that a process has had; 0 where the system does not tell."""
    try:
        fields = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()
    except OSError:
        return 0.0
    return (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK")


def is_endless(pid: int, since: tuple[float, float]) -> bool:
    """Whether a case takes too long that began at a processor time and at a time of the clock."""
    used, passed = processor_time(pid) - since[0], time.monotonic() - since[1]
    return used > PATIENCE or passed > CLOCK * PATIENCE


def _known_cases(seed: int, count: int, variant: str, plugins: tuple[str, ...]) -> list[Case]:
    _activate(variant)
    return list(cases(seed, count, plugins))


def _activate(variant: str) -> None:
    import glintbsdf  # noqa: F401  (names the LLVM library before a variant is chosen)

    import mitsuba as mi  # isort: skip

    if mi.variant() != variant:
        mi.set_variant(variant)


def _hide_warnings() -> None:
    """Show only errors in Mitsuba's log of this process."""
    import mitsuba as mi

    mi.set_log_level(mi.LogLevel.Error)


def _work(connection, seed: int, count: int, variant: str, plugins: tuple[str, ...]) -> None:
    """A worker process: it receives indices of cases and sends outcomes. Its first message says
    that it is ready."""
    every = _known_cases(seed, count, variant, plugins)
    _hide_warnings()
    connection.send("ready")
    while (index := connection.recv()) is not None:
        connection.send(outcome(every[index]))
