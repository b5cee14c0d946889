"""Data that an integrator passes to a glint BSDF besides the footprint: H of the half vector, and
the extent of a light.

Through Mitsuba's wrappers (``twosided``, ``normalmap``, ``blendbsdf`` …) only the fields of the
surface interaction reach a BSDF. BSDFs do not use the derivatives of the normal, ``dn_du`` and
``dn_dv``, and Mitsuba's own integrators leave them at zero. Here they carry, for one evaluation:

* the turn of the half vector, as two vectors w_u and w_v of world space: with e a tangent of the
  shading frame, e·w_u is the change of the half vector's component along e per unit of u, the
  frame's own turn included. So nested frames find what they need. The component of w along the
  geometric normal has no effect, and is removed;
* along the geometric normal, the logarithm of the light's variance, and a mark that all this is
  not the derivative of a normal. The normal is perpendicular to its derivatives, so there is room.

Bits of the flags that Mitsuba does not use mark such BSDFs. Wrappers unite the flags of the BSDFs
inside, so they have these bits, too.
"""

from __future__ import annotations

from dataclasses import dataclass

import drjit as dr
import mitsuba as mi

from glintbsdf.footprint.gaussian import is_literal_zero

#: Bits of ``BSDFFlags``, of BSDFs that integrate lights, of all that average over footprints, and
#: of those whose own samples alone look for an environment; those of Mitsuba 3.9 end at bit 16.
INTEGRATES_LIGHTS = 1 << 30
HAS_FOOTPRINT = 1 << 29
FINDS_ENVIRONMENT = 1 << 28

#: The component along the normal of ``dn_dv`` if the interaction carries data.
MARK = 1.0

#: A variance (radians²) that counts as none.
NO_VARIANCE = 2.0**-60


@dataclass(frozen=True)
class Carried:
    """The data that a surface interaction carries.

    Attributes:
        w_u, w_v (mi.Vector3f): turn of the half vector, world space, per unit of u and of v.
        variance (mi.Float): of the light's directions about the evaluated one, in every
            direction across it, radians².
    """

    w_u: mi.Vector3f
    w_v: mi.Vector3f
    variance: mi.Float

    def put(self, si: mi.SurfaceInteraction3f) -> mi.SurfaceInteraction3f:
        """A copy of ``si`` that carries this."""
        result = mi.SurfaceInteraction3f(si)
        cosine = dr.dot(si.n, si.sh_frame.n)
        oblique = si.sh_frame.n / dr.select(dr.abs(cosine) > 1e-3, cosine, 1)
        w_u, w_v = (w - oblique * dr.dot(mi.Vector3f(si.n), w) for w in (self.w_u, self.w_v))
        w_u, w_v = (dr.select(dr.all(dr.isfinite(w)), w, 0) for w in (w_u, w_v))
        result.dn_du = w_u + si.n * dr.log2(dr.maximum(self.variance, NO_VARIANCE))
        result.dn_dv = w_v + si.n * MARK
        return result

    @staticmethod
    def of(si: mi.SurfaceInteraction3f) -> Carried | None:
        """The data that ``si`` carries; None if it is known while a kernel is recorded that it
        carries nothing. Lanes that carry nothing at run time have a turn and a variance of 0."""
        if all(is_literal_zero(x) for x in si.dn_dv):
            return None
        normal = mi.Vector3f(si.n)
        mark, logarithm = dr.dot(normal, si.dn_dv), dr.dot(normal, si.dn_du)
        present = dr.abs(mark - MARK) < 1e-2
        variance = dr.select(present, dr.exp2(logarithm), 0)
        return Carried(
            dr.select(present, si.dn_du - si.n * logarithm, 0),
            dr.select(present, si.dn_dv - si.n * mark, 0),
            dr.select(variance > 2 * NO_VARIANCE, variance, 0),
        )

    def turn(self, si: mi.SurfaceInteraction3f) -> mi.Matrix2f:
        """H in the shading frame of ``si``, per unit of its UV coordinates."""
        s, t = si.sh_frame.s, si.sh_frame.t
        return mi.Matrix2f(
            [
                [dr.dot(s, self.w_u), dr.dot(s, self.w_v)],
                [dr.dot(t, self.w_u), dr.dot(t, self.w_v)],
            ]
        )

    def spread(self, wi: mi.Vector3f, wo: mi.Vector3f) -> tuple[mi.Vector2f, mi.Vector2f]:
        """Two vectors whose products add up to the covariance of projected half vectors, for the
        local directions ``wi`` and ``wo``, the latter towards the light.

        With m = (ω_i + ω_o)/|ω_i + ω_o|, dm = (I − m mᵀ) dω_o/|ω_i + ω_o|.
        """
        m, inverse = half_vector(wi, wo)
        scale = dr.sqrt(self.variance) * inverse
        return tuple(
            mi.Vector2f(v.x, v.y) * scale
            for v in (axis - m * dr.dot(m, axis) for axis in mi.coordinate_system(wo))
        )

    def shift(self, wi: mi.Vector3f, wo: mi.Vector3f) -> mi.Vector2f:
        """The vector from the projected half vector of the light's centre to the mean of the
        light's.

        The half vector is not linear in ω_o. Under a light of 0.2 radians this shift changes
        densities by some hundredths. Four points of the light stand for it, as they have its
        covariance.
        """
        step, shift = dr.sqrt(2 * self.variance), -half_vector(wi, wo)[0]
        for axis in mi.coordinate_system(wo):
            for sign in (1, -1):
                point = dr.normalize(wo + sign * step * axis)
                shift = shift + 0.25 * half_vector(wi, point)[0]
        return dr.select(self.variance > 0, mi.Vector2f(shift.x, shift.y), 0)


