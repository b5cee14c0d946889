"""Render a scene file to an image file: footprints from the sensor, passes, whole files only."""

from __future__ import annotations

import os
import shutil
import tempfile
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager, nullcontext
from pathlib import Path

import drjit as dr
import mitsuba as mi
import numpy as np

from glintbsdf.scene.denoising import denoised, guided

FORMATS = (".exr", ".png")

# A pass of this many samples keeps two CPU cores busy for about a second, and a GPU busy.
_SAMPLES_PER_PASS = 1 << 18


# ---------------------------------------------------------------------------------------------
#  Scene
# ---------------------------------------------------------------------------------------------


def load_scene(filename: str | Path, parameters: Mapping[str, str] | None = None) -> mi.Scene:
    """Load a scene from XML. ``parameters`` takes the place of its ``$key`` and ``<default>``.

    Gives Dr.Jit a second thread where it has only one: Mitsuba would never return from reading an
    OpenEXR file.
    """
    if dr.thread_count() < 2:
        dr.set_thread_count(2)
    return mi.load_file(str(filename), **(parameters or {}))


def pixel_angle(sensor: mi.Sensor) -> float:
    """Return the angle in radians that a pixel subtends in the middle of the sensor's image.

    It is taken from the ray differentials of the sensor, so that it holds for any projection and
    crop; the geometric mean of both axes. Parallel projections have 0.
    """
    middle = mi.Point2f(0.5)
    ray, _ = sensor.sample_ray_differential(0.0, 0.5, middle, middle)
    if not ray.has_differentials:
        return 0.0
    squared = dr.squared_norm(ray.d_x - ray.d) * dr.squared_norm(ray.d_y - ray.d)
    return float(np.asarray(dr.sqrt(dr.sqrt(squared))).item())


def first_sensor(scene: mi.Scene) -> mi.Sensor:
    """The sensor that a scene is rendered with.

    Raises:
        ValueError: no sensor.
    """
    if not scene.sensors():
        raise ValueError("the scene has no sensor")
    return scene.sensors()[0]


@contextmanager
def footprints(scene: mi.Scene, sensor: mi.Sensor, spp: int, passes: float = 1) -> Iterator[None]:
    """Give all glint BSDFs of ``scene`` the footprint of ``spp`` samples per pixel, in the block.

    A BSDF whose ``pixel_spread`` is 0 gets the sensor's pixel angle, scaled by 1/√spp as Mitsuba
    scales ray differentials. Where the image is the mean of ``passes`` renderings, Mitsuba scales
    by the samples of one pass only. The rest, 1/√passes, goes into ``footprint_sigma``, and is
    taken out of the ``pixel_spread`` that a scene has set itself.
    """
    parameters = mi.traverse(scene)
    parameters.keep([r".*(pixel_spread|footprint_sigma)$"])
    original = {key: mi.Float(parameters[key]) for key in parameters.keys()}
    spread = pixel_angle(sensor) / (spp / passes) ** 0.5
    for key, own in original.items():
        if key.endswith("pixel_spread"):
            parameters[key] = dr.select(own > 0, own * passes**0.5, spread)
        else:
            parameters[key] = own / passes**0.5
    parameters.update()
    try:
        yield
    finally:
        for key, own in original.items():
            parameters[key] = own
        parameters.update()


# ---------------------------------------------------------------------------------------------
#  Image
# ---------------------------------------------------------------------------------------------


