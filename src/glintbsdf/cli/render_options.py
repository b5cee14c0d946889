"""Options of all commands that render images, and the rendering of an image with them."""

from __future__ import annotations

import importlib.util
import re
import sys
import time
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from glintbsdf.core.progress import progress
from glintbsdf.scene import estimation, inspection, rendering
from glintbsdf.scene.image import Image
from glintbsdf.scene.package import Job, Package, inputs
from glintbsdf.scene.storage import Checkpoint

if TYPE_CHECKING:
    from glintbsdf.scene.cluster import Cluster

#: Seconds from one live image to the next.
LIVE_INTERVAL = 5.0

_UNITS = {"": 1, "s": 1, "m": 60, "h": 3600, "d": 86400}
_file = click.Path(exists=True, dir_okay=False, path_type=Path)


@dataclass(frozen=True)
class RenderOptions:
    """Values of the options that :func:`options` adds to a command."""

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

    def of_frame(self, index: int) -> RenderOptions:
        """The options for a frame of a sequence, which has its own checkpoint."""
        if self.checkpoint is None:
            return self
        return replace(self, checkpoint=self.checkpoint / f"frame-{index:06}")

    @contextmanager
    def cluster(self, variant: str) -> Iterator[Cluster | None]:
        """A context with the processes that render; None if this process renders."""
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
    """Seconds, from a text such as ``90``, ``90s``, ``15m``, ``2h`` or ``1.5d``."""
    if value is None:
        return None
    match = re.fullmatch(r"(\d+(?:\.\d+)?)([smhd]?)", value.strip())
    if not match or float(match[1]) == 0:
        raise click.BadParameter(f'must be a time such as 90s, 15m or 2h (got "{value}")')
    return float(match[1]) * _UNITS[match[2]]


def parse_image(
    _context: click.Context, _parameter: click.Parameter, path: Path | None
) -> Path | None:
    """Refuse names of files whose format cannot be written."""
    if path is not None:
        check_image(path)
    return path


def check_image(path: Path) -> None:
    """Raise ``click.BadParameter`` unless the suffix is a format that can be written."""
    if path.suffix.lower() not in rendering.FORMATS:
        allowed = " or ".join(rendering.FORMATS)
        raise click.BadParameter(f'must end in {allowed} (got "{path}")')


def image_option(*names: str, help: str, **settings: Any):
    """An option that names an image file to write."""
    path = click.Path(path_type=Path)
    return click.option(*names, type=path, callback=parse_image, help=help, **settings)


def _parse_memory(_context: click.Context, _parameter: click.Parameter, value: str) -> str:
    if value != "auto" and not re.fullmatch(r"\d+(\.\d+)? ?[kMGT]?i?B", value):
        raise click.BadParameter(f'must be auto or an amount such as 4GB (got "{value}")')
    return value


def options(command):
    """Add the options of :class:`RenderOptions` to a command."""
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
                help="Memory of each of these processes, such as 4GB.",
            ),
            click.option(
                "--scheduler",
                metavar="ADDRESS",
                help="Render on the workers of the Dask scheduler at ADDRESS, such as "
                "tcp://host:8786.",
            ),
            click.option(
                "--tls-ca-file",
                type=_file,
                help="Certificate of the authority, for a scheduler at tls://.",
            ),
            click.option("--tls-cert", type=_file, help="The client's certificate."),
            click.option("--tls-key", type=_file, help="The client's private key."),
            click.option(
                "--checkpoint",
                type=click.Path(file_okay=False, path_type=Path),
                metavar="DIR",
                help="Keep finished parts of the image in DIR. After an interruption of any kind, "
                "the same command continues with these.",
            ),
            click.option(
                "--until-error",
                type=click.FloatRange(min=0, min_open=True),
                metavar="X",
                help="Stop when the noise of the image, the standard error of its pixels over "
                "their mean, is below X.",
            ),
            click.option(
                "--time-limit",
                callback=_parse_duration,
                metavar="TIME",
                help="Stop after TIME, such as 90s, 15m or 2h, and write the image so far.",
            ),
            image_option(
                "--live",
                metavar="FILE",
                help="Write the image so far to FILE, .exr or .png, every five seconds.",
            ),
        ]
    ):
        command = option(command)
    return command


