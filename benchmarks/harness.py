"""The harness of all commands: alternating timings, storage of measured units, tables, options.

A command is a family of parts, which are functions of a :class:`Run`. A part measures the rows of a
:class:`Table`. With ``-o``, each row is stored as a unit of a :class:`Store`, so that a command
that was interrupted continues there.
"""

from __future__ import annotations

import hashlib
import inspect
import json
import os
import platform
import subprocess
import sys
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from importlib.metadata import version
from pathlib import Path

import click
import drjit as dr
import mitsuba as mi
import numpy as np
import rich.table
from rich.console import Console
from rich.live import Live

import glintbsdf
from glintbsdf import NormalMap
from glintbsdf.scene.rendering import replacing

ROOT = Path(__file__).parents[1]

# --------------------------------------------------------------------------------------------------
#  Times
# --------------------------------------------------------------------------------------------------


def timed(action: Callable) -> tuple:
    """Return the evaluated result of an action, and the seconds that it took."""
    dr.sync_thread()
    start = time.perf_counter()
    result = action()
    dr.eval(result)
    dr.sync_thread()
    return result, time.perf_counter() - start


def seconds(work: Callable, *arguments: object) -> float:
    """Wall-clock seconds until the result of ``work(*arguments)`` is evaluated."""
    return timed(lambda: work(*arguments))[1]


def seconds_in_turn(works: Sequence[Callable], repetitions: int) -> np.ndarray:
    """Times (repetitions, works). All works run in turn within each repetition.

    So ratios can be taken within a repetition, and other work of the machine affects all alike.
    Each work is called with the number of the repetition, from 1, as a seed. The caller must have
    called every work once before, as the first call compiles.
    """
    return np.array([[seconds(work, k) for work in works] for k in range(1, repetitions + 1)])


def ratios_to_first(times: np.ndarray) -> np.ndarray:
    """Median over repetitions of the ratio of each work to the first one within the repetition."""
    return np.median(times / times[:, :1], axis=0)


def rmse(image: np.ndarray, reference: np.ndarray) -> float:
    """Root mean square difference."""
    return float(np.sqrt(np.mean((image - reference) ** 2)))


@contextmanager
def single_thread() -> Iterator[None]:
    """A context in which Dr.Jit computes in one thread."""
    threads = dr.thread_count()
    dr.set_thread_count(1)
    try:
        yield
    finally:
        dr.set_thread_count(threads)


# --------------------------------------------------------------------------------------------------
#  Units on disk
# --------------------------------------------------------------------------------------------------

_TEXT = "__json__"


class Store:
    """Measured units in a folder; ``context`` is everything that all of them depend on.

    A unit is one file, whose name is a hash of the context and of the unit's key. A file is
    complete or does not exist.
    """

    def __init__(self, folder: Path, context: dict) -> None:
        self.folder, self.context = folder, context
        folder.mkdir(parents=True, exist_ok=True)

    def path(self, key: dict) -> Path:
        """The file of a unit."""
        text = json.dumps([self.context, key], sort_keys=True, default=str)
        return self.folder / f"{hashlib.blake2b(text.encode(), digest_size=12).hexdigest()}.npz"

    def get(self, key: dict, measure: Callable[[], tuple[object, dict[str, np.ndarray]]]) -> tuple:
        """``(values, arrays)`` of a unit, from the store, or measured now and stored."""
        path = self.path(key)
        if not path.exists():
            values, arrays = measure()
            text = np.array(json.dumps(values))
            with replacing(path) as temporary, temporary.open("wb") as file:
                np.savez_compressed(file, **{_TEXT: text}, **arrays)
        with np.load(path, allow_pickle=False) as file:
            arrays = {name: file[name] for name in file.files}
        return json.loads(str(arrays.pop(_TEXT))), arrays


