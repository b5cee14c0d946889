"""One pass over the pixels of a film: its samples, and their sums in an order that is always the
same.

Mitsuba adds samples to its film by atomic operations of single precision. Their order, and with it
the last bits of an image, changes from run to run as threads take turns. Here every pixel adds up
the samples within reach of the reconstruction filter itself, one after the other and in double
precision. A pass is then the same to the last bit for any number of threads, in any process.

A pass knows how many samples the whole image has: as in Mitsuba, ``sampler.sample_count()`` and
the scale 1/√spp of ray differentials belong to all passes together. What footprints carry does
not depend on how an image is divided into passes.
"""

from __future__ import annotations

from dataclasses import dataclass

import drjit as dr
import mitsuba as mi
import numpy as np

from glintbsdf.bridge.filter_sampling import SharedFilter, colours


@dataclass(frozen=True)
class Tile:
    """A rectangle of pixels, counted from the upper left corner of the uncropped film."""

    x: int
    y: int
    width: int
    height: int

    @property
    def pixels(self) -> int:
        return self.width * self.height

    def slices(self, within: Tile) -> tuple[slice, slice]:
        """Rows and columns of this tile in an array of the pixels of ``within``."""
        top, left = self.y - within.y, self.x - within.x
        return slice(top, top + self.height), slice(left, left + self.width)

    def widened(self, border: int, within: Tile) -> Tile:
        """With ``border`` pixels more on every side that lie in ``within``."""
        left, top = max(self.x - border, within.x), max(self.y - border, within.y)
        right = min(self.x + self.width + border, within.x + within.width)
        bottom = min(self.y + self.height + border, within.y + within.height)
        return Tile(left, top, right - left, bottom - top)


def whole(film: mi.Film) -> Tile:
    """All pixels of a film that an image shows: its crop window."""
    x, y = (int(v) for v in film.crop_offset())
    width, height = (int(v) for v in film.crop_size())
    return Tile(x, y, width, height)


def reach(film: mi.Film) -> int:
    """Pixels beyond its own that a sample adds to, on each side."""
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
        total: samples per pixel of the image, by which footprints are scaled.
        seed: seed of the sensor's sampler.
        shared: places samples by the film's filter, which then does not spread them.

    Returns:
        The tile widened by the reach of the film's filter, within its crop window, and its sums:
        (height, width, channels) float32. The channels are as the film stores them: colours times
        weight, then alpha if there is any, the weight, and the integrator's further channels.
    """
    film = sensor.film()
    film.prepare(integrator.aov_names())
    if not isinstance(integrator, mi.SamplingIntegrator):
        return whole(film), _sums_of_a_film(scene, sensor, integrator, spp, seed)
    with dr.suspend_grad():
        sampler = sensor.sampler().clone()
        sampler.set_sample_count(total)
        if total % spp == 0:  # what stratified samplers must know
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
    """Rays through the pixels of a tile, their weights, where they cross the film (pixels), and the
    signs with which they count.

    The samples of a pixel follow each other. Random numbers are drawn in Mitsuba's order.
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
        place, sign = shared.place(sampler, x, y, order, dr.opaque(mi.UInt32, seed))
        place = place + 0.5
    position = mi.Point2f(mi.Float(x), mi.Float(y)) + place

    scale = dr.rcp(mi.ScalarVector2f(film.crop_size()))
    aperture = sampler.next_2d() if sensor.needs_aperture_sample() else mi.Point2f(0)
    time = mi.Float(sensor.shutter_open())
    if sensor.shutter_open_time() > 0:
        time += sampler.next_1d() * sensor.shutter_open_time()
    wavelength = sampler.next_1d() if mi.is_spectral else 0
    ray, weight = sensor.sample_ray_differential(
        time=time,
        sample1=wavelength,
        sample2=(position - mi.ScalarVector2f(film.crop_offset())) * scale,
        sample3=aperture,
    )
    return ray, weight, position, sign


def _sample(
    integrator: mi.SamplingIntegrator,
    scene: mi.Scene,
    sensor: mi.Sensor,
    sampler: mi.Sampler,
    ray: mi.RayDifferential3f,
) -> tuple[mi.Spectrum, mi.Bool, list[mi.Float]]:
    """Radiance along rays, whether they belong to a surface, and AOVs."""
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
    """What a film stores of samples of weight one."""
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
        channels: channels of all samples of ``tile``, evaluated; a pixel's samples follow each
            other.
        offset: position of each sample in its pixel, in [0, 1]².
        rfilter, border: the filter that spreads samples, over so many pixels on each side.
    """
    count = len(channels)
    width = dr.opaque(mi.UInt32, target.width)
    index = dr.arange(mi.UInt32, target.pixels)
    row = index // width
    # The pixel in the middle of the filter, counted in the tile that has samples.
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
            # Distance of the sample from the centre of the pixel that collects it.
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
        done = (sample + 1 == per_pixel) | ~inside  # beyond the tile there is nothing to visit
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
    """Sums of all pixels from Mitsuba's own film, for integrators that do not follow the rays of
    a sensor, as ``ptracer``: they spread samples over the image, and last bits vary."""
    film = sensor.film()
    sampler = sensor.sampler()
    own = sampler.sample_count()
    integrator.render(scene, sensor, seed=seed, spp=spp)
    sampler.set_sample_count(own)
    if integrator.should_stop():  # Mitsuba caught Ctrl-C, and Python was not told
        raise KeyboardInterrupt
    stored = np.array(film.bitmap(raw=True), dtype=np.float32)
    index = film.base_channels_count()
    weight = stored[..., index, None]
    # What particles bring has no weight, and is an image already.
    image = np.where(weight > 0, stored / np.where(weight > 0, weight, 1), stored)
    image[..., index] = 1
    return image * np.float32(spp)


def developed(film: mi.Film, aov_names: list[str], sums: np.ndarray) -> mi.Bitmap:
    """The image of a film whose samples have the sums (height, width, channels)."""
    film.prepare(aov_names)
    film.put_block(
        mi.ImageBlock(mi.TensorXf(sums.astype(np.float32)), mi.ScalarPoint2i(film.crop_offset()))
    )
    return film.bitmap()
