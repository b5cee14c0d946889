"""One pass over the pixels of a film: samples, and their sums in a fixed order.

Mitsuba adds samples to its film by atomic operations in single precision. Their order depends on
the threads, and with it the last bits of an image. Here every pixel adds the samples within reach
of its reconstruction filter itself, one after the other and in double precision. So a pass is the
same to the last bit for any number of threads and in any process.

As in Mitsuba, ``sampler.sample_count()`` and the scale 1/√spp of ray differentials refer to the
samples of the whole image. So footprints do not depend on the number of passes.
"""

from __future__ import annotations

from dataclasses import dataclass

import drjit as dr
import mitsuba as mi
import numpy as np

from glintbsdf.bridge.filter_sampling import SharedFilter, colours


@dataclass(frozen=True)
class Tile:
    """A rectangle of pixels. Its position is relative to the upper left corner of the whole film,
    without the crop."""

    x: int
    y: int
    width: int
    height: int

    @property
    def pixels(self) -> int:
        return self.width * self.height

    def slices(self, within: Tile) -> tuple[slice, slice]:
        """Rows and columns of this tile in an array over the pixels of ``within``."""
        top, left = self.y - within.y, self.x - within.x
        return slice(top, top + self.height), slice(left, left + self.width)

    def widened(self, border: int, within: Tile) -> Tile:
        """The tile with ``border`` more pixels on every side, as far as they lie in ``within``."""
        left, top = max(self.x - border, within.x), max(self.y - border, within.y)
        right = min(self.x + self.width + border, within.x + within.width)
        bottom = min(self.y + self.height + border, within.y + within.height)
        return Tile(left, top, right - left, bottom - top)


def whole(film: mi.Film) -> Tile:
    """The crop window of a film: all pixels of its image."""
    x, y = (int(v) for v in film.crop_offset())
    width, height = (int(v) for v in film.crop_size())
    return Tile(x, y, width, height)


def reach(film: mi.Film) -> int:
    """Number of neighbouring pixels, on each side, that a sample contributes to."""
    rfilter = film.rfilter()
    return 0 if rfilter.is_box_filter() else int(rfilter.border_size())


def sums_of_samples(
    scene: mi.Scene,
    sensor: mi.Sensor,
    integrator: mi.Integrator,
    tile: Tile,
    spp: int,
    total: int,
    seed: int,
    shared: SharedFilter | None = None,
) -> tuple[Tile, np.ndarray]:
    """Take ``spp`` samples in each pixel of ``tile`` and add them up.

    Args:
        tile: pixels that get samples.
        spp: samples per pixel of this pass.
        total: samples per pixel of the image; footprints are scaled by it.
        seed: seed of the sensor's sampler.
        shared: places samples by the film's filter. A sample then counts in its own pixel only.

    Returns:
        The tile, widened by the reach of the film's filter within the crop window, and its sums:
        (height, width, channels) float32. The channels are those of the film: colours times
        weight, alpha if the film has it, the weight, and the integrator's AOVs.
    """
    film = sensor.film()
    film.prepare(integrator.aov_names())
    if not isinstance(integrator, mi.SamplingIntegrator):
        return whole(film), _sums_of_a_film(scene, sensor, integrator, spp, seed)
    with dr.suspend_grad():
        sampler = sensor.sampler().clone()
        sampler.set_sample_count(total)
        if total % spp == 0:  # stratified samplers need this
            sampler.set_samples_per_wavefront(spp)
        sampler.seed(seed, tile.pixels * spp)

        ray, weight, position, sign = _camera_rays(sensor, sampler, tile, spp, shared, seed)
        ray.scale_differential(1 / total**0.5)
        radiance, valid, aovs = _sample(integrator, scene, sensor, sampler, ray)
        if shared is None:
            channels = _channels(film, radiance * weight, valid, aovs, ray.wavelengths)
            border = reach(film)
        else:
            values = colours(film, radiance * weight, valid, ray.wavelengths)
            channels, border = shared.channels(sign, values, aovs), 0
        offset = position - mi.Vector2f(dr.floor(position))
        dr.eval(channels, offset)
        del ray, weight, radiance, valid, aovs, sampler, position
        target = tile.widened(border, whole(film))
        return target, _sums(channels, offset, film.rfilter(), border, tile, target, spp)