@dataclass(frozen=True)
class ImageRequest:
    """The image to render."""

    scene: Path
    definitions: Mapping[str, str]
    variant: str
    spp: int | None
    seed: int
    denoise: bool
    trim: bool
    keep_integrator: bool
    sensor: str = ""

    def with_glint_path(self) -> bool:
        """Whether to render with ``glint_path`` in place of the scene's integrator, which this
        tells."""
        return replaces_integrator(self.scene, self.definitions, self.keep_integrator)

    def refuse_as_output(self, path: Path | None) -> None:
        """Refuse to overwrite a file of the scene.

        Raises:
            click.ClickException: ``path`` is a file of the scene.
        """
        if path is None or not path.exists():
            return
        documents, files = inputs(self.scene, self.definitions)
        if path.resolve() in {file.resolve() for file in (*documents, *files.values())}:
            raise click.ClickException(f"{path} is a file of the scene: name another with -o")


def replaces_integrator(scene: Path, definitions: Mapping[str, str], keep: bool) -> bool:
    """Whether ``glint_path`` takes the place of the scene's integrator, unless it is to ``keep``
    its own. A note tells so."""
    replaced = [] if keep else rendering.integrators_to_replace(scene, definitions)
    for name in replaced:
        _tell(
            f'"glint_path" renders in place of the integrator "{name}", whose noise on glints is '
            "larger; --keep-integrator keeps it"
        )
    return bool(replaced)


def render_to_file(
    request: ImageRequest,
    path: Path,
    how: RenderOptions,
    cluster: Cluster | None,
    label: str = "Rendering",
) -> rendering.Picture:
    """Render an image to a file.

    Raises:
        click.ClickException: Ctrl-C came; the file has the image so far.
    """
    trimmed = None
    for output in (path, how.live):
        request.refuse_as_output(output)
    with rendering.replacing(path) as unfinished:
        glint_path = request.with_glint_path()
        # While the scene loads, plugins show the progress of their structures. With a cluster,
        # nothing is built here: the scene only serves to plan and to develop the image.
        if cluster or request.trim:
            inspected = inspection.load(request.scene, request.definitions, glint_path)
            loaded = inspected.scene
            if not cluster:
                trimmed = inspection.Trimmed(inspected, request.spp, request.sensor)
        else:
            loaded = rendering.load_scene(request.scene, request.definitions, glint_path=glint_path)
        missed = trimmed.missed if trimmed else lambda: False
        if not request.sensor and len(loaded.sensors()) > 1:
            sensors = rendering.listed(loaded.sensors())
            _tell(f"of the sensors {sensors} the first is rendered, -s names another")
        settings = (request.spp, request.denoise, missed, request.sensor)
        with rendering.Renderer(loaded, *settings) as renderer:
            estimate = None if cluster else estimation.estimate(renderer, request.seed)
            if estimate is not None and estimate.seconds > estimation.LONG:
                _tell(str(estimate))
            with progress(label if cluster is None else f"{label} by {cluster}") as report:
                picture, interrupted = _produce(request, renderer, how, cluster, report, glint_path)
        rendering.save(picture.bitmap, unfinished)
    if trimmed and not trimmed.sufficed:
        _tell("trimmed structures did not suffice: built in full")
    click.echo(path)
    share = f"{100 * picture.fraction:.3g} % of the samples"
    if interrupted:
        raise click.ClickException(f"interrupted: {path} has {share}")
    noise = "unknown" if picture.noise is None else f"{picture.noise:.3g}"
    if picture.fraction < 1 or how.until_error is not None:
        click.echo(f"{share}, noise {noise}", err=True)
    return picture


def _produce(
    request: ImageRequest,
    renderer: rendering.Renderer,
    how: RenderOptions,
    cluster: Cluster | None,
    report,
    glint_path: bool,
) -> tuple[rendering.Picture, bool]:
    """The image, or the finished part of it if Ctrl-C came; and whether it came."""
    checkpoint = render_all = None
    if cluster or how.checkpoint:
        package = Package.of(request.scene, request.definitions)
        job = Job(
            package,
            request.variant,
            renderer.spp,
            request.seed,
            request.denoise,
            request.trim,
            request.sensor,
            glint_path,
        )
        if how.checkpoint:
            checkpoint = Checkpoint(how.checkpoint, job.description())
        if cluster:
            render_all = cluster.render_all(job)
    shown = time.monotonic()

    def observe(image: Image) -> None:
        nonlocal shown
        report(image.fraction)
        if how.live and time.monotonic() - shown > LIVE_INTERVAL:
            with rendering.replacing(how.live) as unfinished:
                rendering.save(rendering.picture(renderer, image).bitmap, unfinished)
            shown = time.monotonic()

    try:
        picture = rendering.produce(
            renderer,
            request.seed,
            render_all,
            checkpoint,
            how.until_error,
            how.time_limit,
            observe,
        )
        return picture, False
    except rendering.Interrupted as interrupt:
        return interrupt.picture, True
