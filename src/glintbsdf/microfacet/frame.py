"""Directions, half vectors and projected normals in the local shading frame.

Directions are unit vectors, pointing away from the surface.
"""

from __future__ import annotations

import drjit as dr
import mitsuba as mi


def above_horizon(active: mi.Bool, *directions: mi.Vector3f) -> tuple:
    """``(active, *directions)``, active only in lanes whose directions are all above the horizon.

    In other lanes all directions become the vertical, for which all results are finite: a NaN in a
    lane that is masked away would still reach its derivatives. The ``bumpmap`` of Mitsuba 3.9
    passes NaN where its relief is level and dp_du is the z axis; the NaN need not be in the z
    component.
    """
    active = mi.Bool(active)
    for direction in directions:
        active &= (mi.Frame3f.cos_theta(direction) > 0) & dr.isfinite(direction.x)
    return active, *(dr.select(active, d, mi.Vector3f(0, 0, 1)) for d in directions)


def half_vector(wi: mi.Vector3f, wo: mi.Vector3f) -> mi.Vector3f:
    """The microfacet normal that reflects ``wi`` to ``wo``; not finite where they are opposite."""
    return dr.normalize(wi + wo)


def normal_from_projection(s: mi.Vector2f) -> mi.Vector3f:
    """The unit normal whose projection on the disk is ``s``; z = 0 on the rim and outside."""
    return mi.Vector3f(s.x, s.y, dr.safe_sqrt(1 - dr.squared_norm(s)))
