"""Render a scene file to an image file: it sets footprints from the sensor, renders units, and
writes complete files only."""

from __future__ import annotations

import os
import shutil
import tempfile
from collections.abc import Callable, Iterator, Mapping
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from pathlib import Path

import drjit as dr
import mitsuba as mi
import numpy as np

from glintbsdf.bridge.filter_sampling import SharedFilter
from glintbsdf.bridge.registration import bsdf_types
from glintbsdf.core.garbage import collect_former_scenes
from glintbsdf.core.interruption import interruptible
from glintbsdf.scene import passes
from glintbsdf.scene.denoising import denoised, guided
from glintbsdf.scene.image import Image
from glintbsdf.scene.merging import Results, merge
from glintbsdf.scene.passes import Tile
from glintbsdf.scene.storage import Checkpoint
from glintbsdf.scene.units import Plan, Unit

FORMATS = (".exr", ".png")


# ---------------------------------------------------------------------------------------------
#  Scene
# ---------------------------------------------------------------------------------------------


def load_scene(
    filename: str | Path,
    parameters: Mapping[str, str] | None = None,
    deferred: bool = False,
    files: Mapping[str, str] | None = None,
    glint_path: bool = False,
) -> mi.Scene:
    """Load a scene from XML.

    Dr.Jit gets a second thread if it has only one, as Mitsuba hangs when it reads an OpenEXR file
    with one thread.

    Args:
        filename: the XML file.
        parameters: values for the scene's ``$key``, in place of its ``<default>``.
        deferred: whether glint BSDFs build nothing yet. :func:`glint_bsdfs` finds them, and their
            ``build`` must be called for the queries that the scene needs.
        files: paths of files, by the names that the scene has for them.
        glint_path: whether the integrator ``glint_path`` takes the place of those that
            :func:`replaceable` finds.
    """
    collect_former_scenes()
    if dr.thread_count() < 2:
        dr.set_thread_count(2)
    parameters = dict(parameters or {})
    if not deferred and not files and not glint_path:
        # The stubs cannot know the names of a scene's parameters.
        return mi.load_file(str(filename), **parameters)  # type: ignore[arg-type]
    config = mi.parser.ParserConfig(mi.variant() or "")
    with folder_of_files(Path(filename).resolve().parent):
        state = mi.parser.parse_file(config, str(filename), **parameters)
        for node, key, value in strings(state):
            if files and value in files:
                node.props[key] = files[value]
        mi.parser.transform_all(config, state)
        for node in replaceable(state) if glint_path else ():
            replace_integrator(node)
        for node in state.nodes:
            if deferred and node.props.plugin_name() in DEFERRABLE:
                node.props["deferred"] = True
        scene = mi.parser.instantiate(config, state)
    if isinstance(scene, mi.Scene):
        return scene
    return scene[0]  # type: ignore[index]  # a list, or a tuple: an object in the stubs


def strings(state: mi.parser.ParserState) -> Iterator[tuple[mi.parser.SceneNode, str, str]]:
    """All string properties of a parsed scene: node, name and value."""
    for node in state.nodes:
        for key in list(node.props.keys()):
            value = node.props[key]
            if isinstance(value, str):
                yield node, key, value


#: Mitsuba's integrators whose place ``glint_path`` can take.
REPLACEABLE = ("path", "direct")

#: Parameters of these integrators that ``glint_path`` does not have: numbers of samples.
_NUMBERS_OF_SAMPLES = ("shading_samples", "emitter_samples", "bsdf_samples")


def replaceable(state: mi.parser.ParserState) -> list[mi.parser.SceneNode]:
    """The integrators of a parsed scene that :func:`replace_integrator` can replace; none in a
    scene without glint BSDFs."""
    types = [node.props.plugin_name() for node in state.nodes]
    if not bsdf_types() & set(types):
        return []
    return [node for node, kind in zip(state.nodes, types, strict=True) if kind in REPLACEABLE]


def replace_integrator(node: mi.parser.SceneNode) -> None:
    """Make a ``path`` or a ``direct`` a ``glint_path`` that estimates the same image."""
    if node.props.plugin_name() == "direct":
        for name in _NUMBERS_OF_SAMPLES:
            if name in node.props:
                del node.props[name]
        node.props["max_depth"] = 2
    node.props.set_plugin_name("glint_path")


def integrators_to_replace(
    filename: str | Path, parameters: Mapping[str, str] | None = None
) -> list[str]:
    """Types of the integrators of a scene's XML that ``glint_path`` can replace.

    Raises:
        RuntimeError: the XML cannot be read.
    """
    config = mi.parser.ParserConfig(mi.variant() or "")
    state = mi.parser.parse_file(config, str(filename), **dict(parameters or {}))
    return [node.props.plugin_name() for node in replaceable(state)]


