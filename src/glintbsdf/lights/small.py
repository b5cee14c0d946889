"""Small lights: those that are asked at every hit, and integrated by the BSDF itself.

A light of angular covariance Σ_ω about its centre is split as a pixel is (notes in
:mod:`~glintbsdf.footprint.pixel_filter`): a share of Σ_ω becomes a spread of normals, over which a
P-NDF averages in closed form, and the rest is sampled, by directions to points of the light that
are contracted towards its centre. Visibility and radiance are those of the points themselves, so
that a light that is textured, or hidden in part, keeps its mean.
"""

from __future__ import annotations

from dataclasses import dataclass

import drjit as dr
import mitsuba as mi
import numpy as np

#: So many emitters are asked at every hit, at most: those of the greatest power. Of the others, one
#: chosen at random.
MOST = 16

#: Standard deviation of directions (radians) up to which a light is small: that of a disk of 0.5.
#: Wider ones are found by BSDF sampling as well as by themselves.
SMALL = 0.25

#: Emitters up to which it pays to look at all of them to save a BSDF sample.
FEW = 8

#: Rays by which the power of an emitter is estimated.
POWER_RAYS = 64

#: Points by which the extent of an emitter of any shape is measured, along each axis.
EXTENT_POINTS = 32


@dataclass
class View:
    """A light as it is seen from a place.

    Attributes:
        d (mi.Vector3f): unit direction to its centre.
        x, y (mi.Vector3f): unit vectors across d, the principal axes of its directions.
        variance_x, variance_y (mi.Float): variances of its directions along these, radians².
        small (mi.Bool): whether it has extent, and both variances are below :data:`SMALL` squared.
    """

    d: mi.Vector3f
    x: mi.Vector3f
    y: mi.Vector3f
    variance_x: mi.Float
    variance_y: mi.Float
    small: mi.Bool

    def spread(self, share: mi.Float) -> mi.Float:
        """The variance (radians²) that a share of the light has in every direction: of a stretched
        light no more than its lesser axis has. Zero for a light that is not small."""
        return dr.select(self.small, share * dr.minimum(self.variance_x, self.variance_y), 0)

    def contracted(self, d: mi.Vector3f, spread: mi.Float) -> mi.Vector3f:
        """The direction ``d`` to a point of the light, moved towards the centre so far that
        directions vary by ``spread`` less."""
        offset = d - self.d
        x, y = dr.dot(offset, self.x), dr.dot(offset, self.y)
        for axis, along, variance in ((self.x, x, self.variance_x), (self.y, y, self.variance_y)):
            left = dr.safe_sqrt(1 - spread / dr.maximum(variance, 1e-20))
            offset = offset + axis * (along * (left - 1))
        return dr.select(spread > 0, dr.normalize(self.d + offset), d)


