"""How an image is made: where, for how long, and what is kept meanwhile.

These are the options of all commands that render, and the work that they ask for.
"""

from __future__ import annotations

import importlib.util
import re
import sys
import time
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING

import click

from glintbsdf.core.progress import progress
from glintbsdf.scene import inspection, rendering
from glintbsdf.scene.image import Image
from glintbsdf.scene.package import Job, Package, inputs
from glintbsdf.scene.storage import Checkpoint

if TYPE_CHECKING:
    from glintbsdf.scene.cluster import Cluster

#: Seconds between two live pictures.
LIVE_INTERVAL = 5.0

_UNITS = {"": 1, "s": 1, "m": 60, "h": 3600, "d": 86400}
_file = click.Path(exists=True, dir_okay=False, path_type=Path)


@dataclass(frozen=True)
class Making:
    """What the options of :func:`options` say."""

    workers: int | None
    memory_limit: str
    scheduler: str | None
    tls_ca_file: Path | None
    tls_cert: Path | None
    tls_key: Path | None
    checkpoint: Path | None
    until_error: float | None
    time_limit: float | None
    live: Path | None

    def __post_init__(self) -> None:
        if self.workers is not None and self.scheduler is not None:
            raise click.UsageError("--workers starts its own scheduler: it excludes --scheduler.")
        tls = (self.tls_ca_file, self.tls_cert, self.tls_key)
        if any(tls) and not all(tls):
            raise click.UsageError("TLS needs all of --tls-ca-file, --tls-cert and --tls-key.")
        if any(tls) and self.scheduler is None:
            raise click.UsageError("TLS is for --scheduler.")

    def of_frame(self, index: int) -> Making:
        """The same for a frame of a sequence, with a checkpoint of its own."""
        if self.checkpoint is None:
            return self
        return replace(self, checkpoint=self.checkpoint / f"frame-{index:06}")

    @contextmanager
    def cluster(self, variant: str) -> Iterator[Cluster | None]:
        """The processes that render, or None where it is this one."""
        if self.workers is None and self.scheduler is None:
            yield None
            return
        if importlib.util.find_spec("distributed") is None:
            raise click.ClickException(
                "many processes need Dask; install it with: "
                f'{sys.executable} -m pip install "dask[distributed]"'
            )
        from glintbsdf.scene.cluster import Cluster, Keys

        if self.workers is not None:
            cluster = Cluster.local(self.workers, self.memory_limit, variant, _tell)
        elif self.scheduler is not None:
            keys = None
            if self.tls_ca_file and self.tls_cert and self.tls_key:
                keys = Keys(self.tls_ca_file, self.tls_cert, self.tls_key)
            cluster = Cluster.at(self.scheduler, keys, _tell)
        with cluster:
            yield cluster


def _tell(message: str) -> None:
    click.echo(f"Note: {message.rstrip(chr(46))}.", err=True)


def _parse_duration(
    _context: click.Context, _parameter: click.Parameter, value: str | None
) -> float | None:
    """Seconds of ``90``, ``90s``, ``15m``, ``2h`` or ``1.5d``."""
    if value is None:
        return None
    match = re.fullmatch(r"(\d+(?:\.\d+)?)([smhd]?)", value.strip())
    if not match or float(match[1]) == 0:
        raise click.BadParameter(f'must be a time such as 90s, 15m or 2h (got "{value}")')
    return float(match[1]) * _UNITS[match[2]]


def parse_image(
    _context: click.Context, _parameter: click.Parameter, path: Path | None
) -> Path | None:
    """Accept only names of image files that can be written."""
    if path is not None:
        check_image(path)
    return path


def check_image(path: Path) -> None:
    """Raise ``click.BadParameter`` unless an image file of this name can be written."""
    if path.suffix.lower() not in rendering.FORMATS:
        allowed = " or ".join(rendering.FORMATS)
        raise click.BadParameter(f'must end in {allowed} (got "{path}")')


def _parse_memory(_context: click.Context, _parameter: click.Parameter, value: str) -> str:
    if value != "auto" and not re.fullmatch(r"\d+(\.\d+)? ?[kMGT]?i?B", value):
        raise click.BadParameter(f'must be auto or an amount such as 4GB (got "{value}")')
    return value


