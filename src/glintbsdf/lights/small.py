"""Small lights: emitters that are sampled at every hit, and that a BSDF can integrate itself.

Seen from a point, the directions to a light have a covariance Σ_ω about its centre. It is split as
the variance of a pixel's filter is (:mod:`~glintbsdf.footprint.pixel_filter`). A share of Σ_ω
becomes a spread of normals, over which a P-NDF averages in closed form. The rest is sampled:
directions to points of the light are contracted towards its centre. Visibility and radiance are
taken at the points themselves. So a light that is textured, or partly hidden, keeps its mean.
"""

from __future__ import annotations

import drjit as dr
import mitsuba as mi
import numpy as np

from glintbsdf.lights.regions import BrightRegions, find_regions, samples_of
from glintbsdf.lights.view import MAX_DEVIATION, View

#: Largest number of emitters that are sampled at every hit: the most powerful ones. Of the others,
#: one is chosen at random.
MAX_SAMPLED = 16

#: With at most this many emitters, it is worth checking all of them to save a BSDF sample.
MAX_CHECKED = 8

#: Shapes that look like uniform ellipses.
ELLIPTIC = ("Sphere", "Disk")

#: Number of rays that estimate the power of an emitter.
POWER_RAYS = 64

#: Number of points along each axis that measure the extent of an emitter of any shape.
EXTENT_POINTS = 32


#: Largest number of samples per pixel of an image whose lights are integrated as a whole.
INTEGRATED_SAMPLES = 1024

#: The same for lights that do not look like ellipses.
PREVIEW_SAMPLES = 16


def automatic_shares(samples: int) -> tuple[float, float]:
    """The shares of a light's extent that the P-NDF integrates, where an image takes ``samples``
    samples per pixel: of a light that looks like an ellipse, and of any other.

    The P-NDF sees a light as a uniform ellipse under which Fresnel reflectance and masking are
    constant. A sphere or a disk is such an ellipse. It is integrated as a whole, until the small
    error that remains is what counts. Any other light loses its corners: under a softbox of
    0.2 radians the error is then a fifth of an image's contrast. This is less than the noise of few
    samples, so its share falls from :data:`PREVIEW_SAMPLES` on. In the limit of many samples all is
    sampled.
    """
    elliptic = (INTEGRATED_SAMPLES / samples) ** 0.25
    return min(1.0, elliptic), min(1.0, (PREVIEW_SAMPLES / samples) ** 0.5)


