"""Rendering with filter importance sampling: the film's filter is the density of samples.

Mitsuba's integrators draw samples uniformly over the image, and the film's filter distributes each
of them over the pixels around it. Here each sample belongs to one pixel. Its offset from the
pixel's centre is drawn from the filter. The offset of its footprint is contracted, see
:mod:`~glintbsdf.footprint.pixel_filter`.
"""

from __future__ import annotations

from dataclasses import dataclass

import drjit as dr
import mitsuba as mi
import numpy as np

from glintbsdf.core.hashing import LATTICE_STEPS, pcg3d, uniform
from glintbsdf.footprint.pixel_filter import PixelFilter

#: Largest number of samples of a wavefront: they are counted in 32 bits.
LARGEST_WAVEFRONT = 2**32 - 1


@dataclass
class SharedFilter:
    """A film's filter, of which footprints carry a share.

    Attributes:
        pixel_filter (PixelFilter): the film's filter.
        contraction (float): factor on the offset of a footprint from its pixel's centre, in [0, 1].
        footprint_ray (mi.RayDifferential3f): the rays through the centres of the footprints of the
            samples that have been placed last, with the differentials of a pixel; None before.
    """

    pixel_filter: PixelFilter
    contraction: float
    footprint_ray: mi.RayDifferential3f | None = None

    def place(
        self, sampler: mi.Sampler, x: mi.UInt32, y: mi.UInt32, order: mi.UInt32, seed: mi.UInt32
    ) -> tuple[mi.Vector2f, mi.Float]:
        """Place the sample number ``order`` of the pixel (``x``, ``y``): returns its offset from
        the pixel's centre (pixels), and the sign of its weight.

        The numbers come from the sampler if it stratifies the samples of a pixel. A
        low-discrepancy sequence replaces the numbers of an independent sampler.
        """
        if sampler.class_name() == "IndependentSampler":
            random = lattice_point(order, x, y, seed)
        else:
            random = sampler.next_2d()
        return self.pixel_filter.sample(random)

    def rays(
        self,
        sensor: mi.Sensor,
        time: mi.Float,
        wavelength: mi.Float,
        pixel: mi.Point2f,
        offset: mi.Vector2f,
        size: mi.ScalarVector2f,
        aperture: mi.Point2f,
    ) -> tuple[mi.RayDifferential3f, mi.Spectrum]:
        """The rays of samples, and their weights. Keeps the rays of their footprints.

        ``pixel``: corner of the pixel, from that of the film's crop window of ``size`` pixels;
        ``offset``: of the sample from the pixel's centre, pixels.
        """
        scale = dr.rcp(mi.ScalarVector2f(size))
        contracted = offset * dr.opaque(mi.Float, self.contraction)
        self.footprint_ray, _ = sensor.sample_ray_differential(
            time, wavelength, (pixel + 0.5 + contracted) * scale, aperture
        )
        place = (pixel + 0.5 + offset) * scale
        return sensor.sample_ray_differential(time, wavelength, place, aperture)

    def channels(
        self, sign: mi.Float, values: list[mi.Float], aovs: list[mi.Float]
    ) -> list[mi.Float]:
        """The channels of a sample in the film: ``values`` times its sign, its weight, and ``aovs``
        times its sign."""
        if self.pixel_filter.positive:
            return [*values, mi.Float(1), *aovs]
        weight = mi.Float(self.pixel_filter.weight**2)
        return [*(sign * v for v in values), weight, *(sign * v for v in aovs)]