class SmallLights:
    """The emitters of a scene: those asked at every hit, and the others.

    Args:
        scene (mi.Scene): the scene.
        every (bool): whether emitters are asked at every hit, :data:`MOST` at most; else none is.
        extents (bool): whether the lights' extents are of interest; else none is small.

    Attributes:
        asked (mi.EmitterPtr): the emitters asked at every hit, ``asked_count`` of them.
        others (mi.EmitterPtr): those of which one is chosen, in proportion to their
            ``sampling_weight``; ``others_count`` of them.
    """

    def __init__(self, scene: mi.Scene, every: bool = True, extents: bool = True) -> None:
        emitters = scene.emitters()
        pointers = scene.emitters_dr()
        weights = np.array([emitter.sampling_weight() for emitter in emitters])
        bounded = [
            k for k, emitter in enumerate(emitters) if not emitter.is_environment() and weights[k]
        ]
        strongest = most_powerful(emitters, bounded, MOST) if every or extents else []
        asked = strongest if every else []
        others = [k for k in range(len(emitters)) if k not in asked and weights[k]]
        self.asked_count, self.others_count, self.extents = len(asked), len(others), extents

        def chosen(indices):
            return dr.gather(mi.EmitterPtr, pointers, mi.UInt32(indices)) if indices else None

        self.asked, self.others = chosen(asked), chosen(others)
        if others:
            self.distribution = mi.DiscreteDistribution(mi.Float(weights[others]))

        # What is known of an emitter is found by its number in Mitsuba's registry; 0 is none.
        names = mi.UInt32(dr.reinterpret_array(mi.UInt32, pointers)).numpy().astype(int)
        size = names.max(initial=0) + 1
        probability, small = np.zeros(size, np.float32), np.zeros(size, bool)
        centre, axes = np.zeros((size, 3), np.float32), np.zeros((size, 3, 3), np.float32)
        delta = np.array(
            [bool(emitter.flags() & mi.EmitterFlags.Delta) for emitter in emitters], bool
        )
        probability[names[asked]] = 1
        probability[names[others]] = weights[others] / max(weights[others].sum(), 1e-30)
        for k in strongest if extents else []:
            found = extent(emitters[k])
            if found is not None:
                small[names[k]] = True
                centre[names[k]], axes[names[k]] = found
        self.probability = mi.Float(probability)
        self.extended = mi.Bool(small)
        #: Whether all emitters are asked, and all of them may be small: then BSDF sampling finds
        #: none that emitter sampling does not.
        self.complete = every and not others and bool(np.all(small[names[asked]] | delta[asked]))
        self.centre = mi.Float(centre.ravel())
        self.axes = mi.Float(axes.ravel())

    def all_small(self, p: mi.Point3f) -> mi.Bool:
        """Where, seen from ``p``, no emitter is left for BSDF sampling: all are small or points."""
        if not self.complete or self.asked_count > FEW:
            return mi.Bool(False)
        result = mi.Bool(True)
        for k in range(self.asked_count):
            emitter = dr.gather(mi.EmitterPtr, self.asked, mi.UInt32(k))
            name = self.name(emitter)
            extended = dr.gather(mi.Bool, self.extended, name)
            result &= self.view(emitter, p).small | ~extended
        return result

    def name(self, emitter: mi.EmitterPtr) -> mi.UInt32:
        """The number by which an emitter is looked up; 0 where there is none."""
        return dr.reinterpret_array(mi.UInt32, emitter)

    def choose(
        self, random: mi.Point2f, active: bool | mi.Bool = True
    ) -> tuple[mi.EmitterPtr, mi.Float, mi.Point2f]:
        """Choose one of the ``others``: the emitter, its probability, and what is left of
        ``random`` to sample it with."""
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
        if self.asked_count == 0:
            return scene.pdf_emitter_direction(si, ds, active)
        probability = dr.gather(mi.Float, self.probability, self.name(ds.emitter), active)
        return ds.emitter.pdf_direction(si, ds, active) * probability

    def view(self, emitter: mi.EmitterPtr, p: mi.Point3f, active: bool | mi.Bool = True) -> View:
        """How an emitter is seen from ``p``."""
        name = self.name(emitter)
        small = dr.gather(mi.Bool, self.extended, name, active)
        to_centre = dr.gather(mi.Vector3f, self.centre, name, active) - mi.Vector3f(p)
        distance = dr.norm(to_centre)
        small &= distance > 0
        inverse = dr.select(small, dr.rcp(distance), 0)
        d = dr.select(small, to_centre * inverse, mi.Vector3f(0, 0, 1))
        s, t = mi.coordinate_system(d)
        xx, xy, yy = mi.Float(0), mi.Float(0), mi.Float(0)
        for k in range(3):
            axis = dr.gather(mi.Vector3f, self.axes, 3 * name + k, active) * inverse
            x, y = dr.dot(axis, s), dr.dot(axis, t)
            xx, xy, yy = dr.fma(x, x, xx), dr.fma(x, y, xy), dr.fma(y, y, yy)
        half = 0.5 * (xx - yy)
        radius = dr.safe_sqrt(dr.fma(half, half, xy * xy))
        mean = 0.5 * (xx + yy)
        # The greater axis, by the half angle of (half, xy); any axis of a round light.
        angle = 0.5 * dr.atan2(xy, half)
        sine, cosine = dr.sincos(angle)
        small &= (mean + radius < SMALL**2) & (mean - radius > 0)
        return View(
            d,
            s * cosine + t * sine,
            t * cosine - s * sine,
            mean + radius,
            dr.maximum(mean - radius, 0),
            small,
        )


def most_powerful(emitters: list, indices: list[int], most: int) -> list[int]:
    """Of the emitters with these indices the ``most`` of the greatest power, in their order."""
    if len(indices) <= most:
        return indices
    powers = [power(emitters[k]) for k in indices]
    order = np.argsort(powers, kind="stable")[::-1][:most]
    return sorted(indices[k] for k in order)


def power(emitter: mi.Emitter) -> float:
    """The power that an emitter sends into the scene, by an estimate."""
    random = np.random.default_rng(0).random((5, POWER_RAYS), dtype=np.float32)
    _, weight = emitter.sample_ray(
        0.0, mi.Float(random[0]), mi.Point2f(random[1:3]), mi.Point2f(random[3:5])
    )
    weight = mi.unpolarized_spectrum(weight)
    total = np.nan_to_num(np.array(dr.mean(weight)), posinf=0)
    return float(np.mean(total))


def extent(emitter: mi.Emitter) -> tuple[np.ndarray, np.ndarray] | None:
    """The centre of an emitter's surface (3), and three vectors (3×3, rows) whose outer products
    add up to the covariance of its points as they are seen from afar.

    None where there is no surface, or no finite one.
    """
    shape = emitter.get_shape()
    if shape is None:
        return None
    box = shape.bbox()
    if shape.class_name() == "Sphere":
        centre = 0.5 * (np.array(box.min) + np.array(box.max))
        radius = 0.5 * (np.array(box.max) - np.array(box.min))
        # From afar a sphere is a disk, whose points have a quarter of the squared radius.
        return centre, np.diag(0.5 * radius)
    u, v = (g.ravel() for g in np.meshgrid(*[(np.arange(EXTENT_POINTS) + 0.5) / EXTENT_POINTS] * 2))
    sample = mi.Point2f(u.astype(np.float32), v.astype(np.float32))
    points = np.array(shape.sample_position(0.0, sample).p, dtype=np.float64)
    if not np.all(np.isfinite(points)):
        return None
    centre = points.mean(axis=1)
    values, vectors = np.linalg.eigh(np.cov(points))
    return centre, (vectors * np.sqrt(np.maximum(values, 0))).T
