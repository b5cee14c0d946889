"""How a light looks from a point: its direction, and its extent."""

from __future__ import annotations

from dataclasses import dataclass

import drjit as dr
import mitsuba as mi

#: A light is small if the standard deviation of the directions to it (radians) is at most this: a
#: disk with a radius of 0.5 radians. Larger lights are sampled by the emitter and by the BSDF.
MAX_DEVIATION = 0.25


@dataclass
class View:
    """A light as it is seen from a point.

    Attributes:
        d (mi.Vector3f): unit direction to its centre.
        x, y (mi.Vector3f): unit vectors perpendicular to d, the principal axes of the directions to
            the light.
        variance_x, variance_y (mi.Float): variances of these directions along x and y, radians².
        small (mi.Bool): whether the light has extent, and both variances are below the square of
            :data:`MAX_DEVIATION`.
        elliptic (mi.Bool): whether it looks like a uniform ellipse.
    """

    d: mi.Vector3f
    x: mi.Vector3f
    y: mi.Vector3f
    variance_x: mi.Float
    variance_y: mi.Float
    small: mi.Bool
    elliptic: mi.Bool

    def spread(self, share: mi.Float) -> mi.Float:
        """The isotropic variance (radians²) that the BSDF integrates: the ``share`` of the smaller
        variance of the light. It is 0 for a light that is not small."""
        return dr.select(self.small, share * dr.minimum(self.variance_x, self.variance_y), 0)

    def contracted(self, d: mi.Vector3f, spread: mi.Float) -> mi.Vector3f:
        """The direction ``d`` to a point of the light, contracted towards the centre, so that the
        variance of directions is smaller by ``spread`` (radians²)."""
        offset = d - self.d
        x, y = dr.dot(offset, self.x), dr.dot(offset, self.y)
        for axis, along, variance in ((self.x, x, self.variance_x), (self.y, y, self.variance_y)):
            factor = dr.safe_sqrt(1 - spread / dr.maximum(variance, 1e-20))
            offset = offset + axis * (along * (factor - 1))
        return dr.select(spread > 0, dr.normalize(self.d + offset), d)