def _camera_rays(
    sensor: mi.Sensor,
    sampler: mi.Sampler,
    tile: Tile,
    spp: int,
    shared: SharedFilter | None,
    seed: int,
) -> tuple[mi.RayDifferential3f, mi.Spectrum, mi.Point2f, mi.Float]:
    """Rays through the pixels of a tile, their weights, their positions on the film (pixels), and
    the signs of their contributions.

    The samples of a pixel are consecutive. Random numbers are drawn in Mitsuba's order.
    """
    film = sensor.film()
    number, per_pixel = dr.arange(mi.UInt32, tile.pixels * spp), dr.opaque(mi.UInt32, spp)
    pixel = number // per_pixel
    row = pixel // dr.opaque(mi.UInt32, tile.width)
    column = pixel - row * dr.opaque(mi.UInt32, tile.width)
    x, y = column + dr.opaque(mi.UInt32, tile.x), row + dr.opaque(mi.UInt32, tile.y)
    place: mi.Point2f | mi.Vector2f
    if shared is None:
        place, sign = sampler.next_2d(), mi.Float(1)
    else:
        order = number - pixel * per_pixel
        offset, sign = shared.place(sampler, x, y, order, dr.opaque(mi.UInt32, seed))
        place = offset + 0.5
    position = mi.Point2f(mi.Float(x), mi.Float(y)) + place

    scale = dr.rcp(mi.ScalarVector2f(film.crop_size()))
    aperture = sampler.next_2d() if sensor.needs_aperture_sample() else mi.Point2f(0)
    time = mi.Float(sensor.shutter_open())
    if sensor.shutter_open_time() > 0:
        time += sampler.next_1d() * sensor.shutter_open_time()
    wavelength = sampler.next_1d() if mi.is_spectral else 0
    corner = mi.ScalarVector2f(film.crop_offset())
    if shared is None:
        on_film = (position - corner) * scale
        ray, weight = sensor.sample_ray_differential(time, wavelength, on_film, aperture)
    else:
        at = mi.Point2f(mi.Float(x), mi.Float(y)) - corner
        size = film.crop_size()
        ray, weight = shared.rays(sensor, time, wavelength, at, offset, size, aperture)
    return ray, weight, position, sign


def _sample(
    integrator: mi.SamplingIntegrator,
    scene: mi.Scene,
    sensor: mi.Sensor,
    sampler: mi.Sampler,
    ray: mi.RayDifferential3f,
) -> tuple[mi.Spectrum, mi.Bool, list[mi.Float]]:
    """Radiance along rays, whether they hit a surface, and AOVs."""
    from mitsuba.python.ad.integrators.common import ADIntegrator

    if not isinstance(integrator, ADIntegrator):
        return integrator.sample(scene, sampler, ray, sensor.get_medium(), mi.Bool(True))
    radiance, valid, aovs, _ = integrator.sample(
        mode=dr.ADMode.Primal,
        scene=scene,
        sampler=sampler,
        ray=ray,
        depth=mi.UInt32(0),
        δL=None,
        δaovs=None,
        state_in=None,
        active=mi.Bool(True),
    )
    return radiance, valid, aovs


def _channels(
    film: mi.Film,
    radiance: mi.Spectrum,
    valid: mi.Bool,
    aovs: list[mi.Float],
    wavelengths: mi.Color0f,
) -> list[mi.Float]:
    """The channels of samples of weight one, as the film stores them."""
    if mi.has_flag(film.flags(), mi.FilmFlags.Special):
        unpolarized = mi.unpolarized_spectrum(radiance) if mi.is_polarized else radiance
        alpha = dr.select(valid, mi.Float(1), mi.Float(0))
        count = film.create_block().channel_count()
        return film.prepare_sample(unpolarized, wavelengths, count, weight=1.0, alpha=alpha)
    return [*colours(film, radiance, valid, wavelengths), mi.Float(1), *aovs]