def options(command):
    """Add the options of :class:`Making` to a command."""
    for option in reversed(
        [
            click.option(
                "--workers",
                type=click.IntRange(min=1),
                metavar="N",
                help="Render in N processes, which share the cores of this machine. The image is "
                "the same to the last bit.",
            ),
            click.option(
                "--memory-limit",
                default="auto",
                show_default=True,
                callback=_parse_memory,
                metavar="BYTES",
                help="Of each of these processes, such as 4GB.",
            ),
            click.option(
                "--scheduler",
                metavar="ADDRESS",
                help="Render on the workers of the Dask scheduler at ADDRESS, such as "
                "tcp://host:8786.",
            ),
            click.option("--tls-ca-file", type=_file, help="For a scheduler at tls://."),
            click.option("--tls-cert", type=_file, help="The client's certificate."),
            click.option("--tls-key", type=_file, help="The client's private key."),
            click.option(
                "--checkpoint",
                type=click.Path(file_okay=False, path_type=Path),
                metavar="DIR",
                help="Keep what is done in DIR. The same command goes on from there, whatever "
                "ended it.",
            ),
            click.option(
                "--until-error",
                type=click.FloatRange(min=0, min_open=True),
                metavar="X",
                help="End when the noise of the image, the standard error of its pixels over their "
                "mean, is below X.",
            ),
            click.option(
                "--time-limit",
                callback=_parse_duration,
                metavar="TIME",
                help="End after TIME, such as 90s, 15m or 2h, with what is done then.",
            ),
            click.option(
                "--live",
                type=click.Path(path_type=Path),
                callback=parse_image,
                metavar="FILE",
                help="Image of what is done so far, .exr or .png, written every five seconds.",
            ),
        ]
    ):
        command = option(command)
    return command


@dataclass(frozen=True)
class Subject:
    """What is to be rendered."""

    scene: Path
    definitions: Mapping[str, str]
    variant: str
    spp: int | None
    seed: int
    denoise: bool
    trim: bool
    sensor: str = ""

    def refuse_as_output(self, path: Path | None) -> None:
        """Refuse to write over a file that the scene is made of.

        Raises:
            click.ClickException: names the file.
        """
        if path is None or not path.exists():
            return
        documents, files = inputs(self.scene, self.definitions)
        if path.resolve() in {file.resolve() for file in (*documents, *files.values())}:
            raise click.ClickException(f"{path} is a file of the scene: name another with -o")


def make(
    subject: Subject, path: Path, making: Making, cluster: Cluster | None, label: str = "Rendering"
) -> rendering.Picture:
    """Render an image to a file.

    Raises:
        click.ClickException: Ctrl-C; the file has what was done.
    """
    trimmed = None
    for output in (path, making.live):
        subject.refuse_as_output(output)
    with rendering.replacing(path) as unfinished:
        # Plugins show the progress of what they build while the scene loads. For a cluster nothing
        # is built here: the scene then serves to plan and to develop the image.
        if cluster or subject.trim:
            inspected = inspection.load(subject.scene, subject.definitions)
            loaded = inspected.scene
            if not cluster:
                trimmed = inspection.Trimmed(inspected, subject.spp, subject.sensor)
        else:
            loaded = rendering.load_scene(subject.scene, subject.definitions)
        missed = trimmed.missed if trimmed else lambda: False
        if not subject.sensor and len(loaded.sensors()) > 1:
            sensors = rendering.listed(loaded.sensors())
            _tell(f"of the sensors {sensors} the first is rendered, -s names another")
        with (
            rendering.Renderer(
                loaded, subject.spp, subject.denoise, missed, subject.sensor
            ) as renderer,
            progress(label if cluster is None else f"{label} by {cluster}") as report,
        ):
            picture, interrupted = _produce(subject, renderer, making, cluster, report)
        rendering.save(picture.bitmap, unfinished)
    if trimmed and not trimmed.sufficed:
        _tell("trimmed structures did not suffice: built in full")
    click.echo(path)
    share = f"{100 * picture.fraction:.3g} % of the samples"
    if interrupted:
        raise click.ClickException(f"interrupted: {path} has {share}")
    noise = "unknown" if picture.noise is None else f"{picture.noise:.3g}"
    if picture.fraction < 1 or making.until_error is not None:
        click.echo(f"{share}, noise {noise}", err=True)
    return picture


def _produce(
    subject: Subject,
    renderer: rendering.Renderer,
    making: Making,
    cluster: Cluster | None,
    report,
) -> tuple[rendering.Picture, bool]:
    """An image, or what was done of it when Ctrl-C came, and whether it came."""
    checkpoint = render_all = None
    if cluster or making.checkpoint:
        package = Package.of(subject.scene, subject.definitions)
        job = Job(
            package,
            subject.variant,
            renderer.spp,
            subject.seed,
            subject.denoise,
            subject.trim,
            subject.sensor,
        )
        if making.checkpoint:
            checkpoint = Checkpoint(making.checkpoint, job.description())
        if cluster:
            render_all = cluster.render_all(job)
    shown = time.monotonic()

    def observe(image: Image) -> None:
        nonlocal shown
        report(image.fraction)
        if making.live and time.monotonic() - shown > LIVE_INTERVAL:
            with rendering.replacing(making.live) as unfinished:
                rendering.save(rendering.picture(renderer, image).bitmap, unfinished)
            shown = time.monotonic()

    try:
        picture = rendering.produce(
            renderer,
            subject.seed,
            render_all,
            checkpoint,
            making.until_error,
            making.time_limit,
            observe,
        )
        return picture, False
    except rendering.Interrupted as interrupt:
        return interrupt.picture, True