def half_vector(wi: mi.Vector3f, wo: mi.Vector3f) -> tuple[mi.Vector3f, mi.Float]:
    """m = (ω_i + ω_o)/|ω_i + ω_o|, and 1/|ω_i + ω_o|; finite where the two are opposite."""
    h = wi + wo
    inverse = dr.rcp(dr.maximum(dr.norm(h), 1e-6))
    return h * inverse, inverse


def half_vector_turn(
    si: mi.SurfaceInteraction3f,
    wo: mi.Vector3f,
    dwi_du: mi.Vector3f,
    dwi_dv: mi.Vector3f,
    inverse_distance: mi.Float,
) -> tuple[mi.Vector3f, mi.Vector3f]:
    """w_u and w_v of :class:`Carried`, for a mirror between ``si.wi`` and ``wo``.

    s = (m·e₁, m·e₂) changes with m, and as the frame turns along with the normal n, de = −(e·dn) n:
    ds = e·(dm − (m·n) dn), with dm = (I − m mᵀ)(dω_i + dω_o)/|ω_i + ω_o|. The frame's rotation
    about the normal is left out; it is of second order where m is near n.

    Args:
        si: with ``dn_du``, ``dn_dv`` the derivatives of the shading normal.
        wo: unit direction to the light, world space.
        dwi_du, dwi_dv: change of the direction to the viewer per unit of u and of v, world space.
        inverse_distance: of the light; 0 for one at infinity.
    """
    wi = si.to_world(si.wi)
    m, inverse = half_vector(wi, wo)
    cosine = dr.dot(m, mi.Vector3f(si.sh_frame.n))
    result = []
    for dwi, dp, dn in ((dwi_du, si.dp_du, si.dn_du), (dwi_dv, si.dp_dv, si.dn_dv)):
        dwo = (wo * dr.dot(wo, dp) - dp) * inverse_distance
        dh = (dwi + dwo) * inverse
        result.append(dh - m * dr.dot(m, dh) - dn * cosine)
    return tuple(result)