#: Plugins that do not build their structures in a scene that is loaded ``deferred``.
DEFERRABLE = ("glint_diffuse", "glint_elements", "glint_filtered", "glint_manifold", "glint_mip")


@contextmanager
def folder_of_files(folder: Path) -> Iterator[None]:
    """A context in which files are searched in ``folder`` first, as ``mi.load_file`` does."""
    resolver = mi.file_resolver()  # type: ignore[operator]  # an object in the stubs
    before = [resolver[k] for k in range(len(resolver))]
    resolver.prepend(str(folder))
    try:
        yield
    finally:
        resolver.clear()
        for path in before:
            resolver.append(path)


def glint_bsdfs(scene: mi.Scene) -> list:
    """All BSDFs of this package in a scene, at any depth, each of them once."""
    from glintbsdf.bridge.bsdf import FootprintBSDF

    return [node for node in mi.traverse(scene).hierarchy if isinstance(node, FootprintBSDF)]


def pixel_spread(sensor: mi.Sensor, spp: int = 1) -> float:
    """The parameter ``pixel_spread`` for an image with ``spp`` samples per pixel, radians.

    It is the angle that a pixel subtends in the middle of the sensor's image, over √spp, as Mitsuba
    scales ray differentials. The angle is the geometric mean of both axes. It comes from the ray
    differentials of the sensor, so it holds for any projection and crop. Parallel projections have
    0.

    Raises:
        ValueError: ``spp`` is less than 1.
    """
    if spp < 1:
        raise ValueError(f"pixel_spread: spp must be a whole number ≥ 1 (got {spp})")
    middle = mi.Point2f(0.5)
    time, wavelength = mi.Float(0), mi.Float(0.5)
    ray, _ = sensor.sample_ray_differential(time, wavelength, middle, middle)  # type: ignore[arg-type]
    if not ray.has_differentials:
        return 0.0
    squared = dr.squared_norm(ray.d_x - ray.d) * dr.squared_norm(ray.d_y - ray.d)
    return float(np.asarray(dr.sqrt(dr.sqrt(squared))).item()) / spp**0.5


def chosen_sensor(scene: mi.Scene, which: str = "") -> mi.Sensor:
    """A sensor of the scene, by its number (from 0) or its id; by default the first one.

    Raises:
        ValueError: the scene has no sensor, or none of this number or id.
    """
    sensors = scene.sensors()
    if not sensors:
        raise ValueError("the scene has no sensor")
    if not which:
        return sensors[0]
    for number, sensor in enumerate(sensors):
        if which in (str(number), sensor.id()):
            return sensor
    raise ValueError(f'no sensor "{which}" among {listed(sensors)}')


def listed(sensors: list[mi.Sensor]) -> str:
    """A list of sensors in words, by number and id."""
    return ", ".join(f'{number} "{sensor.id()}"' for number, sensor in enumerate(sensors))


@contextmanager
def footprints(scene: mi.Scene, sensor: mi.Sensor, spp: int) -> Iterator[None]:
    """A context in which glint BSDFs have the footprint of an image with ``spp`` samples per pixel.

    A BSDF whose ``pixel_spread`` is 0 gets the sensor's pixel angle, scaled by 1/√spp as Mitsuba
    scales ray differentials. ``spp`` is the number of samples of the whole image, whatever its
    passes; integrators see the same number (:mod:`glintbsdf.scene.passes`).
    """
    parameters = mi.traverse(scene)
    parameters.keep([r".*pixel_spread$"])
    original = {key: mi.Float(parameters[key]) for key in parameters.keys()}
    spread = pixel_spread(sensor, spp)
    for key, own in original.items():
        parameters[key] = dr.select(own > 0, own, spread)
    parameters.update()
    try:
        yield
    finally:
        for key, own in original.items():
            parameters[key] = own
        parameters.update()


@contextmanager
def sharing(scene: mi.Scene, sensor: mi.Sensor, spp: int) -> Iterator[SharedFilter | None]:
    """A context in which the scene's ``glint_path`` gives footprints their share of the pixel's
    filter, for an image with ``spp`` samples per pixel, whatever its passes.

    Yields how to place samples; None if the scene has another integrator.
    """
    integrator = scene.integrator()
    if not hasattr(integrator, "sharing"):
        yield None
        return
    with integrator.sharing(scene, sensor.film(), spp) as shared:
        yield shared


# ---------------------------------------------------------------------------------------------
#  Image
# ---------------------------------------------------------------------------------------------