class SmallLights:
    """The emitters of a scene, and how they are sampled.

    Args:
        scene (mi.Scene): the scene.
        every (bool): whether up to :data:`MAX_SAMPLED` emitters are sampled at every hit; otherwise
            none is.
        extents (bool): whether to measure the extents of lights; otherwise none counts as small.
            With both, bright regions of an environment count as lights.

    Attributes:
        sampled (mi.EmitterPtr): the ``sampled_count`` emitters that are sampled at every hit.
        others (mi.EmitterPtr): the ``others_count`` emitters of which one is chosen, in proportion
            to its ``sampling_weight``.
        probability (mi.Float): probability to be sampled at a hit, by :meth:`registry_index`.
        regions (BrightRegions): bright regions of the environment, which BSDFs that integrate
            lights are to see apart from the rest of it; None if there are none.
    """

    def __init__(self, scene: mi.Scene, every: bool = True, extents: bool = True) -> None:
        emitters = scene.emitters()
        pointers = scene.emitters_dr()
        weights = np.array([emitter.sampling_weight() for emitter in emitters])
        bounded = [
            k for k, emitter in enumerate(emitters) if not emitter.is_environment() and weights[k]
        ]
        strongest = most_powerful(emitters, bounded, MAX_SAMPLED) if every or extents else []
        sampled = strongest if every else []
        others = [k for k in range(len(emitters)) if k not in sampled and weights[k]]
        self.sampled_count, self.others_count, self.extents = len(sampled), len(others), extents

        def chosen(indices):
            return dr.gather(mi.EmitterPtr, pointers, mi.UInt32(indices)) if indices else None

        self.sampled, self.others = chosen(sampled), chosen(others)
        if others:
            self.distribution = mi.DiscreteDistribution(mi.Float(weights[others]))

        # Data of emitters are arrays over their indices in Dr.Jit's registry; 0 is no emitter.
        names = mi.UInt32(dr.reinterpret_array(mi.UInt32, pointers)).numpy().astype(int)
        size = names.max(initial=0) + 1
        probability = np.zeros(size, np.float32)
        small, elliptic = np.zeros((2, size), bool)
        centre, axes = np.zeros((size, 3), np.float32), np.zeros((size, 3, 3), np.float32)
        delta = np.array(
            [bool(emitter.flags() & mi.EmitterFlags.Delta) for emitter in emitters], bool
        )
        probability[names[sampled]] = 1
        probability[names[others]] = weights[others] / max(weights[others].sum(), 1e-30)
        for k in strongest if extents else []:
            found = extent(emitters[k])
            if found is not None:
                small[names[k]] = True
                centre[names[k]], axes[names[k]] = found
                elliptic[names[k]] = emitters[k].get_shape().class_name() in ELLIPTIC
        self.probability = mi.Float(probability)
        self.extended, self.elliptic = mi.Bool(small), mi.Bool(elliptic)
        #: Whether every emitter that is not sampled at every hit is an environment.
        self.others_are_environments = every and all(emitters[k].is_environment() for k in others)
        #: Whether all emitters are sampled at every hit, and all are points or may be small. BSDF
        #: sampling is then needed for none of them.
        self.complete = (
            every and not others and bool(np.all(small[names[sampled]] | delta[sampled]))
        )
        self.centre = mi.Float(centre.ravel())
        self.axes = mi.Float(axes.ravel())
        self.regions = None
        for k, emitter in enumerate(emitters):
            if every and extents and emitter.is_environment() and weights[k]:
                found = find_regions(*samples_of(emitter))
                if found:
                    self.regions = BrightRegions(scene, chosen([k]), found)

    def is_cut(self, emitter: mi.EmitterPtr) -> mi.Bool:
        """Whether an emitter is an environment of which regions are cut out."""
        return mi.Bool(False) if self.regions is None else emitter == self.regions.environment

    def in_region(self, ds: mi.DirectionSample3f, active: mi.Bool) -> mi.Bool:
        """Whether ``ds`` is a direction to a bright region of the environment."""
        if self.regions is None:
            return mi.Bool(False)
        return self.regions.contain(ds.d, active & self.is_cut(ds.emitter))

    def count_sampled(self, integrated: mi.Bool) -> mi.UInt32:
        """Number of lights that are sampled at every hit, where BSDFs integrate lights or not."""
        count = dr.opaque(mi.UInt32, self.sampled_count)
        if self.regions is None:
            return count
        return count + dr.select(integrated, self.regions.count, 0)

    def sample_direction(
        self, k: mi.UInt32, it: mi.Interaction3f, random: mi.Point2f, active: mi.Bool
    ) -> tuple[mi.DirectionSample3f, mi.Spectrum, View]:
        """Sample light ``k`` of those that are sampled at every hit: the emitters ``sampled``, then
        the regions of the environment. Returns what ``mi.Emitter.sample_direction`` does, and the
        view of the light from ``it``."""
        found = None
        if self.sampled_count > 0:
            of_emitter = active & (k < dr.opaque(mi.UInt32, self.sampled_count))
            emitter = dr.gather(mi.EmitterPtr, self.sampled, k, of_emitter)
            ds, weight = emitter.sample_direction(it, random, of_emitter)
            ds.emitter = emitter
            with dr.suspend_grad():
                found = ds, weight, self.view(emitter, it.p, of_emitter)
        if self.regions is not None:
            region = k - dr.opaque(mi.UInt32, self.sampled_count)
            of_region = active if found is None else active & ~of_emitter
            sampled = self.regions.sample_direction(region, it, random, of_region)
            sampled = *sampled, self.regions.view(region, of_region)
            found = sampled if found is None else dr.select(of_region, sampled, found)
        return found

    def all_small(self, p: mi.Point3f) -> mi.Bool:
        """Whether all emitters are points, or small as seen from ``p``, so that none of them needs
        BSDF sampling."""
        if not self.complete or self.sampled_count > MAX_CHECKED:
            return mi.Bool(False)
        result = mi.Bool(True)
        for k in range(self.sampled_count):
            emitter = dr.gather(mi.EmitterPtr, self.sampled, mi.UInt32(k))
            extended = dr.gather(mi.Bool, self.extended, self.registry_index(emitter))
            result &= self.view(emitter, p).small | ~extended
        return result

    def registry_index(self, emitter: mi.EmitterPtr) -> mi.UInt32:
        """The index of an emitter in Dr.Jit's registry; 0 where there is none."""
        return dr.reinterpret_array(mi.UInt32, emitter)

    def choose(
        self, random: mi.Point2f, active: bool | mi.Bool = True
    ) -> tuple[mi.EmitterPtr, mi.Float, mi.Point2f]:
        """Choose one of the ``others``: returns the emitter, its probability, and random numbers
        made of ``random`` to sample it with."""
        index, x, probability = self.distribution.sample_reuse_pmf(random.x, active)
        emitter = dr.gather(mi.EmitterPtr, self.others, index, active)
        return emitter, probability, mi.Point2f(x, random.y)

    def pdf_direction(
        self,
        scene: mi.Scene,
        si: mi.Interaction3f,
        ds: mi.DirectionSample3f,
        active: bool | mi.Bool = True,
    ) -> mi.Float:
        """The density (1/sr) with which emitter sampling at ``si`` draws ``ds``."""
        if self.sampled_count == 0:
            return scene.pdf_emitter_direction(si, ds, active)
        probability = dr.gather(mi.Float, self.probability, self.registry_index(ds.emitter), active)
        return ds.emitter.pdf_direction(si, ds, active) * probability

    def view(self, emitter: mi.EmitterPtr, p: mi.Point3f, active: bool | mi.Bool = True) -> View:
        """An emitter as it is seen from ``p``."""
        index = self.registry_index(emitter)
        small = dr.gather(mi.Bool, self.extended, index, active)
        to_centre = dr.gather(mi.Vector3f, self.centre, index, active) - mi.Vector3f(p)
        distance = dr.norm(to_centre)
        small &= distance > 0
        inverse = dr.select(small, dr.rcp(distance), 0)
        d = dr.select(small, to_centre * inverse, mi.Vector3f(0, 0, 1))
        s, t = mi.coordinate_system(d)
        xx, xy, yy = mi.Float(0), mi.Float(0), mi.Float(0)
        for k in range(3):
            axis = dr.gather(mi.Vector3f, self.axes, 3 * index + k, active) * inverse
            x, y = dr.dot(axis, s), dr.dot(axis, t)
            xx, xy, yy = dr.fma(x, x, xx), dr.fma(x, y, xy), dr.fma(y, y, yy)
        half = 0.5 * (xx - yy)
        radius = dr.safe_sqrt(dr.fma(half, half, xy * xy))
        mean = 0.5 * (xx + yy)
        # The major axis has half the polar angle of (half, xy); for a round light any axis will do.
        angle = 0.5 * dr.atan2(xy, half)
        sine, cosine = dr.sincos(angle)
        small &= (mean + radius < MAX_DEVIATION**2) & (mean - radius > 0)
        return View(
            d,
            s * cosine + t * sine,
            t * cosine - s * sine,
            mean + radius,
            dr.maximum(mean - radius, 0),
            small,
            dr.gather(mi.Bool, self.elliptic, index, active),
        )


