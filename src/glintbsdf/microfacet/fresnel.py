"""Fresnel reflectance as Mueller matrices: what a facet does to the polarisation of light.

Directions are unit vectors in the local shading frame, pointing away from the surface.
"""

from __future__ import annotations

import drjit as dr
import mitsuba as mi


def mueller_reflection(
    index: list[mi.Complex2f],
    tint: mi.UnpolarizedSpectrum,
    mode: mi.TransportMode,
    wi: mi.Vector3f,
    wo: mi.Vector3f,
    m: mi.Vector3f,
) -> mi.Spectrum:
    """Mueller matrix (4×4 of spectra) of the reflection from a facet with normal ``m``.

    It acts on Stokes vectors in Mitsuba's implicit bases of the light's directions of propagation:
    arriving along ``-wo`` and leaving along ``wi`` when radiance is transported, the reverse for
    importance. Every entry is multiplied by ``tint``.
    """
    if mode == mi.TransportMode.Importance:
        wi, wo = wo, wi
    cos_theta = dr.dot(wo, m)
    channels = [mi.mueller.specular_reflection(cos_theta, n) for n in index]
    reflection = mi.Spectrum(
        [
            [
                mi.UnpolarizedSpectrum(
                    [t * channel[row][column] for t, channel in zip(tint, channels, strict=True)]
                )
                for column in range(4)
            ]
            for row in range(4)
        ]
    )

    # The matrix refers to the s axes, normal to the plane of incidence; at normal incidence, where
    # there is no such plane, any axis will do.
    s_in, s_out = dr.cross(m, -wo), dr.cross(m, wi)
    collinear = dr.squared_norm(s_in) == 0
    s_in = dr.select(collinear, mi.Vector3f(1, 0, 0), dr.normalize(s_in))
    s_out = dr.select(collinear, mi.Vector3f(1, 0, 0), dr.normalize(s_out))
    return mi.mueller.rotate_mueller_basis(
        reflection, -wo, s_in, mi.mueller.stokes_basis(-wo), wi, s_out, mi.mueller.stokes_basis(wi)
    )