class Renderer:
    """Renders units of an image of a loaded scene; a context manager.

    Args:
        scene: the scene, whose BSDFs are built or trimmed.
        spp: samples per pixel of the whole image; None for the scene's own number. Mitsuba rounds
            it up if the sampler requires this.
        denoise: whether the image will be denoised, see :mod:`glintbsdf.scene.denoising`.
        missed: called after each unit. It returns whether the unit needed structures that were left
            out. They must exist after the call, and the unit is rendered again.
        which: the sensor, see :func:`chosen_sensor`.

    Raises:
        ValueError: there is no sensor, or a mesh lacks the UVs that its BSDF needs, or ``denoise``
            is set for an integrator other than ``glint_path``.
        ModuleNotFoundError: ``denoise`` is set, and no denoiser is installed.
    """

    def __init__(
        self,
        scene: mi.Scene,
        spp: int | None = None,
        denoise: bool = False,
        missed: Callable[[], bool] = lambda: False,
        which: str = "",
    ) -> None:
        self.scene, self.sensor = scene, chosen_sensor(scene, which)
        self.integrator = scene.integrator()
        self.denoise, self.missed = denoise, missed
        sampler = self.sensor.sampler().clone()
        if spp is not None:
            sampler.set_sample_count(spp)
        self.spp = int(sampler.sample_count())
        self.stratified = sampler.class_name() != "IndependentSampler"
        self._stack = ExitStack()

    def __enter__(self) -> Renderer:
        collect_former_scenes()
        self.shared = self._stack.enter_context(sharing(self.scene, self.sensor, self.spp))
        if self.denoise:
            self.integrator = self._stack.enter_context(guided(self.integrator))
        self._stack.enter_context(footprints(self.scene, self.sensor, self.spp))
        return self

    def __exit__(self, *error: object) -> None:
        self._stack.close()

    def plan(self, seed: int) -> Plan:
        """The plan of the image with this seed."""
        divisible = isinstance(self.integrator, mi.SamplingIntegrator)
        film = passes.whole(self.sensor.film())
        return Plan(film, self.spp, seed, self.stratified, divisible)

    def render(self, unit: Unit) -> tuple[Tile, np.ndarray]:
        """The pixels that the samples of a unit reach, and their sums.

        See :func:`~glintbsdf.scene.passes.sums_of_samples`.
        """
        while True:
            result = passes.sums_of_samples(
                self.scene,
                self.sensor,
                self.integrator,
                unit.tile,
                unit.spp,
                self.spp,
                unit.seed,
                self.shared,
            )
            if not self.missed():
                return result

    def render_all(self, units: Iterator[Unit]) -> Results:
        """Render units one after the other, in this process."""
        for unit in units:
            yield unit, *self.render(unit)

    def developed(self, sums: np.ndarray) -> mi.Bitmap:
        """The image from the sums (height, width, channels) of all its pixels."""
        bitmap = passes.developed(self.sensor.film(), self.integrator.aov_names(), sums)
        return denoised(bitmap) if self.denoise else bitmap


@dataclass(frozen=True)
class Picture:
    """A finished or unfinished image.

    Attributes:
        bitmap (mi.Bitmap): the image so far.
        fraction (float): fraction of the samples that it contains, in (0, 1].
        noise (float | None): see :attr:`.Image.noise`.
    """

    bitmap: mi.Bitmap
    fraction: float
    noise: float | None


class Interrupted(KeyboardInterrupt):
    """Ctrl-C came when a part of the image was done; ``picture`` is this part."""

    def __init__(self, picture: Picture) -> None:
        super().__init__()
        self.picture = picture


def produce(
    renderer: Renderer,
    seed: int = 0,
    render_all: Callable[[Iterator[Unit]], Results] | None = None,
    checkpoint: Checkpoint | None = None,
    until_noise: float | None = None,
    time_limit: float | None = None,
    observe: Callable[[Image], None] = lambda image: None,
) -> Picture:
    """Render the image with a seed.

    Args:
        renderer: plans and develops the image; its context must have been entered.
        seed: seed of the image.
        render_all: renders the units; by default ``renderer`` does. See :func:`.merge` for this
            and the other arguments.

    Raises:
        Interrupted: Ctrl-C came when a part of the image was done.
        KeyboardInterrupt: Ctrl-C came before any part was done.
    """
    image = Image(renderer.plan(seed), renderer.sensor.film().base_channels_count() + 1)
    try:
        with interruptible():
            merge(
                image,
                render_all or renderer.render_all,
                checkpoint,
                until_noise,
                time_limit,
                observe,
            )
    except KeyboardInterrupt as interrupt:
        if image.sums is None:
            raise
        raise Interrupted(picture(renderer, image)) from interrupt
    return picture(renderer, image)