def render(
    integrator: mi.SamplingIntegrator,
    scene: mi.Scene,
    sensor: mi.Sensor,
    shared: SharedFilter,
    seed: int | mi.UInt32 = 0,
    spp: int = 0,
    largest: int = LARGEST_WAVEFRONT,
) -> None:
    """Render into the film of ``sensor``, which must be an ``hdrfilm``.

    Args:
        integrator: any integrator; its ``sample`` gets ray differentials scaled by 1/√spp, as
            Mitsuba's own ``render`` scales them.
        scene, sensor: the scene, and the sensor to render.
        shared: how to place samples.
        seed: seed of the sampler.
        spp: samples per pixel; 0 for the sampler's own number.
        largest: largest number of samples in one pass; more are drawn in several passes.
    """
    film = sensor.film()
    sampler = sensor.sampler().clone()
    if spp:
        sampler.set_sample_count(spp)
    spp = sampler.sample_count()
    size = film.crop_size()
    pixels = int(np.prod(size))
    passes = next(n for n in range(1, spp + 1) if spp % n == 0 and spp // n * pixels <= largest)
    per_pass = spp // passes
    sampler.set_samples_per_wavefront(per_pass)
    sampler.seed(seed, per_pass * pixels)

    film.prepare(integrator.aov_names())
    block = mi.ImageBlock(size, film.crop_offset(), film.create_block().channel_count())
    block.set_coalesce(block.coalesce() and per_pass >= 4)
    for index in range(passes):
        add_samples(integrator, scene, sensor, shared, seed, sampler, per_pass, index, block)
        if passes > 1:
            sampler.advance()
            sampler.schedule_state()
            dr.eval(block.tensor())
    film.put_block(block)


def add_samples(
    integrator: mi.SamplingIntegrator,
    scene: mi.Scene,
    sensor: mi.Sensor,
    shared: SharedFilter,
    seed: int | mi.UInt32,
    sampler: mi.Sampler,
    per_pass: int,
    index: int,
    block: mi.ImageBlock,
) -> None:
    """Add to ``block`` the pass number ``index``, with ``per_pass`` samples in each pixel."""
    film = sensor.film()
    size, offset = film.crop_size(), film.crop_offset()
    number = dr.arange(mi.UInt32, per_pass * int(np.prod(size)))
    per_pixel, width = dr.opaque(mi.UInt32, per_pass), dr.opaque(mi.UInt32, size[0])
    pixel = number // per_pixel
    row = pixel // width
    column = pixel - row * width
    order = number - pixel * per_pixel + dr.opaque(mi.UInt32, index * per_pass)
    x, y = (i + dr.opaque(mi.UInt32, o) for i, o in zip((column, row), offset, strict=True))
    seed = mi.UInt32(seed)
    dr.make_opaque(seed)  # Mitsuba gives a literal, which would be a part of the kernel
    jitter, sign = shared.place(sampler, x, y, order, seed)

    aperture = sampler.next_2d() if sensor.needs_aperture_sample() else mi.Point2f(0)
    time = mi.Float(sensor.shutter_open())
    if sensor.shutter_open_time() > 0:
        time = time + sampler.next_1d() * sensor.shutter_open_time()
    wavelength = sampler.next_1d() if mi.is_spectral else mi.Float(0)
    pixel = mi.Point2f(column, row)
    ray, weight = shared.rays(sensor, time, wavelength, pixel, jitter, size, aperture)
    if ray.has_differentials:
        ray.scale_differential(dr.rsqrt(dr.opaque(mi.Float, sampler.sample_count())))

    radiance, valid, aovs = integrator.sample(scene, sampler, ray, sensor.get_medium(), True)
    values = colours(film, weight * radiance, valid, ray.wavelengths)
    block.put(mi.Point2f(x, y) + 0.5, shared.channels(sign, values, aovs))


def colours(
    film: mi.Film, radiance: mi.Spectrum, valid: mi.Bool, wavelengths: mi.Color0f
) -> list[mi.Float]:
    """The colour of a sample as an ``hdrfilm`` stores it, and its alpha if the film has one."""
    if mi.is_polarized:
        radiance = mi.unpolarized_spectrum(radiance)
    if mi.is_spectral:
        radiance = mi.spectrum_to_srgb(radiance, wavelengths)
    elif mi.is_monochromatic:
        radiance = mi.Color3f(radiance.x)
    alpha = [dr.select(valid, mi.Float(1), mi.Float(0))]
    return [*radiance, *(alpha if mi.has_flag(film.flags(), mi.FilmFlags.Alpha) else [])]


def lattice_point(order: mi.UInt32, x: mi.UInt32, y: mi.UInt32, seed: mi.UInt32) -> mi.Point2f:
    """A point of the unit square: number ``order`` of an additive recurrence.

    All points of a pixel are shifted by the same random vector, so each point alone is uniformly
    distributed. The sums are of integers, which wrap around and keep all digits.

    Source: Cranley and Patterson, "Randomization of Number Theoretic Methods for Multiple
    Integration", SIAM J. Numer. Anal. 13(6), 1976; Roberts, "The Unreasonable Effectiveness of
    Quasirandom Sequences", 2018.
    """
    shifts = pcg3d(x, y, seed)
    return mi.Point2f(
        *(
            uniform(shift + order * round(step * 2**32))
            for shift, step in zip(shifts, LATTICE_STEPS, strict=False)
        )
    )