def _sums(
    channels: list[mi.Float],
    offset: mi.Point2f,
    rfilter: mi.ReconstructionFilter,
    border: int,
    tile: Tile,
    target: Tile,
    spp: int,
) -> np.ndarray:
    """Filtered sums of samples, (height, width, channels) float32, for the pixels of ``target``.

    Args:
        channels: channels of all samples of ``tile``, evaluated; samples of a pixel are
            consecutive.
        offset: position of each sample in its pixel, in [0, 1]².
        rfilter: the reconstruction filter.
        border: its reach, in pixels on each side.
    """
    count = len(channels)
    width = dr.opaque(mi.UInt32, target.width)
    index = dr.arange(mi.UInt32, target.pixels)
    row = index // width
    # The pixel in the middle of the filter, relative to the tile that has samples.
    x = mi.Int32(index - row * width) + dr.opaque(mi.Int32, target.x - tile.x)
    y = mi.Int32(row) + dr.opaque(mi.Int32, target.y - tile.y)
    columns, rows = dr.opaque(mi.Int32, tile.width), dr.opaque(mi.Int32, tile.height)
    per_pixel = dr.opaque(mi.UInt32, spp)
    values = [mi.Float64(0) for _ in range(count)]
    across = dr.opaque(mi.Int32, 2 * border + 1)
    last = across * across

    def more(neighbour, sample, *sums):
        return neighbour < last

    def add(neighbour, sample, *sums):
        dy = neighbour // across
        dx = neighbour - dy * across - border
        dy = dy - border
        column, line = x + dx, y + dy
        inside = (column >= 0) & (column < columns) & (line >= 0) & (line < rows)
        source = mi.UInt32(line * columns + column) * per_pixel + sample
        if border:
            # The filter at the distance of the sample from the centre of the receiving pixel.
            kernel = mi.Float(1)
            for within, pixels in ((offset.x, dx), (offset.y, dy)):
                at = dr.gather(mi.Float, within, source, inside)
                kernel = kernel * rfilter.eval(at + mi.Float(pixels) - 0.5, inside)
        else:
            kernel = mi.Float(1)
        weight = mi.Float64(dr.select(inside, kernel, 0))
        sums = [
            total + weight * mi.Float64(dr.gather(mi.Float, channel, source, inside))
            for total, channel in zip(sums, channels, strict=True)
        ]
        done = (sample + 1 == per_pixel) | ~inside  # there are no samples outside of the tile
        return (
            dr.select(done, neighbour + 1, neighbour),
            dr.select(done, 0, sample + 1),
            *sums,
        )

    state = (dr.zeros(mi.Int32, target.pixels), dr.zeros(mi.UInt32, target.pixels), *values)
    _, _, *totals = dr.while_loop(state=state, cond=more, body=add, label="Sums of samples")
    images = [mi.Float(total) for total in totals]
    dr.eval(images)
    shape = (target.height, target.width)
    return np.stack([np.asarray(value).reshape(shape) for value in images], axis=-1)


def _sums_of_a_film(
    scene: mi.Scene, sensor: mi.Sensor, integrator: mi.Integrator, spp: int, seed: int
) -> np.ndarray:
    """Sums of all pixels from Mitsuba's own film, for integrators such as ``ptracer`` that do not
    start from the rays of a sensor. The last bits of these sums vary."""
    film = sensor.film()
    sampler = sensor.sampler()
    own = sampler.sample_count()
    integrator.render(scene, sensor, seed=seed, spp=spp)
    sampler.set_sample_count(own)
    if integrator.should_stop():  # Mitsuba has caught Ctrl-C; Python does not know of it
        raise KeyboardInterrupt
    stored = np.array(film.bitmap(raw=True), dtype=np.float32)
    index = film.base_channels_count()
    weight = stored[..., index, None]
    # Contributions of particles have no weight, and are an image already.
    image = np.where(weight > 0, stored / np.where(weight > 0, weight, 1), stored)
    image[..., index] = 1
    return image * np.float32(spp)


def developed(film: mi.Film, aov_names: list[str], sums: np.ndarray) -> mi.Bitmap:
    """The developed image of a film, from the sums of its samples (height, width, channels)."""
    film.prepare(aov_names)
    film.put_block(
        mi.ImageBlock(mi.TensorXf(sums.astype(np.float32)), mi.ScalarPoint2i(film.crop_offset()))
    )
    return film.bitmap()