def most_powerful(emitters: list, indices: list[int], most: int) -> list[int]:
    """The subset of ``indices`` of the ``most`` most powerful emitters, in order."""
    if len(indices) <= most:
        return indices
    powers = [power(emitters[k]) for k in indices]
    order = np.argsort(powers, kind="stable")[::-1][:most]
    return sorted(indices[k] for k in order)


def power(emitter: mi.Emitter) -> float:
    """An estimate of the power that an emitter sends into the scene."""
    random = np.random.default_rng(0).random((5, POWER_RAYS), dtype=np.float32)
    _, weight = emitter.sample_ray(
        0.0, mi.Float(random[0]), mi.Point2f(random[1:3]), mi.Point2f(random[3:5])
    )
    weight = mi.unpolarized_spectrum(weight)
    total = np.nan_to_num(np.array(dr.mean(weight)), posinf=0)
    return float(np.mean(total))


def extent(emitter: mi.Emitter) -> tuple[np.ndarray, np.ndarray] | None:
    """The centre of an emitter's surface (3), and three vectors (the rows, 3×3) whose outer
    products add up to the covariance of its points, as they are seen from afar.

    None for an emitter without a surface, or without a finite one.
    """
    shape = emitter.get_shape()
    if shape is None:
        return None
    box = shape.bbox()
    if shape.class_name() == "Sphere":
        centre = 0.5 * (np.array(box.min) + np.array(box.max))
        radius = 0.5 * (np.array(box.max) - np.array(box.min))
        # From afar a sphere is a disk. The variance of its points is a quarter of the squared
        # radius.
        return centre, np.diag(0.5 * radius)
    u, v = (g.ravel() for g in np.meshgrid(*[(np.arange(EXTENT_POINTS) + 0.5) / EXTENT_POINTS] * 2))
    sample = mi.Point2f(u.astype(np.float32), v.astype(np.float32))
    points = np.array(shape.sample_position(0.0, sample).p, dtype=np.float64)
    if not np.all(np.isfinite(points)):
        return None
    centre = points.mean(axis=1)
    values, vectors = np.linalg.eigh(np.cov(points))
    return centre, (vectors * np.sqrt(np.maximum(values, 0))).T