def machine(*modules: str) -> dict:
    """Describe the machine and the software; ``modules`` are further files that measure."""
    return {
        "processor": _processor(),
        "cores": os.cpu_count(),
        "threads": dr.thread_count(),
        "system": platform.platform(),
        "python": platform.python_version(),
        "mitsuba": mi.__version__,
        "drjit": dr.__version__,
        "llvm": ".".join(map(str, dr.detail.llvm_version())),
        "numpy": np.__version__,
        "scipy": version("scipy"),
        "variant": mi.variant(),
        "glintbsdf": glintbsdf.__version__,
        "commit": _commit(),
        "source": source_hash(*modules),
    }


def open_store(folder: Path, *modules: str) -> Store:
    """The store in a folder, for this machine and this source; the commit does not count."""
    context = machine(*modules)
    del context["commit"]
    return Store(folder / "measured", context)


def source_hash(*modules: str) -> str:
    """Hash the source of the package, of the measuring benchmarks, and of ``modules``."""
    measuring = ("src/**/*.py", "plugins/*.py", "benchmarks/*.py", "benchmarks/measures/*.py")
    paths = {path for pattern in measuring for path in ROOT.glob(pattern)}
    digest = hashlib.blake2b(digest_size=8)
    for path in sorted(paths | {Path(module) for module in modules}):
        digest.update(path.read_bytes())
    return digest.hexdigest()


def _processor() -> str:
    if sys.platform == "linux":
        for line in Path("/proc/cpuinfo").read_text().splitlines():
            if line.startswith("model name"):
                return line.split(":", 1)[1].strip()
    return platform.processor() or platform.machine()


def _commit() -> str | None:
    """The current commit, with a + if files have changed since; None outside of git."""
    try:
        command = ["git", "-C", str(ROOT), "describe", "--always", "--dirty=+"]
        return subprocess.run(command, capture_output=True, text=True, check=True).stdout.strip()
    except (OSError, subprocess.CalledProcessError):
        return None


# --------------------------------------------------------------------------------------------------
#  Tables
# --------------------------------------------------------------------------------------------------


def new_console() -> Console:
    """A console for tables; a file has no width of its own."""
    console = Console()
    return console if console.is_terminal else Console(width=170)


@dataclass
class Run:
    """One run of a command: its options and results.

    ``maps`` are maps from files, by name; ``only`` is a text that the label of each row must have;
    ``store`` and ``output`` are None if nothing is stored.
    """

    quick: bool = False
    repetitions: int = 3
    only: str = ""
    maps: dict[str, NormalMap] = field(default_factory=dict)
    output: Path | None = None
    store: Store | None = None
    console: Console = field(default_factory=new_console)
    results: dict[str, list[dict]] = field(default_factory=dict)

    @contextmanager
    def table(self, name: str) -> Iterator[Table]:
        """A table that a terminal shows while rows are measured, and a log at the end."""
        table = Table(self, name)
        self.results[name] = table.rows
        if self.console.is_terminal:
            with Live(console=self.console, auto_refresh=False) as table.live:
                yield table
            return
        try:
            yield table
        finally:
            self.console.print(table.shown())

    def save_pictures(self, name: str, rows: list[list[np.ndarray]]) -> None:
        """Write a table of images of equal size, each (H, W) or (H, W, 3), linear, as a PNG."""
        if self.output is None:
            return
        cells = [
            [np.broadcast_to(np.atleast_3d(x), (*x.shape[:2], 3)) for x in row] for row in rows
        ]
        sheet = np.concatenate([np.concatenate(row, 1) for row in cells], 0).astype(np.float32)
        bitmap = mi.Bitmap(sheet).convert(mi.Bitmap.PixelFormat.RGB, mi.Struct.Type.UInt8, True)
        bitmap.write(str(self.output / f"{name.replace(' ', '-')}.png"))