def picture(renderer: Renderer, image: Image) -> Picture:
    """The finished part of an image.

    Raises:
        ValueError: no part is done.
    """
    if image.sums is None:
        raise ValueError("no unit of the image is done")
    return Picture(renderer.developed(image.sums), image.fraction, image.noise)


def render(
    scene: mi.Scene,
    spp: int | None = None,
    seed: int = 0,
    report: Callable[[float], None] = lambda fraction: None,
    denoise: bool = False,
) -> mi.Bitmap:
    """Render the first sensor of ``scene`` and return its developed film.

    The image is rendered in units, see :mod:`glintbsdf.scene.units`. It is the same to the last bit
    in every run. BSDFs see the footprints of pixels, see :func:`footprints`.

    Args:
        scene: the scene.
        spp: samples per pixel; None for the scene's own number. Mitsuba rounds it up if the sampler
            requires this.
        seed: seed of the image.
        report: called after each unit, with the fraction that is done.
        denoise: whether to denoise indirect light, see :mod:`glintbsdf.scene.denoising`.

    Raises:
        ValueError, ModuleNotFoundError: see :class:`Renderer`.
        Interrupted: Ctrl-C came; the exception has the finished part of the image.
    """
    with Renderer(scene, spp, denoise) as renderer:
        done = produce(renderer, seed, observe=lambda image: report(image.fraction))
    return done.bitmap


# ---------------------------------------------------------------------------------------------
#  File
# ---------------------------------------------------------------------------------------------


def save(bitmap: mi.Bitmap, path: str | Path) -> None:
    """Write an image. An ``.exr`` file has all channels, a ``.png`` file the colours as 8-bit
    sRGB."""
    if Path(path).suffix.lower() == ".png":
        if bitmap.pixel_format() == mi.Bitmap.PixelFormat.MultiChannel:
            bitmap = bitmap.split()[0][1]
        bitmap = bitmap.convert(mi.Bitmap.PixelFormat.RGB, mi.Struct.Type.UInt8, srgb_gamma=True)
    bitmap.write(str(path))


@contextmanager
def replacing(path: str | Path) -> Iterator[Path]:
    """Yield a temporary file beside ``path`` that replaces ``path`` if the block succeeds.

    The file is created at once, so a folder that cannot be written is noticed before the work. What
    was written is synchronised to the disk and read back, as Mitsuba does not report a full disk.
    If the block fails, ``path`` stays as it was, and the temporary file is removed.

    Raises:
        OSError: the folder does not exist or cannot be written, or ``path`` is a folder; or the
            file is not whole.
    """
    path = Path(path)
    if path.is_dir():
        raise IsADirectoryError(f"{path} is a folder")
    try:
        handle, name = tempfile.mkstemp(
            dir=path.parent, prefix=f".{path.stem}-", suffix=path.suffix
        )
    except OSError as error:
        raise OSError(f"cannot write to {path}: {error.strerror}") from error
    os.close(handle)
    temporary = Path(name)
    try:
        yield temporary
        _require_whole(temporary, path)
        # mkstemp makes private files; the image gets the permissions of any new file.
        umask = os.umask(0)
        os.umask(umask)
        temporary.chmod(0o666 & ~umask)
        os.replace(temporary, path)
    except RuntimeError as error:  # a writer's message has the temporary name
        if str(temporary) in str(error):
            reason = str(error).rpartition(f'{temporary}"')[2].strip(": ")
            raise OSError(f"cannot write {path}: {reason}") from error
        raise
    finally:
        temporary.unlink(missing_ok=True)


def _require_whole(written: Path, path: Path) -> None:
    """Raise OSError unless a file is complete on the disk.

    An image is read back: OpenEXR's reader finds missing and damaged parts, and so does Mitsuba's
    reader for PNG. Any other file is only checked not to be empty.
    """
    reason = "it is empty"
    try:
        with written.open("rb+") as file:
            os.fsync(file.fileno())
        if written.stat().st_size:
            if written.suffix.lower() == ".exr":
                import OpenEXR

                with OpenEXR.File(str(written), separate_channels=True) as image:
                    whole = all(len(channel.pixels) for channel in image.channels().values())
            elif written.suffix.lower() in FORMATS:
                whole = np.asarray(mi.Bitmap(str(written))).size > 0
            else:
                whole = True
            if whole:
                return
    except Exception as error:  # whatever the library or the system raises, the file is not whole
        reason = " ".join(str(error).split())
    free = shutil.disk_usage(written.parent).free
    raise OSError(
        f"cannot write {path}: what has arrived on the disk is not the whole image ({reason}); "
        f"{free / 1e6:.0f} MB are free there"
    )