def render(
    scene: mi.Scene,
    spp: int | None = None,
    seed: int = 0,
    report: Callable[[float], None] = lambda fraction: None,
    denoise: bool = False,
) -> mi.Bitmap:
    """Render the first sensor of ``scene`` and return its developed film.

    The image is the mean of several passes with seeds derived from ``seed``, and ``report`` is
    called with the fraction done after each. A sampler that stratifies the samples of a pixel would
    lose by that and renders in one pass. BSDFs see the pixels' footprints, see :func:`footprints`.

    Args:
        spp: samples per pixel; None for what the scene says. Mitsuba rounds it up where the
            sampler requires it.
        denoise: filter indirect light, see :mod:`glintbsdf.scene.denoising`.

    Raises:
        ValueError: no sensor, or a mesh without the UVs that its BSDF needs; or ``denoise`` with
            an integrator other than ``glint_path``.
        ModuleNotFoundError: ``denoise``, and no denoiser is installed.
        KeyboardInterrupt: also where Mitsuba itself has caught the signal.
    """
    sensor = first_sensor(scene)
    sampler = sensor.sampler()
    if spp is not None:
        sampler.set_sample_count(spp)
    spp = sampler.sample_count()
    passes = 1
    if sampler.class_name() == "IndependentSampler":
        passes = _pass_count(spp, int(np.prod(sensor.film().crop_size())))

    total: np.ndarray | float = 0.0
    integrators = guided(scene.integrator()) if denoise else nullcontext(scene.integrator())
    with footprints(scene, sensor, spp, passes), integrators as integrator:
        for index in range(passes):
            # Seeds of neighbouring images must not share passes.
            pass_seed = mi.sample_tea_32(seed, index)[0] if passes > 1 else seed
            integrator.render(scene, sensor, seed=pass_seed, spp=spp // passes)
            if integrator.should_stop():
                # Mitsuba caught Ctrl-C during the pass, and Python was not told.
                raise KeyboardInterrupt
            bitmap = sensor.film().bitmap()
            total = total + np.array(bitmap, dtype=np.float64)
            report((index + 1) / passes)
    sampler.set_sample_count(spp)  # which the last pass has left at its own
    np.asarray(bitmap)[...] = total / passes
    return denoised(bitmap) if denoise else bitmap


def _pass_count(spp: int, pixels: int) -> int:
    """The divisor of ``spp`` whose passes come nearest to, and not below, a sensible size."""
    wanted = max(1, spp * pixels // _SAMPLES_PER_PASS)
    return max(count for count in range(1, min(spp, wanted) + 1) if spp % count == 0)


# ---------------------------------------------------------------------------------------------
#  File
# ---------------------------------------------------------------------------------------------


def save(bitmap: mi.Bitmap, path: str | Path) -> None:
    """Write an image: ``.exr`` as it is, ``.png`` its colours alone, as 8-bit sRGB."""
    if Path(path).suffix.lower() == ".png":
        if bitmap.pixel_format() == mi.Bitmap.PixelFormat.MultiChannel:
            bitmap = bitmap.split()[0][1]
        bitmap = bitmap.convert(mi.Bitmap.PixelFormat.RGB, mi.Struct.Type.UInt8, srgb_gamma=True)
    bitmap.write(str(path))


@contextmanager
def replacing(path: str | Path) -> Iterator[Path]:
    """Yield a temporary file beside ``path`` that takes its place when the block succeeds.

    The file is made at once, so that a place that cannot be written shows before the work is done.
    What has been written is brought to the disk and read back, as Mitsuba does not tell of a disk
    that is full. Whatever ends the block otherwise, ``path`` stays as it was and nothing else is
    left.

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
    except RuntimeError as error:  # of a writer, which knows the temporary name only
        if str(temporary) in str(error):
            reason = str(error).rpartition(f'{temporary}"')[2].strip(": ")
            raise OSError(f"cannot write {path}: {reason}") from error
        raise
    finally:
        temporary.unlink(missing_ok=True)


def _require_whole(written: Path, path: Path) -> None:
    """Raise OSError unless an image file has arrived on the disk as a whole.

    OpenEXR's reader finds a missing part as well as a damaged one, Mitsuba's that of a PNG.
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
            else:
                whole = np.asarray(mi.Bitmap(str(written))).size > 0
            if whole:
                return
    except Exception as error:  # of a library, or of the system: the file is not whole
        reason = " ".join(str(error).split())
    free = shutil.disk_usage(written.parent).free
    raise OSError(
        f"cannot write {path}: what has arrived on the disk is not the whole image ({reason}); "
        f"{free / 1e6:.0f} MB are free there"
    )