class Table:
    """Rows of one part of a command. Each is a dictionary, and each of its keys a column."""

    def __init__(self, run: Run, name: str) -> None:
        self.run, self.name, self.live = run, name, None
        self.rows: list[dict] = []

    def measure(self, key: dict, work: Callable[[], dict | list[dict]]) -> list[dict]:
        """Add the rows of one unit, and return them. ``work`` returns one dictionary or several.

        A row is ``key`` and such a dictionary. Rows that an earlier run has stored are not
        measured.
        """
        label = ", ".join(str(value) for value in (self.name, *key.values()))
        if self.run.only not in label:
            return []
        start = time.perf_counter()
        if self.run.store is None:
            found = work()
        else:
            unit = {"table": self.name, "quick": self.run.quick, **key}
            found, _ = self.run.store.get(unit, lambda: (work(), {}))
        rows = [key | row for row in (found if isinstance(found, list) else [found])]
        self.rows += rows
        if self.live is not None:
            self.live.update(self.shown(), refresh=True)
        else:
            click.echo(f"{label}: {time.perf_counter() - start:.1f} s", err=True)
        dr.flush_malloc_cache()
        return rows

    def shown(self) -> rich.table.Table:
        """The table to print; a row without a value in a column has a dash there."""
        table = rich.table.Table(title=self.name)
        columns = list(dict.fromkeys(key for row in self.rows for key in row))
        for column in columns:
            number = not any(isinstance(row.get(column), str) for row in self.rows)
            table.add_column(column.replace("_", " "), justify="right" if number else "left")
        for row in self.rows:
            table.add_row(*(_text(row.get(column)) for column in columns))
        return table


def _text(value: object) -> str:
    """A value as tables show it."""
    if value is None:
        return "–"
    return f"{value:.4g}" if isinstance(value, float) else str(value)


# --------------------------------------------------------------------------------------------------
#  Commands
# --------------------------------------------------------------------------------------------------

VARIANT = click.Option(
    ["-m", "--variant"], default="llvm_ad_rgb", show_default=True, help="Mitsuba variant."
)


def output_option(required: bool = False) -> click.Option:
    """The folder that results go to."""
    return click.Option(
        ["-o", "--output"],
        required=required,
        type=click.Path(file_okay=False, path_type=Path),
        metavar="DIR",
        help="Folder for results, images, and measured units.",
    )


#: Options of every family.
SHARED = (
    click.Option(["--quick"], is_flag=True, help="Fewer and smaller cases."),
    click.Option(["--only"], default="", metavar="TEXT", help="Only rows whose name has this."),
    click.Option(["--map", "maps"], multiple=True, metavar="FILE", help="A further map."),
    click.Option(
        ["--repetitions"], type=click.IntRange(1), default=3, show_default=True, help="Of timings."
    ),
    output_option(),
    VARIANT,
)


def family(name: str, *parts: Callable[[Run], None]) -> click.Command:
    """A command that runs all ``parts``, or the ones that are named.

    Its help consists of the docstrings of the parts' module and of the parts.
    """
    named = {part.__name__: part for part in parts}
    module = sys.modules[parts[0].__module__]

    def command(
        chosen: tuple[str, ...],
        quick: bool,
        only: str,
        maps: tuple[str, ...],
        repetitions: int,
        output: Path | None,
        variant: str,
    ) -> None:
        mi.set_variant(variant)
        dr.set_thread_count(max(2, dr.thread_count()))  # Mitsuba hangs with one
        given = {Path(path).stem: NormalMap.load(path) for path in maps}
        store = None
        if output is not None:
            store = open_store(output, module.__file__)
            store.context["maps"] = {name: a_map.content_hash for name, a_map in given.items()}
        run = Run(quick, repetitions, only, given, output, store)
        try:
            for part in (named[part] for part in chosen or named):
                part(run)
        finally:
            if output is not None:
                about = {"machine": machine(module.__file__), "quick": quick}
                with replacing(output / f"{name}.json") as path:
                    path.write_text(json.dumps(about | run.results, indent=1) + "\n")

    texts = [module.__doc__, *(f"{part}: {inspect.getdoc(f)}" for part, f in named.items())]
    argument = click.Argument(
        ["chosen"], nargs=-1, type=click.Choice(list(named)), metavar="[PART]..."
    )
    return click.Command(
        name,
        callback=command,
        params=[argument, *SHARED],
        help="\n\n".join(texts),
        short_help=module.__doc__.splitlines()[0],
    )
