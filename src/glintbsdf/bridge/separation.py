"""Separated illumination: glints in direct light, a smooth lobe of equal roughness in all other.

Light that has been scattered before arrives from many directions at once, so that glints
would add only noise to its reflection (Tan et al. 2022, section 4). An
integrator may therefore ask glint BSDFs for their smooth counterpart:

    smooth = smooth_context()
    value = bsdf.eval(smooth, si, wo)  # a BSDF of Mitsuba takes it for its ordinary context

The request is a bit of ``BSDFContext.type_mask`` that none of Mitsuba's ``BSDFFlags`` uses.
Mitsuba's BSDFs test their own bits only, and ``twosided``, ``normalmap``, ``bumpmap``,
``blendbsdf`` and ``mask`` pass the context on, so it reaches a glint BSDF wherever it is nested.
The context is known while a kernel is recorded, so a kernel contains the code of one lobe only.
"""

from __future__ import annotations

import mitsuba as mi

#: The highest bit of the mask; ``BSDFFlags`` ends at bit 16 in Mitsuba 3.9.
SMOOTH_LOBES = 1 << 31


def smooth_context() -> mi.BSDFContext:
    """A context for all components, in which glint BSDFs are to use their smooth lobe."""
    ctx = mi.BSDFContext()
    ctx.type_mask |= SMOOTH_LOBES
    return ctx


def asks_for_smooth_lobes(ctx: mi.BSDFContext) -> bool:
    """Whether ``ctx`` comes from :func:`smooth_context`."""
    return bool(ctx.type_mask & SMOOTH_LOBES)
